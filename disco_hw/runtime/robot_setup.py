"""Setup of one robot: its files, read and checked together, and what an operator changes of its task.

The files lie where robot.toml says, or in a log that carries them. A changed task is in the status, in the log and in
force; it is pure.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, cast

import msgspec

from disco_hw.config import (
    PoseInput,
    Robot,
    RobotConfig,
    link_fields,
    load_robot_config,
    model_file_of,
    refuse_outside_task,
    task_fault,
)
from disco_hw.errors import InputError
from disco_hw.fence.clearance import fence_outlines, footprint_outline
from disco_hw.files import KEY, WAY_POINTS, read_bytes
from disco_hw.files import MODEL_TOML as MODEL_KIND
from disco_hw.files import ROBOT_TOML as ROBOT_KIND
from disco_hw.log import MODEL_TOML, PATH_CSV, ROBOT_TOML, Attachment, TaskScene, attachment, records
from disco_hw.model import Model, load_model
from disco_hw.runtime import IN_USE, State
from disco_hw.runtime.preflight import beyond_robot
from disco_hw.tasks import RobotTask, kind_of, task_from
from drivers.private_files import KeyFileError, key_of_file

if TYPE_CHECKING:
    # It brings the libraries of the log's format, which a daemon does without.
    from disco_hw.log.reader import Log

Matrix3 = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True, slots=True)
class Setup:
    """The files of one robot, read and checked; `model_file`, `path_file` are None where robot.toml names none."""

    robot_file: Path
    model_file: Path | None
    path_file: Path | None
    config: RobotConfig
    model: Model

    @property
    def task_config(self) -> RobotConfig:
        """`config` as tasks are judged by it, with the x_icr of the model."""
        return config_for_tasks(self.config, geometry(self.model)[0][2])


def config_for_tasks(config: RobotConfig, x_icr_m: float) -> RobotConfig:
    """Return what tasks are judged by: robot.toml with the x_icr of the robot's model in place of the nominal one."""
    return msgspec.structs.replace(config, robot=msgspec.structs.replace(config.robot, x_icr_m=x_icr_m))


def load_setup(robot: Path, model: Path | None = None, link: str | None = None, path_file: Path | None = None) -> Setup:
    """Read robot.toml, the model and the task's file; the other arguments override what robot.toml says.

    A `path_file` that is given was driven before, and is not judged for what the robot cannot get past. Raises
    InputError.
    """
    config = load_robot_config(robot)
    if link is not None:
        config = msgspec.structs.replace(config, link=msgspec.structs.replace(config.link, **link_fields(link)))
    model_file = model_file_of(robot, config, model)
    config = msgspec.structs.replace(config, pose=_with_key_from_file(robot, config.pose))
    loaded = Model.nominal(config.robot, config.prior) if model_file is None else load_model(model_file)
    if config.task.file is None:
        path_file = None
    else:
        is_checked, path_file = path_file is None, path_file or robot.parent / config.task.file
        x_icr_m = geometry(loaded)[0][2] if is_checked else None
        config = msgspec.structs.replace(config, task=config.task.with_file(path_file, config.robot, x_icr_m))
        if is_checked:
            refuse_outside_task(robot, config)
    return Setup(robot, model_file, path_file, config, loaded)


def _with_key_from_file(robot: Path, pose: PoseInput) -> PoseInput:
    """Return the pose sources with the full paths of their key files, which are written relative to robot.toml."""
    key_file = None if pose.key_file is None else str(robot.parent / pose.key_file)
    also = tuple(_with_key_from_file(robot, one) for one in pose.also)
    return msgspec.structs.replace(pose, key_file=key_file, also=also)


def refuse_missing_effects(setup: Setup) -> None:
    """Raise InputError if the model is marked as one whose parameters may have absorbed an effect it lacks."""
    if setup.model.missing_effects:
        raise InputError(
            f"{setup.model_file}: missing_effects: the model lacks {', '.join(setup.model.missing_effects)}, which its "
            "parameters may have absorbed; write it with `disco-hw gap`, or give --accept-missing-effects"
        )


