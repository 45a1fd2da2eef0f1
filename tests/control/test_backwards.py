"""Backwards along a line: what the costs, the guide and the refinement see, and closed loops of a simulated robot.

Each robot's tracked point lies behind its centre of rotation, so that backwards is the easier way.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from disco_hw.control import CommandLimits, Disco, DiscoSettings, PlannerState
from disco_hw.control.backwards import Backwards, BackwardsTerms, guide_backwards, turned_start
from disco_hw.control.kernel import follow, row_of, stage_cost, terminal_cost
from disco_hw.control.kernel.guide import guide
from disco_hw.control.kernel.sequences import Limits
from disco_hw.control.refinement import Refinement
from disco_hw.control.rollout_points import RolloutPoints
from disco_hw.control.state_prediction import PlanStart, StatePrediction
from disco_hw.jit import compiled_for, kernel_function
from disco_hw.model import Model
from disco_hw.model.step import FreeRun
from disco_hw.tasks import PlannedTask
from disco_hw.tasks.circle import CircleCost
from disco_hw.tasks.line import PathTable, Waypoints
from disco_hw.tasks.line.cost import PathCost
from disco_hw.tasks.timed_path import TimedPathCost
from tests.tables import thinned

LIMITS = CommandLimits(8.0, 20.0)
SPEED_M_S, RADIUS_M, X_ICR_M = 0.2, 0.75, 0.2
MODEL = Model(0.06, 0.4, X_ICR_M)
SETTINGS = DiscoSettings(uncertainty="point", backwards=True)
ANGLES = np.linspace(0.0, 2.0 * math.pi, 361)
ROUND = RADIUS_M * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
TASKS: dict[str, PlannedTask] = {
    "circle": CircleCost(radius_m=RADIUS_M, speed_m_s=SPEED_M_S),
    "path": PathCost(PathTable(ROUND), SPEED_M_S),
    "timed": TimedPathCost(Waypoints(ROUND, RADIUS_M * ANGLES / SPEED_M_S)),
}
ZERO, ONE = np.float32(0.0), np.float32(1.0)
FOUND = (ZERO, ZERO, ZERO, ONE, ZERO)


def round_the_circle(x_icr_m: float = X_ICR_M) -> PlannerState:
    """A robot that goes round backwards: its axle, so far ahead, is turned out of the circle by what that needs."""
    outwards = math.asin(x_icr_m / RADIUS_M)
    yaw, turn, forward = 1.5 * math.pi - outwards, SPEED_M_S / RADIUS_M, -SPEED_M_S * math.cos(outwards)
    return PlannerState(0, RADIUS_M, 0.0, yaw, *((forward + side * 0.2 * turn) / 0.06 for side in (-1.0, 1.0)))


def rolled_out(commands: np.ndarray, state: PlannerState, step_s: float, model: Model = MODEL) -> np.ndarray:
    """Places (T + 1, 2) of the robot as it is."""
    start = np.array([state.x_m, state.y_m, state.yaw_rad, state.left_speed_rad_s, state.right_speed_rad_s])
    run = FreeRun(model, model.point()[None], step_s)
    return np.asarray(run.states(start, np.asarray(commands, np.float64), 0)[:, :2])


def prepared(name: str, state: PlannerState, x_icr_m: float = X_ICR_M) -> BackwardsTerms:
    made = Backwards(TASKS[name]).prepare(
        0.0, state.x_m, state.y_m, state.yaw_rad, None, SETTINGS.step_s, SETTINGS.sampler.horizon, x_icr_m
    )
    assert isinstance(made.terms, BackwardsTerms)
    return made.terms


@kernel_function
def costs(terms, cos_yaw, sin_yaw, forward):
    """Costs of a step and of the end."""
    stage = stage_cost(terms, ZERO, 0, ZERO, ZERO, ONE, ZERO, cos_yaw, sin_yaw, forward, FOUND)[0]
    return stage, terminal_cost(terms, ZERO, ONE, ZERO, cos_yaw, sin_yaw, FOUND)


@kernel_function
def looked_up(terms, forward):
    """What is kept of a step, and the row of the table."""
    return follow(terms, ZERO, ONE, ZERO, forward, FOUND)[1], row_of(terms, ZERO)


@thinned("name", ["path", "circle"], quick=1)
def test_a_cost_sees_the_robot_with_its_back_as_its_front(name):
    terms = prepared(name, round_the_circle())
    cos_yaw, sin_yaw, forward = np.float32(0.8), np.float32(0.6), np.float32(-0.15)
    seen = costs(terms, cos_yaw, sin_yaw, forward)
    assert seen == costs(terms.task, -cos_yaw, -sin_yaw, -forward)
    assert seen != costs(terms.task, cos_yaw, sin_yaw, forward)
    if name == "path":
        assert looked_up(terms, forward) == looked_up(terms.task, -forward) != looked_up(terms.task, forward)


def test_the_turned_robot_begins_where_the_robot_does_and_faces_away_with_its_wheels_exchanged():
    """At 1, 2 m, facing along y, its wheels at 3 and 5 rad/s; time, place and drift stay what they are."""
    start = np.array([1.0, 2.0, 0.0, 1.0, 3.0, 5.0, 6.0, 7.0, 8.0, 9.0], np.float32)
    assert turned_start(start).tolist() == [1.0, 2.0, 0.0, -1.0, -5.0, -3.0, 6.0, 7.0, 8.0, 9.0]
    assert start[3] == 1.0


def test_the_guide_leads_along_the_line_backwards():
    """From 2 cm beside it, within the limits, and away from where the robot faces."""
    on_it = round_the_circle()
    state = PlannerState(0, on_it.x_m + 0.02, *(getattr(on_it, name) for name in on_it.__struct_fields__[2:6]))
    terms = prepared("path", state)
    made = Backwards(TASKS["path"]).prepare(0.0, state.x_m, state.y_m, state.yaw_rad, None, 0.1, 40, X_ICR_M)
    start = np.zeros(10, np.float32)
    wheels = state.left_speed_rad_s, state.right_speed_rad_s
    start[:6] = (
        state.x_m - made.origin_m[0], state.y_m - made.origin_m[1], math.cos(state.yaw_rad), math.sin(state.yaw_rad),
        *wheels,
    )  # fmt: skip
    commands = np.zeros((40, 2), np.float32)
    largest, change = np.float32(LIMITS.speed_rad_s), np.float32(LIMITS.acceleration_rad_s2 * 0.1)
    rest = (
        start,
        RolloutPoints(MODEL, SETTINGS, LIMITS, 1).chassis,
        *wheels,
        Limits(largest, change, np.zeros(2, np.float32)),
        0.1,
    )
    guide_backwards(compiled_for(guide, commands, terms.task, *rest), commands, terms.task, *rest)
    places = rolled_out(commands, state, 0.1)
    assert np.abs(np.hypot(*places[20:].T) - RADIUS_M).max() < 0.005
    assert (commands.sum(axis=1) < 0.0).all()
    assert np.abs(np.diff(commands, axis=0, prepend=[wheels])).max() <= change + 1e-6
    # On, counter-clockwise, by about as much as the task asks for.
    assert math.atan2(places[-1, 1], places[-1, 0]) == pytest.approx(4.0 * SPEED_M_S / RADIUS_M, rel=0.05)


@pytest.mark.parametrize("x_icr_m", [X_ICR_M, -X_ICR_M], ids=["easier", "harder"])
def test_a_refined_plan_stays_on_the_line_backwards(x_icr_m):
    """Within a millimetre, in the sense in which it goes round forwards; with the axle behind, too."""
    state, model = round_the_circle(x_icr_m), replace(MODEL, x_icr_m=x_icr_m)
    points = RolloutPoints(model, SETTINGS, LIMITS, 1)
    refinement = Refinement(LIMITS, SETTINGS, points.history)
    refinement.set_model(points.model, points.chassis)
    begin = StatePrediction(points, SETTINGS, LIMITS).start(state, 0, 0.0)
    start = np.zeros(10, np.float32)
    start[:6] = state.x_m, state.y_m, math.cos(state.yaw_rad), math.sin(state.yaw_rad), *begin.before
    nominal = np.tile(begin.before, (SETTINGS.sampler.horizon, 1)) + np.array([0.3, -0.3])
    terms = prepared("circle", state, x_icr_m)

    def refined(begin: PlanStart) -> np.ndarray | None:
        refinement.reset()
        for _ in range(6):
            commands = refinement.improve(terms, start, begin, nominal)
        return commands

    commands = refined(begin)
    assert commands is not None
    places = rolled_out(commands, state, SETTINGS.step_s, model)
    assert np.abs(np.hypot(*places.T) - RADIUS_M).max() < 1e-3
    assert (commands.sum(axis=1) < 0.0).all()
    # The lag of the sideways speed is counted on where the point is behind, as it drives.
    lagging = refined(begin._replace(lateral_lag_s=0.1))
    assert np.array_equal(lagging, commands) is (x_icr_m > 0.0)
    # A robot that rolls forwards makes no progress along its line, and is left to the sampled plan.
    assert refined(begin._replace(state=begin.state * [1.0, 1.0, 1.0, -1.0, -1.0])) is None


def closed_loop(planner: Disco, state: PlannerState, seconds: float, model: Model = MODEL) -> np.ndarray:
    """Rows (N, 6) of the robot, 50 times a second: place, yaw, wheel speeds, and its speed ahead."""
    period_s = 0.02
    run = FreeRun(model, model.point()[None], period_s)
    now = np.array([state.x_m, state.y_m, state.yaw_rad, state.left_speed_rad_s, state.right_speed_rad_s])
    rows = []
    for tick in range(round(seconds / period_s)):
        t_ns = round(tick * period_s * 1e9)
        command = planner.plan(t_ns, PlannerState(t_ns, *now.tolist())).at(t_ns)
        now = run.states(now, np.array([command]), 0)[-1]
        rows.append([*now, 0.5 * model.wheel_radius_m * (now[3] + now[4])])
    return np.array(rows)


@pytest.mark.thorough
@pytest.mark.parametrize("name", sorted(TASKS))
def test_every_task_is_driven_backwards(name):
    """Round in the same sense as forwards, within 2 mm, the robot's back ahead all the way."""
    planner = Disco(MODEL, TASKS[name], SETTINGS, LIMITS)
    rows = closed_loop(planner, round_the_circle(), 8.0)
    assert np.abs(np.hypot(*rows[100:, :2].T) - RADIUS_M).max() < 2e-3
    assert rows[:, 5].max() < 0.0
    went = np.unwrap(np.arctan2(rows[:, 1], rows[:, 0]))[-1]
    assert went == pytest.approx(8.0 * SPEED_M_S / RADIUS_M, rel=0.05)


@pytest.mark.thorough
def test_a_robot_that_faces_along_the_line_turns_round_first_and_another_task_is_driven_backwards_too():
    planner = Disco(MODEL, CircleCost(radius_m=RADIUS_M, speed_m_s=SPEED_M_S), SETTINGS, LIMITS)
    rows = closed_loop(planner, PlannerState(0, RADIUS_M, 0.0, 0.5 * math.pi, 0.0, 0.0), 20.0)
    assert np.abs(np.hypot(*rows[-250:, :2].T) - RADIUS_M).max() < 3e-3
    assert rows[-250:, 5].max() < 0.0
    planner.set_task(CircleCost(radius_m=0.9, speed_m_s=SPEED_M_S))
    x, y, yaw, *_ = rows[-1]
    rows = closed_loop(planner, PlannerState(0, x, y, yaw, 0.0, 0.0), 15.0)
    assert np.abs(np.hypot(*rows[-250:, :2].T) - 0.9).max() < 3e-3
    assert rows[-250:, 5].max() < 0.0
