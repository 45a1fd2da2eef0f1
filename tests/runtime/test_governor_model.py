"""The governor against a slow specification of its own: how long does a wheel need, and how far may both go."""

import math

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from disco_hw.runtime.pipeline import Governor, Limited, WheelLimits

SPEEDS = st.one_of(
    st.floats(-40.0, 40.0, allow_nan=False), st.sampled_from([0.0, -0.0, 8.0, -8.0, 1e-12, 1e300, -1e300, 5e-324])
)
NOT_FINITE = st.sampled_from([math.nan, math.inf, -math.inf])
PERIODS = st.one_of(st.floats(0.0, 0.05), st.sampled_from([0.0, 0.02, 0.03, 0.030001, 10.0]))
ODD_PERIODS = st.sampled_from([math.nan, -1.0, -0.0, math.inf, 1e9])


def time_needed_s(start, end, limits):
    """Seconds that one wheel needs between two speeds: towards standstill by one limit, away from it by the other."""
    up, down = limits.max_acceleration_rad_s2, limits.max_deceleration_rad_s2
    if start == 0.0 or ((start > 0.0) == (end > 0.0) and abs(end) >= abs(start)):
        return abs(end - start) / up
    if (start > 0.0) == (end > 0.0) or end == 0.0:
        return abs(end - start) / down
    return abs(start) / down + abs(end) / up


def furthest(start, end, dt_s, limits):
    """The largest part of the way of both wheels that takes no longer than `dt_s`, by bisection."""

    def reachable(part):
        return all(time_needed_s(s, s + part * (e - s), limits) <= dt_s for s, e in zip(start, end, strict=True))

    if all(time_needed_s(s, e, limits) <= dt_s for s, e in zip(start, end, strict=True)):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if reachable(middle) else (low, middle)
    return low


class GovernorModel(RuleBasedStateMachine):
    @initialize(
        top=st.floats(0.5, 20.0), up=st.floats(0.5, 100.0), down=st.floats(0.5, 100.0), period_s=st.floats(0.005, 0.1)
    )
    def start(self, top, up, down, period_s):
        self.limits = WheelLimits(top, up, down)
        self.governor = Governor(self.limits, period_s)
        self.period_s = period_s
        self.last = (0.0, 0.0)

    @rule(left=SPEEDS, right=SPEEDS, dt_s=PERIODS)
    def step(self, left, right, dt_s):
        self.check(left, right, dt_s, dt_s)

    @rule(left=SPEEDS, right=SPEEDS, dt_s=ODD_PERIODS)
    def step_after_an_odd_time(self, left, right, dt_s):
        self.check(left, right, dt_s, math.inf if dt_s > 0.0 else 0.0)

    @rule(bad=NOT_FINITE, good=SPEEDS, bad_is_left=st.booleans(), dt_s=PERIODS)
    def request_not_finite(self, bad, good, bad_is_left, dt_s):
        pair = (bad, good) if bad_is_left else (good, bad)
        self.check(*pair, dt_s, dt_s, counts_as=(0.0, 0.0))

    @precondition(lambda self: max(map(abs, self.last)) > 0.0)
    @rule(dt_s=st.floats(0.001, 0.05))
    def ramp(self, dt_s):
        command = self.governor.step(0.0, 0.0, dt_s)
        self.expect(command, (0.0, 0.0), dt_s)

    @rule()
    def reset(self):
        self.governor.reset()
        self.last = (0.0, 0.0)

    def check(self, left, right, dt_s, elapsed_s, counts_as=None):
        command = self.governor.step(left, right, dt_s)
        self.expect(command, counts_as or (left, right), elapsed_s)
        assert (Limited.NOT_FINITE in command.limited) == (counts_as is not None)

    def expect(self, command, desired, elapsed_s):
        top = self.limits.max_speed_rad_s
        fastest = max(map(abs, desired))
        if fastest > top:
            desired = tuple(speed / fastest * top for speed in desired)
        part = furthest(self.last, desired, min(elapsed_s, 1.5 * self.period_s), self.limits)
        expected = [s + part * (e - s) for s, e in zip(self.last, desired, strict=True)]
        got = (command.left_rad_s, command.right_rad_s)
        for expected_speed, have in zip(expected, got, strict=True):
            assert math.isclose(expected_speed, have, rel_tol=1e-9, abs_tol=1e-9), (
                self.last,
                desired,
                elapsed_s,
                expected,
                got,
            )
        assert (Limited.SPEED in command.limited) == (fastest > top)
        self.last = got

    @invariant()
    def never_beyond(self):
        if hasattr(self, "last"):
            assert all(math.isfinite(speed) and abs(speed) <= self.limits.max_speed_rad_s for speed in self.last)


@pytest.mark.parametrize("walks", [25, pytest.param(60, marks=pytest.mark.thorough)])
def test_the_governor_agrees_with_its_specification(walks):
    run_state_machine_as_test(GovernorModel, settings=settings(max_examples=walks, stateful_step_count=25))
