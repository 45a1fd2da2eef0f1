"""The refinement of DISCO's plan: what it reaches beside the line, within the limits, and where it is not used."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from disco_hw.control import CommandLimits, Disco, DiscoSettings, PlannerState
from disco_hw.control.parameter_points import mean_point
from disco_hw.control.refinement import ACCELERATION_M, END_X_ICR, STEPS, drift_correction
from disco_hw.control.rollout_points import RolloutPoints
from disco_hw.control.state_prediction import StatePrediction
from disco_hw.control.surroundings import Surroundings, keeps_clear
from disco_hw.fence import Fence, Footprint
from disco_hw.fence.clearance import Boundaries
from disco_hw.model import Gaussian, Model
from disco_hw.model.model import EffectSetting
from disco_hw.model.step import FreeRun
from disco_hw.tasks.circle import CircleCost

RADIUS_M, X_ICR_M = 0.75, 0.2
LIMITS = CommandLimits(8.0, 20.0)
FOOTPRINT = Footprint(0.5, 0.4, 0.05)
MODEL = Model(0.06, 0.4, X_ICR_M, (EffectSetting("motor_lag", {"tau_s": 0.15}),))
SETTINGS = DiscoSettings(uncertainty="point", refine=True)


def _believed(radius_part: float, others_part: float, effects: tuple[EffectSetting, ...] = ()) -> Model:
    """Return a robot whose geometry is known to these parts of its values: the wheels' radius, and the others."""
    names, values = ("wheel_radius_m", "axial_distance_m", "x_icr_m"), np.array([0.06, 0.4, X_ICR_M])
    deviations = values * np.array([radius_part, others_part, others_part])
    return Model(*values.tolist(), effects, belief=Gaussian(names, values, np.diag(deviations**2)))


def _on_the_circle(speed_m_s: float) -> PlannerState:
    """Return a robot that goes round the circle at this speed, turned inwards as it has to be."""
    turned = math.asin(X_ICR_M / RADIUS_M)
    forward, turn = speed_m_s * math.cos(turned), speed_m_s / RADIUS_M
    left, right = ((forward + side * 0.2 * turn) / 0.06 for side in (-1.0, 1.0))
    return PlannerState(0, RADIUS_M, 0.0, 0.5 * math.pi + turned, left, right)


@pytest.fixture(scope="module")
def drive_on() -> dict[float, tuple[np.ndarray, np.ndarray]]:
    """Plans: commands and distances (m), at a speed that the wheels can do, and at one they cannot."""
    found = {}
    for speed in (0.2, 0.8):
        planner = Disco(MODEL, CircleCost(radius_m=RADIUS_M, speed_m_s=speed), SETTINGS, LIMITS)
        plan = planner.plan(0, _on_the_circle(min(speed, 0.3)))
        assert planner.refinement is not None
        # The outer wheel would need more than its limit at 0.8 m/s on this circle.
        assert (planner.refinement.speed_part < 1.0) is (speed > 0.5)
        assert plan.diagnostics.speed_part == planner.refinement.speed_part
        found[speed] = plan.wheel_speeds, np.hypot(*plan.trajectory[:, :2].T) - RADIUS_M
    return found


@pytest.mark.thorough
def test_a_refined_plan_stays_on_the_line_and_where_it_is_too_fast_for_the_wheels_is_slower(
    drive_on: dict[float, tuple[np.ndarray, np.ndarray]],
) -> None:
    """A robot on the circle is planned to stay within a millimetre of it; sampling alone is not as near.

    Where the outer wheel cannot reach the speed, the plan keeps the limits and the line.
    """
    assert np.abs(drive_on[0.2][1]).max() < 1e-3
    commands, off_m = drive_on[0.8]
    assert np.abs(commands).max() <= LIMITS.speed_rad_s
    assert np.abs(np.diff(commands, axis=0)).max() <= LIMITS.acceleration_rad_s2 * 0.1 + 1e-9
    assert np.abs(off_m).max() < 5e-3


