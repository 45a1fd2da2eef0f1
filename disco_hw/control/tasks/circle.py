"""The paper's task: follow a circle at constant speed, counter-clockwise."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from disco_hw.config import CircleTask
from disco_hw.control.tasks.terms import has_memory, stage_cost, terminal_cost
from disco_hw.model.jit import cast_like, quick_norm, scalar_function, specialise
from disco_hw.model.reference import State


class CircleTerms(NamedTuple):
    """What the kernel needs of a circle.

    Radius (m), speed (m/s), speed over radius (1/s), weight of lost progress or None, and 1 / (step * radius).
    """

    radius_m: Any
    speed_m_s: Any
    turn_rate_rad_s: Any
    progress_weight: Any
    progress_scale: Any


@dataclass(frozen=True, slots=True)
class Circle:
    """Follow a circle counter-clockwise: c = sqrt(d^2 + (s - s0)^2) + w max(0, s0 rho / R - progress).

    d is the distance to the circle's edge, s the longitudinal speed, rho the distance to the centre and progress the
    areal velocity over R. The first term is the paper's (section V-B). It alone is 0.2 for standing still and less for
    spinning about an offset centre of rotation; the second, zero for a robot that drives round the circle fast enough,
    takes the reward from both. `progress_weight` = 0 is the paper's cost.
    """

    center_x_m: float = 0.0
    center_y_m: float = 0.0
    radius_m: float = 0.75
    speed_m_s: float = 0.2
    progress_weight: float = 1.0

    @classmethod
    def from_config(cls, task: CircleTask, progress_weight: float = 1.0) -> Circle:
        """The circle of robot.toml."""
        return cls(task.center_x_m, task.center_y_m, task.radius_m, task.speed_m_s, progress_weight)

    @property
    def origin_m(self) -> tuple[float, float]:
        """World position that rollouts are relative to."""
        return self.center_x_m, self.center_y_m

    def terms(
        self, time_s: float, x_m: float, y_m: float, memory: float | None, step_s: float, horizon: int
    ) -> tuple[Any, float]:
        """Terms for the kernel; nothing depends on time or place, and a circle needs no memory."""
        f32 = np.float32
        return CircleTerms(
            f32(self.radius_m),
            f32(self.speed_m_s),
            f32(self.speed_m_s / self.radius_m),
            f32(self.progress_weight) if self.progress_weight > 0.0 else None,
            f32(1.0 / (step_s * self.radius_m)),
        ), 0.0

    def instant_cost(self, time_s: float, x_m: float, y_m: float, forward_m_s: float) -> float:
        """The paper's instant cost of a state."""
        distance = math.hypot(x_m - self.center_x_m, y_m - self.center_y_m) - self.radius_m
        return math.hypot(distance, forward_m_s - self.speed_m_s)

    def reference_cost(self, step_s: float) -> Callable[..., Any]:
        """The stage cost in numpy, for `disco_hw.control.reference`: of states before and after, speed and step."""

        def cost(old: State, new: State, forward: Any, t: int) -> Any:
            x_old, y_old = old.x - self.center_x_m, old.y - self.center_y_m
            x, y = new.x - self.center_x_m, new.y - self.center_y_m
            rho = np.hypot(x, y)
            progress = (x_old * y - y_old * x) / step_s / self.radius_m
            lost = np.maximum(self.speed_m_s * rho / self.radius_m - progress, 0.0)
            return np.hypot(rho - self.radius_m, forward - self.speed_m_s) + self.progress_weight * lost

        return cost

    def picture(self) -> NDArray[np.float64]:
        """The path to follow as a closed polyline in the world frame, shape (N, 2)."""
        angle = np.linspace(0.0, 2.0 * np.pi, 181)
        return np.column_stack(
            [self.center_x_m + self.radius_m * np.cos(angle), self.center_y_m + self.radius_m * np.sin(angle)]
        )


def _is_circle(task: Any) -> bool:
    return getattr(task, "instance_class", None) is CircleTerms


@scalar_function
def lost_progress(weight: Any, rho: float, swept: float, task: Any) -> Any:
    """Cost of progress below the wanted: `swept` is twice the area swept about the centre in the step (m^2)."""
    if weight is None:
        return cast_like(0.0, rho)
    lost = task.turn_rate_rad_s * rho - swept * task.progress_scale
    return weight * max(lost, cast_like(0.0, rho))


@specialise(stage_cost)
def _stage_cost(
    task: Any, memory: Any, step: Any, x_old: Any, y_old: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any, forward: Any
) -> Callable[..., Any] | None:
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
    ) -> Any:
        rho = quick_norm(x, y)
        off_edge = rho - task.radius_m
        off_speed = forward - task.speed_m_s
        cost = math.sqrt(off_edge * off_edge + off_speed * off_speed)
        return cost + lost_progress(task.progress_weight, rho, x_old * y - y_old * x, task), memory

    return cost


@specialise(terminal_cost)
def _terminal_cost(task: Any, memory: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any) -> Callable[..., Any] | None:
    if not _is_circle(task):
        return None

    def cost(task: Any, memory: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any) -> Any:
        return cast_like(0.0, x)

    return cost


@specialise(has_memory)
def _has_memory(task: Any) -> Callable[..., Any] | None:
    return (lambda task: False) if _is_circle(task) else None
