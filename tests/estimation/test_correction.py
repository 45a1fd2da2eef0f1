"""The correction against textbook forms that share nothing with it."""

import math

import numpy as np
import pytest
from hypothesis import strategies as st

from disco_hw.estimation.correction import FLOOR_VARIANCE, Measurement, PoseCorrector
from disco_hw.estimation.odometry import Pose, PoseBelief
from tests.tables import examples


def belief_of(mean, covariance, sensitivity=None):
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = covariance.tolist()
    flat = None if sensitivity is None else tuple(sensitivity.ravel().tolist())
    return PoseBelief(*mean, xx, xy, xt, yy, yt, tt, flat)


def measured(x, y, yaw, position_variance=1e-4, yaw_variance=4e-4):
    return Measurement(0, Pose(x, y, yaw), position_variance, yaw_variance, False)


def random_covariance(rng, scale=1.0):
    root = rng.standard_normal((3, 3)) * scale
    return root @ root.T + 1e-4 * np.eye(3)


@pytest.mark.parametrize("seed", range(5))
def test_update_equals_the_information_form(seed):
    rng = np.random.default_rng(seed)
    prior, mean = random_covariance(rng, 0.1), rng.normal(size=3)
    z = mean + rng.normal(size=3) * 0.1
    noise = np.diag([1e-4, 1e-4, 4e-4])
    correction = PoseCorrector().correct(belief_of(mean.tolist(), prior), measured(*z.tolist()))
    information = np.linalg.inv(prior) + np.linalg.inv(noise)
    posterior = np.linalg.inv(information)
    expected = posterior @ (np.linalg.solve(prior, mean) + np.linalg.solve(noise, z))
    got = correction.belief
    np.testing.assert_allclose([got.x_m, got.y_m, got.yaw_rad], expected, atol=1e-9)
    np.testing.assert_allclose(got.covariance, posterior + FLOOR_VARIANCE * np.eye(3), rtol=1e-6, atol=1e-12)
    innovation = z - mean
    np.testing.assert_allclose(correction.innovation, innovation, atol=1e-12)
    np.testing.assert_allclose(correction.innovation_variance, np.diag(prior + noise))
    assert correction.distance2 == pytest.approx(innovation @ np.linalg.inv(prior + noise) @ innovation)


@pytest.mark.parametrize("seed", range(5))
def test_uncertain_parameters_are_considered_and_not_estimated(seed):
    rng = np.random.default_rng(seed)
    rest, sensitivity = random_covariance(rng, 0.05), rng.normal(size=(3, 3)) * 0.1
    mean = rng.normal(size=3)
    z = mean + rng.normal(size=3) * 0.05
    correction = PoseCorrector().correct(belief_of(mean.tolist(), rest, sensitivity), measured(*z.tolist()))
    # Schmidt's filter in the joint state (pose, normalised parameters), any gain form, with no gain on the parameters.
    joint = np.block([[rest + sensitivity @ sensitivity.T, sensitivity], [sensitivity.T, np.eye(3)]])
    observe = np.hstack([np.eye(3), np.zeros((3, 3))])
    noise = np.diag([1e-4, 1e-4, 4e-4])
    gain = joint @ observe.T @ np.linalg.inv(observe @ joint @ observe.T + noise)
    gain[3:] = 0.0
    keep = np.eye(6) - gain @ observe
    joint = keep @ joint @ keep.T + gain @ noise @ gain.T
    got = correction.belief
    np.testing.assert_allclose([got.x_m, got.y_m, got.yaw_rad], mean + gain[:3] @ (z - mean), atol=1e-9)
    np.testing.assert_allclose(got.covariance, joint[:3, :3] + FLOOR_VARIANCE * np.eye(3), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(np.array(got.sensitivity).reshape(3, 3), joint[:3, 3:], atol=1e-9)


@pytest.mark.parametrize(("predicted", "seen"), [(3.13, -3.13), (-3.13, 3.13), (3.13, -3.13 + 20 * math.tau)])
def test_yaw_innovation_takes_the_short_way_round(predicted, seen):
    covariance = np.diag([1e-4, 1e-4, 4e-4])
    correction = PoseCorrector().correct(belief_of((0.0, 0.0, predicted), covariance), measured(0.0, 0.0, seen))
    short = math.copysign(math.tau - 6.26, predicted)
    assert correction.innovation[2] == pytest.approx(short, abs=1e-12)
    # Equal variances: the result is half way, at pi, not at zero.
    assert abs(correction.belief.yaw_rad) == pytest.approx(math.pi, abs=1e-6)
    assert -math.pi < correction.belief.yaw_rad <= math.pi


def test_a_thousand_poses_at_standstill_leave_the_covariance_above_its_floor():
    corrector = PoseCorrector()
    belief = belief_of((0.0, 0.0, 0.0), np.diag([1.0, 1.0, 1.0]))
    for _ in range(1000):
        belief = corrector.correct(belief, measured(0.0, 0.0, 0.0)).belief
    standard_deviations = np.sqrt(np.diag(belief.covariance))
    # Balance of floor q and information 1/r: P^2 = q (P + r).
    np.testing.assert_allclose(standard_deviations[:2], math.sqrt(math.sqrt(FLOOR_VARIANCE * 1e-4)), rtol=0.01)
    assert np.linalg.eigvalsh(np.array(belief.covariance))[0] >= FLOOR_VARIANCE


def test_one_corrector_serves_many_beliefs_without_memory():
    rng = np.random.default_rng(0)
    used, cases = PoseCorrector(), []
    for _ in range(10):
        belief = belief_of(rng.normal(size=3).tolist(), random_covariance(rng))
        cases.append((belief, measured(*rng.normal(size=3).tolist())))
    assert [used.correct(*case) for case in cases] == [PoseCorrector().correct(*case) for case in cases]


@examples(
    quick=30,
    every=100,
    exponents=st.lists(st.floats(-8, 4), min_size=3, max_size=3),
    z=st.tuples(st.floats(-1000, 1000), st.floats(-1000, 1000), st.floats(-10, 10)),
    noise_exponent=st.floats(-6, 4),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_sizes_leave_the_covariance_symmetric_and_positive_definite(exponents, z, noise_exponent, seed):
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    covariance = turn @ np.diag(10.0 ** np.array(exponents)) @ turn.T
    sensitivity = rng.normal(size=(3, 3)) if seed % 2 else None
    corrected = PoseCorrector().correct(
        belief_of((0.0, 0.0, 0.0), covariance, sensitivity), measured(*z, 10.0**noise_exponent, 10.0**noise_exponent)
    )
    posterior = np.array(corrected.belief.covariance)
    assert np.isfinite([*posterior.ravel(), corrected.belief.x_m, corrected.belief.yaw_rad]).all()
    np.testing.assert_array_equal(posterior, posterior.T)
    assert np.linalg.eigvalsh(posterior)[0] > 0.0
