"""A drive -> a bag of ROS 2 that RViz, Foxglove, PlotJuggler and `ros2 bag` open, and `disco-hw import` reads again."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator
from heapq import merge
from pathlib import Path
from typing import Any

import numpy as np

from disco_hw.errors import InputError, LogError
from disco_hw.log.drive import DriveLog

MAP_FRAME, BASE_FRAME = "map", "base_link"
JOINTS = ("left_wheel_joint", "right_wheel_joint")
COMMAND_TOPIC, WHEEL_TOPIC, POSE_TOPIC, TWIST_TOPIC = "/wheel_commands", "/joint_states", "/pose", "/cmd_vel"

_EARLIEST_NS = 1_000_000_000
_Timed = tuple[int, str, Any]  # Any: a message, whose class `rosbags` makes.


def write_rosbag(drive: DriveLog, path: Path, start_ns: int, geometry: tuple[float, float] | None) -> int:
    """Write a new folder with an MCAP file and metadata.yaml; return the number of messages.

    `start_ns`: the wall-clock time of the drive's time 0. Wheel speeds that were commanded are JointState messages, one
    without velocities where none is in force; with `geometry`, nominal wheel radius and axial distance (m), also
    TwistStamped. Raises LogError if the path exists or cannot be written, InputError without `rosbags`.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: PLC0415
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ImportError:
        raise InputError(f"{path}: writing a bag needs rosbags; pip install 'disco-hw[ros2]'") from None
    if path.exists():
        raise LogError(f"{path}: already exists; give another name")
    store = get_typestore(Stores.ROS2_HUMBLE)
    make = _Messages(store.types, max(start_ns, _EARLIEST_NS))
    count = 0
    try:
        with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
            connections: dict[str, Any] = {}  # Any: the library's.
            for t_ns, topic, message in make.all_of(drive, geometry):
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(connections[topic], t_ns, store.serialize_cdr(message, kind))
                count += 1
    except OSError as error:
        # Half a bag would pass for a whole one.
        shutil.rmtree(path, ignore_errors=True)
        raise LogError(f"{path}: cannot be written ({error.strerror}); give another place") from None
    return count


class _Messages:
    """Makes messages of a drive's samples, stamped with wall-clock time."""

    def __init__(self, types: Any, start_ns: int) -> None:  # Any: the library's classes by their names.
        self._types = types
        self._start_ns = start_ns

    def all_of(self, drive: DriveLog, geometry: tuple[float, float] | None) -> Iterator[_Timed]:
        """All messages in order of time."""
        parts = [self._commands(drive), self._wheels(drive), self._poses(drive)]
        if geometry is not None:
            parts.append(self._twists(drive, *geometry))
        return merge(*parts, key=lambda one: one[0])

    def _commands(self, drive: DriveLog) -> Iterator[_Timed]:
        part = drive.commands
        for t_s, left, right in zip(part.t_s.tolist(), part.left_rad_s, part.right_rad_s, strict=True):
            speeds = [] if math.isnan(left) else [left, right]
            yield self._joints(t_s, COMMAND_TOPIC, [], speeds)

    def _twists(self, drive: DriveLog, radius_m: float, axial_m: float) -> Iterator[_Timed]:
        part = drive.commands
        vector = self._types["geometry_msgs/msg/Vector3"]
        for t_s, left, right in zip(part.t_s.tolist(), part.left_rad_s, part.right_rad_s, strict=True):
            if math.isnan(left):
                continue
            forward = vector(0.5 * radius_m * (left + right), 0.0, 0.0)
            turning = vector(0.0, 0.0, radius_m * (right - left) / axial_m)
            twist = self._types["geometry_msgs/msg/Twist"](forward, turning)
            t_ns, header = self._header(t_s, BASE_FRAME)
            yield t_ns, TWIST_TOPIC, self._types["geometry_msgs/msg/TwistStamped"](header, twist)

    def _wheels(self, drive: DriveLog) -> Iterator[_Timed]:
        part = drive.wheels
        columns = (part.t_s, part.left_angle_rad, part.right_angle_rad, part.left_speed_rad_s, part.right_speed_rad_s)
        for t_s, left, right, left_speed, right_speed in zip(*(one.tolist() for one in columns), strict=True):
            yield self._joints(t_s, WHEEL_TOPIC, [left, right], [left_speed, right_speed])

    def _poses(self, drive: DriveLog) -> Iterator[_Timed]:
        part = drive.poses
        columns = (part.t_s, part.x_m, part.y_m, part.yaw_rad)
        for t_s, x_m, y_m, yaw_rad in zip(*(one.tolist() for one in columns), strict=True):
            t_ns, header = self._header(t_s, MAP_FRAME)
            position = self._types["geometry_msgs/msg/Point"](x_m, y_m, 0.0)
            half = 0.5 * yaw_rad
            rotation = self._types["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(half), math.cos(half))
            pose = self._types["geometry_msgs/msg/Pose"](position, rotation)
            yield t_ns, POSE_TOPIC, self._types["geometry_msgs/msg/PoseStamped"](header, pose)

    def _joints(self, t_s: float, topic: str, positions: list[float], speeds: list[float]) -> _Timed:
        t_ns, header = self._header(t_s, "")
        arrays = (np.array(positions, dtype=np.float64), np.array(speeds, dtype=np.float64), np.empty(0))
        return t_ns, topic, self._types["sensor_msgs/msg/JointState"](header, list(JOINTS), *arrays)

    def _header(self, t_s: float, frame: str) -> tuple[int, Any]:
        t_ns = self._start_ns + round(t_s * 1e9)
        stamp = self._types["builtin_interfaces/msg/Time"](*divmod(t_ns, 1_000_000_000))
        return t_ns, self._types["std_msgs/msg/Header"](stamp, frame)
