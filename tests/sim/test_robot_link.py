"""The robot's node: what it hears, its restart after bus-off, the babbler's."""

from drivers.types import Frame
from sim import RESTART_DELAY_NS, RobotNode
from sim.bus import CanBus
from sim.can_protocol import CanFrame, ErrorState

MS = 1_000_000


def test_it_hears_data_frames_only_and_which_identifiers_are_long():
    bus = CanBus()
    robot, other = RobotNode(bus), bus.attach("other")
    for frame in (CanFrame(0x100, b"a"), CanFrame(0x100, b"b", extended=True), CanFrame(0x101, remote=True)):
        bus.send(other, frame)
    received_frames = robot.take(5 * MS, bus.advance(5 * MS))
    assert [received.frame for received in received_frames] == [Frame(0x100, b"b", extended=True), Frame(0x100, b"a")]


def test_after_bus_off_it_is_back_after_the_delay_and_not_before():
    bus = CanBus()
    bus.attach("monitor")
    robot = RobotNode(bus)
    bus.force_bus_off(robot.node)
    robot.send([Frame(0x110, b"")])
    assert robot.node.refused_bus_off == 1
    for ms in range(1, 260):
        robot.take(ms * MS, bus.advance(ms * MS))
        if ms * MS <= RESTART_DELAY_NS:
            assert robot.node.state is ErrorState.BUS_OFF
    assert robot.node.state is ErrorState.ACTIVE


def test_what_it_babbles_it_hears_itself():
    bus = CanBus()
    robot = RobotNode(bus)
    robot.babble(Frame(0x100, bytes(8)))
    assert [r.frame.can_id for r in robot.take(MS, bus.advance(MS))] == [0x100]
