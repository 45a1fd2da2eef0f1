"""The CAN transport on Linux's SocketCAN; `make socketcan-test` runs this on a kernel that has it."""

import contextlib
import fcntl
import os
import pty
import select
import socket
import struct
import subprocess
import termios
import threading
import time
import tty
from contextlib import closing
from pathlib import Path

import can
import pytest

from drivers.transport import open_transport
from drivers.transport.can import CanMedium
from drivers.transport.reconnecting import LinkLostError, TransportCounters
from drivers.types import LinkState
from tests.drivers.waiting import collect, outgoing, send, wait_until

VCAN = "vcan0"
N_SLCAN = 17
ERROR_FLAG = 0x2000_0000
PATIENCE_S = 60.0

pytestmark = pytest.mark.skipif(not Path("/sys/class/net", VCAN).exists(), reason=f"no {VCAN}: make socketcan-test")


def ip(*arguments):
    subprocess.run(["ip", "link", *arguments], check=True, capture_output=True)


class RawSocket:
    """AF_CAN without any library: the other node on the bus."""

    def __init__(self, channel=VCAN):
        self.socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self.socket.bind((channel,))
        self.socket.settimeout(PATIENCE_S)

    def send(self, can_id, data=b""):
        self.socket.send(struct.pack("=IB3x8s", can_id, len(data), data))

    def receive(self):
        can_id, length, data = struct.unpack("=IB3x8s", self.socket.recv(16))
        return can_id, data[:length]


@pytest.fixture
def other():
    raw = RawSocket()
    yield raw
    raw.socket.close()


@pytest.fixture
def transport():
    ip("set", VCAN, "up")
    opened = open_transport("can", interface="socketcan", channel=VCAN)
    wait_until(lambda: opened.state is LinkState.UP, PATIENCE_S)
    yield opened
    opened.close()


def test_frames_go_to_and_fro_unchanged_and_in_order(transport, other):
    frames = [(number % 0x800, bytes(range(number % 9))) for number in range(200)]
    for can_id, data in frames:
        other.send(can_id, data)
    received = collect(transport, len(frames), PATIENCE_S)
    assert [(r.frame.can_id, r.frame.data) for r in received] == frames
    for number in range(50):
        send(transport, outgoing(0x100, bytes((number,)), PATIENCE_S))
        assert other.receive() == (0x100, bytes((number,)))


def test_frames_that_this_protocol_has_not_are_counted_as_malformed(transport, other):
    other.send(0x8000_0000 | 0x12345, b"extended")
    other.send(0x4000_0000 | 0x100)
    other.send(0x100, b"good")
    assert [r.frame.data for r in collect(transport, 1, PATIENCE_S)] == [b"good"]
    assert transport.stats.malformed == 2


def test_the_stamp_is_the_kernels_not_that_of_reading(other):
    with closing(CanMedium("socketcan", VCAN, 500_000).connect(TransportCounters())) as connection:
        connection.read()
        before_ns = time.monotonic_ns()
        other.send(0x110, b"stamped")
        after_ns = time.monotonic_ns()
        time.sleep(0.3)
        (received,) = connection.read()
        slack_ns = 2_000_000
        assert before_ns - slack_ns <= received.t_ns <= after_ns + slack_ns
        assert time.monotonic_ns() - received.t_ns > 250_000_000


def test_the_kernels_filter_lets_through_what_it_is_set_to(other):
    with can.Bus(VCAN, "socketcan", can_filters=[{"can_id": 0x120, "can_mask": 0x7F0}]) as bus:
        for can_id in (0x11F, 0x120, 0x12F, 0x130):
            other.send(can_id)
        passed = [message.arbitration_id for message in iter(lambda: bus.recv(0.5), None)]
    assert passed == [0x120, 0x12F]


def test_error_frames_are_counted_and_bus_off_is_a_lost_link_found_again(transport, other):
    other.send(ERROR_FLAG | 0x20, bytes(8))
    wait_until(lambda: transport.stats.bus_errors == 1, PATIENCE_S)
    other.send(ERROR_FLAG | 0x04, bytes((0, 0x01, 0, 0, 0, 0, 0, 0)))
    wait_until(lambda: transport.stats.receive_overflow == 1, PATIENCE_S)
    assert transport.state is LinkState.UP
    generation = transport.generation
    other.send(ERROR_FLAG | 0x40, bytes(8))
    wait_until(lambda: transport.stats.bus_off == 1, PATIENCE_S)
    wait_until(lambda: transport.state is LinkState.UP and transport.generation > generation, PATIENCE_S)


