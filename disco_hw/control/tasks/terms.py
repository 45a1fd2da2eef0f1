"""The seam between the rollout kernel and a task: two functions that each task's file overloads for its own terms."""

from __future__ import annotations

from typing import Any


def stage_cost(
    task: Any, memory: Any, step: Any, x_old: Any, y_old: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any, forward: Any
) -> Any:
    """Cost of one step of a rollout and the task's memory after it; compiled code only.

    `task` is the task's named tuple of terms, `memory` a number carried along the rollout, `step` the index of the
    step; positions are relative to the task's origin (m), before and after the step; `forward` is the longitudinal
    speed over the step (m/s).
    """
    raise TypeError(f"{type(task).__name__} has no stage cost")


def terminal_cost(task: Any, memory: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any) -> Any:
    """Cost of the state that a rollout ends in; compiled code only."""
    raise TypeError(f"{type(task).__name__} has no terminal cost")


def has_memory(task: Any) -> Any:
    """Whether the task carries its memory along a rollout; a constant to the compiler."""
    raise TypeError(f"{type(task).__name__} does not say whether it has a memory")
