"""Tests of what a log's drive by hand has excited, at any instant of it."""

import pytest

from disco_hw.log import records
from disco_hw.viewer.timeline import Excited, Timeline
from tools.viewer_run import PERIOD_NS

TOP_RAD_S = 6.4


def line_of(source, speeds):
    """A timeline whose commands (left, right) were in force tick by tick."""
    line = Timeline()
    for tick, (left, right) in enumerate(speeds):
        t_ns = tick * PERIOD_NS
        line.add(t_ns, records.Command(t_ns, left, right, left, right, 0.1, True, source))
    return line


def found(excited, t_ns):
    return {item["name"]: item["found"] for item in excited.items(t_ns)}


def test_what_was_driven_by_hand_counts_up_to_the_instant():
    excited = Excited(line_of("manual", [(2.0, 2.0)] * 400), TOP_RAD_S)
    assert excited.driven
    assert found(excited, 2_000_000_000)["straight slow"] == pytest.approx(2.0, abs=0.03)
    assert found(excited, 8_000_000_000)["straight slow"] == pytest.approx(7.5, abs=0.6)
    assert found(excited, 8_000_000_000)["turn left slow"] == 0.0


def test_what_a_planner_drove_does_not_count():
    line = line_of("plan", [(2.0, 2.0)] * 100)
    assert not Excited(line, TOP_RAD_S).driven
    assert Excited(line, TOP_RAD_S).items(10**12) == ()
    for tick in range(100, 150):
        t_ns = tick * PERIOD_NS
        line.add(t_ns, records.Command(t_ns, 2.0, 2.0, 2.0, 2.0, 0.1, True, "manual"))
    assert found(Excited(line, TOP_RAD_S), 10**12)["straight slow"] < 1.1


def test_before_the_first_command_there_is_nothing():
    assert Excited(line_of("manual", [(2.0, 2.0)] * 10), TOP_RAD_S).items(-1) == ()
