"""What one message says in one role, as a row of numbers; the classes of messages are made by `rosbags`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from disco_hw.config import Robot, RobotConfig
from disco_hw.log.rosbag.topics import ARRAY, DRIVERS, JOINTS, ODOMETRY, POSES, TWIST, WHEELS, Choice

Row = tuple[float, ...]
Take = Callable[[Any], Row | None]


def finite(row: Row | None) -> Row | None:
    """A row without infinities, else None. NaN stands for what is not known, and stays."""
    return None if row is None or any(map(math.isinf, row)) else row


def stamp_of(message: Any) -> int:
    """The header's stamp, ns; 0 without a header."""
    header = getattr(message, "header", None)
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec) if header is not None else 0


def take_of(role: str, kind: str, choice: Choice, config: RobotConfig) -> tuple[int, Take]:
    """How many numbers a message of this type gives in this role, and how."""
    if role == POSES:
        return 7, _odometry_pose if kind == ODOMETRY else _measured_pose
    if role == WHEELS:
        return 4, _joint_wheels(choice) if kind == JOINTS else _odometry_wheels(config.robot)
    if kind == JOINTS:
        return 2, _joint_command(choice)
    if kind == ARRAY:
        return 2, _array_command(choice, config.ros2.command_joints)
    if kind in TWIST:
        return 2, _twist_command(config.robot)
    return 2, _drivers if DRIVERS.fullmatch(kind) else _wheel_speeds


def _wheel_pair(robot: Robot, forward: float, turning: float) -> Row:
    """Left and right wheel speeds of a motion, rad/s."""
    half = 0.5 * robot.axial_distance_m * turning
    return (forward - half) / robot.wheel_radius_m, (forward + half) / robot.wheel_radius_m


def _twist_command(robot: Robot) -> Take:
    def take(message: Any) -> Row:
        twist = getattr(message, "twist", message)
        return _wheel_pair(robot, float(twist.linear.x), float(twist.angular.z))

    return take


def _mean_of(values: Any, names: Sequence[str], wanted: Sequence[str]) -> float:
    """Mean over several joints; NaN where the array does not hold one of them."""
    found = [float(values[names.index(name)]) for name in wanted if names.index(name) < len(values)]
    return sum(found) / len(found) if len(found) == len(wanted) else math.nan


def _joint_wheels(choice: Choice) -> Take:
    wanted = {*choice.left_joints, *choice.right_joints}

    def take(message: Any) -> Row | None:
        names = list(message.name)
        # Other joints of the robot may come in messages of their own.
        if not wanted <= set(names):
            return None
        sides = (choice.left_joints, choice.right_joints)
        return tuple(_mean_of(values, names, side) for values in (message.position, message.velocity) for side in sides)

    return take


def _joint_command(choice: Choice) -> Take:
    def take(message: Any) -> Row | None:
        names = list(message.name)
        if not {*choice.left_joints, *choice.right_joints} <= set(names):
            return None
        if not len(message.velocity):
            # No speed: from here on nothing is commanded.
            return math.nan, math.nan
        return tuple(_mean_of(message.velocity, names, side) for side in (choice.left_joints, choice.right_joints))

    return take


def _array_command(choice: Choice, joints: Sequence[str]) -> Take:
    def take(message: Any) -> Row | None:
        if not joints:
            return (float(message.data[0]), float(message.data[1])) if len(message.data) == 2 else None
        return tuple(_mean_of(message.data, list(joints), side) for side in (choice.left_joints, choice.right_joints))

    return take


def _drivers(message: Any) -> Row | None:
    """Drive of Clearpath's bases: left and right in rad/s where the mode is that of a velocity (0)."""
    return None if getattr(message, "mode", 0) != 0 else (float(message.drivers[0]), float(message.drivers[1]))


def _wheel_speeds(message: Any) -> Row:
    return float(message.velocity_left), float(message.velocity_right)


def _odometry_wheels(robot: Robot) -> Take:
    def take(message: Any) -> Row:
        twist = message.twist.twist
        return (math.nan, math.nan, *_wheel_pair(robot, float(twist.linear.x), float(twist.angular.z)))

    return take


def _odometry_pose(message: Any) -> Row | None:
    return _space(message.pose.pose)


def _measured_pose(message: Any) -> Row | None:
    return _space(getattr(message.pose, "pose", message.pose))


def _space(pose: Any) -> Row | None:
    return _place(pose.position, pose.orientation)


def transform_row(transform: Any) -> Row | None:
    """Position and quaternion (7,) of a transform."""
    return _place(transform.translation, transform.rotation)


def _place(position: Any, rotation: Any) -> Row | None:
    row = (position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w)
    length = math.hypot(*row[3:])
    # A quaternion of zeros is what a publisher leaves that never set it.
    return None if not (math.isfinite(sum(row)) and 0.5 < length < 2.0) else row
