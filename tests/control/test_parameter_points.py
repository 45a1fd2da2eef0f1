"""Parameter points: from beliefs to what every sequence is rolled out under."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from disco_hw.control.parameter_points import (
    equivalent_points,
    mean_point,
    moments,
    point_estimate,
    sampled_points,
    shared_pairs,
    unscented_points,
)
from disco_hw.model import EffectSetting, Gaussian, Mixture, Model, load_model
from disco_hw.model.terms import effect_of

PAPER = load_model(Path(__file__).parents[2] / "disco_hw/robots/wombot_model.toml")
LAG = EffectSetting("motor_lag", {"tau_s": 0.1})
STEP_S = 0.1
BIAS = EffectSetting("heading_bias", {"bias_rad": 0.1})


def assert_moments_of(belief, model, points, weights):
    """Over the believed parameters the points have the belief's mean and covariance."""
    of_belief = points[:, [model.parameter_names.index(name) for name in belief.names]]
    np.testing.assert_allclose(weights @ of_belief, belief.mean())
    offsets = of_belief - belief.mean()
    np.testing.assert_allclose(np.einsum("l,li,lj->ij", weights, offsets, offsets), belief.covariance(), atol=1e-12)


def test_unscented_points_carry_the_beliefs_moments_over_all_parameters():
    assert_moments_of(PAPER.belief, PAPER, *unscented_points(PAPER, 1.0))


def test_two_points_differ_from_the_mean_in_x_icr_alone_and_two_in_scale_too():
    points, _ = unscented_points(PAPER, 0.5)
    assert shared_pairs(PAPER, points, STEP_S) == 2
    found = equivalent_points(PAPER, points, STEP_S, 2)
    np.testing.assert_array_equal(found[0], [3, 6, 2, 5])
    np.testing.assert_array_equal(found[[2, 3, 5, 6]], np.full((4, 4), -2))
    np.testing.assert_array_equal(found[[1, 4]], np.full((2, 4), -1))
    np.testing.assert_array_equal(points[[3, 6], :2], points[[0, 0], :2])
    assert points[3, 2] > points[0, 2] > points[6, 2]
    np.testing.assert_allclose(points[[2, 5], 0] / points[[2, 5], 1], points[0, 0] / points[0, 1], rtol=1e-12)
    assert points[2, 0] > points[0, 0] > points[5, 0]


@pytest.mark.parametrize("effect", ["turn_slip", "wheel_radius_asymmetry", "slope"])
def test_behind_an_effect_on_the_body_no_point_is_another_at_a_scale(effect):
    values = {parameter.name: 0.01 for parameter in effect_of(effect).parameters}
    model = replace(PAPER, effects=(LAG, EffectSetting(effect, values)))
    points, _ = unscented_points(model, 1.0)
    assert shared_pairs(model, points, STEP_S) == 1
    np.testing.assert_array_equal(equivalent_points(model, points, STEP_S, 1)[0], [3, 6])


def test_effects_on_the_wheels_leave_the_scale_alone_and_believed_ones_keep_their_own_points():
    names = ("axial_distance_m", "motor_lag.tau_s", "x_icr_m", "wheel_radius_m")
    belief = Gaussian(names, np.array([0.4, 0.1, 0.2, 0.06]), np.diag([1e-4, 1e-4, 1e-4, 1e-6]) + 1e-7)
    model = Model(0.06, 0.4, effects=(LAG,), belief=belief)
    points, weights = unscented_points(model, 1.0)
    assert shared_pairs(model, points, STEP_S) == 2
    found = equivalent_points(model, points, STEP_S, 2)
    assert np.sum(found[:, 0] >= 0) == 1
    np.testing.assert_array_equal(points[found[0], 3], np.full(4, points[0, 3]))
    assert_moments_of(belief, model, points, weights)


