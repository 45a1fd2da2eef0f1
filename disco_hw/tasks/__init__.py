"""What the robot is to do: one file a kind of task (docs/add-a-task.md says what such a file holds).

Every module of this package with a `TASK` is a kind, and its name is the kind's. Only the module of the kind that is
asked for is loaded, so that reading robot.toml stays quick.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import msgspec

from disco_hw.tasks.task import Course, PlannedTask, Prepared, Progress, RobotTask, TaskFault

__all__ = [
    "Course",
    "PlannedTask",
    "Prepared",
    "Progress",
    "ReadField",
    "RobotTask",
    "TaskFault",
    "UnknownKind",
    "default_task",
    "kind_of",
    "kinds",
    "task_class",
    "task_from",
]


class UnknownKind(ValueError):  # noqa: N818
    """There is no such kind of task; the message names those that there are."""


class ReadField(ValueError):  # noqa: N818
    """A field that is read from the task's file stands in [task]; the message says so."""


def _modules() -> list[str]:
    return [found.name for found in pkgutil.iter_modules(__path__) if not found.ispkg]


def _task_in(module: str) -> type[RobotTask] | None:
    found: type[RobotTask] | None = getattr(import_module(f"{__name__}.{module}"), "TASK", None)
    return found


def kinds() -> tuple[str, ...]:
    """All kinds of tasks, in alphabetical order."""
    return tuple(sorted(name for name in _modules() if _task_in(name) is not None))


def task_class(kind: str) -> type[RobotTask]:
    """The struct that holds [task] of this kind; raises UnknownKind."""
    found = _task_in(kind) if kind in _modules() else None
    if found is None:
        raise UnknownKind(f"{kind!r} is no kind of task; write one of {', '.join(kinds())}")
    return found


def kind_of(task: RobotTask) -> str:
    """The kind of a task, as robot.toml names it."""
    return type(task).__module__.rpartition(".")[2]


def default_task() -> RobotTask:
    """The task of a robot.toml without [task]."""
    return task_from({})


def task_from(section: Mapping[str, Any]) -> RobotTask:
    """The task that [task] of robot.toml says, validated; the files that it names are not read.

    Without `kind` it is of the kind that claims one of the section's fields, else of the kind that claims none in
    particular. Raises UnknownKind, ReadField, and msgspec.ValidationError for fields that the kind does not have or
    values that they cannot take.
    """
    fields = dict(section)
    kind = fields.pop("kind", None)
    if kind is None:
        kind = _implied_kind(fields)
    if not isinstance(kind, str):
        raise UnknownKind(f"{kind!r} is no kind of task; write one of {', '.join(kinds())}")
    task_type = task_class(kind)
    for name in task_type.read_fields:
        if name in fields:
            raise ReadField(f"{name}: no such field; write way-points in a CSV and name it in path")
    return msgspec.convert(fields, task_type)


def _implied_kind(fields: Mapping[str, Any]) -> str:
    claims = {kind: task_class(kind).implied_by for kind in kinds()}
    claimed = [kind for kind, field in claims.items() if field is not None and field in fields]
    return claimed[0] if claimed else next(kind for kind, field in claims.items() if field == "")
