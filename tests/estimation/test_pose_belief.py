"""Prediction of the belief against finite differences and closed forms."""

import math

import numpy as np
import pytest
from hypothesis import strategies as st

from disco_hw.config import Estimation
from disco_hw.estimation.odometry import (
    MAX_POSITION_VARIANCE,
    MAX_YAW_VARIANCE,
    OdometryParameters,
    Pose,
    PoseBelief,
    arc,
    belief_at,
    motion_model,
    moved,
    predict,
)
from tests.tables import examples

THETA = np.array([[0.15, 0.03, -0.03], [0.03, 0.09, -0.04], [-0.03, -0.04, 0.13]]) * 1e-3
GEOMETRY = (0.061, 0.415, 0.238)
KNOWN = OdometryParameters(*GEOMETRY)
UNCERTAIN = OdometryParameters(*GEOMETRY, tuple(map(tuple, THETA.tolist())))
SETTINGS = Estimation(slip_std_m_per_sqrt_m=0.03, slip_std_rad_per_sqrt_m=0.02, slip_std_rad_per_sqrt_rad=0.05)
PRIOR = np.array([[0.04, 0.01, -0.02], [0.01, 0.05, 0.015], [-0.02, 0.015, 0.06]]) ** 2 + np.eye(3) * 1e-3
TURNS = [(3.0, 3.0), (-2.0, 2.0), (3.0, 5.0), (-4.0, -3.0), (6.0, -1.0)]


def belief_with(covariance, sensitivity=None, yaw=0.7):
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = covariance.tolist()
    flat = None if sensitivity is None else tuple(sensitivity.ravel().tolist())
    return PoseBelief(1.0, -2.0, yaw, xx, xy, xt, yy, yt, tt, flat)


def end(state, left, right, parameters):
    """Where the tracked point ends as a function of start and parameters; yaw not wrapped."""
    motion = arc(OdometryParameters(*parameters), left, right)
    pose = moved(Pose(*state), motion)
    return np.array([pose.x_m, pose.y_m, state[2] + motion.turn_rad])


def jacobian(function, at, step=1e-6):
    columns = []
    for i in range(len(at)):
        change = np.zeros(len(at))
        change[i] = step
        columns.append((function(at + change) - function(at - change)) / (2 * step))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize(("left", "right"), TURNS)
def test_covariance_is_carried_by_the_derivatives_of_the_motion(left, right):
    belief = belief_with(PRIOR)
    predicted = predict(belief, motion_model(SETTINGS, KNOWN), arc(KNOWN, left, right))
    start = np.array([belief.x_m, belief.y_m, belief.yaw_rad])
    by_start = jacobian(lambda s: end(s, left, right, GEOMETRY), start)
    # A yaw error at constant distance: more turn of one wheel, less of the other.
    per_rad = GEOMETRY[1] / GEOMETRY[0] / 2
    by_turn = jacobian(lambda w: end(start, left - w[0] * per_rad, right + w[0] * per_rad, GEOMETRY), np.zeros(1))
    rolled = 0.061 * (abs(left) + abs(right)) / 2
    turned = 0.061 * abs(right - left) / 0.415
    noise = 0.03**2 * rolled * np.diag([1.0, 1.0, 0.0])
    noise += (0.02**2 * rolled + 0.05**2 * turned) * by_turn @ by_turn.T
    np.testing.assert_allclose(predicted.covariance, by_start @ PRIOR @ by_start.T + noise, atol=1e-9)
    np.testing.assert_allclose(
        [predicted.x_m, predicted.y_m, predicted.yaw_rad], end(start, left, right, GEOMETRY), atol=1e-12
    )


@pytest.mark.parametrize(("left", "right"), TURNS)
def test_uncertain_parameters_are_carried_as_a_joint_covariance(left, right):
    model = motion_model(SETTINGS, UNCERTAIN)
    belief = belief_with(PRIOR, np.zeros((3, 3)))
    start = np.array([belief.x_m, belief.y_m, belief.yaw_rad])
    # The textbook form: pose and parameters in one state of six, whose parameters do not move.
    joint = np.block([[PRIOR, np.zeros((3, 3))], [np.zeros((3, 3)), THETA]])
    for _ in range(3):
        belief_plain = predict(belief_with(np.zeros((3, 3)), None, belief.yaw_rad), model, arc(KNOWN, left, right))
        by_start = jacobian(lambda s: end(s, left, right, GEOMETRY), start)
        by_parameters = jacobian(lambda p, s=start: end(s, left, right, p), np.array(GEOMETRY))
        step = np.block([[by_start, by_parameters], [np.zeros((3, 3)), np.eye(3)]])
        joint = step @ joint @ step.T
        joint[:3, :3] += belief_plain.covariance
        start = end(start, left, right, GEOMETRY)
        belief = predict(belief, model, arc(UNCERTAIN, left, right))
    np.testing.assert_allclose(belief.covariance, joint[:3, :3], atol=1e-8)
    sensitivity = np.array(belief.sensitivity).reshape(3, 3)
    root = np.array(model.parameter_root).reshape(3, 3)
    np.testing.assert_allclose(sensitivity @ root.T, joint[:3, 3:], atol=1e-8)


