"""What a page needs to know of the robot besides its records: task, size, model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from disco_hw.adaptation.guard import geometry_of, with_geometry
from disco_hw.log.reader import Log
from disco_hw.log.records import BeliefChange, Task
from disco_hw.model import Model
from disco_hw.runtime.log_setup import setup_of_log
from disco_hw.runtime.robot_setup import Setup, geometry, load_setup
from disco_hw.runtime.task_change import task_of
from disco_hw.tasks import RobotTask


@dataclass(frozen=True, slots=True)
class Stage:
    """The robot's name, its task, nominal size (m) and model.

    `x_icr_m` is the model's, `drive_top_rad_s` the fastest that a wheel is driven by hand.
    """

    name: str
    task: RobotTask
    wheel_radius_m: float
    axial_distance_m: float
    x_icr_m: float
    drive_top_rad_s: float
    model: Model

    def task_at(self, told: Task | None) -> RobotTask:
        """The task that is in force where this record of it is the newest; robot.toml's without one."""
        return self.task if told is None else task_of(told, self.task)


def model_in_force(model: Model, change: BeliefChange | None) -> Model:
    """The model with the belief that was put in force while driving; itself without one."""
    learnt = None if change is None else geometry_of(change)
    return model if learnt is None else with_geometry(model, learnt)


def stage_of_robot(robot_file: Path, model_file: Path | None = None) -> Stage:
    """From robot.toml and the model it names; raises InputError."""
    return _stage(load_setup(robot_file, model_file))


def stage_of_log(log: Log, robot_file: Path | None = None) -> Stage:
    """From the files kept in the log, or from `robot_file` instead; raises InputError if there is neither."""
    if robot_file is not None:
        return stage_of_robot(robot_file)
    return _stage(setup_of_log(log, "name the robot with --robot"))


def _stage(setup: Setup) -> Stage:
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
