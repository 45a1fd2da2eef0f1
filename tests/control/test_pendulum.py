"""The pendulum's kernel against the reference, with the paper's control cost and the update from the noise as drawn."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from disco_hw.control import NoValidControl, pendulum
from disco_hw.control.kernel import BLOCK
from disco_hw.control.pendulum import PAPER_SAMPLER, PendulumPlanner, PendulumPoints
from tests.control import oracle

K, T = 160, 30
SAMPLER = replace(PAPER_SAMPLER, samples=K)
THETA = st.lists(st.tuples(st.floats(0.5, 2.0), st.floats(0.5, 2.0)), min_size=5, max_size=5)


def drawn(optimiser):
    """The last step's noise (K, T)."""
    noise = optimiser.work.noise.reshape(K // int(BLOCK), -1, int(BLOCK))[:, :T]
    return noise.swapaxes(0, 1).reshape(T, K).T.astype(float)


def within(theta, angle, speed, torques, got):
    """Whether costs (L, K) are the reference's to 1e-4, or as near as rounding the start to single precision allows.

    A pendulum that comes to rest near the top magnifies the last digit of its start a thousandfold.
    """
    costs, spread = np.empty_like(got, float), np.empty_like(got, float)
    nearby = (np.spacing(np.float32(math.pi)), np.spacing(np.float32(pendulum.LARGEST_SPEED_RAD_S)))
    for i, point in enumerate(theta):
        costs[i], *others = (
            oracle.pendulum_costs(*point, angle + a * nearby[0], speed + b * nearby[1], torques)
            for a, b in ((0, 0), (1, 1), (1, -1))
        )
        spread[i] = np.abs(np.array(others) - costs[i]).max(axis=0)
    return np.abs(got - costs) <= 1e-4 * costs + spread


@pytest.mark.thorough
@settings(max_examples=40)
@given(THETA, st.floats(-10.0, 10.0), st.floats(-8.0, 8.0), st.integers(0, 2**63 - 1))
@example([(1.0, 1.0)] * 4 + [(0.5, 1.0)], 1.5, -6.5, 245)
def test_costs_and_update(theta, angle, speed, seed):
    theta, weights = np.array(theta), np.array([-3.0, 1.0, 1.0, 1.0, 1.0])
    planner = PendulumPlanner(PendulumPoints(theta, weights), SAMPLER, seed)
    first = planner.plan(angle, speed)
    plan = planner.plan(angle, speed)
    shifted = np.append(first[1:], 0.0)
    noise = drawn(planner.optimiser)
    # Single precision holds the angle within a turn; so does the planner.
    wrapped = math.remainder(angle, 2.0 * math.pi)
    torques = np.clip(shifted + noise, -pendulum.LARGEST_TORQUE_NM, pendulum.LARGEST_TORQUE_NM)
    got = planner.optimiser.work.point_costs.reshape(5, K)
    assert within(theta, wrapped, speed, torques, got).all()
    total = oracle.mean_risk(got.astype(float), weights)
    total += oracle.control_cost(shifted[:, None], noise[..., None], SAMPLER.noise_std, SAMPLER.control_cost_weight)
    np.testing.assert_allclose(planner.optimiser.work.costs, total, rtol=1e-4, atol=1e-2)
    share = oracle.softmax_weights(planner.optimiser.work.costs.astype(float), SAMPLER.temperature)
    expected = np.clip(shifted + share @ noise, -pendulum.LARGEST_TORQUE_NM, pendulum.LARGEST_TORQUE_NM)
    np.testing.assert_allclose(plan, expected, atol=1e-3)


@pytest.mark.long
def test_every_sample_may_have_its_own_parameters():
    """A kernel of its own; test_disco.py plans with such parameters of the robot."""
    theta = np.random.default_rng(1).uniform(0.5, 2.0, (2, K, 2))
    planner = PendulumPlanner(PendulumPoints(theta, np.full(2, 0.5), each=True), SAMPLER)
    planner.plan(math.pi, 0.0)
    torques = np.clip(drawn(planner.optimiser), -2.0, 2.0)
    got = planner.optimiser.work.point_costs.reshape(2, K)
    for k in (0, 79, 80, 159):
        expected = [oracle.pendulum_costs(*theta[i, k], math.pi, 0.0, torques[k : k + 1])[0] for i in range(2)]
        np.testing.assert_allclose(got[:, k], expected, rtol=2e-5)


def test_a_state_that_is_none_is_told():
    planner = PendulumPlanner(PendulumPoints(np.ones((5, 2)), np.full(5, 0.2)), SAMPLER)
    with pytest.raises(NoValidControl, match="no torque sequence has a finite cost"):
        planner.plan(0.0, math.nan)
    assert np.isfinite(planner.plan(0.0, 0.0)).all()


def test_the_printed_cost_does_not_tell_up_from_down_but_this_one_does():
    assert pendulum.instant_cost(math.pi, 0.0) == 200.0
    assert pendulum.instant_cost(0.0, 0.0) == 0.0
