"""Skid-steer kinematics and slip, against closed-form answers."""

import math

import numpy as np
import pytest

from sim.body_dynamics import Body, BodyPose
from sim.effects import hidden_effects
from sim.plant_parameters import PlantParameters
from sim.wheel_dynamics import WheelPieces

R, A, X_ICR = 0.061, 0.415, 0.238
NEVER_US = 2**62


def roll(left_rad_s, right_rad_s, seconds, start=None, slip=(0.0, 0.0, 0.0), **effects):
    """Turn the wheels at constant speeds for whole milliseconds; return the body and its path, shape (n, 3)."""
    count = round(seconds * 1000)
    body = Body(PlantParameters(), hidden_effects(effects), start or BodyPose())
    times = np.arange(1, count + 1) * 1000
    angles = np.stack([times * 1e-6 * left_rad_s, times * 1e-6 * right_rad_s], axis=1)
    disturbance = np.tile(slip, (count, 1))
    path = []
    for k in range(count):
        body.advance(WheelPieces(times, angles), k, k + 1, NEVER_US, disturbance, 0, 1000)
        path.append((body.pose.x_m, body.pose.y_m, body.pose.yaw_rad))
    return body, np.array(path)


def test_equal_wheels_drive_straight():
    body, path = roll(3.0, 3.0, 2.0, start=BodyPose(1.0, 2.0, math.pi / 6))
    travelled = 3.0 * R * 2.0
    expected = (1.0 + travelled * math.cos(math.pi / 6), 2.0 + travelled * 0.5)
    assert (body.pose.x_m, body.pose.y_m) == pytest.approx(expected, abs=1e-12)
    assert np.all(path[:, 2] == math.pi / 6)


def test_unequal_wheels_drive_the_circle_of_radius_root_of_turning_radius_squared_plus_icr_squared():
    left, right = 2.0, 4.0
    v, omega = 0.5 * R * (left + right), R * (right - left) / A
    body, path = roll(left, right, 2 * math.pi / omega)
    centre = np.array([X_ICR, v / omega])
    radii = np.hypot(path[:, 0] - centre[0], path[:, 1] - centre[1])
    np.testing.assert_allclose(radii, math.hypot(v / omega, X_ICR), rtol=1e-9)
    assert body.velocity == pytest.approx((v, -X_ICR * omega, omega), rel=1e-9)


def test_the_point_at_the_icr_moves_as_a_unicycle():
    _, path = roll(2.0, 5.0, 3.0)
    yaw = path[:, 2]
    point = path[:, :2] + X_ICR * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    step = np.diff(point, axis=0)
    middle = 0.5 * (yaw[1:] + yaw[:-1])
    sideways = -np.sin(middle) * step[:, 0] + np.cos(middle) * step[:, 1]
    assert np.abs(sideways).max() < 1e-12


def test_turning_on_the_spot_turns_about_the_icr():
    _, path = roll(-3.0, 3.0, 2.0)
    np.testing.assert_allclose(np.hypot(path[:, 0] - X_ICR, path[:, 1]), X_ICR, rtol=1e-9)
    assert path[-1, 2] == pytest.approx(2.0 * R * 6.0 / A)


def test_a_step_may_be_of_any_length_without_changing_the_path():
    fine, _ = roll(2.0, 5.0, 1.0)
    coarse = Body(PlantParameters(), hidden_effects({}), BodyPose())
    pieces = WheelPieces(np.array([1_000_000]), np.array([[2.0, 5.0]]))
    coarse.advance(pieces, 0, 1, NEVER_US, np.zeros((1, 3)), 0, 1_000_000)
    for name in ("x_m", "y_m", "yaw_rad"):
        assert getattr(coarse.pose, name) == pytest.approx(getattr(fine.pose, name), abs=1e-9)


TURNING_RAD_S = R * 6.0 / A
"""Yaw rate of wheels that turn at 3 rad/s against each other."""


