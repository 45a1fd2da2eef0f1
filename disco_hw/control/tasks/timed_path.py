"""Follow way-points by time: be at each place when its time has come."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from disco_hw.config import TimedPathTask
from disco_hw.control.tasks.path import AGAINST_M
from disco_hw.control.tasks.task import Prepared
from disco_hw.control.tasks.terms import has_memory, looks_up, stage_cost, terminal_cost
from disco_hw.jit import cast_like, quick_norm, specialise
from disco_hw.waypoints import Waypoints

Array = NDArray[np.float64]
# A place that moves by less in a step has no direction.
RESTS_M = 1e-6


class TimedPathTerms(NamedTuple):
    """Where to be at the end of each step: `x`, `y` (T,) m; and which way that goes, `along_x`, `along_y` (T,).

    The latter are of length one, or zero while the place rests.
    """

    x: Any
    y: Any
    along_x: Any
    along_y: Any


@dataclass(frozen=True, eq=False)
class TimedPath:
    """Follow way-points with times: c is the distance to where the robot should be now, and facing.

    The place moves on by itself, so nothing but following it is cheap. Facing is as of `Path`, against the way that the
    place goes, so that it is not followed backwards; while the place rests it is nothing. Before the first time the
    place is the first way-point, after the last the last one. Raises ValueError for way-points without times.
    """

    waypoints: Waypoints

    def __post_init__(self) -> None:
        if self.waypoints.times_s is None:
            raise ValueError("the way-points have no times")

    @classmethod
    def from_config(cls, task: TimedPathTask) -> TimedPath:
        """The path of robot.toml with the way-points that were read for it."""
        return cls(Waypoints(np.array(task.points), np.array(task.times_s)))

    def _where(self, time_s: NDArray[np.floating]) -> tuple[Array, Array]:
        times, places = self.waypoints.times_s, self.waypoints.places_m
        assert times is not None
        x, y = (np.interp(time_s, times, column) for column in places.T)
        return np.asarray(x), np.asarray(y)

    def prepare(
        self, time_s: float, x_m: float, y_m: float, memory: float | None, step_s: float, horizon: int
    ) -> Prepared:
        """Terms for the kernel, relative to where the robot should be now; there is no memory."""
        x, y = self._where(time_s + step_s * np.arange(horizon + 1))
        along_x, along_y = np.diff(x), np.diff(y)
        length = np.hypot(along_x, along_y)
        length[length < RESTS_M] = np.inf
        columns = (x[1:] - x[0], y[1:] - y[0], along_x / length, along_y / length)
        return Prepared(TimedPathTerms(*(column.astype(np.float32) for column in columns)), (float(x[0]), float(y[0])))

    def instant_cost(self, time_s: float, x_m: float, y_m: float, forward_m_s: float) -> float:
        """Distance to where the robot should be."""
        x, y = self._where(np.array(time_s))
        return float(np.hypot(x - x_m, y - y_m))

    def picture(self) -> Array:
        """The path as a polyline in the world frame, (N, 2)."""
        return self.waypoints.places_m


def _is_timed_path(task: Any) -> bool:
    return getattr(task, "instance_class", None) is TimedPathTerms


@specialise(stage_cost)
def _stage_cost(
    task: Any, memory: Any, step: Any, x_old: Any, y_old: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any, forward: Any,
    found: Any,
) -> Callable[..., Any] | None:  # fmt: skip
    if not _is_timed_path(task):
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
        zero = cast_like(0.0, x)
        against = max(-(cos_yaw * task.along_x[step] + sin_yaw * task.along_y[step]), zero)
        return quick_norm(x - task.x[step], y - task.y[step]) + cast_like(AGAINST_M, x) * against, memory

    return cost


@specialise(terminal_cost)
def _terminal_cost(
    task: Any, memory: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any, found: Any
) -> Callable[..., Any] | None:
    if not _is_timed_path(task):
        return None
    return lambda task, memory, x, y, cos_yaw, sin_yaw, found: cast_like(0.0, x)


@specialise(has_memory)
def _has_memory(task: Any) -> Callable[..., Any] | None:
    return (lambda task: False) if _is_timed_path(task) else None


@specialise(looks_up)
def _looks_up(task: Any) -> Callable[..., Any] | None:
    return (lambda task: None) if _is_timed_path(task) else None
