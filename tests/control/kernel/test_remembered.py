"""The compiled rollout of models whose terms remember, against the numpy reference: every sample under every point."""

from dataclasses import replace

import numpy as np
import pytest

from disco_hw.control import CommandLimits, Disco, DiscoSettings, PlannerState, Sampler, SentCommand
from disco_hw.control import kernel as layout
from disco_hw.control.kernel import BLOCK
from disco_hw.control.parameter_points import sampled_points, unscented_points
from disco_hw.control.plan import command_history
from disco_hw.model import EffectSetting, Gaussian, Model, plain
from disco_hw.model.terms import BODY_MEMORIES, COMMAND_MEMORIES
from disco_hw.tasks.circle import CircleCost
from tests.control import oracle
from tests.model import features
from tests.tasks.costs import circle_cost

SAMPLES, HORIZON, STEP_S = 160, 30, 0.1
TICK_NS = 20_000_000
SETTINGS = DiscoSettings(sampler=Sampler(samples=SAMPLES, horizon=HORIZON), iterations_at_start=1, retries=0)
LIMITS = CommandLimits(8.0, 20.0)
CIRCLE = CircleCost(0.3, -0.2)
DIRECTION, LOAD = "sign(u - mean_0.3s(u))", "u mean_1s(|u| + |u_other|)"
RUBBER, PITCH = "(omega - mean_1s(omega))", "(v - slewed_1.25(v))"
TERMS = {
    f"command += k {DIRECTION}": (-0.3, 0.05), f"command += k {LOAD}": (-0.01, 0.002),
    f"omega += k {RUBBER}": (-0.6, 0.1), f"v_x += k {PITCH}": (-0.2, 0.05), "v_x += k v^3": (-0.3, 0.01),
}  # fmt: skip
SENT = np.repeat([[1.0, 2.0], [5.0, 3.0], [-2.0, 4.0], [3.0, 2.5]], 25, axis=0)
BEFORE, BODY = {DIRECTION: (0.4, -0.7), LOAD: (3.0, 2.0)}, {RUBBER: 1.5, PITCH: 4.0}
"""Means of commands up to the first one sent (rad/s), and of right minus left and the sum of the wheels."""


def model_of(believed, terms=tuple(TERMS)):
    """A model with a lag, a delay and these terms; `believed`: deviations of what is not known exactly."""
    effects = [EffectSetting("motor_lag", {"tau_s": 0.1}), EffectSetting("command_delay", {"delay_s": 0.13})]
    effects += [EffectSetting(name, {"k": TERMS[name][0]}) for name in terms]
    model = Model(0.06, 0.5, 0.1, tuple(effects))
    means = model.point()[[model.parameter_names.index(name) for name in believed]]
    return replace(model, belief=Gaussian(tuple(believed), means, np.diag(np.square(list(believed.values())))))


def state_of(model):
    sent = tuple(SentCommand(TICK_NS * k, left, right) for k, (left, right) in enumerate(SENT.tolist()))
    features = [setting.name.partition(" += k ")[2] for setting in model.effects]
    commands, body = (tuple(known[name] for name in features if name in known) for known in (BEFORE, BODY))
    return PlannerState(
        TICK_NS * len(SENT), 0.4, 0.1, 0.7, 2.5, 2.0, sent, 3.0, command_means=commands, body_means=body
    )  # fmt: skip


def remembered(theta):
    """The reference's means at the start: commands one by one until what acts by now, and the wheels' as told."""
    radius, axial = theta["wheel_radius_m"], theta["axial_distance_m"]
    means = {RUBBER: (radius / axial * BODY[RUBBER],), PITCH: (0.5 * radius * BODY[PITCH],)}
    until_s = 1e-9 * TICK_NS * len(SENT) - float(np.mean(theta["command_delay.delay_s"]))
    for name, begin in BEFORE.items():
        mean = np.array(begin)
        for k, command in enumerate(SENT):
            held_s = min(max(until_s - 1e-9 * TICK_NS * k, 0.0), 1e-9 * TICK_NS)
            goes_in = features.goes_in(name, u=command, u_other=command[::-1])
            mean = features.after(name, mean, goes_in, held_s)
        means[name] = tuple(mean)
    return means


def costs_of(model, theta, commands, state):
    named = plain.theta_of(model.parameter_names, theta)
    start = plain.RobotState(
        state.x_m, state.y_m, state.yaw_rad, state.left_speed_rad_s, state.right_speed_rad_s, remembered(named)
    )
    past = command_history(state.sent, state.t_ns, STEP_S, 8, (0.0, 0.0))
    cost = circle_cost(CIRCLE, STEP_S, 0.1)
    one = dict(named)
    one["command_delay.delay_s"] = np.mean(named["command_delay.delay_s"])
    return oracle.point_costs(one, start, commands, past, STEP_S, cost, time_s=3.0)


