"""Whether a task stays within the fence: the footprint on its start and all along its line."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from disco_hw.fence import Fence, Footprint
from disco_hw.fence.clearance import Boundaries, along_line, first_breach


class TaskLine(Protocol):
    """The line of a task; those of `disco_hw.tasks` have it."""

    @property
    def start(self) -> tuple[float, float, float]:
        """Start of the line and the heading there: x, y (m), yaw (rad)."""

    def outline_m(self) -> NDArray[np.float64]:
        """Return the line as points (N, 2)."""


def task_breach(fence: Fence, footprint: Footprint, course: TaskLine) -> str | None:
    """Say where a robot on this task would leave the fence, and how far; None if it stays inside.

    The robot is taken to face along the line. Where it turns at corners the guard sees to the rest.
    """
    if not fence.is_set:
        return None
    boundaries = Boundaries(footprint, fence)
    start = first_breach(boundaries, np.array([course.start], dtype=np.float64))
    if start is not None:
        (x, y), far = start
        return f"the task starts at ({x:.2f}, {y:.2f}), where the footprint is {far:.2f} m outside"
    crossing = first_breach(boundaries, along_line(np.asarray(course.outline_m(), dtype=np.float64)))
    if crossing is not None:
        (x, y), far = crossing
        return f"the task's line crosses it near ({x:.2f}, {y:.2f}): the footprint is {far:.2f} m outside there"
    return None
