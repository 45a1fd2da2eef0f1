"""Tests of changes to the task while the daemon runs, and that the log replays what was made of them."""

from __future__ import annotations

import math
import re

import msgspec
import pytest

from disco_hw.config import Robot, RobotConfig, load_robot_config
from disco_hw.errors import InputError
from disco_hw.log import records
from disco_hw.runtime import State
from disco_hw.runtime.replay import replay
from disco_hw.runtime.robot_setup import (
    TaskRefused,
    changed_task,
    limits,
    record_of,
    requested_task,
    task_in_status,
    task_of,
)
from disco_hw.runtime.supervisor import UserRequest
from disco_hw.tasks import CENTER_M, SLOWEST_M_S
from disco_hw.tasks.circle import RADIUS_M, CircleTask
from disco_hw.tasks.path import PathTask
from disco_hw.tasks.timed_path import TimedPathTask
from tests.drivers.motor.test_motor_drivers import EXAMPLES, robot_toml
from tests.runtime.simulated import recorded, replayed, simulated_stack
from tests.runtime.test_replay import write_log

ROBOT = Robot(name="r", wheel_radius_m=0.06, axial_distance_m=0.31, ticks_per_rev=2048, max_wheel_speed_rad_s=8.0)
CONFIG = RobotConfig(robot=ROBOT)
LINE = PathTask(path="line.csv", speed_m_s=0.2, points=((0.0, 0.0), (2.0, 0.0)))
TIMED = TimedPathTask(path="line.csv", points=LINE.points, times_s=(0.0, 10.0))


def test_the_fields_that_are_given_change_and_the_others_stay():
    changed = changed_task(CircleTask(center_x_m=1.0), {"radius_m": 0.5, "speed_m_s": 0.1}, CONFIG, State.READY)
    assert changed == CircleTask(center_x_m=1.0, radius_m=0.5, speed_m_s=0.1)


@pytest.mark.parametrize("state", [State.ARMED, State.STOPPING])
def test_an_armed_robot_keeps_its_task(state):
    for task, changes in ((CircleTask(), {"radius_m": 0.5}), (LINE, {"speed_m_s": 0.3})):
        with pytest.raises(TaskRefused, match="disarm first"):
            changed_task(task, changes, CONFIG, state)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "give one or more of radius_m"),
        ({"radius": 0.5}, "not radius"),
        ({"radius_m": "0.5"}, "radius_m: not a number"),
        ({"radius_m": True}, "radius_m: not a number"),
        ({"radius_m": math.nan}, "radius_m: not within"),
        ({"radius_m": math.inf}, "radius_m: not within"),
        ({"radius_m": 10**400}, "radius_m"),
        ({"radius_m": 0.0}, "not within 0.1 and 50"),
        ({"radius_m": -0.75}, "not within 0.1 and 50"),
        ({"speed_m_s": 0.0}, "speed_m_s: not within"),
        ({"speed_m_s": -0.2}, "speed_m_s"),
        ({"center_x_m": 1e6}, "center_x_m"),
        ({"speed_m_s": 0.45}, "at most 0.397 m/s"),
        ({"radius_m": 0.1, "speed_m_s": 0.2}, "needs more than 8 rad/s of the outer wheel"),
    ],
)
def test_what_the_robot_cannot_do_is_refused_in_words(changes, message):
    with pytest.raises(TaskRefused, match=message):
        changed_task(CircleTask(), changes, CONFIG, State.READY)


