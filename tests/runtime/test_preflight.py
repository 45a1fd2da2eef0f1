import math
from pathlib import Path

import msgspec
import pytest

from disco_hw.config import Control, Link, Robot, RobotConfig, link_of
from disco_hw.runtime.pipeline import NoPlanner
from disco_hw.runtime.preflight import (
    Level,
    check_command_timing,
    check_firmware_limits,
    check_link_load,
    check_realtime,
    check_round_trip,
    check_safety,
    check_task,
)
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.runtime.supervisor import UserRequest
from disco_hw.tasks.circle import CircleTask
from disco_hw.tasks.lemniscate import LemniscateTask
from disco_hw.tasks.path import PathTask
from drivers.types import Limit, Limits, SafetyCard
from tests.runtime.path_robot import task_robot
from tests.runtime.simulated import replies, simulated_stack


def robot(**changes):
    values = {"name": "wombot", "wheel_radius_m": 0.06, "axial_distance_m": 0.31, "ticks_per_rev": 2048}
    return Robot(**{**values, "max_wheel_speed_rad_s": 8.0, **changes})


def limits(source="device", **changes):
    values = {
        "max_wheel_speed_rad_s": 8.0,
        "max_wheel_acceleration_rad_s2": 20.0,
        "ticks_per_rev": 2048,
        "command_timeout_s": 0.1,
        "stop_deceleration_rad_s2": 20.0,
    }
    reported = {name: Limit(value, source) for name, value in {**values, **changes}.items() if value is not None}
    return Limits(**reported)


@pytest.mark.parametrize(
    ("link", "level"),
    [
        (Link(kind="can", bitrate=500_000), Level.OK),
        (Link(kind="can", bitrate=100_000), Level.WARNING),
        (Link(kind="can", bitrate=50_000), Level.FAIL),
        (Link(kind="serial", baud=921_600), Level.OK),
        (Link(kind="serial", baud=76_800), Level.WARNING),
        (Link(kind="serial", baud=38_400), Level.FAIL),
    ],
)
def test_link_load_is_judged_by_its_budget(link, level):
    check = check_link_load(link, Control())
    assert check.level is level
    assert "%" in check.text
    if level is not Level.OK:
        assert f"link.{'bitrate' if link.kind == 'can' else 'baud'}" in check.text


def test_link_load_counts_the_control_rate():
    slow, fast = (check_link_load(Link(), Control(rate_hz=rate_hz)).text for rate_hz in (20.0, 100.0))
    assert float(fast.split("%")[0]) == pytest.approx(float(slow.split("%")[0]) + 80 * 135 / 5000, abs=0.15)


@pytest.mark.parametrize("speed_and_acceleration", [(), (8.0, 20.0), (8.0019, 20.009), (1.0, 1.0)])
def test_limits_within_or_equal_to_the_firmwares_are_ok(speed_and_acceleration):
    names = ("max_wheel_speed_rad_s", "max_wheel_acceleration_rad_s2")
    (check,) = check_firmware_limits(robot(**dict(zip(names, speed_and_acceleration, strict=False))), limits())
    assert check.level is Level.OK
    assert check.text.count("reported by the controller") == 3, check.text


@pytest.mark.parametrize(
    ("changes", "line", "hint"),
    [
        ({"max_wheel_speed_rad_s": 8.1}, "robot.max_wheel_speed_rad_s: 8.1", "write at most 8,"),
        ({"max_wheel_speed_rad_s": 8.01}, "robot.max_wheel_speed_rad_s: 8.01", "write at most 8,"),
        ({"max_wheel_speed_rad_s": math.nan}, "robot.max_wheel_speed_rad_s: nan", "write at most 8,"),
        ({"max_wheel_acceleration_rad_s2": 20.1}, "robot.max_wheel_acceleration_rad_s2: 20.1", "write at most 20,"),
        ({"max_wheel_acceleration_rad_s2": 25.0}, "robot.max_wheel_acceleration_rad_s2: 25", "write at most 20,"),
        ({"ticks_per_rev": 2000}, "robot.ticks_per_rev: 2000", "write 2048,"),
        ({"ticks_per_rev": 1024}, "robot.ticks_per_rev: 1024", "write 2048,"),
    ],
)
def test_a_limit_beyond_the_firmwares_fails_in_one_line_with_field_and_remedy(changes, line, hint):
    (check,) = check_firmware_limits(robot(**changes), limits())
    assert check.level is Level.FAIL
    assert line in check.text
    assert hint in check.text
    assert "\n" not in check.text


