import pytest

from drivers.types import Frame
from firmware_protocol.firmware_core import FirmwareConfig
from sim.bus_node import ErrorState
from sim.hub_link import HubLink
from sim.injection import COMMANDS, Injection
from sim.plant import Plant
from sim.serial_line import SerialLine
from sim.truth import COLUMNS
from sim.unixcan import UnixCanBus
from sim.virtual_robot import VirtualRobot

MS = 1_000_000


@pytest.fixture
def robot():
    return VirtualRobot(Plant(), FirmwareConfig(ticks_per_rev=2048, max_wheel_speed_rad_s=8.0))


@pytest.fixture
def link(tmp_path):
    link = HubLink(tmp_path / "hub", 0)
    yield link
    link.close()


@pytest.fixture
def injection(robot, link):
    return Injection(robot, link)


def babbled(injection, link, until_ms):
    frames = []
    for now_ms in range(1, until_ms + 1):
        frames += link.advance(now_ms * MS)
        injection.step(now_ms * MS)
    return frames


def test_estop_button(robot, injection):
    assert injection.execute("estop_button on", 0) == "ok"
    for step in range(1, 4):
        robot.step(step * 1000)
    assert robot.outputs.state == "ESTOP"
    assert injection.execute("estop_button off", 0) == "ok"
    assert not robot.estop_button


def test_kidnap(robot, injection):
    assert injection.execute("kidnap 0.5 -1 0.25", 0) == "ok"
    truth = robot.truth
    assert (truth.x_m, truth.y_m, truth.yaw_rad) == pytest.approx((0.5, -1.0, 0.25))


def test_bus_off_of_the_robot(link, injection):
    assert injection.execute("bus_off robot", 0) == "ok"
    assert link.robot.state is ErrorState.BUS_OFF


def test_bus_off_is_the_hosts_by_default(link, injection):
    with UnixCanBus(str(link.hub.path)) as bus:
        link.collect(0)
        assert injection.execute("bus_off", 0) == "ok"
        link.advance(0)
        assert bus.recv(1).arbitration_id == 0x40
    assert link.robot.state is ErrorState.ACTIVE


def test_unplug_lasts_as_long_as_asked(tmp_path, link, injection):
    assert injection.execute("unplug 0.5", 1000 * MS) == "ok"
    link.collect(1499 * MS)
    assert not (tmp_path / "hub").exists()
    link.collect(1500 * MS)
    assert (tmp_path / "hub").exists()


def test_babble_at_its_rate_until_told_to_stop(link, injection):
    assert injection.execute("babble 0x100 200", 0) == "ok"
    frames = babbled(injection, link, 1000)
    assert len(frames) == pytest.approx(200, abs=2)
    assert {received.frame for received in frames} == {Frame(0x100, bytes(8))}
    assert injection.execute("babble 256 0", 1000 * MS) == "ok"
    link.advance(1010 * MS)
    injection.step(2000 * MS)
    assert link.advance(2000 * MS) == []


def test_babble_beyond_the_bit_rate_fills_the_bus_and_no_more(link, injection):
    assert injection.execute("babble 0x001 50000", 0) == "ok"
    frames = babbled(injection, link, 100)
    assert 0.1 * 500_000 / 135 - 35 < len(frames) < 0.1 * 500_000 / 100


def test_reboot(robot, injection):
    for step in range(1, 100):
        robot.step(step * 1000)
    assert injection.execute("reboot watchdog", 0) == "ok"
    robot.step(100_000)
    assert robot.outputs.state in {"BOOT", "FAULT"}
    robot.step(101_000)
    assert robot.outputs.fault != 0
    assert injection.execute("reboot", 0) == "ok"
    for step in range(102, 200):
        robot.step(step * 1000)
    assert robot.outputs.fault == 0


def test_state_answers_with_a_row_of_the_truth(injection):
    row = dict(zip(COLUMNS, injection.execute("state", 42).split(","), strict=True))
    assert row["t_ns"] == "42"
    assert row["state"] == "BOOT"


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "no command"),
        ("explode", "'explode' is no command; say one of bus_off, unplug"),
        ("unplug", "0 arguments given; usage: unplug SECONDS"),
        ("unplug x", "not a number"),
        ("unplug nan", "not within 0 to 3600"),
        ("unplug -1", "not within"),
        ("unplug 1e9", "not within"),
        ("estop_button maybe", "say on or off"),
        ("estop_button on off", "2 arguments given"),
        ("kidnap 1 2", "usage: kidnap DX_M DY_M DYAW_RAD"),
        ("kidnap inf 0 0", "not within"),
        ("babble 0x800 1", "11 bits"),
        ("babble x 1", "write it as 0x100 or 256"),
        ("babble 1 1e12", "not within"),
        ("bus_off moon", "say host or robot"),
        ("reboot moon", "say one of power_on, watchdog, brown_out"),
        ("state now", "1 arguments given"),
    ],
)
def test_a_bad_command_is_refused_with_one_line_and_changes_nothing(robot, link, injection, text, why):
    before = robot.truth
    answer = injection.execute(text, 0)
    assert answer.startswith("error: ")
    assert why in answer
    assert "\n" not in answer
    assert injection.refused == 1
    assert robot.truth == before
    assert link.hub.path.exists()
    assert babbled(injection, link, 5) == []


def test_what_a_link_cannot_do_is_refused(robot):
    line = SerialLine(None, 0)
    injection = Injection(robot, line)
    assert injection.execute("bus_off", 0) == "error: bus_off host: a serial line has no bus-off"
    assert "two ends" in injection.execute("babble 0x100 10", 0)
    injection.step(10**9)
    line.close()


def test_every_command_is_described(injection):
    answer = injection.execute("help", 0)
    named = answer.partition("say one of ")[2].split(", ")
    assert named == [line.split()[0] for line in COMMANDS.splitlines()]
