"""The optimiser on the pendulum: its plan, its random numbers, its report, and what it sampled."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import BSpline

from disco_hw.control.kernel import BLOCK
from disco_hw.control.kernel.step import LEAST, NOMINAL, TEMPERATURE, VALID
from disco_hw.control.optimiser import FIRST_TEMPERATURE, Optimiser, spline_basis
from disco_hw.control.pendulum import LARGEST_TORQUE_NM, PAPER_SAMPLER, STEP_S, PendulumTerms

T, SAMPLES = 20, 100
SAMPLER = replace(PAPER_SAMPLER, samples=SAMPLES, horizon=T)
# As the robot's: the noise as applied, the plan among the samples, temperature by effective sample size.
APPLIED = replace(
    SAMPLER, with_nominal=True, temperature=None, target_ess=10.0, control_cost_weight=0.0, update_from="applied",
    beyond_end="hold",
)  # fmt: skip
WEIGHTS = np.ones(1, np.float32)


def pendulum(angle_rad=math.pi, speed_rad_s=0.0):
    gravity, gain = (np.array([value], np.float32) for value in (1.5 * 9.8 * STEP_S, 3.0 * STEP_S))
    return PendulumTerms(np.array([angle_rad, speed_rad_s], np.float32), gravity, gain, None, np.float32(STEP_S))


def optimiser(sampler=APPLIED, seed=3, history=0, change=0.8):
    return Optimiser(sampler, 1, 1, history, LARGEST_TORQUE_NM, change, seed)


def test_steps_lower_the_cost_of_the_plan():
    found = optimiser()
    reports = []
    for _ in range(30):
        assert found.step(0.0, 1.0, (0.0,), pendulum(), WEIGHTS)
        reports.append(found.work.report.copy())
    assert reports[-1][NOMINAL] < 0.97 * reports[0][NOMINAL]
    assert reports[-1][LEAST] <= reports[-1][NOMINAL] <= reports[0][NOMINAL]
    assert found.ess == pytest.approx(10.0, rel=0.02)
    assert reports[-1][VALID] == SAMPLES


def test_random_numbers_depend_on_seed_and_step_number_alone():
    plans = []
    for skipped in (0, 1):
        found = optimiser(seed=5)
        for _ in range(skipped):
            found.step(0.0, 1.0, (0.0,), pendulum(), WEIGHTS)
        found.reset()
        found.step_number = 7
        found.step(0.0, 1.0, (0.0,), pendulum(), WEIGHTS)
        plans.append(found.nominal())
        assert found.step_number == 8
    np.testing.assert_array_equal(*plans)
    other = optimiser(seed=6)
    other.step_number = 7
    other.step(0.0, 1.0, (0.0,), pendulum(), WEIGHTS)
    assert not np.array_equal(other.nominal(), plans[0])


def test_the_plan_is_a_copy_and_can_be_set_and_forgotten():
    found = optimiser()
    wanted = np.linspace(-1.0, 1.0, T)[:, None]
    found.set_nominal(wanted)
    plan = found.nominal()
    np.testing.assert_allclose(plan, wanted, atol=1e-6)
    with pytest.raises(ValueError, match="read-only"):
        plan[0] = 1.0
    found.step(0.0, 1.0, (0.0,), pendulum(), WEIGHTS)
    np.testing.assert_allclose(plan, wanted, atol=1e-6)
    found.reset()
    assert not found.nominal().any()
    assert found.work.report[TEMPERATURE] == FIRST_TEMPERATURE


def test_a_gain_below_one_moves_the_plan_that_part_of_the_way():
    plans = []
    for gain in (0.0, 0.25, 1.0):
        found = optimiser()
        found.step(0.0, gain, (0.0,), pendulum(), WEIGHTS)
        plans.append(found.nominal())
    assert not plans[0].any()
    np.testing.assert_allclose(plans[1], 0.25 * plans[2], atol=1e-6)
    assert np.abs(plans[2]).max() > 0.1


def test_commands_stay_within_bounds_from_what_was_before():
    found = optimiser(change=0.3)
    for _ in range(5):
        found.step(0.0, 1.0, (1.5,), pendulum(), WEIGHTS)
    sampled, _ = found.sampled_commands(SAMPLES)
    steps = np.diff(np.concatenate([np.full((SAMPLES, 1, 1), 1.5), sampled], axis=1), axis=1)
    assert np.abs(steps).max() <= 0.3 + 1e-6
    assert 1.0 < np.abs(sampled).max() <= LARGEST_TORQUE_NM + 1e-6


def test_samples_can_be_worked_out_again_and_make_the_plan():
    found = optimiser()
    for _ in range(3):
        found.step(0.3, 1.0, (0.2,), pendulum(), WEIGHTS)
    commands, weights = found.sampled_commands(SAMPLES)
    assert np.all(np.diff(weights) <= 0.0)
    np.testing.assert_allclose(weights.sum(), 1.0, rtol=1e-6)
    np.testing.assert_allclose(np.einsum("n,ntc->tc", weights, commands), found.nominal(), atol=1e-5)
    # The same as the kernel kept.
    kept = found.work.commands.reshape(-1, T, int(BLOCK)).transpose(0, 2, 1).reshape(-1, T)[:SAMPLES]
    order = np.argsort(-found.work.weights[:SAMPLES], kind="stable")
    np.testing.assert_allclose(commands[..., 0], kept[order], atol=1e-5)


def test_what_was_sent_before_lies_ahead_of_every_blocks_commands():
    found = optimiser(history=2)
    past = np.array([[0.5], [-0.25]])
    found.set_command_history(past)
    found.step(0.0, 1.0, (0.0,), pendulum(), WEIGHTS)
    rows = found.work.commands.reshape(-1, 2 + T, int(BLOCK))
    assert rows.shape[0] == 2
    np.testing.assert_array_equal(rows[:, :2], np.broadcast_to(past, (2, 2, int(BLOCK))))


def test_nothing_valid_leaves_the_plan_and_is_told():
    found = optimiser()
    found.set_nominal(np.full((T, 1), 0.5))
    assert not found.step(0.0, 1.0, (0.0,), pendulum(math.nan), WEIGHTS)
    np.testing.assert_array_equal(found.nominal(), np.full((T, 1), 0.5))
    assert found.work.report[VALID] == 0
    commands, weights = found.sampled_commands(10)
    assert commands.shape == (0, T, 1)
    assert weights.size == 0


def test_noise_as_drawn_moves_the_plan_beyond_what_the_bounds_let_through():
    plans = {}
    for update_from in ("applied", "drawn"):
        found = optimiser(replace(APPLIED, update_from=update_from), change=0.05)
        found.step(0.0, 1.0, (0.0,), pendulum(), WEIGHTS)
        plans[update_from] = np.abs(np.diff(found.nominal()[:, 0])).max()
    assert plans["applied"] <= 0.05 + 1e-6 < plans["drawn"]


@pytest.mark.parametrize(("knots", "horizon"), [(4, 2), (5, 50), (8, 50), (8, 7), (30, 50)])
def test_the_spline_basis_is_that_of_a_clamped_cubic_spline(knots, horizon):
    first, weights = spline_basis(knots, horizon)
    assert first.min() >= 0
    assert first.max() <= knots - 4
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    control = np.random.default_rng(0).standard_normal(knots)
    vector = np.r_[0, 0, 0, np.linspace(0, 1, knots - 2), 1, 1, 1]
    expected = BSpline(vector, control, 3)((np.arange(horizon) + 0.5) / horizon)
    np.testing.assert_allclose((weights * control[first[:, None] + np.arange(4)]).sum(axis=1), expected, atol=1e-12)
