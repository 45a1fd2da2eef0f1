"""What a page needs to know of the robot besides its records: task, size, model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from disco_hw.adapt.adaptable import geometry_of, with_geometry
from disco_hw.config import CircleTask
from disco_hw.errors import InputError
from disco_hw.log.provenance import MODEL_TOML, ROBOT_TOML
from disco_hw.log.reader import Log
from disco_hw.log.records import BeliefChange
from disco_hw.model import Model
from disco_hw.robot_setup import geometry, load_setup


@dataclass(frozen=True, slots=True)
class Stage:
    """The robot's name, its task, nominal size (m) and model.

    `x_icr_m` is the model's, `drive_top_rad_s` the fastest that a wheel is driven by hand.
    """

    name: str
    task: CircleTask
    wheel_radius_m: float
    axial_distance_m: float
    x_icr_m: float
    drive_top_rad_s: float
    model: Model


def model_in_force(model: Model, change: BeliefChange | None) -> Model:
    """The model with the belief that was put in force while driving; itself without one."""
    learnt = None if change is None else geometry_of(change)
    return model if learnt is None else with_geometry(model, learnt)


def stage_of_robot(robot_file: Path, model_file: Path | None = None) -> Stage:
    """From robot.toml and the model it names; raises InputError."""
    setup = load_setup(robot_file, model_file)
    robot = setup.config.robot
    return Stage(
        name=robot.name,
        task=setup.config.task,
        wheel_radius_m=robot.wheel_radius_m,
        axial_distance_m=robot.axial_distance_m,
        x_icr_m=geometry(setup.model)[0][2],
        drive_top_rad_s=setup.config.drive.speed_share * robot.max_wheel_speed_rad_s,
        model=setup.model,
    )


def stage_of_log(log: Log, robot_file: Path | None = None) -> Stage:
    """From the files kept in the log, or from `robot_file` instead; raises InputError if there is neither."""
    if robot_file is not None:
        return stage_of_robot(robot_file)
    names = log.attachment_names()
    if ROBOT_TOML not in names:
        raise InputError(f"{log.path}: keeps no {ROBOT_TOML}; name the robot with --robot")
    with TemporaryDirectory(prefix="disco-hw-view-") as scratch:
        robot_copy, model_copy = Path(scratch) / ROBOT_TOML, Path(scratch) / MODEL_TOML
        robot_copy.write_bytes(log.attachment(ROBOT_TOML))
        if MODEL_TOML not in names:
            return stage_of_robot(robot_copy)
        model_copy.write_bytes(log.attachment(MODEL_TOML))
        return stage_of_robot(robot_copy, model_copy)
