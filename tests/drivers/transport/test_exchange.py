"""One request at a time on a real pseudo-terminal: whose reply is whose, and what becomes of those that do not come."""

import os
import threading
import time
import tty

import pytest

from drivers.motor import roboclaw_protocol as protocol
from drivers.motor.roboclaw_protocol import RoboclawExchange, query, setting
from drivers.transport.serial import SerialMedium
from drivers.types import Frame, LinkState, OutgoingFrame
from sim.devices.roboclaw import Roboclaw
from tests.drivers.transport.links import opened, up
from tests.drivers.waiting import collect, send, wait_until

ENCODERS, SPEEDS, STATUS = (query(0x80, name) for name in ("encoders", "speeds", "status"))
STOP = setting(0x80, "duty_m1m2", duty_m1=0, duty_m2=0)
# Thirty times what a board is given: on a host whose processors are all taken no reply is late here,
PATIENT = RoboclawExchange(timeout_s=1.0, quiet_s=0.2)
# unless a test has it come late, and then well within the quiet time.
LONG_QUIET = RoboclawExchange(timeout_s=1.0, quiet_s=0.8)


class Line:
    """A board at the far end of a pseudo-terminal.

    `spoil(request, reply)` says in pieces (pause_s, bytes) what of a reply is sent. `requests`: pieces of bytes as they
    came.
    """

    def __init__(self, directory):
        self.board, self.requests = Roboclaw(), []
        self.board.registers.encoder_m1, self.board.registers.speed_m1 = 11, 22
        self.spoil = lambda _request, reply: [(0.0, reply)]
        self.path = directory / "tty"
        self._ended = threading.Event()
        self._plug()

    def _plug(self):
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(self._slave))
        os.set_blocking(self._master, False)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def replug(self):
        self.close()
        os.close(self._master)
        os.close(self._slave)
        self._ended.clear()
        self._plug()

    def close(self):
        self._ended.set()
        self._thread.join()

    def _serve(self):
        while not self._ended.is_set():
            try:
                received = os.read(self._master, 4096)
            except OSError:
                self._ended.wait(0.001)
                continue
            self.requests.append(received)
            for pause_s, piece in self.spoil(received, self.board.receive(time.monotonic_ns() // 1000, received)):
                self._ended.wait(pause_s)
                os.write(self._master, piece)


@pytest.fixture
def line(tmp_path):
    line = Line(tmp_path)
    yield line
    line.close()


@pytest.fixture
def exchange():
    return PATIENT


@pytest.fixture
def transport(line, exchange, monkeypatch):
    # A write that this host cuts short by a pause counts as not taken, and its frame is sent once more.
    monkeypatch.setattr("drivers.transport.serial.WRITE_TIMEOUT_S", 10.0)
    with opened(SerialMedium(str(line.path), 115_200, exchange=exchange), carries_packets=True) as transport:
        up(transport)
        yield transport


def outgoing(*frames, rank=2):
    return [OutgoingFrame(frame, time.monotonic_ns() + 60_000_000_000, rank) for frame in frames]


def test_replies_come_in_the_order_of_the_questions_and_each_is_read_as_its_own(line, transport):
    send(transport, *outgoing(ENCODERS, SPEEDS, STATUS, STOP))
    replies = [received.frame for received in collect(transport, 4)]
    assert [reply.can_id for reply in replies] == [frame.can_id for frame in (ENCODERS, SPEEDS, STATUS, STOP)]
    assert protocol.reply(0x80, "encoders", replies[0].data)[0]["encoder_m1"] == 11
    assert protocol.reply(0x80, "speeds", replies[1].data)[0]["speed_m1"] == 22
    assert replies[3] == Frame(STOP.can_id, protocol.ACKNOWLEDGE)


def test_no_request_leaves_before_the_reply_to_the_one_before_is_whole(line, transport):
    """In pieces, with less than the quiet time between them."""
    line.spoil = lambda _request, reply: [(0.004, reply[:3]), (0.004, reply[3:7]), (0.004, reply[7:])]
    send(transport, *outgoing(ENCODERS, SPEEDS, ENCODERS))
    assert len(collect(transport, 3)) == 3
    assert line.requests == [ENCODERS.data, SPEEDS.data, ENCODERS.data]


@pytest.mark.parametrize("exchange", [LONG_QUIET])
def test_a_late_reply_is_nobodys(line, transport, exchange):
    pauses = iter((exchange.timeout_s + exchange.quiet_s / 2, 0.0, 0.0))
    line.spoil = lambda _request, reply: [(next(pauses), reply)]
    send(transport, *outgoing(ENCODERS, SPEEDS, STATUS))
    assert [received.frame.can_id for received in collect(transport, 2)] == [SPEEDS.can_id, STATUS.can_id]
    assert transport.stats.receive_errors == 1


@pytest.mark.parametrize(
    "spoilt",
    [
        pytest.param(lambda reply: reply[:-1] + bytes([reply[-1] ^ 1]), id="crc"),
        pytest.param(
            lambda reply: reply[:-2] + protocol.with_crc(b"\x81" + ENCODERS.data[1:] + reply[:-2])[-2:], id="address"
        ),
        pytest.param(lambda reply: reply[:5], id="cut"),
        pytest.param(lambda reply: b"\xff" + reply, id="behind-a-late-acknowledgement"),
    ],
)
def test_a_reply_that_does_not_fit_the_question_is_counted_and_the_next_is_whole(line, transport, spoilt):
    changes = iter((spoilt, lambda reply: reply))
    line.spoil = lambda _request, reply: [(0.0, next(changes)(reply))]
    send(transport, *outgoing(ENCODERS, SPEEDS))
    assert [received.frame.can_id for received in collect(transport, 1)] == [SPEEDS.can_id]
    assert transport.stats.malformed == 1


def test_a_board_that_is_silent_holds_up_the_others_for_a_moment_only(line, transport):
    silent = [query(0x81, "status")] * 3
    send(transport, *outgoing(*silent, STATUS))
    assert [received.frame.can_id for received in collect(transport, 1)] == [STATUS.can_id]
    assert transport.stats.receive_errors == 3


def test_a_stop_goes_before_what_waits(line, transport):
    all_wait = threading.Event()
    line.spoil = lambda _request, reply: [(0.0, reply)] * all_wait.wait(10.0)
    send(transport, *outgoing(*[ENCODERS] * 8), *outgoing(STOP, rank=0))
    all_wait.set()
    replies = [received.frame.can_id for received in collect(transport, 9)]
    assert replies.index(STOP.can_id) <= 1


def test_unplugged_and_plugged_in_it_goes_on(line, transport):
    send(transport, *outgoing(ENCODERS))
    collect(transport, 1)
    line.replug()

    def came_back():
        transport.send(*outgoing(SPEEDS), time.monotonic_ns())
        return transport.generation > 1 and transport.state is LinkState.UP

    wait_until(came_back)
    transport.receive()
    send(transport, *outgoing(ENCODERS))
    wait_until(lambda: any(received.frame.can_id == ENCODERS.can_id for received in transport.receive()))


def test_a_packet_that_is_longer_than_any_is_refused(line, transport):
    with pytest.raises(ValueError, match="not a classic CAN frame"):
        transport.send(*outgoing(Frame(1, bytes(513))), time.monotonic_ns())
