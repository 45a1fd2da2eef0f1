"""The fused kernel against the numpy reference: costs, weights and update, over random parameters, effects, states."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from disco_hw.control import CommandLimits, Disco, DiscoSettings, PlannerState, Sampler, SentCommand
from disco_hw.control.kernel import BLOCK
from disco_hw.control.kernel.step import ESS, NOMINAL, TEMPERATURE
from disco_hw.control.optimiser import spline_basis
from disco_hw.control.parameter_points import unscented_points
from disco_hw.control.plan import command_history
from disco_hw.effects.registry import MOTION_EFFECTS
from disco_hw.model import EffectSetting, Gaussian, Model
from disco_hw.model import plain as physics
from disco_hw.tasks.circle import CircleCost
from disco_hw.tasks.line import PathTable, Waypoints
from disco_hw.tasks.line.cost import FARTHEST_STEP_M, PathCost
from disco_hw.tasks.timed_path import TimedPathCost
from tests.control import oracle
from tests.tables import examples
from tests.tasks.costs import circle_cost, path_along, path_cost, timed_path_cost

SAMPLES, HORIZON, STEP_S = 160, 50, 0.1
# Single precision holds no more than this of a cost of hundreds.
RELATIVE = 1e-5
SAMPLER = Sampler(samples=SAMPLES, horizon=HORIZON)
PLAN_SETTINGS = DiscoSettings(sampler=SAMPLER, iterations_at_start=1, retries=0, gain_by_time=False, refine=False)
LIMITS = CommandLimits(8.0, 20.0)

BASE = st.tuples(st.floats(0.02, 0.12), st.floats(0.2, 0.8), st.floats(-0.3, 0.4))
# Never more than 0.4 rad in a step, as the shipped robot: the kernels that other tests compile as well. What turns more
# has another arm of the integration, which the tests with all effects go through.
SLOW_TURNING = st.tuples(st.floats(0.02, 0.08), st.floats(0.45, 0.8), st.floats(-0.3, 0.4))
STATES = st.tuples(
    st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-math.pi, math.pi), st.floats(-6.0, 6.0), st.floats(-6.0, 6.0)
)
COMMANDS = st.lists(st.tuples(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0)), min_size=1, max_size=30)
SEEDS = st.integers(0, 2**63 - 1)
FULL = {
    "motor_lag": {"tau_s": st.floats(0.0, 0.5)},
    "command_delay": {"delay_s": st.floats(0.0, 0.45)},
    "deadband": {"width_rad_s": st.floats(0.0, 1.0)},
    "stiction": {"threshold_rad_s": st.floats(0.0, 1.5)},
    "speed_limit": {"limit_rad_s": st.floats(2.0, 9.0)},
    "yaw_rate_limit": {"limit_rad_s": st.floats(0.3, 5.0)},
    "yaw_acceleration_limit": {"limit_rad_s2": st.floats(0.5, 50.0)},
    "acceleration_limit": {"limit_rad_s2": st.floats(0.3, 60.0), "stop_share": st.floats(0.0, 3.0)},
    "battery_sag": {"loss": st.floats(0.0, 0.5)},
    "wheel_gain": {"left": st.floats(-0.1, 0.1), "right": st.floats(-0.1, 0.1)},
    "turning_load": {"load_rad_s": st.floats(0.0, 1.5), "unequal": st.floats(-0.05, 0.05)},
    "turning_buildup": {
        "limit_rad_s2": st.floats(0.3, 30.0), "at_once_rad_s": st.floats(0.0, 2.0), "shared": st.floats(0.0, 1.2),
    },
    "wheel_radius_asymmetry": {"ratio": st.floats(-0.05, 0.05)},
    "turn_slip": {"k_s": st.floats(-0.1, 0.3)},
    "turn_asymmetry": {"share": st.floats(-0.2, 0.2)},
    "acceleration_slip": {"k_s2_m": st.floats(-0.1, 0.3)},
    "side_slip": {"k_s": st.floats(-0.1, 0.3)},
    "lateral_icr": {"offset_m": st.floats(-0.1, 0.1)},
    "turning_point": {"ahead_m": st.floats(-0.1, 0.1)},
    "load_transfer": {"k_s2": st.floats(-0.2, 0.2)},
    "slope": {"drift_x_m_s": st.floats(-0.05, 0.05), "drift_y_m_s": st.floats(-0.05, 0.05)},
    "downhill_slide": {"slide_x_m": st.floats(-0.2, 0.2), "slide_y_m": st.floats(-0.2, 0.2)},
    "surface_change": {"track": st.floats(-0.2, 0.3), "time_s": st.floats(0.0, 8.0), "radius": st.floats(-0.05, 0.05)},
}  # fmt: skip
EFFECTS = st.fixed_dictionaries({name: st.fixed_dictionaries(values) for name, values in FULL.items()})
SD = np.array([0.003, 0.02, 0.02])
BELIEF_NAMES = ("wheel_radius_m", "axial_distance_m", "x_icr_m")


def model_of(base, effects=None):
    belief = Gaussian(BELIEF_NAMES, np.array(base), np.diag(SD**2))
    chosen = tuple(EffectSetting(name, values) for name, values in (effects or {}).items())
    return Model(*base, effects=chosen, belief=belief)


def state_of(values, commands):
    sent = tuple(SentCommand(20_000_000 * i, left, right) for i, (left, right) in enumerate(commands))
    return PlannerState(20_000_000 * len(commands), *values, sent=sent, elapsed_s=3.0)


CIRCLE = CircleCost(0.3, -0.2)


@st.composite
def way_points(draw):
    """Places (N, 2) from the origin on: legs with corners or an even curve between, once round or not."""
    corners = draw(st.booleans())
    count = draw(st.integers(1, 5))
    length_m = draw(st.lists(st.floats(0.2, 2.0), min_size=count, max_size=count))
    turn_rad = draw(st.lists(st.floats(-math.pi, math.pi), min_size=count, max_size=count))
    pieces = 1 if corners else 20
    heading = np.cumsum(np.repeat(turn_rad, pieces) / pieces)
    step = np.repeat(length_m, pieces) / pieces
    places = np.concatenate(
        [[[0.0, 0.0]], np.cumsum(step[:, None] * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)]
    )
    away = np.hypot(*places[-1]) > 0.2
    return np.concatenate([places, places[:1]]) if away and draw(st.booleans()) else places


@st.composite
def paths(draw):
    """A path at a speed, and where the robot is beside it: anywhere along it, however long the way there is."""
    places = draw(way_points())
    if draw(st.booleans()):
        # The way up to here, or what is left of it.
        far_m = draw(st.floats(-1500.0, 1500.0))
        there = [[far_m, 500.0]]
        places = np.concatenate([there, places]) if far_m < 0.0 else np.concatenate([places, there])
    return path_along(Waypoints(places), draw(st.floats(0.05, 0.5)))


@st.composite
def timed_paths(draw):
    places = draw(way_points())
    apart_s = draw(st.lists(st.floats(0.05, 4.0), min_size=len(places) - 1, max_size=len(places) - 1))
    begin_s = draw(st.floats(-3.0, 3.0))
    return TimedPathCost(Waypoints(places, np.concatenate([[begin_s], begin_s + np.cumsum(apart_s)])))


# Where single precision may fall to either side of an edge (stiction, the next piece of a path), nudges there and back
# change the cost by what does not cancel: of the commands, and of the start along and across. Far beside a curve the
# place on a path runs away from the least error: there a nudge of the start changes the cost by 100 times its length,
# twice what all steps' distances make of it.
NUDGE_RAD_S, NUDGES_M, EDGE, STEEP = 1e-5, ((1e-5, 1e-5), (1e-5, -1e-5)), 2e-5, 3e-3
FEW = 0.1


def sequence_cost(task, place, x_icr_m, farther=1.0):
    match task:
        case CircleCost():
            return circle_cost(task, STEP_S, x_icr_m)
        case PathCost():
            return path_cost(task, place, STEP_S, x_icr_m, farther * FARTHEST_STEP_M)
        case TimedPathCost():
            return timed_path_cost(task, 0.0, STEP_S)


def sampled_commands(disco, before, sampler, state):
    """The commands (K, T, 2) of the last step, of a plan that continued from `before`."""
    work = disco.optimiser.work
    noise = work.noise.reshape(-1, work.noise.size // work.weights.size, int(BLOCK)).swapaxes(0, 1)
    noise = noise.reshape(noise.shape[0], -1)[: sampler.knots * 2, : sampler.samples].astype(float)
    first, weights = spline_basis(sampler.knots, sampler.horizon)
    by_knot = noise.T.reshape(sampler.samples, sampler.knots, 2)
    spread = np.einsum("tj,ktjc->ktc", weights, by_knot[:, first[:, None] + np.arange(4)])
    last = state.sent[-1]
    anchor = np.array(disco._prediction.anchor(state, state.elapsed_s))
    assert np.all(np.abs(anchor - (last.left_rad_s, last.right_rad_s)) <= 12.0)
    change = LIMITS.acceleration_rad_s2 * STEP_S
    commands = oracle.limited(before, spread, anchor, LIMITS.speed_rad_s, change)
    if disco._guidance._guide is not None:
        # What the guide is has its own tests.
        commands[1] = work.guide
    return commands


def check_against_reference(model, state, task, plan_settings, seed):
    """Plan twice and check every cost, the weights and the update of the second step."""
    disco = Disco(model, task, plan_settings, LIMITS, seed)
    now_ns = state.t_ns
    before = disco.plan(now_ns, state).wheel_speeds
    disco.plan(now_ns, state)
    work = disco.optimiser.work

    sampler, guided = plan_settings.sampler, disco._guidance._guide is not None
    commands = sampled_commands(disco, before, sampler, state)

    theta, point_weights = unscented_points(model, plan_settings.ut_alpha)
    weighed = point_weights != 0.0
    past = command_history(state.sent, now_ns, STEP_S, 8, (state.left_speed_rad_s, state.right_speed_rad_s))
    start = physics.RobotState(state.x_m, state.y_m, state.yaw_rad, state.left_speed_rad_s, state.right_speed_rad_s)

    options = {"time_s": state.elapsed_s, "euler": plan_settings.euler}

    def costs_of(sequences, x_m=0.0, y_m=0.0, farther=1.0):
        cost = sequence_cost(task, disco._memory, disco.chassis.x_icr_m, farther)
        names = model.parameter_names
        begin = replace(start, x=start.x + x_m, y=start.y + y_m)
        return np.array(
            [
                oracle.point_costs(physics.theta_of(names, point), begin, sequences, past, STEP_S, cost, **options)
                for point in theta[weighed]
            ]
        )

    def beyond_single_precision(sequences):
        there_and_back = [(costs_of(sequences + NUDGE_RAD_S), costs_of(sequences - NUDGE_RAD_S))]
        there_and_back += [(costs_of(sequences, x, y), costs_of(sequences, -x, -y)) for x, y in NUDGES_M]
        # Far off, a place moves on by the most that it may, which can be to just between two pieces.
        there_and_back.append((costs_of(sequences, farther=1.0 + 1e-6), costs_of(sequences, farther=1.0 - 1e-6)))
        middle = costs_of(sequences)
        edge = [np.abs(there + back - 2.0 * middle) > EDGE for there, back in there_and_back]
        steep = [np.abs(there - back) > STEEP for there, back in there_and_back]
        return np.any([*edge, *steep], axis=(0, 1))

    expected = costs_of(commands)
    got = work.point_costs.reshape(point_weights.size, -1)[:, : sampler.samples].astype(float)
    assert not got[~weighed].any()
    got = got[weighed]
    apart = ~np.isclose(got, expected, atol=1e-4, rtol=RELATIVE).all(axis=0)
    if apart.mean() >= FEW:
        # By the reference alone: a robot just so far off a path that its steps end on an edge says nothing of the rest.
        assume(beyond_single_precision(commands).mean() < FEW)
    assert apart.mean() < FEW
    excused = apart.copy()
    if apart.any():
        excused[apart] = beyond_single_precision(commands[apart])
    np.testing.assert_allclose(got[:, ~excused], expected[:, ~excused], atol=1e-4, rtol=RELATIVE)

    mean = oracle.mean_risk(np.where(excused, got, expected), point_weights[weighed])
    np.testing.assert_allclose(work.costs[: sampler.samples], mean, atol=1e-4, rtol=RELATIVE)
    assert work.report[NOMINAL] == pytest.approx(mean[0], abs=1e-4, rel=RELATIVE)
    kernel_weights = oracle.softmax_weights(work.costs[: sampler.samples].astype(float), work.report[TEMPERATURE])
    assert work.report[ESS] == pytest.approx(oracle.effective_sample_size(kernel_weights), rel=1e-3)
    # That the guide has the robot where the plan stands has its own test.
    cheaper = work.costs[1] < plan_settings.guide_below * work.costs[0]
    taken = guided and (cheaper or disco._guidance.until_ns is not None)
    updated = commands[1] if taken else oracle.updated(commands, kernel_weights)
    np.testing.assert_allclose(work.nominal, updated, atol=2e-4)


def test_every_effect_that_moves_the_robot_is_tried():
    assert set(FULL) == set(MOTION_EFFECTS)


@examples(quick=6, every=15, base=SLOW_TURNING, values=STATES, commands=COMMANDS, seed=SEEDS)
def test_costs_and_update_of_the_bare_model(base, values, commands, seed):
    check_against_reference(model_of(base), state_of(values, commands), CIRCLE, PLAN_SETTINGS, seed)


@pytest.mark.thorough
@settings(max_examples=15)
@given(SLOW_TURNING, STATES, COMMANDS, SEEDS)
def test_costs_and_update_with_euler_steps(base, values, commands, seed):
    check_against_reference(
        model_of(base), state_of(values, commands), CIRCLE, replace(PLAN_SETTINGS, euler=True), seed
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("effects", "changes"),
    [(st.none(), {}), (st.none(), {"ut_alpha": 0.5}), (EFFECTS, {}), (EFFECTS, {"euler": True})],
    ids=["bare", "with a weight of the mean", "all effects", "all effects in Euler steps"],
)
@settings(max_examples=15)
@given(BASE, st.data(), STATES, COMMANDS, SEEDS)
def test_costs_and_update_of_a_model_that_turns_fast(effects, changes, base, data, values, commands, seed):
    model = model_of(base, data.draw(effects))
    check_against_reference(model, state_of(values, commands), CIRCLE, replace(PLAN_SETTINGS, **changes), seed)


STRAIGHT_BACK = np.array([[0.0, 0.0], [-1.61291931, 0.66600324], [0.0, 0.0]])


def test_costs_and_update_on_a_way_straight_back():
    path, state = PathCost(PathTable(STRAIGHT_BACK), 0.5), state_of((0.0,) * 5, [(0.5, 0.0)])
    check_against_reference(model_of((0.078125, 0.5, 0.0)), state, path, PLAN_SETTINGS, 0)


@pytest.mark.thorough
@settings(max_examples=40)
@example(PathCost(PathTable(STRAIGHT_BACK), 0.5), (0.078125, 0.5, 0.0), (0.0,) * 5, [(0.5, 0.0)], 0)
@given(paths(), SLOW_TURNING, STATES, COMMANDS, SEEDS)
def test_costs_and_update_along_a_path(path, base, values, commands, seed):
    check_against_reference(model_of(base), state_of(values, commands), path, PLAN_SETTINGS, seed)


# A way of 1.6 km up to here: places on it that count from far off are too coarse for single precision.
LONG_WAY = path_along(
    Waypoints(
        np.array([[-1488.79531, 500.0], [0.0, 0.0], [0.449185571, 0.255162581], [-0.182519024, 1.60631644], [0.0, 0.0]])
    ),
    0.1529235977265182,
)
OF_LONG_WAY = {
    "motor_lag": {"tau_s": 0.47914409582507633},
    "stiction": {"threshold_rad_s": 1.2520654093994823},
    "acceleration_slip": {"k_s2_m": 0.23437032236889863},
    "battery_sag": {"loss": 0.4561363272116118},
    "turn_slip": {"k_s": -0.04359815160943236},
    "deadband": {"width_rad_s": 0.7305651833213925},
    "lateral_icr": {"offset_m": -0.004562940814339528},
    "surface_change": {"track": 0.008894168233453126, "time_s": 3.1938459042995833, "radius": 0.0},
    "command_delay": {"delay_s": 0.26292225199520247},
    "yaw_acceleration_limit": {"limit_rad_s2": 38.72731466682443},
    "slope": {"drift_x_m_s": 0.0002, "drift_y_m_s": 0.0093},
    "speed_limit": {"limit_rad_s": 7.97758228652401},
    "wheel_gain": {"left": 0.030486864105775724, "right": 0.0},
    "yaw_rate_limit": {"limit_rad_s": 1.5},
    "acceleration_limit": {"limit_rad_s2": 60.0, "stop_share": 1.0},
    "turning_buildup": {"limit_rad_s2": 100.0, "at_once_rad_s": 0.0, "shared": 0.0},
}


@pytest.mark.long
@settings(max_examples=15)
@example(
    LONG_WAY,
    (0.12, 0.586163711510468, -0.19162802348634833),
    {name: OF_LONG_WAY.get(name, dict.fromkeys(values, 0.0)) for name, values in FULL.items()},
    (0.0, 0.0, -1.856898605248339, -0.8129740774929726, 4.5038842029330866),
    [(0.0, 0.0)],
    0,
)
@given(paths(), BASE, EFFECTS, STATES, COMMANDS, SEEDS)
def test_costs_and_update_along_a_path_with_all_effects(path, base, effects, values, commands, seed):
    check_against_reference(model_of(base, effects), state_of(values, commands), path, PLAN_SETTINGS, seed)


@pytest.mark.thorough
@settings(max_examples=20)
@given(timed_paths(), SLOW_TURNING, STATES, COMMANDS, SEEDS)
def test_costs_and_update_along_a_path_by_time(path, base, values, commands, seed):
    check_against_reference(model_of(base), state_of(values, commands), path, PLAN_SETTINGS, seed)


@pytest.mark.long
@settings(max_examples=20)
@given(paths() | timed_paths(), BASE, STATES, COMMANDS, SEEDS)
def test_costs_and_update_along_any_path_of_a_model_that_turns_fast(path, base, values, commands, seed):
    check_against_reference(model_of(base), state_of(values, commands), path, PLAN_SETTINGS, seed)