@pytest.mark.parametrize(
    ("turn_ratio", "name", "value"),
    [(1.0, "speed_m_s", 0.02), (2.0, "speed_m_s", 0.06), (1.0, "center_x_m", 900.0)],
    ids=["slower than the controller holds", "slower than it holds through a gear", "where no pose reaches"],
)
def test_a_change_is_refused_in_the_words_in_which_robot_toml_is(tmp_path, turn_ratio, name, value):
    link = f'driver = "vesc"\n{EXAMPLES["vesc"]}\n[wheels]\nturn_ratio = {turn_ratio}'
    file = robot_toml(tmp_path, link)
    config = load_robot_config(file)
    with pytest.raises(TaskRefused) as change:
        changed_task(config.task, {name: value}, config, State.READY)
    text = re.sub(r"(?m)^\[task\]\n(.+\n)*", f"[task]\n{name} = {value}\n", file.read_text("utf-8"))
    file.write_text(text, "utf-8")
    with pytest.raises(InputError) as loading:
        load_robot_config(file)
    assert str(loading.value) == f"{file}: task.{change.value}"
    if least := re.search(r"write at least ([\d.]+)", str(change.value)):
        assert changed_task(config.task, {name: float(least[1])}, config, State.READY).speed_m_s == float(least[1])


def test_the_change_to_a_circle_that_is_too_small_for_the_models_x_icr_is_refused():
    config = msgspec.structs.replace(CONFIG, robot=msgspec.structs.replace(ROBOT, x_icr_m=0.3))
    assert limits(config.robot, CircleTask())["radius_m"][0] == 0.316
    with pytest.raises(TaskRefused, match=r"radius_m: not within 0\.316 and 50"):
        changed_task(CircleTask(), {"radius_m": 0.3}, config, State.READY)
    assert changed_task(CircleTask(), {"radius_m": 0.316}, config, State.READY).radius_m == 0.316
    with pytest.raises(TaskRefused, match=r"radius_m: 0\.3 m is too small: .*; write at least 0\.316$"):
        changed_task(CircleTask(radius_m=0.3), {"speed_m_s": 0.1}, config, State.READY)


def test_the_limits_are_those_that_are_enforced_by_the_outer_wheel():
    shown = limits(ROBOT, CircleTask())
    assert shown["radius_m"] == RADIUS_M
    assert shown["center_y_m"] == CENTER_M
    slowest, fastest = shown["speed_m_s"]
    assert slowest == SLOWEST_M_S
    changed_task(CircleTask(), {"speed_m_s": fastest}, CONFIG, State.READY)
    with pytest.raises(TaskRefused):
        changed_task(CircleTask(), {"speed_m_s": fastest * 1.001}, CONFIG, State.READY)
    speed, radius_m = CircleTask(radius_m=0.75).fastest_m_s(ROBOT), 0.75
    outer_rad_s = speed / radius_m * (radius_m + 0.5 * ROBOT.axial_distance_m) / ROBOT.wheel_radius_m
    assert outer_rad_s == pytest.approx(ROBOT.max_wheel_speed_rad_s)


def test_a_record_holds_the_kind_and_what_can_be_changed_and_gives_the_task_back():
    task = CircleTask(center_x_m=1.0, center_y_m=-2.0, radius_m=0.5, speed_m_s=0.1)
    assert task_of(record_of(7, task), CircleTask()) == task
    assert (record_of(7, task).t_ns, record_of(7, task).kind) == (7, "circle")
    assert record_of(7, LINE) == records.Task(7, "path", {"speed_m_s": 0.2})
    assert record_of(7, TIMED) == records.Task(7, "timed_path", {})


def test_a_record_of_an_old_log_is_understood():
    old = msgspec.json.decode(
        b'{"t_ns":7,"center_x_m":1.0,"center_y_m":-2.0,"radius_m":0.5,"speed_m_s":0.1,"kind":"circle"}',
        type=records.Task,
    )
    assert task_of(old, CircleTask()) == CircleTask(center_x_m=1.0, center_y_m=-2.0, radius_m=0.5, speed_m_s=0.1)
    # Paths, and way-points by time, were both called paths.
    path = '{"t_ns":7,"center_x_m":"NaN","center_y_m":"NaN","radius_m":"NaN","speed_m_s":0.1,"kind":"path"}'
    old = msgspec.json.decode(path, type=records.Task, strict=False)
    assert task_of(old, LINE) == msgspec.structs.replace(LINE, speed_m_s=0.1)
    assert task_of(old, TIMED) == TIMED


