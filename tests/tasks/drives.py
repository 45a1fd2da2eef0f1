"""Drives of a robot that is what its model's mean says, planned by DISCO at 10 Hz."""

from pathlib import Path

import numpy as np

from disco_hw.control import CommandLimits, Disco, DiscoSettings, PlannerState
from disco_hw.experiments.circle import KinematicPlant
from disco_hw.model import load_model

MODEL = load_model(Path(__file__).parents[2] / "disco_hw/robots/wombot_model.toml")
MEAN = {"wheel_radius_m": 0.061, "axial_distance_m": 0.415, "x_icr_m": 0.238}
# Wheel speeds (rad/s) of spinning at 1.6 rad/s about the point of rotation.
SPIN = 1.6 * MEAN["axial_distance_m"] / MEAN["wheel_radius_m"] / 2.0


def planner_for(task, settings=None):
    return Disco(MODEL, task, settings or DiscoSettings(), CommandLimits(8.0, 20.0), 2)


def plant_at(*start):
    """Return the robot at x, y (m) and yaw (rad), with a wheel lag of 0.1 s."""
    return KinematicPlant(MEAN, start, 0.1, 0.0, 1)


def begin_with(disco, plant, wheels):
    """Have the planner start from a plan that keeps these wheel speeds, which the robot has."""
    plant.wheels = wheels
    disco.plan(0, PlannerState(0, plant.x_m, plant.y_m, plant.yaw_rad, *wheels))
    disco.optimiser.set_nominal(np.broadcast_to(wheels, (disco.settings.sampler.horizon, 2)))


def drive(disco, plant, steps):
    """Drive for these steps of 0.1 s; gives each step's number when the robot has made it."""
    for step in steps:
        now_ns = step * 100_000_000
        state = PlannerState(now_ns, plant.x_m, plant.y_m, plant.yaw_rad, *plant.wheels)
        plant.advance(*disco.plan(now_ns, state).at(now_ns), 0.1)
        yield step
