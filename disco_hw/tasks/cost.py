"""What the cost of a task is written in: plain functions of numbers, which the planner compiles.

The terms of a task are a named tuple of float32 numbers and arrays with the functions of its cost. `stage` and
`terminal` are the c and phi of the paper's Algorithm 1:

    stage(self, memory, step, x_old, y_old, x, y, cos_yaw, sin_yaw, forward, found) -> cost, memory
    terminal(self, memory, x, y, cos_yaw, sin_yaw, found) -> cost

`step` is the index of the step; positions are relative to the task's origin (m), before and after it; `forward` is the
longitudinal speed over it (m/s); `memory` is a number that a rollout carries along. No compiler makes vectors of
looking numbers up in a table at a place of every sample's own. So terms with a `table`, rows of four float32, flat,
have two functions more, and the look-up happens between `follow` and `stage`:

    follow(self, memory, x, y, forward, found) -> memory, kept      where a sample is after the step
    row_of(self, memory) -> int32                                   the row of the table for a memory, within it

Terms of a task with a line may say it, for the planner to follow it by a steering law (control/kernel/guide.py):

    place_of(self, place, x, y) -> place                            beside a position, from the one before
    line_at(self, place, ahead_m) -> x, y, head_x, head_y, along, speed
    way_ahead_m(self, time_s) -> m                                  not compiled

the point so far on, the heading in which a robot stays on the line there, the cosine by which that is off the line,
and the speed wanted; a place begins as a rollout's memory does. And how far a robot on the line goes in so long: the
law has one whose plan stands.

`found` holds what `follow` kept and the four numbers of that row; zeros without a table. Constants are made by
`single`: any other number would pull the arithmetic up to double precision. Compiled, the functions below use estimates
refined by a Newton step; as written here they are their oracle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar, cast

import numpy as np

Found = tuple[float, float, float, float, float]


def norm(x: float, y: float) -> float:
    """Length of a vector."""
    return math.hypot(x, y)


def norm_and_inverse(x: float, y: float) -> tuple[float, float]:
    """Length of a vector and its reciprocal; of zero, 1e-15 and 1e15."""
    length = max(math.hypot(x, y), 1e-15)
    return length, 1.0 / length


def norm_of_three(x: float, y: float, z: float) -> float:
    """Length of a vector of three."""
    return math.hypot(x, y, z)


def single(value: float) -> float:
    """A number in single precision, for the terms of a cost and its constants."""
    return cast(float, np.float32(value))


def constant(value: float, like: float) -> float:
    """A number in the precision of another one."""
    return value


Helper = TypeVar("Helper", bound=Callable[..., object])
HELPERS: list[Callable[..., object]] = []
"""Functions that costs call, for the planner to compile."""


def helper(function: Helper) -> Helper:
    """Let the functions of a cost call this one."""
    HELPERS.append(function)
    return function
