"""Events about the planner: each change is reported once, and a speed that the wheels limit where it is news."""

from __future__ import annotations

import numpy as np

from disco_hw.control.plan import Diagnostics, WheelPlan
from disco_hw.runtime.pipeline import Source
from disco_hw.runtime.plausibility import LIMITED_PART, PlannerEvents

LIMITED = "planner: the wheels limit the speed here, to 70% of the task's; the robot follows its line more slowly"


def _plan(speed_part: float) -> WheelPlan:
    """Return a plan at this part of the task's speed."""
    found = Diagnostics(20.0, 1.0, 0.0, 0.0, 0.0, 400, speed_part=speed_part)
    return WheelPlan(0, 0.1, np.zeros((2, 2)), np.zeros((3, 3)), found)


def test_a_speed_that_the_wheels_limit_is_reported_once_in_a_drive() -> None:
    """Corners come and go, and a tick without a plan is no new drive; another start of the task is one."""
    events = PlannerEvents("ramp")
    slow, fast = _plan(0.7), _plan(1.0)
    reported = [events.step(Source.PLAN, plan, None) for plan in (fast, slow, slow, fast, slow)]
    assert reported == [(), (LIMITED,), (), (), ()]
    assert events.step(Source.TAIL, None, "planted") == ("planner: planted",)
    assert events.step(Source.PLAN, slow, None) == ("planner: recovered",)
    assert events.step(Source.HOLD, None, None) == ()
    assert events.step(Source.PLAN, slow, None) == (LIMITED,)


def test_a_place_that_limits_the_speed_more_is_reported_when_its_part_no_longer_falls() -> None:
    """A corner comes into the horizon over some ticks; another that limits the speed no more is not reported."""
    events = PlannerEvents("ramp")
    parts = (0.7, 0.6, 0.5, 0.4, 0.4, 0.4, 1.0, 0.35, 0.35, 1.0, 0.2, 0.25)
    reported = [events.step(Source.PLAN, _plan(part), None) for part in parts]
    worse = [(LIMITED.replace("70%", text),) for text in ("40%", "25%")]
    assert reported == [(LIMITED,), (), (), (), worse[0], (), (), (), (), (), (), worse[1]]


def test_a_speed_that_varies_a_little_is_not_reported() -> None:
    events = PlannerEvents("ramp")
    assert events.step(Source.PLAN, _plan(LIMITED_PART), None) == ()
    assert events.step(Source.PLAN, _plan(LIMITED_PART - 0.01), None) != ()
