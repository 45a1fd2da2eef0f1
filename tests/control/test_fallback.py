"""A follower drives while the planner finds nothing, within the same limits, and hands the robot back."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from disco_hw.control import CommandLimits, NoValidControl, PlannerState
from disco_hw.control.baselines import LAWS, WithFallback
from disco_hw.control.kernel.guide import SteeredChassis
from disco_hw.control.plan import PlanOutcome, constant_plan
from disco_hw.tasks.circle import CircleCost
from disco_hw.tasks.line import PathTable
from disco_hw.tasks.line.cost import PathCost
from disco_hw.tasks.timed_path import TimedPathCost
from tests.tables import thinned

BASE = (0.061, 0.415, 0.238)
LIMITS = CommandLimits(8.0, 20.0)
SQUARE = np.array([[0.0, 0.0], [1.5, 0.0], [1.5, 1.5], [0.0, 1.5], [0.0, 0.0]])
TASKS = {"circle": CircleCost(), "square": PathCost(PathTable(SQUARE))}


class Planted:
    """A planner that plans, ramps or gives up, as its `outcome` says (None: gives up)."""

    def __init__(self) -> None:
        self.chassis = SteeredChassis(*BASE, 0.0, 0.0)
        self.is_trapped = False
        self.outcome: PlanOutcome | None = PlanOutcome.PLANNED

    def plan(self, now_ns, state):
        if self.outcome is None:
            raise NoValidControl("planted")
        plan = constant_plan(now_ns, state, 1.0, 1.0, BASE)
        return msgspec.structs.replace(
            plan, diagnostics=msgspec.structs.replace(plan.diagnostics, outcome=self.outcome)
        )

    def reset(self) -> None: ...

    def set_task(self, task) -> None: ...

    def set_belief(self, belief) -> None:
        self.chassis = SteeredChassis(2.0 * BASE[0], *BASE[1:], 0.0, 0.0)


def state(x=0.75, y=0.0, yaw=math.pi / 2, t_ns=0):
    return PlannerState(t_ns, x, y, yaw, 0.0, 0.0)


def driven(planner, start, seconds):
    """Poses (N, 3) of a robot that does at once what it is asked."""
    x, y, yaw = start
    radius, axle, x_icr = BASE
    poses = []
    for tick in range(round(seconds / 0.02)):
        left, right = planner.plan(tick * 20_000_000, state(x, y, yaw, tick * 20_000_000)).at(tick * 20_000_000)
        assert max(abs(left), abs(right)) <= LIMITS.speed_rad_s
        forward, turn = 0.5 * radius * (left + right), radius * (right - left) / axle
        x += 0.02 * (forward * math.cos(yaw) + turn * x_icr * math.sin(yaw))
        y += 0.02 * (forward * math.sin(yaw) - turn * x_icr * math.cos(yaw))
        yaw += 0.02 * turn
        poses.append((x, y, yaw))
    return np.array(poses)


@pytest.mark.parametrize("law", LAWS)
@thinned("outcome", [None, PlanOutcome.STOPPING], quick=1)
def test_every_law_drives_the_circle_on_while_the_planner_finds_nothing(law, outcome):
    planted = Planted()
    planted.outcome = outcome
    poses = driven(WithFallback(planted, LAWS[law], TASKS["circle"], LIMITS), (0.75, 0.0, math.pi / 2 + 0.32), 20.0)
    off = np.hypot(poses[:, 0], poses[:, 1]) - 0.75
    assert np.abs(off[250:]).max() < 0.01
    turned = np.unwrap(np.arctan2(poses[:, 1], poses[:, 0]))
    assert turned[-1] - turned[0] == pytest.approx(20.0 * 0.2 / 0.75, rel=0.05)


def test_the_planner_has_the_robot_back_with_its_first_valid_plan():
    planted = Planted()
    both = WithFallback(planted, LAWS["lqr"], TASKS["circle"], LIMITS)
    outcomes = []
    for tick, outcome in enumerate([PlanOutcome.PLANNED, PlanOutcome.STOPPING, None, PlanOutcome.RESTARTED]):
        planted.outcome = outcome
        plan = both.plan(tick * 20_000_000, state(t_ns=tick * 20_000_000))
        outcomes.append(plan.diagnostics.outcome)
        assert (plan.at(tick * 20_000_000) == (1.0, 1.0)) is (outcomes[-1] is not PlanOutcome.FALLBACK)
    assert outcomes == [PlanOutcome.PLANNED, PlanOutcome.FALLBACK, PlanOutcome.FALLBACK, PlanOutcome.RESTARTED]


@pytest.mark.parametrize("field", ["x_m", "yaw_rad", "left_speed_rad_s"])
def test_nobody_drives_from_a_state_that_is_not_finite(field):
    planted = Planted()
    both = WithFallback(planted, LAWS["lqr"], TASKS["circle"], LIMITS)
    lost = msgspec.structs.replace(state(), **{field: math.nan})
    planted.outcome = PlanOutcome.STOPPING
    assert both.plan(0, lost).diagnostics.outcome is PlanOutcome.STOPPING
    planted.outcome = None
    with pytest.raises(NoValidControl, match="planted"):
        both.plan(0, lost)


def test_another_task_is_followed_and_another_belief_steered():
    planted = Planted()
    both = WithFallback(planted, LAWS["lqr"], TASKS["circle"], LIMITS)
    planted.outcome = None
    before = np.array(both.plan(0, state()).at(0))
    both.set_belief(None)
    np.testing.assert_allclose(both.plan(0, state()).at(0), 0.5 * before, rtol=1e-6)
    both.set_task(replace(TASKS["circle"], center_x_m=-5.0, radius_m=5.75))
    assert not np.allclose(both.plan(0, state()).at(0), 0.5 * before, rtol=0.05)


def test_a_square_is_driven_on_from_where_the_planner_left_it():
    planted = Planted()
    both = WithFallback(planted, LAWS["kanayama"], TASKS["square"], LIMITS)
    both.plan(0, state(0.7, 0.0, 0.0))
    planted.outcome = None
    poses = driven(both, (0.7, 0.0, 0.0), 6.0)
    assert poses[-1][0] == pytest.approx(1.5, abs=0.05)
    assert 0.2 < poses[-1][1] < 0.6


def test_way_points_by_time_have_no_line_to_follow():
    with pytest.raises(TypeError, match="TimedPathCost has no line"):
        WithFallback(Planted(), LAWS["lqr"], TimedPathCost.__new__(TimedPathCost), LIMITS)


def test_no_law_drives_into_what_the_planner_stops_for():
    planted = Planted()
    both = WithFallback(planted, LAWS["lqr"], TASKS["circle"], LIMITS)
    planted.is_trapped, planted.outcome = True, PlanOutcome.STOPPING
    assert both.plan(0, state()).diagnostics.outcome is PlanOutcome.STOPPING
    planted.outcome = None
    with pytest.raises(NoValidControl, match="planted"):
        both.plan(20_000_000, state())
    planted.is_trapped = False
    assert both.plan(40_000_000, state()).diagnostics.outcome is PlanOutcome.FALLBACK
