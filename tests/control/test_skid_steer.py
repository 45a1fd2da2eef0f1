"""The fused kernel against the numpy reference: costs, weights and update, over random parameters, effects, states."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from disco_hw.control import Circle, Disco, DiscoSettings, PlannerState, Sampler, SentCommand, WheelLimits, reference
from disco_hw.control.blocks import BLOCK
from disco_hw.control.parameter_points import unscented_points
from disco_hw.control.past import past_commands
from disco_hw.control.spline import spline_basis
from disco_hw.model import EffectSetting, Gaussian, Model
from disco_hw.model import reference as physics

SAMPLES, HORIZON, STEP_S = 160, 50, 0.1
SAMPLER = Sampler(samples=SAMPLES, horizon=HORIZON)
PLAN_SETTINGS = DiscoSettings(sampler=SAMPLER, iterations_at_start=1, retries=0, gain_by_time=False)
LIMITS = WheelLimits(8.0, 20.0)

BASE = st.tuples(st.floats(0.02, 0.12), st.floats(0.2, 0.8), st.floats(-0.3, 0.4))
STATES = st.tuples(
    st.floats(-2.0, 2.0),
    st.floats(-2.0, 2.0),
    st.floats(-math.pi, math.pi),
    st.floats(-6.0, 6.0),
    st.floats(-6.0, 6.0),
)
COMMANDS = st.lists(st.tuples(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0)), min_size=1, max_size=30)
FULL = {
    "motor_lag": {"tau_s": st.floats(0.0, 0.5)},
    "command_delay": {"delay_s": st.floats(0.0, 0.45)},
    "deadband": {"width_rad_s": st.floats(0.0, 1.0)},
    "stiction": {"threshold_rad_s": st.just(0.0)},
    "speed_limit": {"limit_rad_s": st.floats(2.0, 9.0)},
    "yaw_rate_limit": {"limit_rad_s": st.floats(0.3, 5.0)},
    "battery_sag": {"loss": st.floats(0.0, 0.5)},
    "wheel_gain": {"left": st.floats(-0.1, 0.1), "right": st.floats(-0.1, 0.1)},
    "wheel_radius_asymmetry": {"ratio": st.floats(-0.05, 0.05)},
    "turn_slip": {"k_s": st.floats(-0.1, 0.3)},
    "acceleration_slip": {"k_s2_m": st.floats(-0.1, 0.3)},
    "side_slip": {"k_s": st.floats(-0.1, 0.3)},
    "lateral_icr": {"offset_m": st.floats(-0.1, 0.1)},
    "slope": {"drift_x_m_s": st.floats(-0.05, 0.05), "drift_y_m_s": st.floats(-0.05, 0.05)},
    "surface_change": {"track": st.floats(-0.2, 0.3), "time_s": st.floats(0.0, 8.0), "radius": st.floats(-0.05, 0.05)},
}
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


def check_against_reference(model, state, task, plan_settings, seed):
    """Plan twice and check every cost, the weights and the update of the second step."""
    disco = Disco(model, task, plan_settings, LIMITS, seed)
    now_ns = state.t_ns
    before = disco.plan(now_ns, state).wheel_speeds
    disco.plan(now_ns, state)
    work = disco._optimiser.work

    sampler = plan_settings.sampler
    noise = work.noise.reshape(-1, work.noise.size // work.weights.size, int(BLOCK)).swapaxes(0, 1)
    noise = noise.reshape(noise.shape[0], -1)[: sampler.knots * 2, : sampler.samples].astype(float)
    first, weights = spline_basis(sampler.knots, sampler.horizon)
    by_knot = noise.T.reshape(sampler.samples, sampler.knots, 2)
    spread = np.einsum("tj,ktjc->ktc", weights, by_knot[:, first[:, None] + np.arange(4)])
    last = state.sent[-1]
    anchor = np.array(disco._anchor(state))
    assert np.all(np.abs(anchor - (last.left_rad_s, last.right_rad_s)) <= 12.0)
    change = LIMITS.acceleration_rad_s2 * STEP_S
    commands = reference.limited(before, spread, anchor, LIMITS.speed_rad_s, change)

    theta, point_weights = unscented_points(model, plan_settings.ut_alpha)
    past = past_commands(state.sent, now_ns, STEP_S, 8, (state.left_speed_rad_s, state.right_speed_rad_s))
    start = physics.State(state.x_m, state.y_m, state.yaw_rad, state.left_speed_rad_s, state.right_speed_rad_s)
    expected = np.array(
        [
            reference.point_costs(
                physics.theta_of(model.parameter_names, point), start, commands, past, STEP_S,
                reference.circle_cost(task, STEP_S), time_s=state.elapsed_s,
            )
            for point in theta
        ]
    )  # fmt: skip
    got = work.point_costs.reshape(point_weights.size, -1)[:, : sampler.samples]
    np.testing.assert_allclose(got, expected, atol=1e-4, rtol=1e-5)

    mean = reference.mean_risk(expected, point_weights)
    np.testing.assert_allclose(work.costs[: sampler.samples], mean, atol=1e-4, rtol=1e-5)
    report = disco._optimiser.report()
    assert report["cost_nominal"] == pytest.approx(mean[0], abs=1e-4, rel=1e-5)
    kernel_weights = reference.softmax_weights(work.costs[: sampler.samples].astype(float), report["temperature"])
    assert report["ess"] == pytest.approx(reference.effective_sample_size(kernel_weights), rel=1e-3)
    np.testing.assert_allclose(work.nominal, reference.updated(commands, kernel_weights), atol=2e-4)


@settings(max_examples=60, deadline=None)
@given(BASE, STATES, COMMANDS, st.integers(0, 2**63 - 1))
def test_costs_and_update_of_the_bare_model(base, values, commands, seed):
    check_against_reference(model_of(base), state_of(values, commands), Circle(), PLAN_SETTINGS, seed)


@settings(max_examples=60, deadline=None)
@given(BASE, EFFECTS, STATES, COMMANDS, st.integers(0, 2**63 - 1))
def test_costs_and_update_with_all_effects(base, effects, values, commands, seed):
    check_against_reference(model_of(base, effects), state_of(values, commands), Circle(), PLAN_SETTINGS, seed)
