"""Tests of what the plausibility watch counts, and what it leaves alone."""

from __future__ import annotations

import math

import pytest

from disco_hw.runtime.plausibility import Plausibility
from drivers.types import PoseSample, PowerSample, WheelSample


@pytest.fixture
def watch():
    return Plausibility()


def wheels(t_ns: int, left: float, right: float) -> WheelSample:
    return WheelSample(t_ns, t_ns, 0.0, 0.0, left, right)


def power(seconds: float, volts: float) -> tuple[PowerSample, ...]:
    return (PowerSample(round(seconds * 1e9), volts, 1.0, 20.0),)


def test_a_dip_of_the_supply_is_counted_once_and_again_after_it_has_recovered(watch):
    volts = [25.0] * 20 + [23.0] * 3 + [24.9] * 10 + [23.0] * 2
    reported = [text for i, v in enumerate(volts) for text in watch.step((), (), power(0.1 * i, v))]
    assert (watch.supply_dips, watch.poses_frozen) == (2, 0)
    assert reported[0] == "the supply voltage dropped from 25.0 V to 23.0 V"


def test_a_battery_that_runs_down_under_load_is_no_dip(watch):
    for i in range(6000):
        watch.step((), (), power(0.1 * i, 25.0 - 0.0008 * i - 0.6 * (i % 40 < 20)))
    assert (watch.supply_dips, watch.poses_frozen) == (0, 0)


@pytest.mark.parametrize("volts", [math.nan, 0.0, -1.0, math.inf])
def test_a_voltage_that_is_none_is_passed_over(watch, volts):
    for value in (25.0, volts, 25.0):
        assert watch.step((), (), power(1.0, value)) == ()
    assert (watch.supply_dips, watch.poses_frozen) == (0, 0)


def pose(x_m: float) -> tuple[PoseSample, ...]:
    return (PoseSample(0, 0, x_m, 1.0, 0.5, 0.01, 0.01),)


@pytest.mark.parametrize(
    ("left", "right", "count"),
    [
        (2.0, 2.0, 1), (-2.0, -2.0, 1), (0.31, 0.0, 1), (-0.31, 0.0, 1), (0.0, 0.31, 1), (0.0, -0.31, 1),
        (0.0, 0.0, 0), (0.29, -0.29, 0),
    ],
)  # fmt: skip
def test_a_pose_that_stays_the_same_to_the_digit_counts_while_a_wheel_turns_either_way(watch, left, right, count):
    for x_m in (0.1, 0.2, 0.2, 0.2, 0.2, 0.3):
        watch.step((wheels(0, left, right),), pose(x_m), ())
    assert (watch.supply_dips, watch.poses_frozen) == (0, count)


def test_a_pose_that_is_repeated_once_is_no_fault(watch):
    for x_m in (0.1, 0.2, 0.2, 0.3, 0.3, 0.4):
        assert watch.step((wheels(0, 2.0, 2.0),), pose(x_m), ()) == ()
    assert (watch.supply_dips, watch.poses_frozen) == (0, 0)
