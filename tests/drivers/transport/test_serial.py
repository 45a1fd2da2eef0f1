"""The serial transport on pseudo-terminals."""

import re
import socket
import termios
import time
from contextlib import closing
from unittest.mock import Mock

import pytest
import serial

from drivers.transport.reconnecting import TransportCounters
from drivers.transport.serial import WRITE_TIMEOUT_S, SerialMedium, open_port, request_low_latency
from drivers.types import Frame, LinkState
from firmware_protocol.serial_framing import FrameDecoder, encode_frame
from tests.drivers.transport.links import opened, up
from tests.drivers.transport.pseudo_terminal import PseudoTerminal
from tests.drivers.waiting import collect, median_send_s, outgoing, send, wait_until

FRAME = Frame(0x110, bytes(range(8)))
LINE = encode_frame(FRAME.can_id, FRAME.data)


@pytest.fixture
def medium(terminal):
    return SerialMedium(str(terminal.path), 115_200)


@pytest.fixture
def transport(medium):
    with opened(medium) as transport:
        up(transport)
        yield transport


def decoded(terminal):
    return FrameDecoder().feed(bytes(terminal.received))


def test_frames_both_ways(transport, terminal):
    before_ns = time.monotonic_ns()
    terminal.write(LINE)
    (received,) = collect(transport, 1)
    assert received.frame == FRAME
    assert before_ns <= received.t_ns <= time.monotonic_ns()
    send(transport, outgoing(0x080, b""), outgoing(0x100, b"\x00\xff\x00"))
    wait_until(lambda: decoded(terminal) == [(0x080, b""), (0x100, b"\x00\xff\x00")])


def test_the_line_is_set_up_as_asked(transport, terminal):
    attributes = termios.tcgetattr(terminal._master)
    assert attributes[4] == attributes[5] == termios.B115200
    assert attributes[2] & termios.CSIZE == termios.CS8
    assert not attributes[2] & (termios.PARENB | termios.CSTOPB | termios.CRTSCTS)


@pytest.mark.parametrize("cut", range(1, len(LINE)))
def test_a_frame_cut_anywhere(transport, terminal, cut):
    terminal.write(LINE[:cut])
    time.sleep(0.002)
    terminal.write(LINE[cut:] + LINE)
    assert [received.frame for received in collect(transport, 2)] == [FRAME, FRAME]
    assert transport.stats.malformed == 0


def test_garbage_is_counted_and_the_next_frame_is_whole(transport, terminal):
    corrupt = bytearray(LINE)
    corrupt[4] ^= 0x10
    terminal.write(b"\xff\x80\xfe" * 100 + b"\0" + bytes(corrupt) + LINE[3:] + LINE)
    assert [received.frame for received in collect(transport, 1)] == [FRAME]
    assert transport.stats.malformed == 3
    terminal.write(b"\x01\x02\0" + LINE)
    collect(transport, 1)
    assert transport.stats.malformed == 4
    assert transport.generation == 1


def test_half_a_frame_of_an_earlier_program_does_not_spoil_our_first(terminal, medium):
    """The receiving end holds what was written before; our first byte on a new line ends it."""
    terminal.received.extend(LINE[:6])
    with opened(medium) as transport:
        up(transport)
        send(transport, outgoing(0x100, b"\x01"))
        wait_until(lambda: decoded(terminal) == [(0x100, b"\x01")])
        send(transport, outgoing(0x100, b"\x02"))
        wait_until(lambda: terminal.received.endswith(encode_frame(0x100, b"\x01") + encode_frame(0x100, b"\x02")))


