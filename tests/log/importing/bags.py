"""Bags of a robot as people record it, made with `rosbags` from a simulated drive."""

from __future__ import annotations

import math
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from disco_hw.config import Ros2
from disco_hw.log.drive import chosen
from disco_hw.log.importing.rosbag import read_rosbag
from tests.inference.drives import logged, robot_config

BEGAN_NS = 1_700_000_000_000_000_000
LATENCY_NS = 4_000_000
LEFT = ("front_left_wheel_joint", "rear_left_wheel_joint")
RIGHT = ("front_right_wheel_joint", "rear_right_wheel_joint")


def time_ns(k):
    """Time of the k-th sample of wheels."""
    return BEGAN_NS + k * 20_000_000


class Maker:
    """Writes messages of the usual types to a bag of ROS 2 or ROS 1."""

    def __init__(self, writer, store, ros1):
        self.writer, self.store, self.ros1 = writer, store, ros1
        self.types = store.types
        self.connections = {}
        self.sequence = 0

    def stamp(self, t_ns):
        return self.types["builtin_interfaces/msg/Time"](*divmod(int(t_ns), 10**9))

    def header(self, t_ns, frame):
        before = (self.sequence,) if self.ros1 else ()
        return self.types["std_msgs/msg/Header"](*before, self.stamp(t_ns), frame)

    def create(self, name, *values):
        return self.types[name](*values)

    def write(self, topic, message, log_ns):
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        raw = self.store.serialize_ros1(message, kind) if self.ros1 else self.store.serialize_cdr(message, kind)
        self.writer.write(self.connections[topic], int(log_ns), raw)

    def vector(self, x=0.0, y=0.0, z=0.0):
        return self.create("geometry_msgs/msg/Vector3", x, y, z)

    def turn(self, yaw):
        return self.create("geometry_msgs/msg/Quaternion", 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))

    def pose(self, x, y, yaw):
        return self.create("geometry_msgs/msg/Pose", self.create("geometry_msgs/msg/Point", x, y, 0.0), self.turn(yaw))

    def twist(self, v, w):
        return self.create("geometry_msgs/msg/Twist", self.vector(v), self.vector(z=w))

    def twist_stamped(self, t_ns, v, w):
        return self.create("geometry_msgs/msg/TwistStamped", self.header(t_ns, "base_link"), self.twist(v, w))

    def joints(self, t_ns, names, positions, speeds):
        numbers = (np.array(positions, dtype=np.float64), np.array(speeds, dtype=np.float64), np.zeros(0))
        return self.create("sensor_msgs/msg/JointState", self.header(t_ns, ""), list(names), *numbers)

    def wheels(self, k, angle=None, speeds=(5.0,) * 4, *, stamp_ns=None, log_ns=None):
        """Write sample k, at 50 Hz, of four wheels that turn at 5 rad/s."""
        angles = [0.1 * k if angle is None else angle] * 4
        message = self.joints(time_ns(k) if stamp_ns is None else stamp_ns, LEFT + RIGHT, angles, speeds)
        self.write("/joint_states", message, time_ns(k) if log_ns is None else log_ns)

    def pose_stamped(self, t_ns, frame, x, y, yaw):
        return self.create("geometry_msgs/msg/PoseStamped", self.header(t_ns, frame), self.pose(x, y, yaw))

    def with_covariance(self, x, y, yaw):
        return self.create("geometry_msgs/msg/PoseWithCovariance", self.pose(x, y, yaw), np.zeros(36))

    def pose_covariance(self, t_ns, frame, *pose):
        header, inner = self.header(t_ns, frame), self.with_covariance(*pose)
        return self.create("geometry_msgs/msg/PoseWithCovarianceStamped", header, inner)

    def odometry(self, t_ns, frame, x, y, yaw, v=0.0, w=0.0):
        header, inner = self.header(t_ns, frame), self.with_covariance(x, y, yaw)
        twist = self.create("geometry_msgs/msg/TwistWithCovariance", self.twist(v, w), np.zeros(36))
        return self.create("nav_msgs/msg/Odometry", header, "base_link", inner, twist)

    def transforms(self, t_ns, *edges):
        one = [
            self.create(
                "geometry_msgs/msg/TransformStamped",
                self.header(t_ns, parent),
                child,
                self.create("geometry_msgs/msg/Transform", self.vector(x, y, z), self.turn(yaw)),
            )
            for parent, child, x, y, z, yaw in edges
        ]
        return self.create("tf2_msgs/msg/TFMessage", one)

    def image(self, t_ns, pixels):
        fields = (self.header(t_ns, "camera"), 100, pixels.size // 100, "mono8", 0, 100, pixels)
        return self.create("sensor_msgs/msg/Image", *fields)


@cache
def typestore(distro):
    """The types of a release of ROS; to write the code that reads and writes them takes longer than a small bag."""
    store = get_typestore(distro)
    if distro is Stores.ROS1_NOETIC:
        tf = "tf2_msgs/msg/TFMessage"
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", tf))
    return store


@contextmanager
def bag(path, storage="mcap", distro=Stores.ROS2_HUMBLE, version=9):
    """A maker for a bag at this path."""
    if storage == "ros1":
        with Writer1(path) as writer:
            yield Maker(writer, typestore(Stores.ROS1_NOETIC), True)
        return
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Writer2(path, version=version, storage_plugin=plugin) as writer:
        yield Maker(writer, typestore(distro), False)


def config(**ros2):
    return msgspec.structs.replace(robot_config(), ros2=Ros2(**ros2))


def read_bag(path, count, write_sample, **ros2):
    """The drive that is read from a bag into which `write_sample(maker, k)` has written each sample."""
    with bag(path) as maker:
        for k in range(count):
            write_sample(maker, k)
    return read_rosbag(path, config(**ros2))


def minus(a, b):
    """The pose that takes b to a: a = result o b, planar."""
    yaw = a[2] - b[2]
    c, s = math.cos(yaw), math.sin(yaw)
    return a[0] - c * b[0] + s * b[1], a[1] - s * b[0] - c * b[1], yaw


def first_seconds(drive, until_s):
    """What a drive holds before this time."""
    parts = {name: getattr(drive, name) for name in ("commands", "wheels", "poses")}
    return replace(drive, **{name: chosen(part, part.t_s < until_s) for name, part in parts.items()})


def recorded(path, storage="mcap", distro=Stores.ROS2_HUMBLE, drive=None, cut_s=None, clock=lambda t_s: 0.0, leave=()):
    """A robot with four wheels, an odometry, two SLAMs, a camera and a joystick; returns the drive that it is of.

    Twist commands and the arm's joint states have no stamp, /amcl_pose is slow, map - odom is dated 0.5 s ahead and
    repeated between corrections. `cut_s`: from and to which second nothing was recorded. `clock`: what the robot's
    clock has added to its stamps by then, s. `leave`: topics left out.
    """
    drive = first_seconds(logged("poor"), 8.0) if drive is None else drive
    robot = robot_config().robot
    r, a = robot.wheel_radius_m, robot.axial_distance_m
    events = []

    def at(t_s, topic, build):
        if topic not in leave and not (cut_s and cut_s[0] <= t_s < cut_s[1]):
            events.append((t_s, topic, build))

    def stamp(t_s):
        return BEGAN_NS + round((t_s + clock(t_s)) * 1e9)

    commands, wheels, poses = drive.commands, drive.wheels, drive.poses
    for t, left, right in zip(commands.t_s, commands.left_rad_s, commands.right_rad_s, strict=True):
        if math.isfinite(left):
            v, w = r * (left + right) / 2, r * (right - left) / a
            at(t, "/cmd_vel", lambda m, t=t, v=v, w=w: m.twist(v, w))
    odom = [0.0, 0.0, 0.0]
    track, before = [], None
    for row in zip(wheels.t_s, wheels.left_angle_rad, wheels.right_angle_rad, wheels.left_speed_rad_s,
                   wheels.right_speed_rad_s, strict=True):  # fmt: skip
        t, left, right, left_speed, right_speed = row
        if before is not None:
            dl, dr = left - before[0], right - before[1]
            odom[2] += r * (dr - dl) / a / 2
            odom[0] += r * (dl + dr) / 2 * math.cos(odom[2])
            odom[1] += r * (dl + dr) / 2 * math.sin(odom[2])
            odom[2] += r * (dr - dl) / a / 2
        before = (left, right)
        track.append((t, *odom))
        names = (*LEFT, *RIGHT, "arm_joint")
        angles = (left + 0.01, left - 0.01, right + 0.02, right - 0.02, 1.0)
        speeds = (left_speed + 0.1, left_speed - 0.1, right_speed, right_speed, 0.0)
        at(t, "/joint_states", lambda m, t=t, p=angles, s=speeds, n=names: m.joints(stamp(t), n, p, s))
        v, w = r * (left_speed + right_speed) / 2, r * (right_speed - left_speed) / a
        at(t, "/odom", lambda m, t=t, o=tuple(odom), v=v, w=w: m.odometry(stamp(t), "odom", *o, v, w))
        edge = ("odom", "base_footprint", odom[0], odom[1], 0.0, odom[2])
        at(t, "/tf", lambda m, t=t, edge=edge: m.transforms(stamp(t), edge))
    track = np.array(track)
    at(-0.05, "/tf_static", lambda m: m.transforms(0, ("base_footprint", "base_link", 0.0, 0.0, 0.1, 0.0)))
    for k, (t, x, y, yaw) in enumerate(zip(poses.t_s, poses.x_m, poses.y_m, poses.yaw_rad, strict=True)):
        base = [np.interp(t, track[:, 0], track[:, i]) for i in (1, 2, 3)]
        o = minus((x, y, yaw), base)
        edge = ("map", "odom", o[0], o[1], 0.0, o[2])
        for again in (t, t + 0.02):
            at(again, "/tf", lambda m, t=again, edge=edge: m.transforms(stamp(t + 0.5), edge))
        at(t, "/rtabmap/odom", lambda m, t=t, p=(x, y, yaw): m.odometry(stamp(t), "map", *p))
        if k % 25 == 0:
            at(t, "/amcl_pose", lambda m, t=t, p=(x, y, yaw): m.pose_covariance(stamp(t), "map", *p))
            at(t, "/camera/image_raw", lambda m, t=t: m.image(stamp(t), np.zeros(10_000, dtype=np.uint8)))
    at(0.0, "/goal_pose", lambda m: m.pose_stamped(stamp(0.0), "map", 9.0, 9.0, 0.0))
    at(0.0, "/initialpose", lambda m: m.pose_covariance(0, "map", 0.0, 0.0, 0.0))
    with bag(path, storage, distro) as maker:
        for t, topic, build in sorted(events, key=lambda event: event[0]):
            maker.write(topic, build(maker), BEGAN_NS + round(t * 1e9) + (0 if topic == "/cmd_vel" else LATENCY_NS))
    return drive