def test_a_wrong_wheel_radius_adds_up_with_the_distance_whatever_the_step():
    # 20 % of the radius is 20 % of the distance, not 20 % of a random walk.
    radius_only = OdometryParameters(0.06, 0.4, 0.0, ((0.012**2, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    model = motion_model(Estimation(slip_std_m_per_sqrt_m=1e-9), radius_only)
    for steps in (1, 500):
        belief = belief_at(Pose(0.0, 0.0, 0.0), 1e-12, 1e-12, model)
        for _ in range(steps):
            belief = predict(belief, model, arc(radius_only, 2.0 / 0.06 / steps, 2.0 / 0.06 / steps))
        assert belief.x_m == pytest.approx(2.0)
        assert math.sqrt(belief.covariance[0][0]) == pytest.approx(0.4, rel=1e-6)


def test_slip_on_a_straight_does_not_depend_on_the_sampling_rate():
    model = motion_model(SETTINGS, KNOWN)
    covariances = []
    for steps in (2000, 4000):
        belief = belief_at(Pose(0.0, 0.0, 0.3), 1e-6, 1e-6, model)
        for _ in range(steps):
            belief = predict(belief, model, arc(KNOWN, 40.0 / steps, 40.0 / steps))
        covariances.append(belief.covariance)
    np.testing.assert_allclose(covariances[0], covariances[1], rtol=2e-3)
    # Continuous random walk: yaw variance grows with s, the lateral one it causes with s^3 / 3.
    s = 40.0 * 0.061
    along = np.array([math.cos(0.3), math.sin(0.3)])
    across = np.array([-math.sin(0.3), math.cos(0.3)])
    position = np.array(covariances[1])[:2, :2]
    assert along @ position @ along == pytest.approx(1e-6 + 0.03**2 * s, rel=1e-6)
    x_icr_part = 0.02**2 * (0.238**2 * s - 0.238 * s**2)  # the tracked point swings the other way
    expected = 1e-6 + 0.03**2 * s + 0.02**2 * s**3 / 3 + 1e-6 * s**2 + x_icr_part
    assert across @ position @ across == pytest.approx(expected, rel=1e-3)


def test_each_variance_has_its_own_ceiling():
    # Straight along x with an unknown radius: only x runs away; turning about the tracked point: only the yaw does.
    radius_only = OdometryParameters(0.06, 0.4, 0.0, ((0.03**2, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    model = motion_model(Estimation(slip_std_rad_per_sqrt_m=1e-6, slip_std_rad_per_sqrt_rad=1e-6), radius_only)
    start = belief_at(Pose(0.0, 0.0, 0.0), 1e-6, 1e-6, model)
    far = predict(start, model, arc(radius_only, 10_000.0, 10_000.0)).covariance
    assert far[0][0] == pytest.approx(MAX_POSITION_VARIANCE)
    assert far[1][1] < 100.0
    spun = predict(start, model, arc(radius_only, -100.0, 100.0)).covariance
    assert spun[2][2] == pytest.approx(MAX_YAW_VARIANCE)
    assert spun[0][0] < 1.0


def test_variances_have_a_ceiling_and_stay_definite():
    for parameters in (KNOWN, UNCERTAIN):
        model = motion_model(SETTINGS, parameters)
        belief = belief_at(Pose(0.0, 0.0, 0.0), 1e-4, 1e-4, model)
        for _ in range(300):
            belief = predict(belief, model, arc(parameters, 3000.0, 3100.0), 1e5, 0.01)
        covariance = np.array(belief.covariance)
        ceilings = [MAX_POSITION_VARIANCE, MAX_POSITION_VARIANCE, MAX_YAW_VARIANCE]
        np.testing.assert_allclose(np.diag(covariance), ceilings, rtol=1e-12)
        assert np.linalg.eigvalsh(covariance)[0] > 0.0


@examples(
    quick=30,
    every=100,
    turns=st.lists(st.tuples(st.floats(-100, 100), st.floats(-100, 100)), max_size=30),
    known=st.booleans(),
)
def test_any_drive_keeps_the_covariance_positive_definite(turns, known):
    parameters = KNOWN if known else UNCERTAIN
    model = motion_model(SETTINGS, parameters)
    belief = belief_at(Pose(0.0, 0.0, 0.0), 1e-6, 1e-6, model)
    for left, right in turns:
        belief = predict(belief, model, arc(parameters, left, right))
    covariance = np.array(belief.covariance)
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0
    assert -math.pi < belief.yaw_rad <= math.pi
