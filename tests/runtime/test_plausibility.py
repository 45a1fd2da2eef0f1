"""What the plausibility watch counts, and what it leaves alone."""

from __future__ import annotations

import math

import pytest

from disco_hw.runtime.plausibility import Plausibility, PlausibilityStats
from drivers.types import PoseSample, PowerSample, WheelCommand, WheelSample

TICK_NS = 20_000_000
NONE = PlausibilityStats()


def wheels(t_ns: int, left: float, right: float) -> WheelSample:
    return WheelSample(t_ns, t_ns, 0.0, 0.0, left, right)


def drive(watch: Plausibility, speeds, commands, first: int = 0) -> list[str]:
    """Ticks with one wheel sample each; returns what was reported."""
    reported = []
    for number, ((left, right), command) in enumerate(zip(speeds, commands, strict=True), first):
        now_ns = number * TICK_NS
        sent = None if command is None else WheelCommand(*command, 0.1)
        reported += watch.step(now_ns, (wheels(now_ns, left, right),), (), (), sent)
    return reported


def lagging(commands, delay: int, tau_s: float):
    """Wheel speeds of a motor with delay and lag."""
    speed = [0.0, 0.0]
    for number in range(len(commands)):
        wanted = commands[max(number - delay, 0)]
        part = 1.0 - math.exp(-TICK_NS * 1e-9 / tau_s)
        speed = [now + part * (target - now) for now, target in zip(speed, wanted, strict=True)]
        yield tuple(speed)


def swinging(count: int):
    return [(3.0 * math.sin(number / 20), 4.0 * math.sin(number / 13)) for number in range(count)]


@pytest.mark.parametrize(("delay", "tau_s"), [(0, 0.02), (5, 0.1), (10, 0.15)])
def test_wheels_that_lag_behind_their_commands_follow_them(delay, tau_s):
    watch, commands = Plausibility(), swinging(600)
    assert drive(watch, lagging(commands, delay, tau_s), commands) == []
    assert watch.stats == NONE


@pytest.mark.parametrize(("side", "name"), [(0, "left"), (1, "right")])
def test_a_wheel_that_stands_for_a_moment_is_counted_once(side, name):
    watch, commands = Plausibility(), [(3.0, -3.0)] * 60
    stalled = [(3.0, -3.0)] * 40 + [tuple(0.0 if i == side else v for i, v in enumerate((3.0, -3.0)))] * 6
    stalled += [(3.0, -3.0)] * 14
    reported = drive(watch, stalled, commands)
    assert len(reported) == 1
    assert f"the {name} wheel does not follow: 0.0 rad/s" in reported[0]
    assert watch.stats.wheels_not_following == 1


def test_two_odd_samples_are_no_fault_and_three_are():
    for odd, count in ((2, 0), (3, 1)):
        watch = Plausibility()
        drive(watch, [(2.0, 2.0)] * 30 + [(-2.0, 2.0)] * odd + [(2.0, 2.0)] * 5, [(2.0, 2.0)] * (35 + odd))
        assert watch.stats.wheels_not_following == count


def test_wheels_are_not_judged_without_commands_nor_right_after_the_first():
    watch = Plausibility()
    assert drive(watch, [(5.0, 5.0)] * 100, [None] * 100) == []
    assert drive(watch, [(5.0, 5.0)] * 14, [(0.0, 0.0)] * 14, first=100) == []
    assert watch.stats == NONE


def test_what_was_commanded_before_a_pause_is_not_held_against_the_wheels():
    watch = Plausibility()
    drive(watch, [(3.0, 3.0)] * 30 + [(0.0, 0.0)] * 5, [(3.0, 3.0)] * 30 + [None] + [(3.0, 3.0)] * 4)
    assert watch.stats == NONE


def power(seconds: float, volts: float) -> tuple[PowerSample, ...]:
    return (PowerSample(round(seconds * 1e9), volts, 1.0, 20.0),)


def test_a_dip_of_the_supply_is_counted_once_and_again_after_it_has_recovered():
    watch = Plausibility()
    volts = [25.0] * 20 + [23.0] * 3 + [24.9] * 10 + [23.0] * 2
    reported = [text for i, v in enumerate(volts) for text in watch.step(i * TICK_NS, (), (), power(0.1 * i, v), None)]
    assert watch.stats == PlausibilityStats(supply_dips=2)
    assert reported[0] == "the supply dipped from 25.0 V to 23.0 V"


def test_a_battery_that_runs_down_under_load_is_no_dip():
    watch = Plausibility()
    for i in range(6000):
        watch.step(i * TICK_NS, (), (), power(0.1 * i, 25.0 - 0.0008 * i - 0.6 * (i % 40 < 20)), None)
    assert watch.stats == NONE


@pytest.mark.parametrize("volts", [math.nan, 0.0, -1.0, math.inf])
def test_a_voltage_that_is_none_is_passed_over(volts):
    watch = Plausibility()
    for value in (25.0, volts, 25.0):
        assert watch.step(0, (), (), power(1.0, value), None) == ()
    assert watch.stats == NONE


def pose(x_m: float) -> tuple[PoseSample, ...]:
    return (PoseSample(0, 0, x_m, 1.0, 0.5, 0.01, 0.01),)


@pytest.mark.parametrize(
    ("left", "right", "count"),
    [
        (2.0, 2.0, 1), (-2.0, -2.0, 1), (0.31, 0.0, 1), (-0.31, 0.0, 1), (0.0, 0.31, 1), (0.0, -0.31, 1),
        (0.0, 0.0, 0), (0.29, -0.29, 0),
    ],
)  # fmt: skip
def test_a_pose_that_stays_the_same_to_the_digit_counts_while_a_wheel_turns_either_way(left, right, count):
    watch = Plausibility()
    for x_m in (0.1, 0.2, 0.2, 0.2, 0.2, 0.3):
        watch.step(0, (wheels(0, left, right),), pose(x_m), (), None)
    assert watch.stats == PlausibilityStats(poses_frozen=count)


def test_a_pose_that_is_repeated_once_is_no_fault():
    watch = Plausibility()
    for x_m in (0.1, 0.2, 0.2, 0.3, 0.3, 0.4):
        assert watch.step(0, (wheels(0, 2.0, 2.0),), pose(x_m), (), None) == ()
    assert watch.stats == NONE
