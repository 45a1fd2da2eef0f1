from dataclasses import replace

import numpy as np
import pytest

from disco_hw.log.drive import Commands, Poses, Wheels
from disco_hw.log.importing.csv_drive import length_fault, time_fault, yaw_fault

RADIUS_M = 0.06
TRACK_M = 0.31
NO_COMMANDS, NO_WHEELS = Commands(), Wheels()


def circle(left=2.0, right=3.0, duration_s=60.0, rest_s=0.0, noise_m=0.0):
    """Poses and wheels of a robot that drives a circle and then rests; yaw is not wrapped."""
    t_s = np.arange(0.0, duration_s + rest_s, 0.05)
    driving = np.minimum(t_s, duration_s)
    omega = RADIUS_M * (right - left) / TRACK_M
    speed = RADIUS_M * (right + left) / 2.0
    yaw = omega * driving
    if omega:
        x_m, y_m = speed / omega * np.sin(yaw), speed / omega * (1.0 - np.cos(yaw))
    else:
        x_m, y_m = speed * driving, np.zeros_like(t_s)
    noise = np.random.default_rng(1).normal(0.0, noise_m, (2, t_s.size))
    segment = np.zeros(t_s.size, dtype=np.int64)
    moving = t_s < duration_s
    speeds = (left * moving, right * moving)
    wheels = Wheels(t_s, left * driving, right * driving, *speeds, segment, True, True)
    return Poses(t_s, x_m + noise[0], y_m + noise[1], yaw, segment), wheels, Commands(t_s, *speeds, segment)


def wrapped(yaw_rad):
    return np.angle(np.exp(1j * yaw_rad))


@pytest.mark.parametrize(
    ("step", "fault"), [(0.02, False), (1.0, False), (2.0, True), (20.0, True), (2e7, True), (2e-5, True)], ids=str
)
def test_times_in_seconds(step, fault):
    assert (time_fault(np.arange(100) * step) is not None) == fault


def test_too_few_times_say_nothing():
    assert time_fault(np.array([0.0, 1e9])) is None


@pytest.mark.parametrize("known", ["wheels", "commands", "neither"])
def test_degrees_are_distinguished_from_radians_that_were_not_wrapped(known):
    poses, wheels, commands = circle(duration_s=120.0)
    moved = (wheels if known == "wheels" else NO_WHEELS, commands if known == "commands" else NO_COMMANDS)
    assert np.abs(poses.yaw_rad).max() > 20.0
    assert yaw_fault(poses.t_s, poses.yaw_rad, poses.segment, *moved) is None
    degrees = yaw_fault(poses.t_s, 57.29578 * poses.yaw_rad, poses.segment, *moved)
    assert "degrees" in degrees
    assert "pose_yaw_rad" in degrees


def test_wrapped_degrees_are_degrees_and_wrapped_radians_believed_whatever_the_wheels_say():
    poses, wheels, commands = circle(duration_s=120.0)
    degrees = np.degrees(wrapped(poses.yaw_rad))
    assert "degrees" in yaw_fault(poses.t_s, degrees, poses.segment, wheels, commands)
    poses, _, _ = circle()
    _, stationary, none = circle(0.0, 0.0)
    assert yaw_fault(poses.t_s, wrapped(poses.yaw_rad), poses.segment, stationary, none) is None


@pytest.mark.parametrize("speeds", [(2.0, 3.0), (3.0, 3.0), (-3.0, -3.0), (1.0, 4.0)])
def test_a_circle_and_a_line_in_metres_are_believed(speeds):
    poses, wheels, commands = circle(*speeds)
    assert length_fault(poses, wheels, commands, None) is None
    assert length_fault(poses, wheels, commands, RADIUS_M) is None
    assert length_fault(poses, NO_WHEELS, commands, RADIUS_M) is None


STATIONARY = circle(0.0, 0.0)


@pytest.mark.parametrize(
    ("poses", "wheels", "commands"),
    [
        circle(duration_s=20.0, rest_s=3000.0, noise_m=0.02),
        circle(-3.0, 3.0),
        (STATIONARY[0], *circle()[1:]),
        STATIONARY,
        (STATIONARY[0], NO_WHEELS, NO_COMMANDS),
    ],
    ids=["noise at rest", "turning on the spot", "lifted wheels", "no motion", "no wheels"],
)
def test_a_drive_without_a_path_to_compare_says_nothing(poses, wheels, commands):
    assert length_fault(poses, wheels, commands, RADIUS_M) is None


@pytest.mark.parametrize(("scale", "nominal"), [(1000.0, None), (100.0, RADIUS_M), (39.4, RADIUS_M), (5.0, RADIUS_M)])
def test_millimetres_centimetres_and_inches_are_refused(scale, nominal):
    poses, wheels, commands = circle()
    scaled = replace(poses, x_m=scale * poses.x_m, y_m=scale * poses.y_m)
    assert "write metres" in length_fault(scaled, wheels, commands, nominal)


@pytest.mark.parametrize(("scale", "nominal"), [(57.3, None), (9.55, RADIUS_M)])
def test_wheels_in_degrees_or_rpm_are_refused(scale, nominal):
    poses, wheels, commands = circle()
    angles = {name: scale * getattr(wheels, name) for name in ("left_angle_rad", "right_angle_rad")}
    assert "rad/s" in length_fault(poses, replace(wheels, **angles), commands, nominal)
