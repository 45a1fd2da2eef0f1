"""Does the task get on: says so when the robot has stayed where it is for five seconds, and what stands in the way."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.types import WheelSample

WINDOW_NS = 5_000_000_000
LEAST_M = 0.05
"""Who gets no further than this within the window makes no progress; less for a task that is slower than that."""
LEAST_PART = 0.25
"""Of what the task's speed makes in the window."""
ASKED_RAD_S = 0.05
"""A command below this asks for no motion."""
ROLLED_RAD = 0.5
"""Wheels that have turned less in the window stand."""


@dataclass
class _Window:
    """Since when and where the robot is; how far the wheels have turned and were asked to at most."""

    begun_ns: int
    x_m: float
    y_m: float
    angles_rad: tuple[float, float] | None
    largest_rad_s: float = 0.0
    said: bool = False


class Headway:
    """Watches a running task of this speed; one of NaN, whose places have times and may rest, is not watched."""

    def __init__(self, speed_m_s: float) -> None:
        self._least_m = min(LEAST_M, LEAST_PART * speed_m_s * WINDOW_NS * 1e-9) if speed_m_s > 0.0 else math.nan
        self._window: _Window | None = None

    def step(
        self, now_ns: int, running: bool, place_m: tuple[float, float], command_rad_s: tuple[float, float],
        wheels: WheelSample | None, planner_failure: str | None,
    ) -> tuple[str, ...]:  # fmt: skip
        """Take in a tick; returns what to say, once for each time that the robot stays."""
        if not running or math.isnan(self._least_m):
            self._window = None
            return ()
        angles = None if wheels is None else (wheels.left_angle_rad, wheels.right_angle_rad)
        window = self._window
        if window is None or math.hypot(place_m[0] - window.x_m, place_m[1] - window.y_m) > self._least_m:
            self._window = _Window(now_ns, *place_m, angles)
            return ("task: gets on again",) if window is not None and window.said else ()
        window.largest_rad_s = max(window.largest_rad_s, *map(abs, command_rad_s))
        if window.said or now_ns - window.begun_ns < WINDOW_NS:
            return ()
        window.said = True
        return (f"task: no progress for 5 s: {_obstacle(window, angles, planner_failure)}",)


def _obstacle(window: _Window, angles_rad: tuple[float, float] | None, planner_failure: str | None) -> str:
    """What stands in the way, from the commands down to the ground."""
    if planner_failure is not None:
        return f"the planner has no plan: {planner_failure}"
    if window.largest_rad_s < ASKED_RAD_S:
        return "the planner asks for no motion; look at the task and at where the robot is"
    if angles_rad is None or window.angles_rad is None:
        return f"the wheels were asked for up to {window.largest_rad_s:.2f} rad/s, and say nothing of how they turn"
    turned = max(abs(now - then) for now, then in zip(angles_rad, window.angles_rad, strict=True))
    if turned < ROLLED_RAD:
        return (
            f"the wheels stand although asked for up to {window.largest_rad_s:.2f} rad/s: blocked, or a dead band that "
            "the model does not know (disco-hw gap finds it)"
        )
    return f"the wheels have turned by {turned:.1f} rad, and the pose has not moved: slip, an obstacle, a frozen pose"
