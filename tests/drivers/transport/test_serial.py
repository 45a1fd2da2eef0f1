"""The serial transport on pseudo-terminals."""

import re
import socket
import termios
import time

import pytest
import serial

from drivers.transport.reconnecting import BackoffPolicy, ReconnectingTransport, TransportCounters
from drivers.transport.serial import WRITE_TIMEOUT_S, SerialMedium, open_port, request_low_latency
from drivers.types import Frame, LinkState
from firmware_protocol.serial_framing import FrameDecoder, encode_frame
from tests.drivers.transport.pseudo_terminal import PseudoTerminal
from tests.drivers.waiting import collect, median_send_s, outgoing, send, wait_until

FAST = BackoffPolicy(first_s=0.01, longest_s=0.05, steady_s=0.1)
FRAME = Frame(0x110, bytes(range(8)))
LINE = encode_frame(FRAME.can_id, FRAME.data)


@pytest.fixture
def terminal():
    terminal = PseudoTerminal()
    yield terminal
    terminal.remove()


@pytest.fixture
def transport(terminal):
    transport = ReconnectingTransport(SerialMedium(str(terminal.path), 115_200), backoff=FAST)
    transport.open()
    wait_until(lambda: transport.state is LinkState.UP)
    yield transport
    transport.close()


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


def test_half_a_frame_of_an_earlier_program_does_not_spoil_our_first(terminal):
    """The receiving end holds what was written before; our first byte on a new line ends it."""
    transport = ReconnectingTransport(SerialMedium(str(terminal.path), 115_200), backoff=FAST)
    terminal.received.extend(LINE[:6])
    transport.open()
    try:
        wait_until(lambda: transport.state is LinkState.UP)
        send(transport, outgoing(0x100, b"\x01"))
        wait_until(lambda: decoded(terminal) == [(0x100, b"\x01")])
        send(transport, outgoing(0x100, b"\x02"))
        wait_until(lambda: terminal.received.endswith(encode_frame(0x100, b"\x01") + encode_frame(0x100, b"\x02")))
    finally:
        transport.close()


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


def test_an_adapter_that_comes_back_under_another_number_is_found_by_its_lasting_name(tmp_path):
    """The old number belongs to another device meanwhile, which is open, says nothing, and never fails."""
    before, after = PseudoTerminal(), PseudoTerminal()
    by_id = tmp_path / "usb-FTDI_A10K3X-if00"
    by_id.symlink_to(before.path)
    transport = ReconnectingTransport(SerialMedium(str(by_id), 115_200), backoff=FAST, mute_after_s=0.3)
    transport.open()

    def frames_from(terminal):
        # Again and again: a host that pauses makes the line mute, and what was on it is gone.
        return wait_until(lambda: terminal.write(LINE) or transport.receive())

    try:
        wait_until(lambda: transport.state is LinkState.UP)
        assert frames_from(before)[-1].frame == FRAME
        generation = transport.generation
        by_id.unlink()
        by_id.symlink_to(after.path)
        wait_until(lambda: transport.generation > generation)
        assert re.search(r"no frame received for 0\.[36] s", transport.last_error)
        assert "/dev/serial/by-id" in transport.last_error
        assert frames_from(after)[-1].frame == FRAME
        wait_until(lambda: transport.last_error is None)
    finally:
        transport.close()
        before.remove()
        after.remove()


def test_bytes_that_are_no_frames_do_not_count_as_an_answer(terminal):
    transport = ReconnectingTransport(SerialMedium(str(terminal.path), 115_200), backoff=FAST, mute_after_s=0.3)
    transport.open()

    def reopened():
        terminal.write(b"$GPGGA,,,\r\n\0")
        return transport.generation >= 2

    try:
        wait_until(reopened)
    finally:
        transport.close()


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


def test_both_lines_are_low_unless_robot_toml_says_otherwise(terminal):
    """At the seam to the kernel, as pseudo-terminals have no such lines: which are set, and which are cleared."""
    line_states = []

    class Port(serial.Serial):
        def _update_dtr_state(self):
            line_states.append(("dtr", self._dtr_state))

        def _update_rts_state(self):
            line_states.append(("rts", self._rts_state))

    port = SerialMedium(str(terminal.path), 115_200)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(serial, "Serial", Port)
        port.connect(TransportCounters()).close()
    assert set(line_states) == {("dtr", False), ("rts", False)}


class FtdiPort:
    """Stands for an adapter that can hold received bytes back, or for one that says in some way that it cannot."""

    def __init__(self, error=None):
        self.low_latency = False
        self.error = error

    def set_low_latency_mode(self, enabled):
        if self.error is not None:
            raise self.error
        self.low_latency = enabled


def test_an_adapter_that_holds_bytes_back_is_set_not_to():
    port = FtdiPort()
    request_low_latency(port)
    assert port.low_latency


@pytest.mark.parametrize("error", [ValueError("no such mode"), OSError(25, "ENOTTY"), NotImplementedError("not here")])
def test_a_port_without_low_latency_is_used_as_it_is(error):
    request_low_latency(FtdiPort(error))
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
    transport = ReconnectingTransport(SerialMedium(listener.url, 115_200), backoff=FAST)
    transport.open()
    try:
        for generation in (1, 2):
            listener.accept()
            wait_until(lambda: transport.state is LinkState.UP and transport.generation == generation)  # noqa: B023
            listener.peer.sendall(LINE[:5])
            time.sleep(0.002)
            listener.peer.sendall(LINE[5:] + LINE)
            assert [received.frame for received in collect(transport, 2)] == [FRAME, FRAME]
            send(transport, outgoing(0x100, b"\x02"))
            wait_until(lambda: listener.received() == [(0x100, b"\x02")])
            listener.peer.close()
        assert transport.stats.malformed == 0
    finally:
        transport.close()


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
