"""The paper's task: follow a circle at constant speed, counter-clockwise."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from disco_hw.config import CircleTask
from disco_hw.control.tasks.task import Prepared
from disco_hw.control.tasks.terms import has_memory, looks_up, stage_cost, terminal_cost
from disco_hw.jit import cast_like, quick_norm, quick_norm_and_inverse, scalar_function, specialise

# The radius over the distance from the centre below which progress stops growing.
NEAR_CENTRE = 2.0


class CircleTerms(NamedTuple):
    """What the kernel needs of a circle.

    Radius (m), speed (m/s); weight of lost progress or None, progress wanted by the end of the horizon (m/s times
    steps), progress of a radian (m/s), largest reciprocal square of the radius; weight of the last distance or None.
    """

    radius_m: Any
    speed_m_s: Any
    progress_weight: Any
    wanted: Any
    per_rad: Any
    closest: Any
    terminal_steps: Any


@dataclass(frozen=True, slots=True)
class Circle:
    """Follow a circle counter-clockwise: sum of c = sqrt(d^2 + (s - s0)^2) over the steps, plus lost progress.

    d is the distance to the circle's edge, s the longitudinal speed: the paper's cost (section V-B). It alone is 0.2
    for standing still and less for spinning about an offset centre of rotation. Progress takes the reward from both: it
    is R times the angle by which the tracked point moves on about the centre, zero in sum for any loop beside it; what
    the steps together miss of `progress_part` of s0 costs `progress_weight` times as much as the same miss of speed. A
    robot that drives round pays nothing. The
    last d counts as much as it would over `terminal_s` more: the way back to the edge begins with a loss, as turning in
    pushes the tracked point out, and would else not pay within the horizon. `Circle.paper` has neither.
    """

    center_x_m: float = 0.0
    center_y_m: float = 0.0
    radius_m: float = 0.75
    speed_m_s: float = 0.2
    progress_weight: float = 1.0
    progress_part: float = 0.8
    terminal_s: float = 1.0

    @classmethod
    def from_config(cls, task: CircleTask, mode: str = "default") -> Circle:
        """The circle of robot.toml, with the cost of the control mode."""
        circle = cls(task.center_x_m, task.center_y_m, task.radius_m, task.speed_m_s)
        return circle.paper() if mode == "paper" else circle

    def paper(self) -> Circle:
        """The same circle with the paper's cost alone."""
        return replace(self, progress_weight=0.0, terminal_s=0.0)

    def prepare(
        self, time_s: float, x_m: float, y_m: float, memory: float | None, step_s: float, horizon: int
    ) -> Prepared:
        """Terms for the kernel; nothing depends on time or place. The memory is the angle swept (rad)."""
        return _prepared(self, step_s, horizon)

    def instant_cost(self, time_s: float, x_m: float, y_m: float, forward_m_s: float) -> float:
        """The paper's instant cost of a state."""
        distance = math.hypot(x_m - self.center_x_m, y_m - self.center_y_m) - self.radius_m
        return math.hypot(distance, forward_m_s - self.speed_m_s)

    def picture(self) -> NDArray[np.float64]:
        """The path to follow as a closed polyline in the world frame, shape (N, 2)."""
        angle = np.linspace(0.0, 2.0 * np.pi, 181)
        return np.column_stack(
            [self.center_x_m + self.radius_m * np.cos(angle), self.center_y_m + self.radius_m * np.sin(angle)]
        )


@lru_cache(maxsize=16)
def _prepared(circle: Circle, step_s: float, horizon: int) -> Prepared:
    f32 = np.float32
    terms = CircleTerms(
        f32(circle.radius_m),
        f32(circle.speed_m_s),
        f32(circle.progress_weight) if circle.progress_weight > 0.0 else None,
        f32(circle.progress_part * circle.speed_m_s * horizon),
        f32(circle.radius_m / step_s),
        f32((NEAR_CENTRE / circle.radius_m) ** 2),
        f32(circle.terminal_s / step_s) if circle.terminal_s > 0.0 else None,
    )
    return Prepared(terms, (circle.center_x_m, circle.center_y_m))


def _is_circle(task: Any) -> bool:
    return getattr(task, "instance_class", None) is CircleTerms


@scalar_function
def _swept(weight: Any, memory: Any, x_old: Any, y_old: Any, x: Any, y: Any, inverse: Any, task: Any) -> Any:
    """Angle swept about the centre so far (rad); steps near the centre count less than their angle."""
    if weight is None:
        return memory
    return memory + (x_old * y - y_old * x) * min(inverse * inverse, task.closest)


@scalar_function
def _lost(weight: Any, memory: Any, task: Any) -> Any:
    """Cost of the progress that is missing at the end."""
    zero = cast_like(0.0, memory)
    if weight is None:
        return zero
    return weight * max(task.wanted - memory * task.per_rad, zero)


@scalar_function
def _last_distance(steps: Any, x: Any, y: Any, task: Any) -> Any:
    """Cost of the distance to the edge that is left at the end."""
    if steps is None:
        return cast_like(0.0, x)
    return steps * abs(quick_norm(x, y) - task.radius_m)


@specialise(stage_cost)
def _stage_cost(
    task: Any, memory: Any, step: Any, x_old: Any, y_old: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any, forward: Any,
    found: Any,
) -> Callable[..., Any] | None:  # fmt: skip
    if not _is_circle(task):
        return None

    def cost(
        task: Any,
        memory: Any,
        step: Any,
        x_old: Any,
        y_old: Any,
        x: Any,
        y: Any,
        cos_yaw: Any,
        sin_yaw: Any,
        forward: Any,
        found: Any,
    ) -> Any:
        rho, inverse = quick_norm_and_inverse(x, y)
        off_edge = rho - task.radius_m
        off_speed = forward - task.speed_m_s
        swept = _swept(task.progress_weight, memory, x_old, y_old, x, y, inverse, task)
        return math.sqrt(off_edge * off_edge + off_speed * off_speed), swept

    return cost


@specialise(terminal_cost)
def _terminal_cost(
    task: Any, memory: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any, found: Any
) -> Callable[..., Any] | None:
    if not _is_circle(task):
        return None

    def cost(task: Any, memory: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any, found: Any) -> Any:
        return _lost(task.progress_weight, memory, task) + _last_distance(task.terminal_steps, x, y, task)

    return cost


@specialise(has_memory)
def _has_memory(task: Any) -> Callable[..., Any] | None:
    if not _is_circle(task):
        return None
    pays_for_progress = not isinstance(task.types[CircleTerms._fields.index("progress_weight")], types.NoneType)
    return (lambda task: True) if pays_for_progress else (lambda task: False)


@specialise(looks_up)
def _looks_up(task: Any) -> Callable[..., Any] | None:
    return (lambda task: None) if _is_circle(task) else None
