"""A real hub and python-can clients in one process; time given by the test."""

import can
import pytest

from drivers.types import Frame
from sim.bus_node import ErrorState
from sim.hub_link import HubLink
from sim.robot_link import LinkFaultError
from sim.robot_node import RESTART_DELAY_NS
from sim.unixcan import UnixCanBus

MS = 1_000_000
FRAME = Frame(0x100, bytes(range(8)))


@pytest.fixture
def link(tmp_path):
    link = HubLink(tmp_path / "hub", 0)
    yield link
    link.close()


@pytest.fixture
def bus(link):
    with UnixCanBus(str(link.hub.path)) as bus:
        link.collect(0)
        yield bus


def run(link, from_ns, to_ns, step_ns=MS // 4):
    received = []
    for now_ns in range(from_ns, to_ns, step_ns):
        link.collect(now_ns)
        received += link.advance(now_ns)
    return received


def send(bus, frame=FRAME, **options):
    bus.send(can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False, **options))


def test_the_robot_receives_with_the_time_of_the_frames_end(link, bus):
    send(bus)
    (received,) = run(link, 0, 2 * MS)
    assert received.frame == FRAME
    assert 111 * 2000 - 6000 <= received.t_ns <= 135 * 2000


def test_the_host_receives_what_the_robot_sends(link, bus):
    link.send([FRAME, Frame(0x080, b"\x01")])
    assert run(link, 0, 2 * MS) == []
    assert [bus.recv(1).arbitration_id for _ in range(2)] == [0x080, 0x100]


def test_frames_that_are_not_for_robots_are_left_out(link, bus):
    bus.send(can.Message(arbitration_id=0x100, is_extended_id=True, data=b"1"))
    bus.send(can.Message(arbitration_id=0x100, is_extended_id=False, is_remote_frame=True))
    send(bus)
    assert [received.frame for received in run(link, 0, 2 * MS)] == [FRAME]


def test_waiting_frames_can_be_let_in_a_few_at_a_time(link, bus):
    send(bus)
    send(bus)
    assert link.collect(0) == 2
    link.advance(0, admit=1)
    assert len(link.advance(5 * MS, admit=0)) == 1
    link.advance(6 * MS, admit=1)
    assert len(link.advance(9 * MS)) == 1


def test_a_host_in_bus_off_is_told_and_cut_off(link, bus):
    link.force_bus_off("host")
    run(link, 0, MS)
    assert bus.recv(1).is_error_frame
    send(bus)
    link.send([FRAME])
    assert run(link, MS, 5 * MS) == []
    assert bus.recv(0) is None


def test_the_robot_comes_back_from_bus_off_by_itself(link, bus):
    link.send([FRAME])
    link.force_bus_off("robot")
    assert link.error_counters == (256, 0)
    send(bus)
    assert run(link, 0, RESTART_DELAY_NS) == []
    assert link.robot.state is ErrorState.BUS_OFF
    run(link, RESTART_DELAY_NS, RESTART_DELAY_NS + 10 * MS)
    assert link.robot.state is ErrorState.ACTIVE
    assert link.error_counters == (0, 0)
    send(bus)
    assert len(run(link, RESTART_DELAY_NS + 10 * MS, RESTART_DELAY_NS + 20 * MS)) == 1
    link.force_bus_off("robot")
    run(link, RESTART_DELAY_NS + 20 * MS, 2 * RESTART_DELAY_NS + 10 * MS)
    assert link.error_counters == (256, 0)
    run(link, 2 * RESTART_DELAY_NS + 10 * MS, 3 * RESTART_DELAY_NS)
    assert link.error_counters == (0, 0)


def test_a_restart_is_a_due_event(link):
    link.force_bus_off("robot")
    link.advance(MS)
    link.advance(MS)
    assert link.next_event_ns() == MS + RESTART_DELAY_NS


def test_nobody_else_can_be_put_into_bus_off(link):
    with pytest.raises(LinkFaultError, match="say host or robot"):
        link.force_bus_off("moon")


def test_unplugged_hosts_are_cut_off_for_a_while(link, bus):
    link.unplug(50 * MS)
    with pytest.raises(can.CanOperationError):
        bus.recv(1)
    with pytest.raises(can.CanInitializationError):
        UnixCanBus(str(link.hub.path))
    run(link, 0, 60 * MS)
    UnixCanBus(str(link.hub.path)).shutdown()


def test_a_babbling_node_is_heard_by_robot_and_hosts(link, bus):
    link.babble(FRAME)
    assert [received.frame for received in run(link, 0, MS)] == [FRAME]
    assert bus.recv(1).arbitration_id == 0x100


def test_the_log_is_candump(tmp_path):
    with (tmp_path / "bus.log").open("w") as log:
        link = HubLink(tmp_path / "hub2", 0, log=lambda line: log.write(line + "\n"))
        link.send([FRAME])
        run(link, 0, MS)
        link.close()
    (message,) = can.LogReader(tmp_path / "bus.log")
    assert (message.arbitration_id, bytes(message.data)) == (FRAME.can_id, FRAME.data)


def test_summary_counts(link, bus):
    send(bus)
    link.send([Frame(0x110, b"")] * 100)
    run(link, 0, 50 * MS)
    assert "sent=64 received=1 full=36 bus_off=0" in link.summary()
    assert "frames_in=1" in link.summary()
