"""A virtual robot driven by a control law of your own, or by DISCO beside it, in simulated time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw.config import RobotConfig
from disco_hw.control.law import Law, LawController
from disco_hw.errors import InputError
from disco_hw.experiments.simulated_time import SimulatedRun, virtual_robot
from disco_hw.experiments.virtual import true_parameters
from disco_hw.reports.outputs import refuse_file
from disco_hw.runtime.assembly import make_planner
from disco_hw.runtime.pipeline import Planner
from disco_hw.runtime.robot_setup import Setup, load_setup
from sim.body_dynamics import BodyPose
from sim.effects import HiddenEffectError

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class VirtualDrive:
    """What a virtual robot did, tick by tick: `t_s` (N,) since the start, and what truly was.

    `poses` (N, 3): x, y (m), yaw (rad) of the tracked point; `speeds` (N,) m/s forward; `commands` (N, 2): wheel speeds
    sent, left and right (rad/s), NaN where none was. `laps` of the task; `events`: what the daemon said.
    """

    t_s: Array
    poses: Array
    speeds: Array
    commands: Array
    laps: float
    events: tuple[str, ...]


def drive_virtual(
    robot: Path | str,
    law: Law | None = None,
    seconds: float = 60.0,
    *,
    model: Path | str | None = None,
    hide: Mapping[str, float | Sequence[float]] | None = None,
    log: Path | str | None = None,
    seed: int = 1,
) -> VirtualDrive:
    """Drive the task of a robot.toml on a virtual robot, in simulated time, from the task's start; see `VirtualDrive`.

    The daemon's own tick: estimation, limits and supervision are those of the real robot. Its controller is the
    reference firmware, which sends the poses, whatever [link], [wheels] and [pose] say. `law`: yours; DISCO if None.
    `hide`: effects that the plant has and the model lacks (`disco-hw sim --list-effects`). `log`: an MCAP file to
    write. Raises InputError for wrong files and effects, WorkError if the robot refuses to start.
    """
    setup = _at_the_reference_controller(load_setup(Path(robot), None if model is None else Path(model)))
    if log is not None:
        refuse_file(Path(log))
    start = BodyPose(*setup.config.task.course().start)
    try:
        virtual = virtual_robot(setup, true_parameters(setup, None), start, effects=hide, seed=seed)
    except HiddenEffectError as error:
        raise InputError(f"hide: {error}") from None
    run = SimulatedRun(setup, virtual, _planner(setup, law))
    run.start()
    rows: list[tuple[Any, ...]] = []
    events: list[str] = []
    begun_us = run.now_us
    for tick in run.ticks(seconds):
        truth = virtual.truth
        sent = (np.nan, np.nan) if tick.command is None else (tick.command.left_rad_s, tick.command.right_rad_s)
        rows.append(((run.now_us - begun_us) * 1e-6, truth.x_m, truth.y_m, truth.yaw_rad, truth.speed_m_s, *sent))
        events += tick.events
    if log is not None:
        run.write_log(Path(log))
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    return VirtualDrive(table[:, 0], table[:, 1:4], table[:, 4], table[:, 5:7], run.core.progress.laps, tuple(events))


def _at_the_reference_controller(setup: Setup) -> Setup:
    usual = {field.name: field.default for field in msgspec.structs.fields(RobotConfig)}
    kept = {section: usual[section] for section in ("link", "wheels", "pose")}
    return replace(setup, config=msgspec.structs.replace(setup.config, **kept))


def _planner(setup: Setup, law: Law | None) -> Planner:
    if law is None:
        return make_planner(setup.config, setup.model)
    return LawController(law, setup.model, setup.config.task.planned(setup.config.control.mode))
