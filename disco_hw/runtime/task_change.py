"""Another value of what a person may change of the task, in the status, in the log and in force; pure."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, cast

import msgspec

from disco_hw.config import Robot
from disco_hw.log import records
from disco_hw.runtime import State
from disco_hw.tasks import RobotTask, kind_of, task_from

_FASTEST_M_S = 100.0
_LOCKED = frozenset({State.ARMED, State.STOPPING})


class TaskRefused(Exception):  # noqa: N818
    """The change is not made; the message says why and what to do."""


def changed_task(task: RobotTask, asked: Mapping[str, Any], robot: Robot, state: State) -> RobotTask:
    """The task with the fields in `asked`, all of them editable, m and m/s.

    Raises TaskRefused while the robot is armed or stopping, for anything that is no number within the limits, and for a
    speed that the wheels cannot reach on the changed task.
    """
    if state in _LOCKED:
        raise TaskRefused(f"the task can be changed while the robot is disarmed, and it is {state.name}; disarm first")
    editable = task.editable(robot)
    if not editable:
        raise TaskRefused(task.editing_note(robot))
    unknown = sorted(set(asked) - set(editable))
    if unknown or not asked:
        raise TaskRefused(f"give one or more of {', '.join(editable)}" + (f", not {unknown[0]}" if unknown else ""))
    values = {}
    for name, value in asked.items():
        low, high, _ = editable[name]
        # What the wheels can do depends on the other fields too, and is judged below.
        values[name] = _number(name, value, low, _FASTEST_M_S if name == "speed_m_s" else high)
    changed = with_values(task, values)
    refusal = changed.too_fast(robot)
    if refusal is not None:
        raise TaskRefused(refusal)
    return changed


def with_values(task: RobotTask, values: Mapping[str, float]) -> RobotTask:
    """The task with those of the values that are fields of it."""
    kept = {name: values[name] for name in task.__struct_fields__ if name in values}
    return cast(RobotTask, msgspec.structs.replace(cast(msgspec.Struct, task), **kept))


def limits(robot: Robot, task: RobotTask) -> dict[str, tuple[float, float]]:
    """Least and largest value of each field that can be changed; the speed's largest is that on the present line."""
    return {name: (field.low, field.high) for name, field in task.editable(robot).items()}


def asked_of(task: RobotTask) -> dict[str, Any]:
    """The task as the daemon's status gives it: its fields, and for what is read from a file a digest of that."""
    fields: dict[str, Any] = msgspec.to_builtins(task)
    read = tuple(fields.pop(name) for name in task.read_fields)
    digest = {"digest": digest_of(tuple(getattr(task, name) for name in task.read_fields))} if read else {}
    return {"kind": kind_of(task), **fields, **digest}


def task_in_status(asked: Mapping[str, Any], robots: RobotTask) -> RobotTask | None:
    """The task that `asked_of` gave; None for one with other way-points than those in `robots`, robot.toml's."""
    if "digest" in asked:
        same = asked_of(robots)
        if (same["kind"], same.get("digest")) != (asked["kind"], asked["digest"]):
            return None
        return with_values(robots, {name: value for name, value in asked.items() if isinstance(value, float)})
    try:
        return task_from(asked)
    except (ValueError, msgspec.ValidationError):
        return None


@lru_cache(maxsize=4)
def digest_of(read: tuple[object, ...]) -> str:
    """A few letters that are the same for the same contents of a task's file only."""
    return hashlib.sha256(msgspec.json.encode(read)).hexdigest()[:16]


def record_of(t_ns: int, task: RobotTask) -> records.Task:
    """The record of a task that is in force from `t_ns` on; what is read from its file is in the log's copy of that."""
    fields = {name: getattr(task, name) for name in task.__struct_fields__}
    return records.Task(
        t_ns, kind_of(task), {name: value for name, value in fields.items() if isinstance(value, float)}
    )


def task_of(record: records.Task, robots: RobotTask) -> RobotTask:
    """The task of a record: `robots`, robot.toml's, with the values in the record."""
    return with_values(robots, record.values())


def _number(name: str, value: Any, least: float, largest: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TaskRefused(f"{name}: not a number; write one")
    # So that no number at all, and a whole one that is too large for a float, are outside as well.
    if not least <= value <= largest:
        raise TaskRefused(f"{name}: not within {least:g} and {largest:g}; write another value")
    return float(value)
