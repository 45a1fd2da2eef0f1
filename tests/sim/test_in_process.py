import pytest

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.experiments.simulated_time import virtual_robot
from disco_hw.runtime.robot_setup import load_setup
from drivers.types import Frame, LinkState, OutgoingFrame
from firmware_protocol.firmware_core import FirmwareConfig
from sim import LinkFaultError
from sim.body_dynamics import BodyPose
from sim.effects import HiddenEffectError
from sim.plant import Plant
from sim.plant_parameters import PlantParameters
from sim.virtual_robot import RobotInProcess, VirtualRobot
from tools.faults.in_process import REOPEN_NS, SimulatedCan

FIRMWARE = FirmwareConfig(ticks_per_rev=2048, max_wheel_speed_rad_s=8.0)


def test_frames_come_while_time_passes_and_only_then():
    robot = RobotInProcess(VirtualRobot(Plant(PlantParameters(), None, 1, BodyPose(1.0, 2.0, 0.5)), FIRMWARE))
    robot.advance(500_000)
    assert robot.truth.t_us == 500_000
    assert robot.host.receive()
    assert not robot.host.receive()
    assert (robot.truth.x_m, robot.truth.y_m) == (1.0, 2.0)


def test_an_unknown_effect_is_refused():
    with pytest.raises(HiddenEffectError):
        virtual_robot(load_setup(SHIPPED_ROBOT), PlantParameters(), BodyPose(), effects={"levitation": 1.0})


MS = 1_000_000
FRAME = Frame(0x100, bytes(8))


@pytest.fixture
def can():
    can = SimulatedCan()
    can.host.open()
    return can


def send(can, deadline_ms=1000):
    return can.host.send(OutgoingFrame(FRAME, deadline_ms * MS), 0)


def test_frames_take_their_time_both_ways(can):
    assert send(can)
    can.send([Frame(0x110, b"\x01")])
    assert can.advance(100_000) == []
    (received,) = can.advance(1 * MS)
    assert received.frame == FRAME
    assert 200_000 < received.t_ns < 400_000
    (telemetry,) = can.host.receive()
    assert telemetry.frame == Frame(0x110, b"\x01")
    assert telemetry.t_ns > received.t_ns
    assert can.host.receive() == ()
    assert can.host.stats.frames_sent == can.host.stats.frames_received == 1


def test_what_is_late_or_does_not_fit_is_counted(can):
    assert not send(can, deadline_ms=-1)
    assert [send(can) for _ in range(40)] == [True] * 32 + [False] * 8
    assert (can.host.stats.expired, can.host.stats.transmit_queue_full) == (1, 8)


def test_unplugged_the_link_is_down_and_comes_back_as_another(can):
    assert (can.host.state, can.host.generation) == (LinkState.UP, 1)
    can.unplug(50 * MS)
    assert can.host.state is LinkState.CONNECTING
    assert can.host.last_error == "unplugged"
    assert not send(can)
    can.advance(49 * MS)
    assert can.host.state is LinkState.CONNECTING
    can.advance(50 * MS)
    assert (can.host.state, can.host.generation, can.host.last_error) == (LinkState.UP, 2, None)
    assert (can.host.stats.reconnects, can.host.stats.send_errors) == (1, 1)


def test_bus_off_of_the_host_is_a_new_link_later(can):
    can.advance(1 * MS)
    can.force_bus_off("host")
    can.advance(2 * MS)
    assert can.host.state is LinkState.CONNECTING
    assert can.host.stats.bus_off == 1
    can.advance(2 * MS + REOPEN_NS)
    assert (can.host.state, can.host.generation) == (LinkState.UP, 2)


def test_bus_off_of_the_robot_shows_in_its_counters_and_passes(can):
    can.force_bus_off("robot")
    assert can.error_counters == (256, 0)
    for ms in range(1, 300):
        can.advance(ms * MS)
    assert can.error_counters == (0, 0)
    can.send([FRAME])
    can.advance(301 * MS)
    assert [received.frame for received in can.host.receive()] == [FRAME]


def test_a_babbler_thrown_off_the_bus_comes_back(can):
    babbler = next(node for node in can.bus.nodes if node.name == "babbler")
    can.bus.force_bus_off(babbler)
    for ms in range(1, 20):
        can.babble(FRAME)
        can.advance(ms * MS)
    assert babbler.sent > 0


def test_closed_it_is_closed_whatever_happens(can):
    can.host.close()
    can.host.close()
    can.unplug(5 * MS)
    can.advance(10 * MS)
    assert can.host.state is LinkState.CLOSED


def test_nobody_else_can_be_bus_off(can):
    with pytest.raises(LinkFaultError, match="moon"):
        can.force_bus_off("moon")