def test_an_interface_that_goes_down_is_waited_for(transport):
    generation = transport.generation
    ip("set", VCAN, "down")
    wait_until(lambda: transport.state is LinkState.CONNECTING and "down" in transport.last_error, PATIENCE_S)
    assert not transport.send(outgoing(), time.monotonic_ns())
    ip("set", VCAN, "up")
    wait_until(lambda: transport.state is LinkState.UP and transport.generation > generation, PATIENCE_S)
    # A raw socket keeps the error of the time when the interface was down until it has been read once.
    RawSocket().send(0x110, b"again")
    assert collect(transport, 1, PATIENCE_S)[-1].frame.data == b"again"


def test_an_absent_interface_is_named():
    with closing(open_transport("can", interface="socketcan", channel="can77")) as opened:
        wait_until(lambda: opened.last_error and "can77" in opened.last_error, PATIENCE_S)
        assert opened.state is LinkState.CONNECTING


class SlcanAdapter:
    """An adapter on a pseudo-terminal, with the kernel's slcan on the other side: a CAN device with a bus state."""

    def __init__(self):
        before = set(os.listdir("/sys/class/net"))
        self.adapter, self._line = pty.openpty()
        tty.setraw(self.adapter)
        tty.setraw(self._line)
        fcntl.ioctl(self._line, termios.TIOCSETD, struct.pack("i", N_SLCAN))
        (self.channel,) = set(os.listdir("/sys/class/net")) - before
        self._running = True
        self._thread = threading.Thread(target=self._drain_adapter, daemon=True)
        self._thread.start()
        ip("set", self.channel, "type", "can", "bitrate", "500000")
        ip("set", self.channel, "up")

    def send_line(self, line):
        os.write(self.adapter, line)

    def state(self):
        shown = subprocess.run(["ip", "-d", "link", "show", self.channel], capture_output=True, text=True, check=True)
        return shown.stdout.split("state ")[-1].split()[0]

    def close(self):
        self._running = False
        self._thread.join()
        for descriptor in (self._line, self.adapter):
            with contextlib.suppress(OSError):
                os.close(descriptor)

    def _drain_adapter(self):
        while self._running:
            if select.select([self.adapter], [], [], 0.1)[0]:
                os.read(self.adapter, 4096)


@pytest.fixture
def slcan():
    adapter = SlcanAdapter()
    yield adapter
    adapter.close()


def test_a_real_bus_off_keeps_the_link_down_until_the_controller_is_restarted(slcan):
    with closing(open_transport("can", interface="socketcan", channel=slcan.channel)) as opened:
        wait_until(lambda: opened.state is LinkState.UP, PATIENCE_S)
        slcan.send_line(b"t1102AABB\r")
        assert collect(opened, 1, PATIENCE_S)[0].frame.data == b"\xaa\xbb"
        slcan.send_line(b"e1a\r")
        wait_until(lambda: opened.stats.bus_errors == 1, PATIENCE_S)
        slcan.send_line(b"sb256000\r")
        wait_until(lambda: slcan.state() == "BUS-OFF", PATIENCE_S)
        wait_until(lambda: opened.stats.bus_off == 1 and opened.state is LinkState.CONNECTING, PATIENCE_S)
        with pytest.raises(LinkLostError, match="bus-off"):
            CanMedium("socketcan", slcan.channel, 500_000).connect(TransportCounters())
        time.sleep(1.0)
        assert opened.state is LinkState.CONNECTING, "what is sent now would be swallowed in silence"
        ip("set", slcan.channel, "down")
        ip("set", slcan.channel, "up")
        wait_until(lambda: opened.state is LinkState.UP, PATIENCE_S)
        slcan.send_line(b"t1101CC\r")
        assert collect(opened, 1, PATIENCE_S)[-1].frame.data == b"\xcc"


def test_an_adapter_that_is_pulled_out_is_a_lost_link(slcan):
    with closing(open_transport("can", interface="socketcan", channel=slcan.channel)) as opened:
        wait_until(lambda: opened.state is LinkState.UP, PATIENCE_S)
        slcan.close()
        wait_until(lambda: opened.state is LinkState.CONNECTING, PATIENCE_S)
        assert slcan.channel in opened.last_error