def link_key(setup: Setup) -> bytes | None:
    """Return the key of authenticated mode from the file that robot.toml names, None if it names none.

    Raises InputError.
    """
    name = setup.config.link.key_file
    if name is None:
        return None
    path = setup.robot_file.parent / name
    try:
        return key_of_file(path, *read_bytes(path, KEY))
    except (KeyFileError, InputError) as error:
        raise InputError(f"{setup.robot_file}: link.key_file: {error}") from None


def geometry(model: Model) -> tuple[tuple[float, float, float], Matrix3]:
    """Mean (m) and covariance (m^2) of (wheel_radius_m, axial_distance_m, x_icr_m); zero where a value is exact."""
    names = ("wheel_radius_m", "axial_distance_m", "x_icr_m")
    mean = dict(zip(model.parameter_names, model.point().tolist(), strict=True))
    covariance = {(a, b): 0.0 for a in names for b in names}
    belief = model.belief
    if belief is not None:
        mean |= dict(zip(belief.names, belief.mean().tolist(), strict=True))
        for row, values in zip(belief.names, belief.covariance().tolist(), strict=True):
            covariance |= {(row, column): value for column, value in zip(belief.names, values, strict=True)}
    r, a, x = names
    return (mean[r], mean[a], mean[x]), (
        (covariance[r, r], covariance[r, a], covariance[r, x]),
        (covariance[a, r], covariance[a, a], covariance[a, x]),
        (covariance[x, r], covariance[x, a], covariance[x, x]),
    )


def scene_of(config: RobotConfig) -> TaskScene:
    """Return the task's course and the robot's size, for whoever draws a log or a running robot."""
    outline = tuple((x, y) for x, y in config.task.course().outline_m().tolist())
    fence = tuple(tuple((x, y) for x, y in line.tolist()) for line in fence_outlines(config.fence))
    around = footprint_outline(config.robot.footprint, (0.0, 0.0, 0.0))
    footprint = tuple((x, y) for x, y in around.tolist())
    return TaskScene(outline, config.robot.axial_distance_m, config.robot.wheel_radius_m, fence, footprint)


def kept_files(setup: Setup) -> list[Attachment]:
    """Return copies of robot.toml, the model and the task's path for a log; raises InputError if one cannot be read."""
    named = (
        (ROBOT_TOML, ROBOT_KIND, setup.robot_file),
        (MODEL_TOML, MODEL_KIND, setup.model_file),
        (PATH_CSV, WAY_POINTS, setup.path_file),
    )
    return [attachment(file, name, kind) for name, kind, file in named if file is not None]


def setup_of_log(log: Log, hint: str) -> Setup:
    """Return the robot as it was when a log was recorded, from the copies in it; no other file is read.

    The files that the result names are gone. Raises InputError: with `hint` for a log without a robot.toml or
    without a file that it names, and with log and copy for one that is wrong.
    """
    names = log.attachment_names()
    if ROBOT_TOML not in names:
        raise InputError(f"{log.path}: carries no {ROBOT_TOML}; {hint}")
    with TemporaryDirectory(prefix="disco-hw-log-") as scratch:
        files = {name: Path(scratch) / name for name in (ROBOT_TOML, MODEL_TOML, PATH_CSV) if name in names}
        for name, file in files.items():
            file.write_bytes(log.attachment(name))
        try:
            config = load_robot_config(files[ROBOT_TOML])
            if config.model.file is not None and MODEL_TOML not in names:
                raise InputError(f"{log.path}: carries no {MODEL_TOML}, which its {ROBOT_TOML} names; {hint}")
            if config.task.file is not None and PATH_CSV not in names:
                raise InputError(f"{log.path}: carries no {PATH_CSV}, which its {ROBOT_TOML} names; {hint}")
            return load_setup(files[ROBOT_TOML], files.get(MODEL_TOML), path_file=files.get(PATH_CSV))
        except InputError as error:
            # Nobody can look into the scratch copies, which are gone by then.
            raise InputError(str(error).replace(f"{scratch}/", f"{log.path}: ")) from None


# Above any robot: what its own wheels can do is judged afterwards and says more.
_FASTEST_M_S = 100.0


