"""The planner over any transition function: against the reference, repeatable, safe, on every device that is there."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from disco_hw.control import NoValidControl, Sampler, pendulum
from disco_hw.control.black_box import BlackBoxDisco
from disco_hw.control.parameter_points import sampled_points, unscented_points
from disco_hw.control.pendulum import PAPER_SAMPLER
from disco_hw.model import plain as physics
from disco_hw.tasks.circle import CircleCost
from tests.control import oracle
from tests.control.torch_models import circle_cost, pendulum_cost, pendulum_transition, skid_steer_transition
from tests.tasks import costs
from tests.tasks.drives import MODEL

POINTS, WEIGHTS = unscented_points(MODEL, 1.0)
STEP_S, T, K = 0.1, 20, 64
SAMPLER = Sampler(samples=K, horizon=T)
START = np.array([0.75, 0.1, 1.2, 0.0])
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def skid_steer(sampler=SAMPLER, theta=POINTS, weights=WEIGHTS, **options):
    return BlackBoxDisco(
        skid_steer_transition(STEP_S), circle_cost(CircleCost()), theta[..., :3], weights, 2, sampler,
        **{"largest": 8.0, "dtype": torch.float64} | options,
    )  # fmt: skip


def costs_of(disco, commands):
    return disco._rolled(torch.as_tensor(START), torch.as_tensor(commands)).numpy()


@pytest.mark.parametrize("each", [False, True])
def test_costs_are_those_of_the_reference(each):
    theta, weights = (
        (sampled_points(MODEL, 3 * K, 1, 0).reshape(3, K, 3), np.full(3, 1 / 3)) if each else (POINTS, WEIGHTS)
    )
    commands = np.random.default_rng(1).uniform(-6.0, 6.0, (K, T, 2))
    got = costs_of(skid_steer(theta=theta, weights=weights), commands)
    start, past = physics.RobotState(*START[:3], 0.0, 0.0), np.zeros((1, 2))
    cost = costs.circle_cost(CircleCost().paper(), STEP_S)
    for row, point in zip(got, theta, strict=True):
        named = physics.theta_of(MODEL.parameter_names, point)
        np.testing.assert_allclose(row, oracle.point_costs(named, start, commands, past, STEP_S, cost), atol=1e-9)


@pytest.mark.parametrize(("risk", "part"), [("mean", 1.0), ("cvar", 0.3), ("worst", 1e-9)])
def test_risk_is_that_of_the_reference(risk, part):
    costs = np.random.default_rng(2).gamma(2.0, size=(7, K))
    weights = np.random.default_rng(3).dirichlet(np.ones(7))
    disco = skid_steer(replace(SAMPLER, risk=risk, worst_part=max(part, 1e-3)), weights=weights)
    expected = oracle.mean_risk(costs, weights) if risk == "mean" else oracle.cvar_risk(costs, weights, part)
    np.testing.assert_allclose(disco._combined(torch.as_tensor(costs)).numpy(), expected, rtol=1e-9)


def test_the_plan_is_the_weighted_mean_at_the_wanted_effective_sample_size():
    disco = skid_steer()
    noise = disco._noise().numpy()
    commands = np.clip(noise, -8.0, 8.0)
    mean = oracle.mean_risk(costs_of(disco, commands), WEIGHTS)
    weights = oracle.softmax_weights(mean, oracle.temperature_for(mean, SAMPLER.target_ess))
    np.testing.assert_allclose(disco.plan(START), oracle.updated(commands, weights), atol=1e-6)
    assert disco.ess == pytest.approx(SAMPLER.target_ess, rel=1e-3)
    assert not noise[0].any()


def test_the_papers_control_cost_and_update_from_the_noise_as_drawn():
    sampler = replace(SAMPLER, knots=None, with_nominal=False, temperature=0.3, control_cost_weight=0.3, noise_std=3.0,
                      update_from="drawn", beyond_end="zero")  # fmt: skip
    disco = skid_steer(sampler, largest=2.0)
    nominal = disco.plan(START)
    shifted = np.vstack([nominal[1:], np.zeros((1, 2))])
    noise = disco._noise().numpy()
    costs = oracle.mean_risk(costs_of(disco, np.clip(shifted + noise, -2.0, 2.0)), WEIGHTS)
    costs += oracle.control_cost(shifted, noise, 3.0, 0.3)
    expected = np.clip(shifted + oracle.updated(noise, oracle.softmax_weights(costs, 0.3)), -2.0, 2.0)
    np.testing.assert_allclose(disco.plan(START), expected, atol=1e-9)


def test_commands_keep_their_limits():
    disco = skid_steer(largest=3.0, change=0.5)
    plan = disco.plan(START)
    assert np.abs(plan).max() <= 3.0
    assert np.abs(np.diff(plan, axis=0)).max() <= 0.5 + 1e-9


def test_the_same_seed_repeats_and_reset_goes_on():
    one, other = skid_steer(seed=5), skid_steer(seed=5)
    first = one.plan(START)
    np.testing.assert_array_equal(first, other.plan(START))
    np.testing.assert_array_equal(one.plan(START), other.plan(START))
    one.reset()
    assert not np.array_equal(one.plan(START), first)
    assert not np.array_equal(skid_steer(seed=6).plan(START), first)


def test_without_a_finite_cost_it_says_so_and_keeps_the_plan():
    disco = skid_steer()
    disco.plan(START)
    kept = disco._nominal.clone()
    with pytest.raises(NoValidControl, match="no control sequence has a finite cost"):
        disco.plan(np.full(4, math.nan), shift_steps=0)
    assert torch.equal(disco._nominal, kept)
    assert np.isfinite(disco.plan(START)).all()


@pytest.mark.parametrize("device", DEVICES)
def test_the_pendulum_is_swung_up(device):
    theta, weights = np.array([[1.0, 1.0]]), np.ones(1)
    disco = BlackBoxDisco(
        pendulum_transition, pendulum_cost, theta, weights, 1, replace(PAPER_SAMPLER, samples=200),
        largest=pendulum.LARGEST_TORQUE_NM, device=device,
    )  # fmt: skip
    angle, speed = math.pi, 0.0
    for _ in range(120):
        angle, speed = pendulum.step(angle, speed, disco.plan(np.array([angle, speed]))[0, 0], 1.0, 1.0)
    assert math.cos(angle) > 0.95


NEGATIVE = np.array([-0.5, *[0.25] * 6])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sampler": replace(SAMPLER, risk="cvar"), "weights": NEGATIVE}, "weights: -0.5 is negative, and risk 'cvar'"),
        ({"sampler": replace(SAMPLER, risk="worst"), "weights": NEGATIVE}, "-0.5 is negative, and risk 'worst'"),
        ({"weights": WEIGHTS[1:]}, r"weights: shape \(6,\); must be \(7,\), one for each point of theta"),
        ({"weights": np.full(7, 0.5)}, "weights: sum to 3.5; must sum to 1"),
        ({"weights": np.full(7, math.nan)}, "theta, weights: must be finite"),
        ({"theta": POINTS[0]}, r"theta: shape \(3,\); must be \(L, p\), or \(L, 64, p\)"),
        ({"theta": np.ones((7, K - 1, 3))}, r"theta: shape \(7, 63, 3\); must be"),
        ({"largest": 0.0}, "largest: 0.0; must be above 0"),
        ({"largest": math.nan}, "largest: nan; must be above 0"),
        ({"change": -1.0}, "change: -1.0; must be above 0"),
    ],
)
def test_settings_without_a_meaning_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        skid_steer(**options)


def test_negative_weights_have_a_meaning_for_the_mean():
    assert np.isfinite(skid_steer(weights=NEGATIVE).plan(START)).all()


@pytest.mark.parametrize(
    ("name", "wrong", "returned"),
    [
        ("transition", lambda state, control, theta: state[:1], r"\(.*\); must return a tensor of shape \(7, 64"),
        ("stage_cost", lambda state, t: state[..., 0].mean(), r"\(.*\); must return a tensor of shape \(7, 64"),
        ("stage_cost", lambda state, t: 0.0, r"float; must return a tensor of shape \(7, 64\)"),
        ("terminal_cost", lambda state: state[..., :1], r"\(.*\); must return a tensor of shape \(7, 64"),
    ],
)
def test_what_is_no_tensor_of_the_right_shape_is_refused(name, wrong, returned):
    given = {"transition": skid_steer_transition(STEP_S), "stage_cost": circle_cost(CircleCost())}
    disco = BlackBoxDisco(**{**given, name: wrong}, theta=POINTS, weights=WEIGHTS, controls=2, sampler=SAMPLER)
    with pytest.raises(ValueError, match=f"{name} returned {returned}"):
        disco.plan(START)


def test_a_state_and_a_shift_that_are_none_are_refused():
    disco = skid_steer()
    with pytest.raises(ValueError, match=r"state: shape \(1, 4\); must be \(n,\)"):
        disco.plan(START[None])
    with pytest.raises(ValueError, match="shift_steps: -1; must be 0 or more"):
        disco.plan(START, shift_steps=-1)
    with pytest.raises(ValueError, match="controls: 0; must be above 0"):
        BlackBoxDisco(skid_steer_transition(STEP_S), circle_cost(CircleCost()), POINTS, WEIGHTS, 0, SAMPLER)