def test_without_twins_there_are_none():
    model = Model(0.06, 0.4, belief=Gaussian(("wheel_radius_m",), np.array([0.06]), np.array([[1e-5]])))
    points, _ = unscented_points(model, 1.0)
    assert shared_pairs(model, points, STEP_S) == 0
    np.testing.assert_array_equal(equivalent_points(model, points, STEP_S, 1), np.full((3, 2), -1))


def test_points_at_the_end_of_their_range_are_no_twins():
    # The wide prior's points reach below the least radius and are kept there: their ratio is another one.
    wide = Gaussian(PAPER.belief.names, PAPER.belief.mean(), 40.0 * PAPER.belief.covariance())
    model = replace(PAPER, belief=wide)
    points, _ = unscented_points(model, 1.0)
    assert points[:, 0].min() == 0.005
    found = equivalent_points(model, points, STEP_S, 2)
    for leader, group in enumerate(found):
        for twin in group[group >= 0]:
            assert points[twin, 0] / points[twin, 1] == pytest.approx(points[leader, 0] / points[leader, 1], rel=1e-9)


def test_points_are_kept_in_their_physical_range():
    belief = Gaussian(("wheel_radius_m", "motor_lag.tau_s"), np.array([0.06, 0.05]), np.diag([0.01, 0.01]))
    model = Model(0.06, 0.4, effects=(LAG,), belief=belief)
    for points in (unscented_points(model, 1.0)[0], sampled_points(model, 500, 1, 0)):
        assert points[:, 0].min() == 0.005
        assert points[:, 3].min() == 0.0


def test_parameters_that_only_measure_make_no_points():
    names = ("wheel_radius_m", "heading_bias.bias_rad")
    belief = Gaussian(names, np.array([0.06, 0.1]), np.diag([1e-5, 0.01]))
    assert unscented_points(Model(0.06, 0.4, effects=(BIAS,), belief=belief), 1.0)[0].shape == (3, 4)
    only = Gaussian(names[1:], np.array([0.1]), np.array([[0.01]]))
    assert unscented_points(Model(0.06, 0.4, effects=(BIAS,), belief=only), 1.0)[0].shape == (1, 4)


@pytest.mark.parametrize(("weight", "mean"), [(0.95, 0.06), (0.6, 0.6 * 0.06 + 0.4 * 0.1)])
def test_a_mixture_counts_by_its_dominant_component_or_as_a_whole(weight, mean):
    one = Gaussian(("wheel_radius_m",), np.array([0.06]), np.array([[1e-5]]))
    other = Gaussian(("wheel_radius_m",), np.array([0.1]), np.array([[1e-5]]))
    mixture = Mixture(np.array([weight, 1.0 - weight]), (one, other))
    assert moments(mixture)[0][0] == pytest.approx(mean)


def test_draws_are_a_function_of_seed_and_step():
    one, same = (sampled_points(PAPER, 50, 7, 3) for _ in range(2))
    np.testing.assert_array_equal(one, same)
    assert not np.any(sampled_points(PAPER, 50, 7, 4)[:, 0] == one[:, 0])
    assert not np.any(sampled_points(PAPER, 50, 8, 3)[:, 0] == one[:, 0])


def test_the_command_delay_is_drawn_at_its_mean():
    names = ("wheel_radius_m", "command_delay.delay_s")
    belief = Gaussian(names, np.array([0.06, 0.1]), np.diag([1e-5, 1e-3]))
    model = Model(0.06, 0.4, effects=(EffectSetting("command_delay", {"delay_s": 0.2}),), belief=belief)
    draws = sampled_points(model, 20, 1, 0)
    np.testing.assert_array_equal(draws[:, 3], 0.1)
    assert np.ptp(draws[:, 0]) > 0.0


def test_point_and_mean():
    model = replace(PAPER, wheel_radius_m=0.07)
    np.testing.assert_allclose(point_estimate(model)[0], [[0.07, 0.415, 0.238]])
    np.testing.assert_allclose(mean_point(model), [[0.061, 0.415, 0.238]])