def planned(model, settings):
    """A plan's planner, the commands (K, T, 2) of its samples, and their costs under every point (L, K)."""
    disco, state = Disco(model, CIRCLE, settings, LIMITS, 3), state_of(model)
    disco.plan(state.t_ns, state)
    work = disco.optimiser.work
    rows = work.commands.reshape(work.commands.shape[0], -1, 2, int(BLOCK))[:, -HORIZON:].astype(float)
    commands = rows.transpose(0, 3, 1, 2).reshape(-1, HORIZON, 2)[:SAMPLES]
    got = work.point_costs.reshape(-1, work.costs.size)[:, :SAMPLES].astype(float)
    return disco, commands, got


def check(model, settings=SETTINGS):
    disco, commands, got = planned(model, settings)
    theta, weights = unscented_points(model, settings.ut_alpha)
    for point, costs, weight in zip(theta, got, weights, strict=True):
        if weight != 0.0:
            expected = costs_of(model, point, commands, state_of(model))
            np.testing.assert_allclose(costs, expected, rtol=2e-5, atol=2e-4)
    return disco, theta


ALL = {"wheel_radius_m": 0.002, "axial_distance_m": 0.02, "x_icr_m": 0.02, "command_delay.delay_s": 0.02}
ALL |= {f"{name}.k": deviation for name, (_, deviation) in TERMS.items()}


@pytest.mark.long
def test_costs_under_points_that_differ_in_when_and_how_much_was_remembered():
    model = model_of(ALL)
    disco, theta = check(model)
    # The path that is drawn is that of the same rollout.
    for point, path in zip(theta, disco.point_trajectories(), strict=True):
        named = plain.theta_of(model.parameter_names, point)
        state = plain.RobotState(0.4, 0.1, 0.7, 2.5, 2.0, remembered(named))
        past = command_history(state_of(model).sent, state_of(model).t_ns, STEP_S, 8, (0.0, 0.0))
        in_force = plain.delayed(np.vstack([past, disco.optimiser.nominal()]), 8, named, STEP_S)
        for t, (left, right) in enumerate(in_force):
            state, _, _ = plain.step(named, state, left, right, STEP_S, 3.0 + STEP_S * t)
        np.testing.assert_allclose(path[-1], [state.x, state.y, state.yaw], atol=1e-9)


@pytest.mark.thorough
def test_it_matters_to_costs_what_was_before():
    model = model_of({"wheel_radius_m": 0.002})
    _, commands, got = planned(model, replace(SETTINGS, uncertainty="point"))
    bare = costs_of(model, model.point(), commands, state_of(model))
    np.testing.assert_allclose(got[0], bare, rtol=2e-5, atol=2e-4)
    named = plain.theta_of(model.parameter_names, model.point())
    start = plain.RobotState(0.4, 0.1, 0.7, 2.5, 2.0)
    past = command_history(state_of(model).sent, state_of(model).t_ns, STEP_S, 8, (0.0, 0.0))
    forgotten = oracle.point_costs(named, start, commands, past, STEP_S, circle_cost(CIRCLE, STEP_S, 0.1), time_s=3.0)
    assert np.abs(forgotten - bare).max() > 0.01 * np.abs(bare).max()


@pytest.mark.long
@pytest.mark.parametrize("terms", [tuple(TERMS)[:2], tuple(TERMS)[2:4]], ids=["commands", "body"])
def test_costs_where_only_commands_or_only_the_body_are_remembered(terms):
    believed = {name: ALL[name] for name in ("wheel_radius_m", "axial_distance_m", "x_icr_m", f"{terms[0]}.k")}
    check(model_of(believed, terms))


@pytest.mark.long
def test_costs_under_a_draw_for_every_sample():
    model = model_of(ALL)
    disco, commands, (got,) = planned(model, replace(SETTINGS, uncertainty="joint"))
    theta = sampled_points(model, disco.optimiser.padded_samples, 3, disco.optimiser.step_number - 1)
    expected = costs_of(model, theta[:SAMPLES], commands, state_of(model))
    np.testing.assert_allclose(got, expected, rtol=2e-5, atol=2e-4)


def test_there_is_room_for_all_that_terms_may_remember():
    rows = int(layout.BODY_REMEMBERED // BLOCK), sum(len(of) for of in BODY_MEMORIES.values())
    assert sum(rows) <= layout.STATE_ROWS
    assert int(layout.REMEMBERED // BLOCK) + 2 * len(COMMAND_MEMORIES) <= layout.STATE_ROWS
