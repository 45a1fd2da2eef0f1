"""Sound drives of simulated robots, and what makes each contradict itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np

from disco_hw.log.drive import Commands, DriveLog
from tools.gap.logs import simulated_drive

Change = Callable[[DriveLog], DriveLog]
RADIUS_M, AXIAL_M = 0.06, 0.4


@cache
def sound(drive: str = "free", seed: int = 900) -> DriveLog:
    return simulated_drive(seed=seed, drive=drive)


def wrapped(yaw_rad):
    return np.pi - np.mod(np.pi - yaw_rad, 2.0 * np.pi)


def with_poses(**changes) -> Change:
    """Poses whose columns are made by these functions of the old poses."""
    return lambda log: replace(
        log, poses=replace(log.poses, **{k: function(log.poses) for k, function in changes.items()})
    )


def rotated(angle_rad: float, with_heading: bool = True) -> Change:
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return with_poses(
        x_m=lambda p: cosine * p.x_m - sine * p.y_m,
        y_m=lambda p: sine * p.x_m + cosine * p.y_m,
        yaw_rad=lambda p: wrapped(p.yaw_rad + (angle_rad if with_heading else 0.0)),
    )


def with_wheels(left: float = 1.0, right: float = 1.0, swap: bool = False) -> Change:
    """Encoders that count so many times as much, or those of the other side."""

    def change(log: DriveLog) -> DriveLog:
        wheels = log.wheels
        sides = ("right", "left") if swap else ("left", "right")
        columns = {
            f"{to}_{what}": factor * getattr(wheels, f"{of}_{what}")
            for to, of, factor in zip(("left", "right"), sides, (left, right), strict=True)
            for what in ("angle_rad", "speed_rad_s")
        }
        return replace(log, wheels=replace(wheels, **columns))

    return change


def with_commands(factor: float) -> Change:
    def change(log: DriveLog) -> DriveLog:
        commands = log.commands
        left, right = factor * commands.left_rad_s, factor * commands.right_rad_s
        return replace(log, commands=replace(commands, left_rad_s=left, right_rad_s=right))

    return change


def without_commands(log: DriveLog) -> DriveLog:
    return replace(log, commands=Commands())


def of_another_drive(log: DriveLog) -> DriveLog:
    other = sound("circle", 901).poses
    columns = {name: getattr(other, name)[: log.poses.t_s.size] for name in ("x_m", "y_m", "yaw_rad")}
    times = {name: getattr(log.poses, name)[: columns["x_m"].size] for name in ("t_s", "segment")}
    return replace(log, poses=replace(log.poses, **columns, **times))


def then(*changes: Change) -> Change:
    def change(log: DriveLog) -> DriveLog:
        for each in changes:
            log = each(log)
        return log

    return change


def heading_stops(log: DriveLog) -> DriveLog:
    yaw_rad = log.poses.yaw_rad.copy()
    third = yaw_rad.size // 3
    yaw_rad[third : 2 * third] = yaw_rad[third]
    return replace(log, poses=replace(log.poses, yaw_rad=yaw_rad))


# What is changed, the cause that is named, and words of its remedy.
FAULTS: dict[str, tuple[Change, str, str]] = {
    "poses of another drive": (of_another_drive, "unrelated", "not of one drive"),
    "constant poses": (
        with_poses(**dict.fromkeys(("x_m", "y_m", "yaw_rad"), lambda p: np.full(p.t_s.size, 0.3))),
        "poses_still",
        "pose sensor is dead",
    ),
    "y mirrored": (with_poses(y_m=lambda p: -p.y_m), "axis_mirrored", "sign of pose_y_m"),
    "x mirrored": (with_poses(x_m=lambda p: -p.x_m), "axis_mirrored", "sign of pose_y_m"),
    "x and y exchanged": (with_poses(x_m=lambda p: p.y_m, y_m=lambda p: p.x_m), "axis_mirrored", "exchange x and y"),
    "a frame mirrored": (
        with_poses(y_m=lambda p: -p.y_m, yaw_rad=lambda p: -p.yaw_rad),
        "mirrored",
        "axis of the pose frame is mirrored",
    ),
    "a compass": (with_poses(yaw_rad=lambda p: wrapped(0.5 * np.pi - p.yaw_rad)), "heading_mirrored", "clockwise"),
    "degrees": (with_poses(yaw_rad=lambda p: np.degrees(p.yaw_rad)), "heading_units", "write radians"),
    "millimetres": (
        with_poses(x_m=lambda p: 1e3 * p.x_m, y_m=lambda p: 1e3 * p.y_m),
        "pose_units",
        "as millimetres do: write metres",
    ),
    "positions turned alone": (rotated(1.5, with_heading=False), "heading_offset", "off the course"),
    "heading backwards": (
        with_poses(yaw_rad=lambda p: wrapped(p.yaw_rad + np.pi)),
        "heading_backwards",
        "mounting of the pose sensor",
    ),
    "a standing heading": (
        with_poses(yaw_rad=lambda p: np.zeros(p.t_s.size)),
        "heading_still",
        "not a measured heading",
    ),
    "a heading that stops for a third": (heading_stops, "heading_still", "not a measured heading"),
    "encoders doubled": (with_wheels(2.0, 2.0), "encoder_count", "wheels count 2.00 times the expected ticks"),
    "encoders halved": (with_wheels(0.5, 0.5), "encoder_count", "wheels count 0.50 times the expected ticks"),
    "encoders doubled, no commands": (
        then(with_wheels(2.0, 2.0), without_commands),
        "encoder_count",
        "check ticks_per_rev and gear",
    ),
    "left encoder doubled": (with_wheels(2.0, 1.0), "encoder_count", "left wheel counts"),
    "encoders swapped": (with_wheels(swap=True), "sides_swapped", "encoders are swapped (the poses show it too)"),
    "encoders swapped, no commands": (
        then(with_wheels(swap=True), without_commands),
        "mirrored",
        "left and right encoders are swapped",
    ),
    "left encoder reversed": (with_wheels(-1.0, 1.0), "encoder_reversed", "left encoder counts against the commands"),
    "right encoder reversed, no commands": (
        then(with_wheels(1.0, -1.0), without_commands),
        "encoder_reversed",
        "right encoder counts backwards",
    ),
    "both encoders reversed, no commands": (
        then(with_wheels(-1.0, -1.0), without_commands),
        "wheels_reversed",
        "both encoders count backwards",
    ),
    "left encoder dead": (with_wheels(0.0, 1.0), "encoder_dead", "left encoder does not count"),
    "right encoder dead, no commands": (
        then(with_wheels(1.0, 0.0), without_commands),
        "encoder_dead",
        "right encoder never counts",
    ),
    "both encoders dead": (with_wheels(0.0, 0.0), "wheels_still", "encoders are not read"),
    "commands in rpm": (with_commands(9.549), "command_scale", "in rad/s of the wheel"),
    "commands halved": (with_commands(0.5), "command_scale", "commands are 0.5 times"),
    "commands reversed": (with_commands(-1.0), "command_reversed", "both commands have the other sign"),
    "poses 5 s late": (with_poses(t_s=lambda p: p.t_s + 5.0), "time_base", "stamped 5 s late"),
    "poses 2 s early": (with_poses(t_s=lambda p: p.t_s - 2.0), "time_base", "stamped 2 s early"),
    "a clock that runs fast": (with_poses(t_s=lambda p: 1.1 * p.t_s), "time_base", "times the rate"),
    "poses in milliseconds": (with_poses(t_s=lambda p: 1e3 * p.t_s), "time_base", "two time bases"),
    "poses since 1970": (with_poses(t_s=lambda p: p.t_s + 1.7e9), "time_base", "0 s of it together"),
}
