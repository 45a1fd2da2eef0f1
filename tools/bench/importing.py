"""A bag of ten minutes with images, most of a gigabyte: how long `disco-hw import` takes, and how much memory."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from disco_hw.config import SHIPPED_ROBOT

DURATION_S = 600.0
IMAGE_HZ, IMAGE_BYTES = 10.0, 155_000
WHEELS_HZ, POSES_HZ, COMMANDS_HZ = 50.0, 30.0, 20.0
BEGAN_NS = 1_700_000_000_000_000_000


def run() -> dict[str, float]:
    """Return seconds and MB, for both kinds of storage."""
    figures: dict[str, float] = {}
    for storage in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
        with tempfile.TemporaryDirectory() as name:
            bag, key = Path(name) / "bag", f"import.{storage.name.lower()}"
            write_bag(bag, storage)
            figures[f"{key}.bag_mb"] = sum(file.stat().st_size for file in bag.iterdir()) * 1e-6
            command = [sys.executable, "-m", "disco_hw", "import", str(bag), "--robot", str(SHIPPED_ROBOT)]
            began_s = time.monotonic()
            process = subprocess.Popen([*command, "-o", f"{name}/log.mcap"], stdout=subprocess.DEVNULL)
            _, status, used = os.wait4(process.pid, 0)
            figures[f"{key}.s"] = time.monotonic() - began_s
            figures[f"{key}.cpu_s"] = used.ru_utime + used.ru_stime
            figures[f"{key}.peak_mb"] = used.ru_maxrss * 1e-3
            assert status == 0, status
    return figures


def write_bag(path: Path, storage: StoragePlugin) -> None:
    """A circle as a four-wheeled robot records it: wheels, speeds, a SLAM's poses, and a camera."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = store.types
    image = np.random.default_rng(1).integers(0, 256, IMAGE_BYTES, dtype=np.uint8)
    radius_m, axial_m, v, w = 0.06, 0.4, 0.3, 0.4
    left, right = (v - w * axial_m / 2) / radius_m, (v + w * axial_m / 2) / radius_m
    joints = ("front_left_wheel", "rear_left_wheel", "front_right_wheel", "rear_right_wheel")

    def header(t_ns, frame):
        return kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](*divmod(t_ns, 10**9)), frame)

    def vector(x=0.0, z=0.0):
        return kinds["geometry_msgs/msg/Vector3"](x, 0.0, z)

    def wheels(t_s, t_ns):
        angles = np.array([left, left, right, right]) * t_s
        speeds = np.array([left, left, right, right])
        return kinds["sensor_msgs/msg/JointState"](header(t_ns, ""), list(joints), angles, speeds, np.zeros(0))

    def pose(t_s, t_ns):
        yaw = w * t_s
        at = kinds["geometry_msgs/msg/Point"](v / w * math.sin(yaw), v / w * (1 - math.cos(yaw)), 0.0)
        turned = kinds["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
        placed = kinds["geometry_msgs/msg/Pose"](at, turned)
        return kinds["geometry_msgs/msg/PoseStamped"](header(t_ns, "map"), placed)

    def speed(_, t_ns):
        twist = kinds["geometry_msgs/msg/Twist"](vector(v), vector(z=w))
        return kinds["geometry_msgs/msg/TwistStamped"](header(t_ns, "base_link"), twist)

    def picture(_, t_ns):
        return kinds["sensor_msgs/msg/CompressedImage"](header(t_ns, "camera"), "jpeg", image)

    streams = {
        "/joint_states": (WHEELS_HZ, wheels),
        "/slam/pose": (POSES_HZ, pose),
        "/cmd_vel": (COMMANDS_HZ, speed),
        "/camera/compressed": (IMAGE_HZ, picture),
    }
    at = sorted((k / hz, topic) for topic, (hz, _) in streams.items() for k in range(round(DURATION_S * hz)))
    with Writer(path, version=8, storage_plugin=storage) as writer:
        connections = {}
        for t_s, topic in at:
            t_ns = BEGAN_NS + round(t_s * 1e9)
            message = streams[topic][1](t_s, t_ns)
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], t_ns, store.serialize_cdr(message, kind))
