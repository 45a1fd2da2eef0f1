"""Classical followers: the reference is what keeps the tracked point on the line, and every law keeps to it."""

import math

import numpy as np
import pytest

from disco_hw.control.baselines import Follower, Kanayama, LinearQuadratic, PurePursuit, Reference
from disco_hw.control.kernel.guide import SteeredChassis
from disco_hw.control.plan import CommandLimits, PlannerState
from tests.tables import thinned
from tools.foreign_plant import NOMINAL, ForeignRobot
from tools.tracking import classical, drive, tracks

SQUARE = np.array([[0.0, 0.0], [1.5, 0.0], [1.5, 1.5], [0.0, 1.5], [0.0, 0.0]])


@pytest.mark.parametrize("x_icr_m", [0.238, 0.0, -0.2])
def test_on_a_circle_the_robot_is_turned_inwards_by_what_its_tracked_point_slides(x_icr_m):
    angle = np.linspace(0.0, 2.0 * math.pi, 1441)
    reference = Reference(0.75 * np.column_stack([np.cos(angle), np.sin(angle)]), 0.2, x_icr_m)
    inwards = reference.yaw_rad - reference.along_rad
    np.testing.assert_allclose(inwards, math.asin(x_icr_m / 0.75), atol=0.015)


def test_a_robot_that_moves_as_the_reference_stays_on_a_square_and_turns_before_its_corner():
    reference = Reference(SQUARE, 0.2, 0.238)
    step_s = reference.spacing_m / 0.2
    before = reference.ahead(0, 1.45)
    assert reference.yaw_rad[before] > 0.8
    x, y = reference.places_m[0]
    worst = 0.0
    for place in range(len(reference.places_m) - 1):
        yaw, forward, turn = reference.yaw_rad[place], reference.forward_m_s[place], reference.turn_rad_s[place]
        x += step_s * (forward * math.cos(yaw) + turn * 0.238 * math.sin(yaw))
        y += step_s * (forward * math.sin(yaw) - turn * 0.238 * math.cos(yaw))
        worst = max(worst, math.hypot(x - reference.places_m[place + 1, 0], y - reference.places_m[place + 1, 1]))
    assert worst < 0.03


# Pure pursuit looks ahead of corners, and cuts those of a square.
LARGEST_MM = {PurePursuit: 45.0, Kanayama: 30.0, LinearQuadratic: 30.0}


@thinned("way", ["square", "circle", "eight", "slalom"], quick=1)
@thinned("law", [Kanayama(), PurePursuit(), LinearQuadratic()], quick=1, ids=lambda law: type(law).__name__)
def test_every_law_follows_every_way_with_the_nominal_robot(law, way):
    driven = drive(classical(law), ForeignRobot(*NOMINAL), tracks()[way], duration_s=20.0).after()
    assert driven.rms_mm < LARGEST_MM[type(law)]
    assert driven.speed_m_s > 0.15


@thinned(
    ("chassis", "radius_m", "speed_m_s", "off_m"),
    [
        (SteeredChassis(0.15, 0.5, 0.1, 0.0, 0.0), 3.0, 1.5, 0.1),
        (SteeredChassis(0.061, 0.415, 0.238, 0.0, 0.0), 1.5, 0.4, 0.1),
        (SteeredChassis(0.15, 0.6, 0.2, 0.0, 0.0), 2.0, 0.5, 0.1),
        (SteeredChassis(0.15, 0.6, 0.2, 0.0, 0.0), 3.0, 1.0, 0.1),
        (SteeredChassis(0.3, 2.0, 0.8, 0.0, 0.0), 7.5, 1.0, 0.1),
    ],
    quick=1,
)
@pytest.mark.parametrize("law", [Kanayama(), PurePursuit(), LinearQuadratic()], ids=lambda law: type(law).__name__)
def test_a_fast_or_large_robot_comes_back_to_its_circle_and_stays_there(law, chassis, radius_m, speed_m_s, off_m):
    """Wheels that change their speed by 20 rad/s in a second, and follow late by 0.1 s."""
    angle, step_s = np.linspace(0.0, 2.0 * math.pi, 721), 0.02
    reference = Reference(radius_m * np.column_stack([np.cos(angle), np.sin(angle)]), speed_m_s, chassis.x_icr_m)
    follower = Follower(reference, law, chassis, CommandLimits(12.0, 20.0))
    x, y, yaw, wheels, away_m = radius_m + off_m, 0.0, float(reference.yaw_rad[0]), np.zeros(2), []
    for k in range(round(25.0 / step_s)):
        now_ns = round(k * step_s * 1e9)
        command = follower.plan(now_ns, PlannerState(now_ns, x, y, yaw, *wheels)).at(now_ns)
        wheels = wheels + np.clip(step_s / 0.1 * np.subtract(command, wheels), -20.0 * step_s, 20.0 * step_s)
        forward, turn = chassis.wheel_radius_m * np.array(
            [wheels.sum() / 2, np.diff(wheels)[0] / chassis.axial_distance_m]
        )
        middle = yaw + 0.5 * step_s * turn
        x += step_s * (forward * math.cos(middle) + turn * chassis.x_icr_m * math.sin(middle))
        y += step_s * (forward * math.sin(middle) - turn * chassis.x_icr_m * math.cos(middle))
        yaw += step_s * turn
        away_m.append(math.hypot(x, y) - radius_m)
    assert np.abs(away_m[len(away_m) // 2 :]).max() < 0.03


@pytest.mark.parametrize("x_icr_m", [0.1, -0.1])
def test_on_a_circle_the_reference_turns_as_the_circle_does(x_icr_m):
    angle = np.linspace(0.0, 2.0 * math.pi, 400)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    circle[-1] = circle[0]
    # The heading is that at a piece's begin and the way's that of its middle: half a piece, 5 % here.
    assert Reference(circle, 0.2, x_icr_m).turn_rad_s.mean() == pytest.approx(0.2, rel=0.06)
