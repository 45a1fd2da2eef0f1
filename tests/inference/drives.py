"""Logs of simulated robots for the tests of inference."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from disco_hw.config import Prior, Robot, RobotConfig
from disco_hw.log.drive import DriveLog
from sim.effects import hidden_effects
from sim.plant_parameters import PlantParameters
from tools.simulated_drives import create_drive
from tools.simulated_log import read_back, simulated_log, write_csv

# In the order of the NAMES of inference.
TRUTH = {"x_icr_m": 0.12, "wheel_radius_m": 0.06, "axial_distance_m": 0.45}
THETA = np.array([*TRUTH.values()])
TICKS_PER_REV = 2048
# Here, as tests of logs that need it have no need of inference, which loads torch.
ROBOT = f"""
[robot]
name = "test"
wheel_radius_m = 0.055
axial_distance_m = 0.4
ticks_per_rev = {TICKS_PER_REV}
max_wheel_speed_rad_s = 8.0
"""


def robot_config(**prior):
    robot = Robot(
        name="test", wheel_radius_m=0.055, axial_distance_m=0.4, ticks_per_rev=TICKS_PER_REV, max_wheel_speed_rad_s=8.0
    )
    return RobotConfig(robot=robot, prior=Prior(**prior))


def write_log(path: Path, drive: str = "circle", seed: int = 1, hide: dict | None = None, **parameters: float) -> Path:
    plant = PlantParameters(**(TRUTH | parameters)).with_ideal_motors()
    write_csv(path, simulated_log(create_drive(drive, seed), plant, hidden_effects(hide or {}), seed))
    return path


@cache
def logged(drive: str = "circle", seed: int = 1, hidden: tuple = (), noiseless: bool = False) -> DriveLog:
    plant = PlantParameters(**TRUTH).with_ideal_motors()
    plant = plant.noiseless() if noiseless else plant
    rows = simulated_log(create_drive(drive, seed), plant, hidden_effects(dict(hidden)), seed)
    return read_back(rows, TICKS_PER_REV)
