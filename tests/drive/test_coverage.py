"""Tests of which motion counts as excited."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from disco_hw.config import SHIPPED_ROBOT, load_robot_config
from disco_hw.drive.coverage import Coverage
from disco_hw.drive.scripts import create_script
from disco_hw.runtime.pipeline import Governor, WheelLimits

CONFIG = load_robot_config(SHIPPED_ROBOT)
TOP = 6.4
PERIOD_NS = 20_000_000


def covered(wheels, duration_s, coverage=None):
    """Drive through the governor as the daemon does."""
    coverage = coverage or Coverage(TOP)
    governor = Governor(WheelLimits(8.0, 20.0, 20.0), 0.02)
    for tick in range(round(duration_s * 50)):
        command = governor.step(*wheels(tick * 0.02), 0.02)
        coverage.add(tick * PERIOD_NS, command.left_rad_s, command.right_rad_s)
    return coverage


def found(coverage):
    return {item.name: item.found for item in coverage.items() if item.found}


def script(name):
    made = create_script(name, CONFIG.robot, CONFIG.task, 0.8)
    return covered(made.at, made.duration_s)


def test_the_excitation_script_leaves_nothing_missing():
    coverage = script("excite")
    assert [item.describe() for item in coverage.missing()] == []
    assert coverage.describe().endswith("nothing is missing")


def test_a_circle_lacks_nearly_everything():
    coverage = script("circle")
    long = {name: amount for name, amount in found(coverage).items() if amount > 2.0}
    assert long == {"curve left fast": pytest.approx(47.0, abs=0.5)}
    missing = {item.name for item in coverage.missing()}
    assert {"curve right slow", "straight fast", "reverse slow", "hard start", "quick steering"} <= missing


@pytest.mark.parametrize(
    ("left", "right", "name"),
    [
        (1.0, 1.0, "straight slow"),
        (6.0, 6.0, "straight fast"),
        (-1.0, -1.0, "reverse slow"),
        (-6.0, -6.0, "reverse fast"),
        (-2.0, 2.0, "turn left slow"),
        (5.0, -5.0, "turn right fast"),
        (2.0, 3.0, "curve left slow"),
        (5.0, 4.0, "curve right fast"),
        (-4.0, -5.0, "curve right fast"),
        (0.0, 0.0, "rest"),
        (0.3, 0.3, None),
    ],
)
def test_steady_motion_is_named_by_side_and_pace_and_creeping_counts_for_nothing(left, right, name):
    coverage = Coverage(TOP)
    for tick in range(101):
        coverage.add(tick * PERIOD_NS, left, right)
    assert found(coverage) == ({name: pytest.approx(2.0)} if name else {})
    assert coverage.driven_s == pytest.approx(2.0)


def test_starts_and_stops_are_counted_where_they_are_hard():
    hard = covered(lambda t: (5.0, 5.0) if t % 2.0 > 1.0 else (0.0, 0.0), 8.5)
    assert found(hard)["hard start"] == 4
    assert found(hard)["hard stop"] == 4
    soft = covered(lambda t: (1.0 * t, 1.0 * t) if t < 5.0 else (10.0 - t, 10.0 - t), 12.0)
    assert not {"hard start", "hard stop"} & set(found(soft))


def test_steering_counts_where_it_is_quick():
    fast = covered(lambda t: (3.0 - 2.0 * math.sin(math.pi * t), 3.0 + 2.0 * math.sin(math.pi * t)), 8.2)
    assert found(fast)["quick steering"] == 8
    slow = covered(lambda t: (3.0 - 2.0 * math.sin(0.8 * t), 3.0 + 2.0 * math.sin(0.8 * t)), 20.0)
    assert "quick steering" not in found(slow)


def test_a_crossing_counts_where_it_is_slow_and_without_a_rest():
    ramp = covered(lambda t: (0.6 * (t - 5.0), 0.6 * (t - 5.0)), 10.0)
    assert found(ramp)["slow crossing of zero"] == 2
    step = covered(lambda t: (3.0, 3.0) if t < 2.0 else (-3.0, -3.0), 4.0)
    assert "slow crossing of zero" not in found(step)
    rested = covered(lambda t: (3.0, 3.0) if t < 2.0 else (0.0, 0.0) if t < 2.6 else (-3.0, -3.0), 4.0)
    assert "slow crossing of zero" not in found(rested)


def test_nothing_counts_across_a_pause():
    coverage = Coverage(TOP)
    coverage.add(0, 3.0, 3.0)
    coverage.pause()
    coverage.add(60_000_000_000, -3.0, -3.0)
    assert found(coverage) == {}
    assert coverage.driven_s == 0.0


def test_a_gap_counts_as_a_tenth_of_a_second_at_most():
    coverage = Coverage(TOP)
    coverage.add(0, 3.0, 3.0)
    coverage.add(10_000_000_000, 3.0, 3.0)
    assert found(coverage) == {"straight slow": pytest.approx(0.1)}


def test_words_and_json_agree():
    coverage = covered(lambda _t: (3.0, 3.0), 10.0)
    reported = coverage.as_dict()
    assert "straight slow" not in reported["missing"]
    assert len(reported["missing"]) == len(reported["items"]) - 1
    assert "1 of 17 motions" in coverage.describe()
    assert "straight fast 0/2 s" in coverage.describe()


speeds = st.floats(allow_nan=True, allow_infinity=True)


@given(st.lists(st.tuples(st.integers(-5, 10**11), speeds, speeds), max_size=50))
def test_found_never_shrinks_and_never_exceeds_the_time(story):
    coverage = Coverage(TOP)
    before = coverage.items()
    for t_ns, left, right in story:
        coverage.add(t_ns, left, right)
        now = coverage.items()
        assert all(new.found >= old.found for new, old in zip(now, before, strict=True))
        before = now
    assert sum(item.found for item in before if item.unit == "s") <= coverage.driven_s + 1e-9