@pytest.mark.parametrize(
    ("place", "effects", "yaw_rate_rad_s"),
    [
        ((0.0, 0.0), {"turn_slip": 0.1}, TURNING_RAD_S * (1.0 - 0.1 * TURNING_RAD_S)),
        ((0.0, 0.0), {"turn_slip": 10.0}, 0.5 * TURNING_RAD_S),
        (
            (0.0, 0.0),
            {"x_saturating_turn_slip": 0.2},
            TURNING_RAD_S * (1.0 - 0.2 * TURNING_RAD_S / (1.0 + TURNING_RAD_S / 0.4)),
        ),
        ((0.5, 0.1), {"x_carpet_patch": 0.2}, TURNING_RAD_S / 1.2),
        ((3.0, 0.0), {"x_carpet_patch": 0.2}, TURNING_RAD_S),
    ],
    ids=["slip", "most slip", "saturating slip", "on the carpet", "off the carpet"],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_turn_on_the_spot_is_slowed_alike_in_both_directions(place, effects, yaw_rate_rad_s, sign):
    body, _ = roll(-3.0 * sign, 3.0 * sign, 0.2, start=BodyPose(*place, 0.0), **effects)
    assert body.velocity[2] == pytest.approx(sign * yaw_rate_rad_s)


def test_a_larger_right_wheel_turns_the_robot_left():
    _, path = roll(3.0, 3.0, 1.0, wheel_radius_asymmetry=0.02)
    assert path[-1, 2] == pytest.approx(3.0 * R * 2 * 0.02 / A)
    assert roll(3.0, 3.0, 1.0, wheel_radius_asymmetry=-0.02)[1][-1, 2] < 0.0


def test_side_slip_carries_the_body_outwards():
    v, omega = 0.5 * R * 6.0, R * 2.0 / A
    body, _ = roll(2.0, 4.0, 0.5, side_slip=0.15)
    assert body.velocity[1] == pytest.approx(-X_ICR * omega - 0.15 * v * omega)
    assert roll(3.0, 3.0, 0.5, side_slip=0.15)[0].velocity[1] == 0.0


def test_lateral_icr_moves_the_centre_of_rotation_to_the_left():
    _, path = roll(-3.0, 3.0, 2.0, lateral_icr=0.03)
    np.testing.assert_allclose(np.hypot(path[:, 0] - X_ICR, path[:, 1] - 0.03), math.hypot(X_ICR, 0.03), rtol=1e-9)


def test_slope_drifts_in_the_world_frame_while_the_wheels_turn():
    drift = 0.02
    for yaw in (0.0, 2.0):
        _, flat = roll(3.0, 3.0, 1.0, start=BodyPose(0, 0, yaw))
        _, hill = roll(3.0, 3.0, 1.0, start=BodyPose(0, 0, yaw), slope=(drift, math.pi / 2))
        np.testing.assert_allclose(hill[-1] - flat[-1], (0.0, drift, 0.0), atol=1e-9)
    assert np.all(roll(0.0, 0.0, 1.0, slope=drift)[1] == 0.0)


def test_the_surface_changes_track_and_radius_from_its_time_on():
    body, path = roll(2.0, 4.0, 2.0, surface_change=(0.15, 1.0, -0.03))
    before, after = path[999, 2] / 1.0, (path[1999, 2] - path[999, 2]) / 1.0
    assert after == pytest.approx(before * 0.97 / 1.15)
    assert body.velocity[0] == pytest.approx(0.97 * 3.0 * R)


def accelerate(sign, **effects):
    """Speed up evenly to 6 rad/s within 1 s, then brake evenly; distances rolled by the body in each half."""
    times = np.arange(1, 2001) * 1000
    t = times * 1e-6
    angle = np.where(t < 1.0, 3.0 * t**2, 3.0 + 6.0 * (t - 1.0) - 3.0 * (t - 1.0) ** 2) * sign
    body = Body(PlantParameters(), hidden_effects(effects), BodyPose())
    pieces = WheelPieces(times, np.stack([angle, angle], axis=1))
    travelled = []
    for first in (0, 1000):
        body.advance(pieces, first, first + 1000, NEVER_US, np.zeros((2000, 3)), 0, 1000)
        travelled.append(body.pose.x_m - sum(travelled))
    return travelled


@pytest.mark.parametrize("sign", [1, -1])
def test_acceleration_slip_loses_way_when_speeding_up_and_gains_it_when_braking(sign):
    plain, slipping = accelerate(sign), accelerate(sign, acceleration_slip=0.2)
    slip_ratio = 0.2 * 6.0 * R
    assert slipping[0] == pytest.approx(plain[0] * (1.0 - slip_ratio), rel=0.02)
    assert slipping[1] == pytest.approx(plain[1] * (1.0 + slip_ratio), rel=0.02)


def test_drag_takes_a_share_that_grows_with_the_speed_squared():
    body, _ = roll(-5.0, -5.0, 0.2, x_speed_squared_drag=0.5)
    v = -5.0 * R
    assert body.velocity[0] == pytest.approx(v * (1.0 - 0.5 * v * v))


def test_wheel_ripple_repeats_once_a_turn_and_averages_out():
    seconds = 2.0
    _, path = roll(2 * math.pi, 2 * math.pi, seconds, x_wheel_ripple=0.03)
    speed = np.diff(path[:, 0]) / 1e-3
    assert speed.max() == pytest.approx(2 * math.pi * R * 1.03, rel=1e-4)
    assert speed.min() == pytest.approx(2 * math.pi * R * 0.97, rel=1e-4)
    np.testing.assert_allclose(speed[:999], speed[1000:], rtol=1e-6)
    assert path[-1, 0] == pytest.approx(2 * math.pi * R * seconds, rel=1e-4)


def test_slip_disturbance_moves_a_driving_body_and_not_a_resting_one():
    body, _ = roll(3.0, 3.0, 0.1, slip=(0.01, -0.02, 0.03))
    assert body.velocity == pytest.approx((3.0 * R + 0.01, -0.02, 0.03))
    assert np.all(roll(0.0, 0.0, 0.1, slip=(0.01, -0.02, 0.03))[1] == 0.0)


def test_the_body_stops_after_the_piece_that_reaches_the_asked_time_and_knows_where_it_was_then():
    body = Body(PlantParameters(), hidden_effects({}), BodyPose())
    times = np.arange(1, 11) * 1000
    angles = np.stack([times * 3e-6, times * 3e-6], axis=1)
    reached = body.advance(WheelPieces(times, angles), 0, 10, 3500, np.zeros((10, 3)), 0, 1000)
    assert reached == 4
    assert body.pose.x_m == pytest.approx(3.0 * R * 4e-3)
    assert body.pose_at(3500).x_m == pytest.approx(3.0 * R * 3.5e-3)


def test_displacement_is_a_step_in_the_world_frame():
    body, _ = roll(3.0, 3.0, 0.5, start=BodyPose(0.0, 0.0, 1.0))
    before = body.pose
    body.displace(0.5, -0.25, 0.1)
    after = body.pose
    assert after == BodyPose(before.x_m + 0.5, before.y_m - 0.25, before.yaw_rad + 0.1)
    assert body.pose_at(500_000) == after