class TaskRefused(Exception):  # noqa: N818
    """The change is not made; the message says why and what to do."""


def changed_task(task: RobotTask, requested: Mapping[str, Any], config: RobotConfig, state: State) -> RobotTask:
    """Return the task with the fields in `requested`, all of them editable, m and m/s.

    `config` is that of `config_for_tasks`. Raises TaskRefused while the robot is armed or stopping, for anything that
    is no number within the limits, for what the robot cannot do, and for what robot.toml would be refused for.
    """
    if state in IN_USE:
        raise TaskRefused(
            f"the task can be changed only while the robot is disarmed (it is {state.name}); disarm first"
        )
    editable = task.editable(config.robot)
    if not editable:
        raise TaskRefused(task.editing_note(config.robot))
    unknown = sorted(set(requested) - set(editable))
    if unknown or not requested:
        raise TaskRefused(f"give one or more of {', '.join(editable)}" + (f", not {unknown[0]}" if unknown else ""))
    values = {}
    for name, value in requested.items():
        low, high, _ = editable[name]
        # What the wheels can do depends on the other fields too, and is judged below.
        values[name] = _number(name, value, low, _FASTEST_M_S if name == "speed_m_s" else high)
    changed = with_values(task, values)
    fault = beyond_robot(config, changed) or task_fault(config, changed)
    if fault is not None:
        raise TaskRefused(f"{fault.field}: {fault.fault}; {fault.hint}")
    return changed


def with_values(task: RobotTask, values: Mapping[str, float]) -> RobotTask:
    """Return the task with those of the values that are fields of it."""
    kept = {name: values[name] for name in task.__struct_fields__ if name in values}
    return cast(RobotTask, msgspec.structs.replace(cast(msgspec.Struct, task), **kept))


def limits(robot: Robot, task: RobotTask) -> dict[str, tuple[float, float]]:
    """Least and largest value of each field that can be changed; the speed's largest is that on the present line."""
    return {name: (field.low, field.high) for name, field in task.editable(robot).items()}


def requested_task(task: RobotTask) -> dict[str, Any]:
    """Return the task as in the daemon's status: its fields, and a digest of what is read from a file."""
    fields: dict[str, Any] = msgspec.to_builtins(task)
    read = tuple(fields.pop(name) for name in task.read_fields)
    digest = {"digest": digest_of(tuple(getattr(task, name) for name in task.read_fields))} if read else {}
    return {"kind": kind_of(task), **fields, **digest}


def task_in_status(requested: Mapping[str, Any], robots: RobotTask) -> RobotTask | None:
    """Return the task that `requested_task` gave; None if its way-points are not those of `robots`, robot.toml's."""
    if "digest" in requested:
        same = requested_task(robots)
        if (same["kind"], same.get("digest")) != (requested["kind"], requested["digest"]):
            return None
        return with_values(robots, {name: value for name, value in requested.items() if isinstance(value, float)})
    try:
        return task_from(requested)
    except (ValueError, msgspec.ValidationError):
        return None


@lru_cache(maxsize=4)
def digest_of(read: tuple[object, ...]) -> str:
    """Return a 16-digit hash of the contents of a task's file."""
    return hashlib.sha256(msgspec.json.encode(read)).hexdigest()[:16]


def record_of(t_ns: int, task: RobotTask) -> records.Task:
    """Return the record of a task that is in force from `t_ns` on.

    What is read from its file is in the log's copy of that.
    """
    fields = {name: getattr(task, name) for name in task.__struct_fields__}
    return records.Task(
        t_ns, kind_of(task), {name: value for name, value in fields.items() if isinstance(value, float)}
    )


def task_of(record: records.Task, robots: RobotTask) -> RobotTask:
    """Return the task of a record: `robots`, robot.toml's, with the values in the record."""
    return with_values(robots, record.values())


def _number(name: str, value: Any, least: float, largest: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TaskRefused(f"{name}: not a number; write one")
    # So that no number at all, and a whole one that is too large for a float, are outside as well.
    if not least <= value <= largest:
        raise TaskRefused(f"{name}: not within {least:g} and {largest:g}; write another value")
    return float(value)