def test_of_a_path_only_the_speed_can_be_changed():
    changed = changed_task(LINE, {"speed_m_s": 0.3}, CONFIG, State.READY)
    assert changed == msgspec.structs.replace(LINE, speed_m_s=0.3)
    assert set(limits(ROBOT, LINE)) == {"speed_m_s"}
    fastest = ROBOT.max_wheel_speed_rad_s * ROBOT.wheel_radius_m
    assert limits(ROBOT, LINE)["speed_m_s"] == (SLOWEST_M_S, pytest.approx(fastest))
    with pytest.raises(TaskRefused, match="give one or more of speed_m_s, not radius_m"):
        changed_task(LINE, {"radius_m": 0.5}, CONFIG, State.READY)
    with pytest.raises(TaskRefused, match="needs more than 8 rad/s of the wheels; write at most"):
        changed_task(LINE, {"speed_m_s": 1.01 * fastest}, CONFIG, State.READY)


def test_a_status_and_a_record_hold_a_path_without_its_way_points():
    other = msgspec.structs.replace(LINE, speed_m_s=0.1)
    requested = requested_task(other)
    assert "points" not in requested
    assert task_in_status(requested, LINE) == other
    assert task_in_status(requested, msgspec.structs.replace(LINE, points=((0.0, 0.0), (2.0, 0.1)))) is None
    assert task_in_status(requested, CircleTask()) is None
    assert task_in_status(requested_task(CircleTask(radius_m=2.0)), LINE) == CircleTask(radius_m=2.0)
    assert task_of(record_of(7, other), LINE) == other
    assert other.describe() == "path line.csv of 2.00 m at 0.1 m/s"


def test_of_way_points_by_time_nothing_can_be_changed():
    with pytest.raises(TaskRefused, match="times of the way-points set the speed; change t_s in their CSV"):
        changed_task(TIMED, {"speed_m_s": 0.3}, CONFIG, State.READY)
    assert limits(ROBOT, TIMED) == {}
    assert TIMED.describe() == "path line.csv of 2.00 m in 10 s, at most 0.2 m/s"
    assert task_in_status(requested_task(TIMED), TIMED) == TIMED
    assert task_in_status(requested_task(TIMED), msgspec.structs.replace(TIMED, times_s=(0.0, 11.0))) is None
    assert task_in_status(requested_task(TIMED), LINE) is None
    assert task_in_status(requested_task(LINE), TIMED) is None
    assert task_of(record_of(7, TIMED), TIMED) == TIMED


def test_another_circle_is_driven_recorded_and_replayed_bit_for_bit(tmp_path):
    stack = simulated_stack()
    stack.run(1.5)
    stack.core.set_task(CircleTask(center_x_m=0.25, radius_m=0.5, speed_m_s=0.25))
    stack.run(0.5, UserRequest.ARM)
    stack.run(2.4, UserRequest.START)
    stack.run(0.5, UserRequest.DISARM)
    assert [task_of(record, CircleTask()) for record in recorded(stack, records.Task)] == [stack.core.task]
    estimate = stack.core.last.pipeline.estimate
    off_new, off_old = (math.hypot(estimate.x_m - x, estimate.y_m) - r for x, r in ((0.25, 0.5), (0.0, 0.75)))
    assert abs(off_new) < 0.07 < abs(off_old)
    log = write_log(tmp_path / "run.mcap", stack.recorder.ticks)
    replayed(log)
    # Without the record the planner would have followed the circle of robot.toml.
    untold = [(t, [r for r in tick if not isinstance(r, records.Task)]) for t, tick in stack.recorder.ticks]
    assert not replay(write_log(tmp_path / "untold.mcap", untold)).ok