@pytest.mark.parametrize("cut", [0, 1, len(LINE) // 2, len(LINE) - 1])
def test_unplugged_within_a_frame_and_plugged_in_again(transport, terminal, cut):
    for generation in (2, 3):
        terminal.write(LINE[:cut])
        terminal.unplug()
        wait_until(lambda: transport.state is LinkState.CONNECTING and transport.last_error)
        assert not transport.send(outgoing(), time.monotonic_ns())
        wait_until(lambda: "no such device" in transport.last_error)
        terminal.plug()
        wait_until(lambda: transport.state is LinkState.UP and transport.generation == generation)  # noqa: B023
        terminal.write(LINE[cut:] + LINE)
        assert collect(transport, 1)[-1].frame == FRAME
        send(transport, outgoing(0x100, b"\x02"))
        wait_until(lambda: decoded(terminal) == [(0x100, b"\x02")])
    assert transport.stats.reconnects == 2
    assert transport.stats.receive_errors >= 2


def test_a_device_that_reads_nothing_blocks_nobody(transport, terminal):
    terminal.stop_reading()
    wait_until(lambda: median_send_s(transport) and transport.stats.expired and transport.stats.transmit_queue_full)
    assert median_send_s(transport) < WRITE_TIMEOUT_S / 2, "shorter by far than one write that waits for room"
    wait_until(lambda: median_send_s(transport) and "accepts no more bytes" in (transport.last_error or ""), 60.0)
    assert transport.state is LinkState.UP
    time.sleep(0.1)
    terminal.received.clear()
    terminal.read_on()
    wait_until(lambda: terminal.received)
    send(transport, outgoing(0x100, b"first after the jam"[:8]))
    wait_until(lambda: decoded(terminal)[-1] == (0x100, b"first after the jam"[:8]))


def test_an_adapter_that_comes_back_under_another_number_is_found_by_its_lasting_name(terminal, tmp_path):
    """The old number belongs to another device meanwhile, which is open, says nothing, and never fails."""
    by_id = tmp_path / "usb-FTDI_A10K3X-if00"
    by_id.symlink_to(terminal.path)

    def frames_from(terminal):
        # Again and again: a host that pauses makes the line mute, and what was on it is gone.
        return wait_until(lambda: terminal.write(LINE) or transport.receive())

    with (
        closing(PseudoTerminal()) as after,
        opened(SerialMedium(str(by_id), 115_200), mute_after_s=0.3) as transport,
    ):
        up(transport)
        assert frames_from(terminal)[-1].frame == FRAME
        generation = transport.generation
        by_id.unlink()
        by_id.symlink_to(after.path)
        wait_until(lambda: transport.generation > generation)
        assert re.search(r"no frame received for 0\.[36] s", transport.last_error)
        assert "/dev/serial/by-id" in transport.last_error
        assert frames_from(after)[-1].frame == FRAME
        wait_until(lambda: transport.last_error is None)


def test_bytes_that_are_no_frames_do_not_count_as_an_answer(terminal, medium):
    with opened(medium, mute_after_s=0.3) as transport:
        wait_until(lambda: terminal.write(b"$GPGGA,,,\r\n\0") or transport.generation >= 2)


@pytest.mark.parametrize(("dtr", "rts"), [(False, False), (True, False), (False, True)])
def test_the_lines_are_set_before_the_port_is_opened(terminal, monkeypatch, dtr, rts):
    seen = []
    really_open = serial.Serial.open

    def look(port):
        seen.append((port.dtr, port.rts, port.exclusive))
        really_open(port)

    monkeypatch.setattr(serial.Serial, "open", look)
    SerialMedium(str(terminal.path), 115_200, dtr, rts).connect(TransportCounters()).close()
    assert seen == [(dtr, rts, True)]


def test_both_lines_are_low_unless_robot_toml_says_otherwise(medium, monkeypatch):
    """At the seam to the kernel, as pseudo-terminals have no such lines: which are set, and which are cleared."""
    line_states = []

    class Port(serial.Serial):
        def _update_dtr_state(self):
            line_states.append(("dtr", self._dtr_state))

        def _update_rts_state(self):
            line_states.append(("rts", self._rts_state))

    monkeypatch.setattr(serial, "Serial", Port)
    medium.connect(TransportCounters()).close()
    assert set(line_states) == {("dtr", False), ("rts", False)}


def test_an_adapter_that_holds_bytes_back_is_set_not_to():
    port = Mock()
    request_low_latency(port)
    port.set_low_latency_mode.assert_called_once_with(True)


@pytest.mark.parametrize("error", [ValueError("no such mode"), OSError(25, "ENOTTY"), NotImplementedError("not here")])
def test_a_port_without_low_latency_is_used_as_it_is(error):
    request_low_latency(Mock(set_low_latency_mode=Mock(side_effect=error)))
    request_low_latency(object())


class Listener:
    """The far end of a serial line over a socket, as an emulator or a serial server has it: one peer, then the next."""

    def __init__(self, family, address):
        self.server = socket.socket(family)
        self.server.bind(address)
        self.server.listen()
        place = self.server.getsockname()
        self.url = f"unix://{place}" if family is socket.AF_UNIX else f"socket://127.0.0.1:{place[1]}"
        self.peer = None

    def accept(self):
        self.peer, _ = self.server.accept()

    def received(self):
        return FrameDecoder().feed(self.peer.recv(4096))

    def close(self):
        self.server.close()
        if self.peer is not None:
            self.peer.close()


@pytest.fixture(params=["unix", "tcp"])
def listener(request, tmp_path):
    unix = request.param == "unix"
    listener = Listener(socket.AF_UNIX, str(tmp_path / "line")) if unix else Listener(socket.AF_INET, ("127.0.0.1", 0))
    yield listener
    listener.close()


def test_a_line_over_a_socket_carries_frames_both_ways_and_comes_back(listener):
    with opened(SerialMedium(listener.url, 115_200)) as transport:
        for generation in (1, 2):
            listener.accept()
            up(transport, generation)
            listener.peer.sendall(LINE[:5])
            time.sleep(0.002)
            listener.peer.sendall(LINE[5:] + LINE)
            assert [received.frame for received in collect(transport, 2)] == [FRAME, FRAME]
            send(transport, outgoing(0x100, b"\x02"))
            wait_until(lambda: listener.received() == [(0x100, b"\x02")])
            assert transport.generation == generation
            listener.peer.close()
        assert transport.stats.malformed == 0


def test_what_waits_on_a_socket_is_read_at_once(listener):
    """The socket port of pyserial says that one byte waits, however many do: thousands of calls a second."""
    with open_port(SerialMedium(listener.url, 115_200), timeout_s=1.0, write_timeout_s=1.0, exclusive=True) as port:
        listener.accept()
        listener.peer.sendall(20 * LINE)
        assert port.read(1) == LINE[:1]
        assert port.in_waiting == 20 * len(LINE) - 1
        assert port.read(port.in_waiting) == (20 * LINE)[1:]
    assert not port.is_open
    with pytest.raises(serial.PortNotOpenError):
        assert port.in_waiting


def test_a_socket_at_which_nobody_listens_is_reported_in_one_line(listener):
    listener.close()
    medium = SerialMedium(listener.url, 115_200)
    with pytest.raises(serial.SerialException) as refused:
        medium.connect(TransportCounters())
    assert medium.explain(refused.value) == (
        f"{listener.url}: nothing listens there; start the serial server or the emulator, or correct the port"
    )