@pytest.mark.thorough
def test_a_wide_belief_does_not_lead_a_refined_plan_off_the_line() -> None:
    """The refinement plans in the mean: under points 15 % apart it would stay where their spread costs least."""
    planner = Disco(
        _believed(0.15, 0.15, MODEL.effects),
        CircleCost(radius_m=RADIUS_M, speed_m_s=0.2),
        replace(SETTINGS, uncertainty="ut"),
        LIMITS,
    )
    plan = planner.plan(0, _on_the_circle(0.2))
    assert np.abs(np.hypot(*plan.trajectory[:, :2].T) - RADIUS_M).max() < 1e-3


def _cost(commands: np.ndarray, state: PlannerState, speed_m_s: float, step_s: float) -> float:
    """Cost of commands (STEPS, 2) beside the circle, written anew in numpy."""
    wheels = np.array([state.left_speed_rad_s, state.right_speed_rad_s])
    start = np.array([state.x_m, state.y_m, state.yaw_rad, *wheels])
    states = FreeRun(MODEL, mean_point(MODEL), step_s).states(start, commands, 0)[1:]
    angles = math.atan2(state.y_m, state.x_m) + speed_m_s * step_s / RADIUS_M * np.arange(1, STEPS + 1)
    reference = RADIUS_M * np.column_stack([np.cos(angles), np.sin(angles)])
    way_m = float(np.hypot(*np.diff(reference, axis=0).T).sum())
    weights = np.ones(STEPS)
    weights[-1] = max(END_X_ICR * X_ICR_M * STEPS / way_m, 1.0)
    turned = states[-1, 2] - (angles[-1] + 0.5 * math.pi + math.asin(X_ICR_M / RADIUS_M))
    turned_m = X_ICR_M * math.remainder(turned, 2.0 * math.pi)
    changes = np.diff(np.vstack([wheels, commands]), axis=0)
    distance = float(weights @ ((states[:, :2] - reference) ** 2).sum(axis=1))
    last = float(weights[-1]) * turned_m**2
    return distance + last + float(((ACCELERATION_M * changes / step_s) ** 2).sum())


@pytest.mark.thorough
@pytest.mark.parametrize("speed_m_s", [0.1, 0.2, 0.3])
def test_a_refined_plan_costs_no_more_than_the_sampled_one(speed_m_s: float) -> None:
    """In the mean of what is believed, on the line and beside it."""
    settings = replace(DiscoSettings.for_speed(speed_m_s, 50.0), uncertainty="point", refine=True)
    on_it = _on_the_circle(speed_m_s)
    planner = Disco(MODEL, CircleCost(radius_m=RADIUS_M, speed_m_s=speed_m_s), settings, LIMITS)
    for off_m, turned_rad in ((0.0, 0.0), (0.02, 0.0), (-0.02, 0.1), (0.0, -0.1)):
        state = structs.replace(on_it, x_m=on_it.x_m + off_m, yaw_rad=on_it.yaw_rad + turned_rad)
        planner.reset()
        refined = planner.plan(0, state).wheel_speeds
        sampled = planner.optimiser.nominal()[:STEPS]
        costs = [_cost(commands, state, speed_m_s, settings.step_s) for commands in (refined, sampled)]
        assert costs[0] <= costs[1]


@pytest.mark.thorough
@pytest.mark.parametrize(("x_icr_m", "counts"), [(X_ICR_M, True), (-X_ICR_M, False)], ids=["behind", "ahead"])
def test_plans_count_on_the_lag_of_the_sideways_speed_with_the_point_behind(x_icr_m: float, counts: bool) -> None:
    """From beside the line, as on it nothing changes that could lag."""
    plans = []
    for lag_s in (0.0, 0.1):
        model = Model(0.06, 0.4, x_icr_m, MODEL.effects)
        planner = Disco(model, CircleCost(radius_m=RADIUS_M, speed_m_s=0.2), SETTINGS, LIMITS)
        state = structs.replace(_on_the_circle(0.2), x_m=RADIUS_M + 0.02, lateral_lag_s=lag_s)
        plans.append(planner.plan(0, state).wheel_speeds)
    assert np.array_equal(*plans) is not counts


