"""No progress for five seconds is said once, with what stands in the way; standing on purpose is not."""

import math

import pytest

from disco_hw.control.plan import LawController
from disco_hw.runtime import State
from disco_hw.runtime.plausibility import Headway
from disco_hw.runtime.robot_setup import load_setup
from drivers.types import WheelSample
from sim.body_dynamics import BodyPose
from tests.runtime.path_robot import timed_path_robot
from tests.runtime.simulated import ROBOT_FILE, simulated_stack, start

TICK_NS = 20_000_000
COMMAND = (0.4, -0.5)


def headway_events(
    seconds, speed_m_s=0.2, robot_m_s=0.0, wheels_rad_s=0.0, command=COMMAND, failure=None, running=True
):
    """What a headway says while the robot moves, its wheels turn and it is commanded like this; with the times."""
    headway, found = Headway(speed_m_s), []
    for tick in range(round(seconds * 50)):
        now_ns = tick * TICK_NS
        angle = wheels_rad_s * now_ns * 1e-9
        wheels = WheelSample(now_ns, now_ns, angle, angle, wheels_rad_s, wheels_rad_s)
        place = robot_m_s * now_ns * 1e-9, 0.0
        found += [(now_ns * 1e-9, text) for text in headway.step(now_ns, running, place, command, wheels, failure)]
    return found


@pytest.mark.parametrize(
    ("what", "expected"),
    [
        ({}, "the wheels do not turn although commanded up to 0.50 rad/s"),
        ({"command": (0.0, 0.0)}, "the planner commands no motion"),
        ({"failure": "nothing finite"}, "the planner has no plan: nothing finite"),
        ({"wheels_rad_s": 2.0}, "the wheels have turned by 10.0 rad, but the pose has not changed"),
    ],
)
def test_a_robot_that_stays_is_reported_once_with_what_stands_in_the_way(what, expected):
    ((at_s, text),) = headway_events(30.0, **what)
    assert at_s == pytest.approx(5.0, abs=0.05)
    assert text.startswith("task: no progress for 5 s: ")
    assert expected in text


@pytest.mark.parametrize("swings_rad_s", [(0.2, 0.2), (3.0, 3.0), (-2.0, 2.0)], ids=["hardly", "to and fro", "turning"])
def test_wheels_that_follow_commands_which_lead_nowhere_are_not_called_blocked(swings_rad_s):
    headway, found, angles = Headway(0.2), [], [0.0, 0.0]
    for tick in range(300):
        now_ns, sign = tick * TICK_NS, 1.0 if tick // 25 % 2 == 0 else -1.0
        speeds = tuple(sign * speed for speed in swings_rad_s)
        found += headway.step(now_ns, True, (0.0, 0.0), speeds, WheelSample(now_ns, now_ns, *angles, *speeds), None)
        angles = [angle + 0.02 * speed for angle, speed in zip(angles, speeds, strict=True)]
    ((_, _, reason),) = (text.split(": ", 2) for text in found)
    assert reason == (
        f"the wheels follow their commands, up to {max(swings_rad_s):.2f} rad/s, but these turn the robot on the "
        "spot or to and fro; check the task and the position of the robot"
    )


@pytest.mark.parametrize("speed_m_s", [0.2, 0.02])
def test_a_robot_that_drives_is_not_reported(speed_m_s):
    assert headway_events(60.0, speed_m_s=speed_m_s, robot_m_s=0.9 * speed_m_s) == []


@pytest.mark.parametrize("what", [{"running": False}, {"speed_m_s": math.nan}])
def test_what_does_not_run_or_may_rest_is_not_watched(what):
    assert headway_events(20.0, **what) == []


def test_it_is_reported_when_the_robot_gets_on_again():
    headway, found = Headway(0.2), []
    for tick in range(500):
        x_m = 0.0 if tick < 300 else 0.004 * (tick - 300)
        found += headway.step(tick * TICK_NS, True, (x_m, 0.0), COMMAND, None, None)
    assert [text.split(":")[1] for text in found] == [" no progress for 5 s", " the robot makes progress again"]


def test_way_points_by_time_are_watched_once_the_last_time_is_over():
    headway, found = Headway(math.nan), []
    for tick in range(1000):
        now_ns, is_over = tick * TICK_NS, tick >= 500
        found += [
            (now_ns * 1e-9, text) for text in headway.step(now_ns, True, (0.0, 0.0), (0.0, 0.0), None, None, is_over)
        ]
    ((at_s, text),) = found
    assert at_s == pytest.approx(15.0, abs=0.05)
    assert "no progress for 5 s" in text


def test_the_daemon_says_that_a_robot_stands_short_of_the_end_of_way_points_by_time(tmp_path):
    robot_file = timed_path_robot(tmp_path, "t_s,x_m,y_m\n0,0,0\n2,0.3,0\n")
    setup = load_setup(robot_file)
    law = LawController(lambda *_: (0.0, 0.0), setup.model, setup.config.task.planned(setup.config.control.mode))
    stack = simulated_stack(robot_file=robot_file, planner=law, start=BodyPose(0.23, 0.0, 0.0))
    start(stack, 0.02)
    events = [event for tick in stack.run(7.2) for event in tick.events]
    assert [event.split(":")[1] for event in events if event.startswith("task:")] == [" no progress for 5 s"]


def started(**changes):
    stack = simulated_stack(**changes)
    start(stack, 0.02)
    return stack


def test_the_daemon_says_that_a_robot_stands_within_a_dead_band_that_its_model_does_not_know():
    setup = load_setup(ROBOT_FILE)
    law = LawController(lambda *_: (1.2, 1.2), setup.model, setup.config.task.planned(setup.config.control.mode))
    events = [event for tick in started(planner=law, hide={"deadband": 1.3}).run(5.4) for event in tick.events]
    assert [event for event in events if event.startswith("task: no progress for 5 s: the wheels do not turn")]


def test_wheels_that_stand_beyond_any_dead_band_stop_the_robot():
    *_, tick = started(hide={"deadband": 20.0}).run(1.5)
    assert tick.output.state is State.FAULT
    assert "although the wheel is commanded to turn" in tick.output.detail
