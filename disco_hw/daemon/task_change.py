"""Another circle than robot.toml's, as a person asks for it while the daemon runs; pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import msgspec

from disco_hw.config import CircleTask, Robot
from disco_hw.daemon.states import State
from disco_hw.log import records

RADIUS_M = (0.1, 50.0)
CENTER_M = (-1000.0, 1000.0)
SLOWEST_M_S = 0.01
_FASTEST_M_S = 100.0
FIELDS = ("radius_m", "speed_m_s", "center_x_m", "center_y_m")
_LOCKED = frozenset({State.ARMED, State.STOPPING})


class TaskRefused(Exception):  # noqa: N818
    """The change is not made; the message says why and what to do."""


def changed_task(task: CircleTask, asked: Mapping[str, Any], robot: Robot, state: State) -> CircleTask:
    """The task with the fields of FIELDS that are in `asked`, m and m/s.

    Raises TaskRefused while the robot is armed or stopping, for anything that is no number within the limits, and for a
    speed that the outer wheel cannot reach on that circle.
    """
    if state in _LOCKED:
        raise TaskRefused(f"the task can be changed while the robot is disarmed, and it is {state.name}; disarm first")
    unknown = sorted(set(asked) - set(FIELDS))
    if unknown or not asked:
        raise TaskRefused(f"give one or more of {', '.join(FIELDS)}" + (f", not {unknown[0]}" if unknown else ""))
    changed = msgspec.structs.replace(task, **{name: _number(name, value) for name, value in asked.items()})
    fastest = fastest_m_s(robot, changed.radius_m)
    if changed.speed_m_s > fastest:
        raise TaskRefused(
            f"{changed.speed_m_s:g} m/s on a radius of {changed.radius_m:g} m asks the outer wheel for more than "
            f"{robot.max_wheel_speed_rad_s:g} rad/s; at most {math.floor(fastest * 1000.0) / 1000.0:g} m/s, or widen it"
        )
    return changed


def fastest_m_s(robot: Robot, radius_m: float) -> float:
    """Speed on a circle at which the outer wheel of the nominal robot is at its limit."""
    outer = 1.0 + 0.5 * robot.axial_distance_m / radius_m
    return robot.max_wheel_speed_rad_s * robot.wheel_radius_m / outer


def limits(robot: Robot, task: CircleTask) -> dict[str, tuple[float, float]]:
    """Least and largest value of each field; the speed's largest is that on the present radius."""
    return {
        "radius_m": RADIUS_M,
        "speed_m_s": (SLOWEST_M_S, fastest_m_s(robot, task.radius_m)),
        "center_x_m": CENTER_M,
        "center_y_m": CENTER_M,
    }


def record_of(t_ns: int, task: CircleTask) -> records.Task:
    """The record of a task that is in force from `t_ns` on."""
    return records.Task(t_ns, task.center_x_m, task.center_y_m, task.radius_m, task.speed_m_s)


def task_of(record: records.Task) -> CircleTask:
    """The task that a record tells of."""
    return CircleTask(
        center_x_m=record.center_x_m,
        center_y_m=record.center_y_m,
        radius_m=record.radius_m,
        speed_m_s=record.speed_m_s,
    )


def _number(name: str, value: Any) -> float:
    least, largest = {"radius_m": RADIUS_M, "speed_m_s": (SLOWEST_M_S, _FASTEST_M_S)}.get(name, CENTER_M)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TaskRefused(f"{name}: not a number; write one")
    # So that no number at all, and a whole one that is too large for a float, are outside as well.
    if not least <= value <= largest:
        raise TaskRefused(f"{name}: not within {least:g} and {largest:g}; write another value")
    return float(value)