@pytest.mark.thorough
def test_warming_up_compiles_the_refinement() -> None:
    """The refinement is compiled before the robot reaches its line, though warming up plans far from it."""
    planner = Disco(MODEL, CircleCost(radius_m=RADIUS_M), SETTINGS, LIMITS)
    planner.warm_up()
    assert planner.refinement is not None
    assert planner.refinement.is_compiled


def test_plans_are_refined_except_in_two_modes() -> None:
    """The paper's mode is to stay as it is."""
    assert Disco(MODEL, CircleCost(radius_m=RADIUS_M), DiscoSettings(), LIMITS).refinement is not None
    for settings in (DiscoSettings.paper(), DiscoSettings(refine=False)):
        assert Disco(MODEL, CircleCost(radius_m=RADIUS_M), settings, LIMITS).refinement is None


def _carried_heading(carried_m_s: complex, speed_m_s: float, begin_rad: float) -> float:
    """Heading at an angle of the circle that keeps a carried robot on it: integrated backwards from a lap further on.

    The way of the tracked point across the body is x_icr times the turn, to the right of a robot that turns left.
    """
    step_s = 1e-3
    angles = begin_rad + speed_m_s / RADIUS_M * step_s * np.arange(round(2.0 * math.pi * RADIUS_M / speed_m_s / step_s))
    own = speed_m_s * 1j * np.exp(1j * angles) - carried_m_s
    yaw = float(np.angle(own[-1]))
    for velocity in own[::-1]:
        across = (velocity * np.exp(-1j * yaw)).imag
        yaw -= -across / X_ICR_M * step_s
    return yaw


@pytest.mark.parametrize("begin_rad", [0.5, 1.0, 2.5, 4.0])
def test_the_last_heading_is_turned_against_the_ground_that_carries_the_robot(begin_rad: float) -> None:
    """By as much as the robot has to be turned to stay on a circle, and on a straight line by the angle of its ways."""
    speed_m_s, carried_m_s, step_s = 0.2, 0.03 * complex(0.6, -0.8), 0.1
    along_m = np.linspace(0.0, 4.0 * X_ICR_M, 13)
    angles = begin_rad + along_m / RADIUS_M
    circle = np.column_stack([RADIUS_M * np.cos(angles), RADIUS_M * np.sin(angles)]).astype(np.float32)
    turn = drift_correction(circle, speed_m_s * step_s, carried_m_s * step_s, X_ICR_M)
    expected = _carried_heading(carried_m_s, speed_m_s, begin_rad) - _carried_heading(0.0, speed_m_s, begin_rad)
    assert abs(expected) > 0.02
    assert math.atan2(turn.imag, turn.real) == pytest.approx(math.remainder(expected, 2.0 * math.pi), abs=0.012)
    straight = np.column_stack([along_m, 0.0 * along_m]).astype(np.float32)
    turn = drift_correction(straight, speed_m_s * step_s, 0.03j * step_s, X_ICR_M)
    assert math.atan2(turn.imag, turn.real) == pytest.approx(-math.atan2(0.03, speed_m_s), abs=1e-3)


@pytest.mark.parametrize("carried_m", [0.02j, 0.5j])
def test_a_robot_that_slows_down_to_stop_is_turned_by_thirty_degrees_at_most(carried_m: complex) -> None:
    """Though the ground may then carry it faster than it goes."""
    there = np.column_stack([np.linspace(0.0, 4.0 * X_ICR_M, 13), np.zeros(13)]).astype(np.float32)
    turn = drift_correction(there, 0.01, carried_m, X_ICR_M)
    assert math.atan2(turn.imag, turn.real) == pytest.approx(-math.atan(0.5), abs=1e-3)


def test_a_robot_is_not_turned_for_what_comes_behind_a_sharp_turn_or_the_end() -> None:
    """As the task's table has it: the robot stops there."""
    there = np.column_stack([np.linspace(0.0, 0.4, 5), np.zeros(5)]).astype(np.float32)
    expected = drift_correction(there, 0.02, 0.003j, X_ICR_M)
    for behind in (there[::-1], np.repeat(there[-1:], 5, axis=0)):
        assert drift_correction(np.vstack([there, behind[1:]]), 0.02, 0.003j, X_ICR_M) == pytest.approx(expected)
    assert drift_correction(np.repeat(there[-1:], 5, axis=0), 0.02, 0.003j, X_ICR_M) == 1.0