def test_each_difference_is_a_check_of_its_own():
    differing = robot(max_wheel_speed_rad_s=9.0, max_wheel_acceleration_rad_s2=21.0, ticks_per_rev=1)
    assert [check.level for check in check_firmware_limits(differing, limits())] == [Level.FAIL] * 3


def test_limits_that_nobody_has_looked_at_are_said_to_be_declared():
    declared = limits("robot.toml", ticks_per_rev=None, max_wheel_acceleration_rad_s2=None)
    (check,) = check_firmware_limits(robot(), declared)
    assert check.text == "8 rad/s of at most 8, declared in robot.toml, not reported by the controller"
    (check,) = check_firmware_limits(robot(max_wheel_speed_rad_s=8.1), declared)
    assert check.level is Level.FAIL
    assert "declared in robot.toml" in check.text


@pytest.mark.parametrize(
    ("rate_hz", "valid_for_s", "timeout_s", "level", "expected"),
    [
        (50.0, 0.1, 0.1, Level.OK, "3 commands in a row"),
        (100.0, 0.1, 0.1, Level.OK, "8 commands in a row"),
        (50.0, 0.1, 0.08, Level.OK, "2 commands in a row"),
        (100.0, 0.1, 0.07, Level.OK, "5 commands in a row"),
        (50.0, 0.06, 0.1, Level.WARNING, "only 1"),
        (20.0, 0.1, 0.1, Level.WARNING, "not one"),
        (20.0, 0.1, 0.05, Level.FAIL, "between two commands"),
        (20.0, 0.1, 0.02, Level.FAIL, "between two commands"),
    ],
)
def test_command_timing_counts_what_may_be_lost(rate_hz, valid_for_s, timeout_s, level, expected):
    control = Control(rate_hz=rate_hz, command_valid_for_s=valid_for_s)
    check = check_command_timing(control, limits(command_timeout_s=timeout_s))
    assert check.level is level
    assert expected in check.text


@pytest.mark.parametrize("rate_hz", [20.0, 30.0, 50.0, 100.0])
@pytest.mark.parametrize("timeout_s", [0.06, 0.08, 0.1])
def test_command_timing_agrees_with_a_count_of_periods(rate_hz, timeout_s):
    spare = sum(periods / rate_hz < timeout_s - 1e-9 for periods in range(2, 99))
    check = check_command_timing(Control(rate_hz=rate_hz), limits(command_timeout_s=timeout_s))
    if 1 / rate_hz < timeout_s:
        assert ("not one" if spare == 0 else str(spare)) in check.text.split("Hz")[1]


def test_realtime_says_what_is_allowed_and_the_remedy_for_what_is_not():
    assert {check.level for check in check_realtime(80, True, True, 4)} == {Level.OK}
    checks = check_realtime(80, False, False, 1)
    assert [check.level for check in checks] == [Level.WARNING] * 3
    assert "LimitRTPRIO" in checks[0].text
    assert "LimitMEMLOCK" in checks[1].text
    assert "realtime_priority is 0" in check_realtime(0, True, True, 4)[0].text


@pytest.mark.parametrize(
    ("round_trips_s", "level"),
    [
        ([0.001, 0.002, 0.003], Level.OK),
        ([0.001, 0.0099], Level.OK),
        ([0.001, 0.011], Level.WARNING),
        ([0.001, 0.020], Level.FAIL),
        ([0.001, 0.001, 0.001, 0.080], Level.FAIL),
        (10 * [0.001] + [0.080], Level.WARNING),
        (9 * [0.001] + 2 * [0.020], Level.WARNING),
        (8 * [0.001] + 3 * [0.020], Level.FAIL),
        ([], Level.FAIL),
    ],
)
def test_round_trips_are_judged_by_the_control_period(round_trips_s, level):
    assert check_round_trip(round_trips_s, 0.02).level is level


