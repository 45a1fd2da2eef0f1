"""Refined plans at corners: robots whose wheels are slow for their speed stay on the line, and slow down in time."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import disco_hw
from disco_hw.control import CommandLimits, Disco, DiscoSettings, PlannerState
from disco_hw.model import Model, load_model
from disco_hw.tasks.line import PathTable
from disco_hw.tasks.line.cost import PathCost

SHIPPED = load_model(Path(disco_hw.__file__).parent / "robots" / "wombot_model.toml")
LEG_M = 4.0


def drive_round_a_corner(geometry, limits, speed_m_s, turn_rad):
    """Places (N, 2), relative to the corner, and times (N,) of a robot that is as its model says."""
    # Believed in as the shipped robot is, for the kernel that they share.
    radius_m, axle_m, x_icr_m = geometry
    model = Model(
        radius_m, axle_m, x_icr_m, belief=replace(SHIPPED.belief, means=np.array([x_icr_m, radius_m, axle_m]))
    )
    way = LEG_M * np.array([[-1.0, 0.0], [0.0, 0.0], [math.cos(turn_rad), math.sin(turn_rad)]])
    settings = DiscoSettings.for_speed(speed_m_s, 50.0)
    planner = Disco(model, PathCost(PathTable(way), speed_m_s), settings, limits)
    state, wheels, places = (*way[0].tolist(), 0.0), (0.0, 0.0), [way[0]]
    for step in range(round(3.0 * LEG_M / (speed_m_s * settings.step_s))):
        now_ns = round(step * settings.step_s * 1e9)
        plan = planner.plan(now_ns, PlannerState(now_ns, *state, *wheels))
        state, wheels = tuple(plan.trajectory[1].tolist()), tuple(plan.wheel_speeds[0].tolist())
        places.append(np.array(state[:2]))
        if math.dist(places[-1], way[2]) < 0.5 * LEG_M:
            break
    return np.array(places), settings.step_s * np.arange(len(places))


def off_m(places, turn_rad):
    """Distances to the nearer of the two legs."""
    along = np.array([math.cos(turn_rad), math.sin(turn_rad)])
    first = np.hypot(np.maximum(places[:, 0], 0.0), places[:, 1])
    forward = np.maximum(places @ along, 0.0)
    return np.minimum(first, np.hypot(*(places - forward[:, None] * along).T))


LARGE, FAST_M_S, SLOW_WHEELS = (0.165, 0.9, 0.02), 0.9, CommandLimits(12.0, 5.0)


@pytest.mark.parametrize(
    "turn_deg", [90.0, *(pytest.param(turn, marks=pytest.mark.thorough) for turn in (45.0, 114.0))]
)
def test_a_large_robot_slows_down_before_a_corner_and_is_as_fast_behind_it(turn_deg):
    places, times_s = drive_round_a_corner(LARGE, SLOW_WHEELS, FAST_M_S, math.radians(turn_deg))
    assert off_m(places, math.radians(turn_deg)).max() < 0.01
    speeds = np.hypot(*np.diff(places, axis=0).T) / np.diff(times_s)
    to_corner_m = np.hypot(*places[1:].T)
    assert speeds[to_corner_m < 0.1].min() < 0.5 * FAST_M_S
    assert np.allclose(speeds[(to_corner_m > 1.5) & (times_s[1:] > 2.0)], FAST_M_S, rtol=0.05)


@pytest.mark.parametrize("x_icr_m", [0.238, pytest.param(-0.238, marks=pytest.mark.thorough)])
def test_a_robot_is_turned_beyond_a_right_angle_to_the_line_before_a_turn_of_more(x_icr_m):
    """Its tracked point comes to the corner along the line while it backs: facing less it would pass beside it."""
    turn_rad = math.radians(114.0)
    places, _ = drive_round_a_corner((0.061, 0.415, x_icr_m), CommandLimits(8.0, 20.0), 0.5, turn_rad)
    assert off_m(places, turn_rad).max() < 0.015


def test_a_robot_that_is_fast_for_its_wheels_comes_to_rest_on_its_line_behind_a_corner():
    """With a horizon in which it could not end a turn it would swing to and fro by 0.7 m."""
    places, _ = drive_round_a_corner((0.165, 0.8, 0.1), CommandLimits(12.0, 5.0), 1.6, math.radians(90.0))
    assert off_m(places, math.radians(90.0)).max() < 0.03


@pytest.mark.parametrize(("speed_m_s", "is_facing"), [(1.2, True), (0.9, False)])
def test_a_fast_robot_that_turns_before_a_corner_counts_as_facing_its_line(speed_m_s, is_facing):
    """Else its plans are not refined in the turn, and it swings to and fro behind the corner."""
    model = Model(0.165, 0.8, 0.0, belief=replace(SHIPPED.belief, means=np.array([0.0, 0.165, 0.8])))
    way = LEG_M * np.array([[-1.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    settings = DiscoSettings.for_speed(speed_m_s, 50.0)
    planner = Disco(model, PathCost(PathTable(way), speed_m_s), settings, CommandLimits(12.0, 10.0))
    planner.plan(0, PlannerState(0, -0.02, 0.0, 1.2, 0.0, 0.0))
    # It faces the line behind the corner by a cosine of 0.93.
    assert (planner.refinement._found[1] > 0.9) == is_facing
