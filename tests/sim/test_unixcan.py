"""Against a hub in a process of its own."""

import errno
import multiprocessing
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import can
import pytest

from sim.can_protocol import CanFrame, pack_frame
from sim.unixcan import UnixCanBus
from tests.sim.hub_process import HUB_PROCESS
from tests.tables import thinned

FLOOD = 20_000


@contextmanager
def hubs(folder):
    """Starts hubs, which end with the block."""
    processes = []

    def start():
        path = folder / f"hub{len(processes)}"
        process = subprocess.Popen(
            [sys.executable, HUB_PROCESS, str(path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        processes.append(process)
        assert process.stdout.readline() == f"ready {path}\n".encode()
        return str(path), process

    try:
        yield start
    finally:
        for process in processes:
            process.kill()
            process.communicate()


@pytest.fixture
def start_hub(tmp_path):
    with hubs(tmp_path) as start:
        yield start


@pytest.fixture(scope="module")
def hub(tmp_path_factory):
    """One hub for all that leave it as it was: each opens and closes its own buses."""
    with hubs(tmp_path_factory.mktemp("hub")) as start:
        yield start()[0]


MESSAGES = [
    can.Message(arbitration_id=0x123, is_extended_id=False, data=bytes(range(8))),
    can.Message(arbitration_id=0x7FF, is_extended_id=False, data=b""),
    can.Message(arbitration_id=0x123, is_extended_id=True, data=b"\x01"),
    can.Message(arbitration_id=0x1FFFFFFF, is_extended_id=True, data=bytes(8)),
    can.Message(arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=5),
    can.Message(arbitration_id=0x12345, is_extended_id=True, is_remote_frame=True, dlc=0),
    can.Message(arbitration_id=0x204, is_extended_id=False, is_error_frame=True, data=bytes((0, 8, 0, 0, 0, 0, 96, 0))),
]


@pytest.mark.parametrize("message", MESSAGES, ids=str)
def test_what_is_sent_is_received(hub, message):
    before_s = time.time_ns() * 1e-9
    with UnixCanBus(hub) as a, UnixCanBus(hub) as b:
        a.send(message)
        received = b.recv(30)
        assert received.equals(message, timestamp_delta=None, check_channel=False)
        assert before_s <= received.timestamp <= time.time_ns() * 1e-9
        assert received.channel == hub
        assert a.recv(0) is None


def test_opened_by_name_through_the_entry_point(hub):
    with can.Bus(interface="unixcan", channel=hub, bitrate=500_000) as bus:
        assert isinstance(bus, UnixCanBus)


def test_filters(hub):
    with UnixCanBus(hub) as a, UnixCanBus(hub, can_filters=[{"can_id": 0x120, "can_mask": 0x7F0}]) as b:
        for can_id in (0x11F, 0x120, 0x12F, 0x130, 0x121):
            a.send(can.Message(arbitration_id=can_id, is_extended_id=False))
        assert [b.recv(30).arbitration_id for _ in range(3)] == [0x120, 0x12F, 0x121]
        b.set_filters(None)
        a.send(can.Message(arbitration_id=0x130, is_extended_id=False))
        assert b.recv(30).arbitration_id == 0x130


def test_receive_times_out(hub):
    with UnixCanBus(hub) as bus:
        assert bus.recv(0) is None
        start_s = time.monotonic()
        assert bus.recv(0.05) is None
        assert time.monotonic() - start_s >= 0.05


def test_own_messages_on_request(hub):
    with UnixCanBus(hub, receive_own_messages=True) as bus:
        bus.send(MESSAGES[0])
        assert bus.recv(30).arbitration_id == 0x123


def test_descriptor_is_readable_while_frames_wait(hub):
    with UnixCanBus(hub) as a, UnixCanBus(hub) as b:
        assert select.select([b.fileno()], [], [], 0)[0] == []
        a.send(MESSAGES[0])
        assert select.select([b.fileno()], [], [], 5)[0] == [b.fileno()]
    assert b.fileno() == -1


def test_fd_is_refused(hub):
    with UnixCanBus(hub) as bus, pytest.raises(ValueError, match="classic"):
        bus.send(can.Message(arbitration_id=1, is_fd=True, data=bytes(12)))


def test_no_hub_is_one_clear_error(tmp_path):
    with pytest.raises(can.CanInitializationError, match=r"no CAN hub at .*nowhere"):
        UnixCanBus(str(tmp_path / "nowhere"))


def test_a_full_transmit_buffer_is_enobufs(start_hub):
    path, process = start_hub()
    with UnixCanBus(path) as bus:
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED)
        sent = 0
        with pytest.raises(can.CanOperationError) as error:  # noqa: PT012
            for _ in range(1000):
                bus.send(MESSAGES[0], timeout=0)
                sent += 1
        assert error.value.error_code == errno.ENOBUFS
        assert 10 <= sent <= 100
        start_s = time.monotonic()
        with pytest.raises(can.CanOperationError) as error:
            bus.send(MESSAGES[0], timeout=0.05)
        assert time.monotonic() - start_s >= 0.05
        assert error.value.error_code == errno.ENOBUFS
        process.send_signal(signal.SIGCONT)
        bus.send(MESSAGES[0], timeout=30)


@thinned("number", [signal.SIGKILL, signal.SIGTERM], quick=1)
def test_death_of_the_hub_is_an_error_on_both_ways(start_hub, number):
    path, process = start_hub()
    with UnixCanBus(path) as bus:
        process.send_signal(number)
        process.wait(60)
        for _ in range(2):
            with pytest.raises(can.CanOperationError, match=r"the hub has closed|Connection reset"):
                bus.recv(30)
            with pytest.raises(can.CanOperationError):
                bus.send(MESSAGES[0])


def test_death_of_the_hub_wakes_a_reader(start_hub):
    path, process = start_hub()
    with UnixCanBus(path) as bus:
        threading.Timer(0.1, process.kill).start()
        with pytest.raises(can.CanOperationError):
            bus.recv(None)


def test_shutdown_wakes_a_reader_and_may_be_repeated(hub):
    bus = UnixCanBus(hub)
    threading.Timer(0.1, bus.shutdown).start()
    with pytest.raises(can.CanOperationError):
        bus.recv(None)
    bus.shutdown()
    for call in (lambda: bus.recv(0.1), lambda: bus.send(MESSAGES[0])):
        with pytest.raises(can.CanOperationError):
            call()


def test_rubbish_from_the_other_end_is_an_error_not_a_crash(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()
        with UnixCanBus(str(tmp_path / "s")) as bus:
            connection, _ = listener.accept()
            connection.send(pack_frame(CanFrame(1))[:4] + b"\x0f" + bytes(11))
            with pytest.raises(can.CanOperationError, match="is no CAN frame"):
                bus.recv(30)
            connection.close()


def _flood(path, start):
    with UnixCanBus(path) as bus:
        start.wait()
        for number in range(FLOOD):
            bus.send(can.Message(arbitration_id=0x100 + number % 7, is_extended_id=False, data=number.to_bytes(4)))


@pytest.mark.thorough
def test_twenty_thousand_frames_between_processes_arrive_all_and_in_order(start_hub):
    path, _ = start_hub()
    context = multiprocessing.get_context("spawn")
    start = context.Event()
    sender = context.Process(target=_flood, args=(path, start))
    with UnixCanBus(path) as bus:
        sender.start()
        start.set()
        for number in range(FLOOD):
            message = bus.recv(60)
            assert message is not None, f"frame {number} is missing"
            assert int.from_bytes(message.data) == number
            assert message.arbitration_id == 0x100 + number % 7
        assert bus.recv(0.05) is None
    sender.join(60)
    assert sender.exitcode == 0


def test_a_paced_hub_passes_on_what_the_bit_rate_allows(hub):
    count = 300
    with UnixCanBus(hub) as a, UnixCanBus(hub) as b:
        sender = threading.Thread(target=lambda: [a.send(MESSAGES[0]) for _ in range(count)])
        start_s = time.monotonic()
        sender.start()
        for _ in range(count):
            assert b.recv(30) is not None
        took_s = time.monotonic() - start_s
        sender.join()
    # Not faster than the wire: 111 bits at least at 500 kbit/s.
    assert took_s >= count * 111 / 500_000