def test_a_robot_that_gets_nowhere_is_left_to_the_sampled_plan() -> None:
    """A plan that starts anew from the robot's place can put off its way for ever; who moves is refined again."""
    planner = Disco(_believed(0.01, 0.01), CircleCost(radius_m=RADIUS_M, speed_m_s=0.2), DiscoSettings(), LIMITS)
    moving = _on_the_circle(0.2)
    standing = structs.replace(moving, left_speed_rad_s=0.0, right_speed_rad_s=0.0)
    steps = [
        len(planner.plan(t * 100_000_000, structs.replace(state, t_ns=t * 100_000_000)).wheel_speeds)
        for t, state in enumerate([moving] + 40 * [standing] + 20 * [moving])
    ]
    assert steps[0] == steps[10] == STEPS
    assert steps[40] == DiscoSettings().sampler.horizon
    assert steps[60] == STEPS


# At 0.4 m/s a robot that brakes with 0.18 m/s^2 needs 0.44 m, and more where its wheels may be larger.
STOPS = pytest.mark.parametrize(
    ("room_to_stop_m", "radius_part", "is_clear"), [(0.2, 0.01, False), (0.6, 0.01, True), (0.6, 0.2, False)]
)
SPEED_M_S, BRAKING = 0.4, CommandLimits(8.0, 3.0)


def _before_a_wall(room_to_stop_m: float, speed_m_s: float = SPEED_M_S) -> Surroundings:
    """Return the surroundings of a robot with a wall ahead, so far behind where a refined plan ends."""
    settings, keep_m = DiscoSettings(), 0.05
    way_m = STEPS * settings.step_s * speed_m_s
    wall_m = FOOTPRINT.ahead + 0.5 * FOOTPRINT.length + keep_m + way_m + room_to_stop_m
    room = Fence(keep_in=((-5.0, -5.0), (wall_m, -5.0), (wall_m, 5.0), (-5.0, 5.0)), margin_m=keep_m)
    around = Surroundings(FOOTPRINT, settings.step_s, settings.sampler.horizon, speed_m_s)
    around.look_around(Boundaries(FOOTPRINT, room, ()), 0.0)
    return around


@STOPS
@pytest.mark.parametrize("origin_m", [(0.0, 0.0), (30.0, -20.0)])
def test_a_robot_keeps_clear_if_it_can_stop_after_its_commands(
    room_to_stop_m: float, radius_part: float, is_clear: bool, origin_m: tuple[float, float]
) -> None:
    around, settings = _before_a_wall(room_to_stop_m), DiscoSettings()
    points = RolloutPoints(_believed(radius_part, 0.001), settings, BRAKING, 1)
    turning = SPEED_M_S / MODEL.wheel_radius_m
    begin = StatePrediction(points, settings, BRAKING).start(PlannerState(0, 0.0, 0.0, 0.0, turning, turning), 0, 0.0)
    around.place(0.0, 0.0, origin_m, 1.25 * SPEED_M_S)
    start = np.zeros(10, np.float32)
    start[:2] = -np.array(origin_m)
    commands = np.full((STEPS, 2), turning)
    found = keeps_clear(around, points, begin, commands, start, BRAKING, settings.step_s)
    assert found is is_clear


@pytest.mark.thorough
@STOPS
def test_a_plan_is_refined_only_if_the_robot_can_stop_after_it(
    room_to_stop_m: float, radius_part: float, is_clear: bool
) -> None:
    around, settings = _before_a_wall(room_to_stop_m), DiscoSettings()
    nearly_straight = CircleCost(0.0, 100.0, 100.0, SPEED_M_S)
    planner = Disco(_believed(radius_part, 0.001), nearly_straight, settings, BRAKING, surroundings=around)
    turning = SPEED_M_S / MODEL.wheel_radius_m
    plan = planner.plan(0, PlannerState(0, 0.0, 0.0, 0.0, turning, turning))
    assert (len(plan.wheel_speeds) == STEPS) is is_clear
