"""What the page shows: a robot (task, size, model), and a log opened for looking at.

A log's timeline is in memory; its plans are read when one is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from disco_hw.adaptation.guard import geometry_of, with_geometry
from disco_hw.errors import InputError
from disco_hw.log.reader import Log
from disco_hw.log.records import TOPICS, BeliefChange, FrameIn, FrameOut, Plan, Task
from disco_hw.model import Model
from disco_hw.runtime.pipeline import Source
from disco_hw.runtime.robot_setup import Setup, geometry, load_setup, setup_of_log
from disco_hw.runtime.task_change import task_of
from disco_hw.tasks import RobotTask
from disco_hw.viewer.snapshot import PLAN_AGE_NS, Snapshot, snapshot_at
from disco_hw.viewer.timeline import Timeline
from drivers.types import MotorSample


@dataclass(frozen=True, slots=True)
class ShownRobot:
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

    def task_at(self, record: Task | None) -> RobotTask:
        """The task that is in force where this record of it is the newest; robot.toml's without one."""
        return self.task if record is None else task_of(record, self.task)


def model_in_force(model: Model, change: BeliefChange | None) -> Model:
    """The model with the belief that was put in force while driving; itself without one."""
    learnt = None if change is None else geometry_of(change)
    return model if learnt is None else with_geometry(model, learnt)


def stage_of_robot(robot_file: Path, model_file: Path | None = None) -> ShownRobot:
    """From robot.toml and the model it names; raises InputError."""
    return _stage(load_setup(robot_file, model_file))


def stage_of_log(log: Log, robot_file: Path | None = None) -> ShownRobot:
    """From the files kept in the log, or from `robot_file` instead; raises InputError if there is neither."""
    if robot_file is not None:
        return stage_of_robot(robot_file)
    return _stage(setup_of_log(log, "name the robot with --robot"))


def _stage(setup: Setup) -> ShownRobot:
    robot = setup.config.robot
    return ShownRobot(
        name=robot.name,
        task=setup.config.task,
        wheel_radius_m=robot.wheel_radius_m,
        axial_distance_m=robot.axial_distance_m,
        x_icr_m=geometry(setup.model)[0][2],
        drive_top_rad_s=setup.config.drive.speed_share * robot.max_wheel_speed_rad_s,
        model=setup.model,
    )


_UNSEEN = (FrameIn, FrameOut, MotorSample)
_DRIVING = frozenset({Source.PLAN.value, Source.FALLBACK.value, Source.MANUAL.value})
_SHOWN = tuple(topic.name for topic in TOPICS if topic.record not in _UNSEEN)


class Recording:
    """An open log with its robot; `ticks` (N,) are the times of its ticks, ns. Close it, or use it in `with`."""

    def __init__(self, path: Path, robot_file: Path | None = None) -> None:
        self._log = Log(path)
        try:
            if "/estimate" not in self._log.counts:
                raise InputError(f"{path}: holds no estimates, so there is nothing to show; give a log of `run`")
            self.stage: ShownRobot = stage_of_log(self._log, robot_file)
            self.timeline = Timeline()
            for now_ns, record in self._log.brief_records(_SHOWN):
                self.timeline.add(now_ns, record)
            self.ticks: NDArray[np.int64] = self.timeline.estimate.rows(0, np.iinfo(np.int64).max)[0]
        except BaseException:
            self._log.close()
            raise

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; safe to call twice."""
        self._log.close()

    @property
    def first_ns(self) -> int:
        """Time of the first tick."""
        return int(self.ticks[0])

    @property
    def duration_s(self) -> float:
        """From the first tick to the last."""
        return float(self.ticks[-1] - self.ticks[0]) * 1e-9

    @property
    def task_start_s(self) -> float:
        """Seconds from the first tick to the first that drives: by the task's plan, or by hand; 0 if none does."""
        driven = (t_ns for t_ns, source in self.timeline.source if source in _DRIVING)
        return (next(driven, self.first_ns) - self.first_ns) * 1e-9

    def at(self, t_s: float) -> Snapshot:
        """The instant of the last tick at or before `t_s` seconds from the first; the ends beyond them."""
        t_ns = int(self.ticks[self.tick_at(t_s)])
        return snapshot_at(self.timeline, t_ns, self._plan_at(t_ns))

    def tick_at(self, t_s: float) -> int:
        """Number of the last tick at or before `t_s`, from 0 on."""
        t_ns = self.first_ns + round(t_s * 1e9)
        return min(max(int(np.searchsorted(self.ticks, t_ns, "right")) - 1, 0), len(self.ticks) - 1)

    def seconds_of(self, tick: int) -> float:
        """Seconds from the first tick to this one."""
        return float(self.ticks[min(max(tick, 0), len(self.ticks) - 1)] - self.first_ns) * 1e-9

    def _plan_at(self, t_ns: int) -> Plan | None:
        newest = None
        for entry in self._log.records(("/plan",), t_ns - PLAN_AGE_NS, t_ns + 1):
            newest = entry.record
        return newest if isinstance(newest, Plan) else None