def test_round_trip_gives_median_and_worst():
    text = check_round_trip([0.001, 0.002, 0.006], 0.02).text
    assert "median 2.00 ms" in text
    assert "worst 6.00 ms of 3" in text
    delayed = check_round_trip(10 * [0.001] + [0.080], 0.02).text
    assert "worst 80.00 ms of 11; 1 longer than a control period of 20 ms" in delayed


@pytest.mark.parametrize(
    "task", [CircleTask(speed_m_s=0.3), PathTask(path="p.csv", speed_m_s=0.7, points=((0, 0), (1, 0)))]
)
def test_a_task_that_is_too_fast_for_the_wheels_fails(task):
    def found(speed_m_s):
        return check_task(RobotConfig(robot=robot(), task=msgspec.structs.replace(task, speed_m_s=speed_m_s)))

    fastest = task.fastest_m_s(robot())
    assert found(0.1).level is found(fastest).level is Level.OK
    too_fast = found(1.01 * fastest)
    assert too_fast.level is Level.FAIL
    assert too_fast.text.startswith("task.speed_m_s: ")
    assert "at most" in too_fast.text


def test_a_circle_that_is_too_small_for_the_x_icr_of_the_model_fails_and_keeps_the_robot_from_being_armed(tmp_path):
    file = task_robot(tmp_path, 'kind = "circle"\nradius_m = 0.2\nspeed_m_s = 0.1\n')
    setup = load_setup(file)
    check = check_task(setup.task_config)
    assert check.level is Level.FAIL
    assert check.text.startswith("task.radius_m: 0.2 m is too small")
    assert check.text.endswith("; write at least 0.251")
    stack = simulated_stack(robot_file=file, planner=NoPlanner())
    stack.run(0.5)
    (reply,) = replies(stack.run(0.1, UserRequest.ARM))
    assert not reply.accepted
    assert check.text in reply.text


@pytest.mark.parametrize(("facing", "said"), [("forwards", False), ("backwards", True)])
def test_a_robot_that_drives_backwards_is_told_so_before_it_is_armed(facing, said):
    config = RobotConfig(robot=robot(), task=CircleTask(), control=Control(facing=facing))
    assert (", driven backwards; the wheels can do" in check_task(config).text) is said


@pytest.mark.parametrize(
    ("brakes", "level", "expected"),
    [
        (True, Level.OK, "its watchdog; about 0.14 m and 0.50 s at 0.48 m/s"),
        (False, Level.WARNING, "its watchdog; 0.05 m, 0.10 s, at 0.48 m/s, and then as far as the robot rolls"),
    ],
)
def test_the_safety_card_says_how_far_and_how_long_at_full_speed(brakes, level, expected):
    card = SafetyCard("the controller", "its watchdog", 0.1, brakes, "a frame")
    checks = check_safety(robot(max_wheel_acceleration_rad_s2=20.0), card)
    assert [(check.level, check.text) for check in checks if check.name == "stops by"] == [(level, expected)]


@pytest.mark.parametrize("task", [CircleTask(radius_m=0.75), LemniscateTask(size_m=2.25)])
def test_a_task_that_turns_faster_than_the_base_can_fails(task):
    """Of an AgileX Scout 2.0; both have the same tightest bend."""
    sizes = {"max_turn_rad_s": 0.5235, "max_speed_m_s": 1.5, "wheel_radius_m": 0.06, "track_m": 0.31}
    link = link_of(Path("robot.toml"), {"driver": "agilex", "interface": "virtual", "channel": "can0", **sizes})

    def found(speed_m_s):
        wide = robot(max_wheel_speed_rad_s=20.0)
        return check_task(RobotConfig(robot=wide, link=link, task=msgspec.structs.replace(task, speed_m_s=speed_m_s)))

    assert found(0.392).level is Level.OK
    assert "the wheels can do 0.39 m/s on it" in found(0.392).text
    too_fast = found(0.4)
    assert too_fast.level is Level.FAIL
    assert too_fast.text.startswith("task.speed_m_s: ")
    assert too_fast.text.endswith("; write at most 0.392 m/s, or a larger figure")
