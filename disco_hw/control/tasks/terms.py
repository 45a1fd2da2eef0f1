"""The seam between the rollout kernel and a task: functions that each task's file overloads for its own terms.

A task may have a table that its samples look up, each at its own place. No compiler makes vectors of that. So such a
task is asked in two parts with the look-up in between: `follow` says where a sample is after a step, then `stage_cost`
is given what the table holds there.
"""

from __future__ import annotations

from typing import Any


def stage_cost(
    task: Any, memory: Any, step: Any, x_old: Any, y_old: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any, forward: Any,
    found: Any,
) -> Any:  # fmt: skip
    """Cost of one step of a rollout and the task's memory after it; compiled code only.

    `task` is the task's named tuple of terms, `memory` a number carried along the rollout, `step` the index of the
    step; positions are relative to the task's origin (m), before and after the step; `forward` is the longitudinal
    speed over the step (m/s). `found`: what `follow` kept for the cost, and the four numbers that the table holds at
    the memory that `follow` left; zeros without a table.
    """
    raise TypeError(f"{type(task).__name__} has no stage cost")


def terminal_cost(task: Any, memory: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any, found: Any) -> Any:
    """Cost of the state that a rollout ends in; compiled code only."""
    raise TypeError(f"{type(task).__name__} has no terminal cost")


def has_memory(task: Any) -> Any:
    """Whether `stage_cost` changes the task's memory; a constant to the compiler."""
    raise TypeError(f"{type(task).__name__} does not say whether it has a memory")


def looks_up(task: Any) -> Any:
    """None for a task without a table, anything else for one with; a constant to the compiler."""
    raise TypeError(f"{type(task).__name__} does not say whether it has a table")


def table_of(task: Any) -> Any:
    """The table that samples look up, rows of four float32, flat."""
    raise TypeError(f"{type(task).__name__} has no table")


def follow(task: Any, memory: Any, x: Any, y: Any, forward: Any, found: Any) -> Any:
    """The memory after a step, and a number to keep for its cost; only of a task with a table, compiled code only.

    `x`, `y` after the step; `found` as of the step before.
    """
    raise TypeError(f"{type(task).__name__} has no table to follow")


def row_of(task: Any, memory: Any) -> Any:
    """The table's row for a memory, int32 and within the table."""
    raise TypeError(f"{type(task).__name__} has no table")
