"""Another circle than robot.toml's, or another speed along its path, as a person asks for it; pure."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import msgspec

from disco_hw.config import CircleTask, PathTask, Point, Robot, RobotTask, TimedPathTask
from disco_hw.course import course_of
from disco_hw.log import records
from disco_hw.runtime.states import State

RADIUS_M = (0.1, 50.0)
CENTER_M = (-1000.0, 1000.0)
SLOWEST_M_S = 0.01
_FASTEST_M_S = 100.0
FIELDS = {
    CircleTask: ("radius_m", "speed_m_s", "center_x_m", "center_y_m"),
    PathTask: ("speed_m_s",),
    TimedPathTask: (),
}
"""What can be changed of each kind of task."""
_LOCKED = frozenset({State.ARMED, State.STOPPING})


class TaskRefused(Exception):  # noqa: N818
    """The change is not made; the message says why and what to do."""


def changed_task(task: RobotTask, asked: Mapping[str, Any], robot: Robot, state: State) -> RobotTask:
    """The task with the fields of FIELDS that are in `asked`, m and m/s.

    Raises TaskRefused while the robot is armed or stopping, for anything that is no number within the limits, and for a
    speed that the outer wheel cannot reach on that circle, or any wheel along a path.
    """
    if state in _LOCKED:
        raise TaskRefused(f"the task can be changed while the robot is disarmed, and it is {state.name}; disarm first")
    fields = FIELDS[type(task)]
    if not fields:
        raise TaskRefused("the way-points have times, which say all; change t_s in their CSV and start anew")
    unknown = sorted(set(asked) - set(fields))
    if unknown or not asked:
        raise TaskRefused(f"give one or more of {', '.join(fields)}" + (f", not {unknown[0]}" if unknown else ""))
    changed = msgspec.structs.replace(task, **{name: _number(name, value) for name, value in asked.items()})
    refusal = too_fast(robot, changed)
    if refusal is not None:
        raise TaskRefused(refusal)
    return changed


def too_fast(robot: Robot, task: RobotTask) -> str | None:
    """Why the wheels of the nominal robot cannot do the task, and the remedy; None if they can."""
    fastest = fastest_m_s(robot, task)
    if task.speed_m_s <= fastest:
        return None
    most = f"at most {math.floor(fastest * 1000.0) / 1000.0:g} m/s"
    if isinstance(task, CircleTask):
        return (
            f"{task.speed_m_s:g} m/s on a radius of {task.radius_m:g} m asks the outer wheel for more than "
            f"{robot.max_wheel_speed_rad_s:g} rad/s; {most}, or widen it"
        )
    return f"{task.speed_m_s:g} m/s asks the wheels for more than {robot.max_wheel_speed_rad_s:g} rad/s; {most}"


def fastest_m_s(robot: Robot, task: RobotTask) -> float:
    """Speed at which a wheel of the nominal robot is at its limit: the outer one on a circle, any straight ahead."""
    outer = 1.0 + 0.5 * robot.axial_distance_m / task.radius_m if isinstance(task, CircleTask) else 1.0
    return robot.max_wheel_speed_rad_s * robot.wheel_radius_m / outer


def limits(robot: Robot, task: RobotTask) -> dict[str, tuple[float, float]]:
    """Least and largest value of each field that can be changed; the speed's largest is that on the present radius."""
    every = {
        "radius_m": RADIUS_M,
        "speed_m_s": (SLOWEST_M_S, fastest_m_s(robot, task)),
        "center_x_m": CENTER_M,
        "center_y_m": CENTER_M,
    }
    return {name: every[name] for name in FIELDS[type(task)]}


def in_words(task: RobotTask) -> str:
    """The task for a person."""
    if isinstance(task, CircleTask):
        centre = f"({task.center_x_m:g}, {task.center_y_m:g}) m"
        return f"circle of {task.radius_m:g} m about {centre} at {task.speed_m_s:g} m/s"
    path = f"path {task.path} of {course_of(task).length_m:.2f} m"
    if isinstance(task, TimedPathTask):
        return f"{path} in {task.times_s[-1]:g} s, at most {task.speed_m_s:.3g} m/s"
    return f"{path} at {task.speed_m_s:g} m/s"


def asked_of(task: RobotTask) -> dict[str, Any]:
    """The task as the daemon's status tells it: a path by its file's name and a digest of its way-points."""
    if isinstance(task, CircleTask):
        return dict(msgspec.to_builtins(task))
    if isinstance(task, PathTask):
        return {"kind": "path", "path": task.path, "speed_m_s": task.speed_m_s, "digest": digest_of(task.points, ())}
    return {"kind": "timed_path", "path": task.path, "digest": digest_of(task.points, task.times_s)}


def told_task(asked: Mapping[str, Any], robots: RobotTask) -> RobotTask | None:
    """The task that `asked_of` told of; None for a path with other way-points than those in `robots`, robot.toml's."""
    if asked["kind"] == "circle":
        return msgspec.convert(asked, CircleTask)
    if asked_of(robots).get("digest") != asked["digest"]:
        return None
    return msgspec.structs.replace(robots, speed_m_s=asked["speed_m_s"]) if isinstance(robots, PathTask) else robots


@lru_cache(maxsize=4)
def digest_of(points: tuple[Point, ...], times_s: tuple[float, ...]) -> str:
    """A few letters that are the same for the same way-points only."""
    return hashlib.sha256(msgspec.json.encode((points, times_s))).hexdigest()[:16]


def record_of(t_ns: int, task: RobotTask) -> records.Task:
    """The record of a task that is in force from `t_ns` on; a path's way-points are in the log's copy of its file."""
    if isinstance(task, CircleTask):
        return records.Task(t_ns, task.center_x_m, task.center_y_m, task.radius_m, task.speed_m_s)
    return records.Task(t_ns, math.nan, math.nan, math.nan, task.speed_m_s, "path")


def task_of(record: records.Task, robots: RobotTask) -> RobotTask:
    """The task that a record tells of; of a path it tells the speed, and the rest is that of `robots`, robot.toml's."""
    if record.kind == "path":
        return msgspec.structs.replace(robots, speed_m_s=record.speed_m_s) if isinstance(robots, PathTask) else robots
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
