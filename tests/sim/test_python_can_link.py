"""On python-can's virtual bus, and on a real hub that dies and comes back."""

import signal
import subprocess
import sys

import can
import pytest

from drivers.transport import can as can_transport
from drivers.types import Frame
from sim import LinkFaultError
from sim.hub import Hub
from sim.python_can_link import RETRY_NS, PythonCanLink
from tests.firmware_protocol.other_end import LinkEnd
from tests.firmware_protocol.ports.posix_board import build_board, prefer, running_board
from tests.firmware_protocol.protocol_host import ProtocolHost
from tests.sim.hub_process import HUB_PROCESS

FRAME = Frame(0x100, bytes(range(8)))


@pytest.fixture
def bus():
    with can.Bus(interface="virtual", channel="robot") as bus:
        yield bus


@pytest.fixture
def link():
    link = PythonCanLink("virtual", "robot", 0)
    yield link
    link.close()


@pytest.mark.parametrize("frame", [FRAME, Frame(0x317, b"\x01", extended=True)], ids=["short identifier", "long"])
def test_frames_pass_both_ways(link, bus, frame):
    link.send([frame])
    message = bus.recv(30)
    assert Frame(message.arbitration_id, bytes(message.data), message.is_extended_id) == frame
    bus.send(message)
    assert link.collect(7) == 1
    assert [(r.t_ns, r.frame) for r in link.advance(7)] == [(7, frame)]


def test_waiting_frames_can_be_let_in_a_few_at_a_time(link, bus):
    for number in range(3):
        bus.send(can.Message(arbitration_id=number, is_extended_id=False))
    assert link.collect(1) == 3
    assert [r.frame.can_id for r in link.advance(1, admit=1)] == [0]
    assert link.collect(2) == 2
    assert [r.frame.can_id for r in link.advance(2)] == [1, 2]


def test_frames_that_are_not_for_robots_are_counted_and_left_out(link, bus):
    for kind in ("is_remote_frame", "is_error_frame"):
        bus.send(can.Message(arbitration_id=1, is_extended_id=False, **{kind: True}))
    assert link.collect(1) == 0
    assert link.ignored == 2


def test_unplug_and_back(link, bus):
    link.unplug(100)
    link.send([FRAME])
    assert bus.recv(0) is None
    assert link.send_failures == 1
    assert link.next_event_ns() == 100
    link.collect(100)
    link.send([FRAME])
    assert bus.recv(30) is not None


def test_a_bus_that_breaks_is_opened_again(tmp_path, capsys):
    path = tmp_path / "hub"
    hub = Hub(path, 0)
    link = PythonCanLink("unixcan", str(path), 0)
    assert link.filenos()
    hub.close()
    assert link.collect(1) == 0
    assert link.errors == 1
    assert "opening it again" in capsys.readouterr().err
    link.send([FRAME])
    assert link.send_failures == 1
    link.collect(1 + RETRY_NS)
    assert link.errors == 2
    hub = Hub(path, 0)
    link.collect(1 + 2 * RETRY_NS)
    hub.collect(1)
    link.send([FRAME])
    hub.collect(2)
    assert hub.stats.frames_in == 1
    link.close()
    hub.close()


def test_a_full_bus_is_counted_and_left_open(tmp_path):
    hub = Hub(tmp_path / "hub", 0)
    link = PythonCanLink("unixcan", str(tmp_path / "hub"), 0)
    link.send([FRAME] * 500)
    assert link.send_failures > 300
    assert link.errors == 0
    link.close()
    hub.close()


def test_faults_of_the_own_bus_are_refused(link, bus):
    with pytest.raises(LinkFaultError, match="only on the simulator's own bus"):
        link.force_bus_off("host")
    link.babble(FRAME)
    assert bus.recv(30).arbitration_id == 0x100


def test_what_cannot_be_opened_raises():
    with pytest.raises((can.CanError, OSError)):
        PythonCanLink("unixcan", "/nonexistent/hub", 0)


class HubProcess:
    """A hub with what is on slcan TERMINAL as a node, from its ready line on."""

    def __init__(self, path, terminal, *options):
        command = [sys.executable, HUB_PROCESS, str(path), "slcan", terminal, *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        prefer(self.process)

    def __enter__(self):
        assert self.process.stdout.readline().startswith("ready"), self.process.stderr.read()
        return self

    def __exit__(self, *_):
        self.process.send_signal(signal.SIGTERM)
        self.process.communicate(timeout=60)


def drive_with_another_node(path):
    """Drive a board that is a node of the bus at `path`; then a third node stops it."""
    transport = can_transport.create_transport(interface="unixcan", channel=str(path))
    transport.open()
    with can.Bus(interface="unixcan", channel=str(path)) as other:
        host = ProtocolHost(LinkEnd(transport), first_session=5, valid_for_s=0.5)
        try:
            host.settle()
            host.to_driving()
            assert (host.state, host.fault) == ("ARMED", "NONE")
            host.wait_for("turning wheels", lambda: host.fastest > 1.0)
            received_ids = set()
            while (message := other.recv(0)) is not None:
                received_ids.add(message.arbitration_id)
            # What the robot says and what its host says: each node hears both.
            assert {0x100, 0x101, 0x110, 0x111, 0x130, 0x133} <= received_ids
            other.send(can.Message(arbitration_id=0x080, data=b"\1", is_extended_id=False))
            host.wait_for_state("ESTOP", within_s=2.0)
            host.wait_for("standing wheels", lambda: host.fastest == 0.0, 2.0)
        finally:
            host.end.close()


@pytest.mark.thorough
@pytest.mark.hil
def test_a_board_behind_slcan_sits_on_the_mock_bus_beside_other_nodes(tmp_path):
    with (
        running_board(build_board(tmp_path, "-DDISCO_LINK_SLCAN")) as board,
        HubProcess(tmp_path / "bus", board.link, "sleep_after_open=0"),
    ):
        drive_with_another_node(tmp_path / "bus")
