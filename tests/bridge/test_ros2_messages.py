"""Our types against those of ROS: each goes through the bytes of an independent reader, and back."""

import dataclasses
import math
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: make venv")
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from disco_hw.bridge import ros2_messages as msg

STORE = get_typestore(Stores.ROS2_JAZZY)
# As costmap_converter_msgs defines them; they are no part of ROS 2 itself.
OBSTACLE = """std_msgs/Header header
geometry_msgs/Polygon polygon
float64 radius
int64 id
geometry_msgs/Quaternion orientation
geometry_msgs/TwistWithCovariance velocities
"""
OBSTACLES = """std_msgs/Header header
costmap_converter_msgs/ObstacleMsg[] obstacles
"""
for name, text in (("ObstacleMsg", OBSTACLE), ("ObstacleArrayMsg", OBSTACLES)):
    STORE.register(get_types_from_msg(text, f"costmap_converter_msgs/msg/{name}"))
TYPES = [
    one for one in vars(msg).values() if dataclasses.is_dataclass(one) and one.__module__ == msg.__name__
]  # fmt: skip


def ros_name(kind):
    """geometry_msgs/msg/Pose for geometry_msgs::msg::dds_::Pose_."""
    package, _, _, name = kind.__idl__.idl_transformed_typename.split("::")
    return f"{package}/msg/{name.removesuffix('_')}"


def filled(kind, seed=1):
    """A message whose every field is another value."""
    message = kind()
    for number, field in enumerate(dataclasses.fields(kind), seed):
        value = getattr(message, field.name)
        if isinstance(value, bool):
            value = True
        elif isinstance(value, int):
            value = number
        elif isinstance(value, float):
            value = number + 0.25
        elif isinstance(value, str):
            value = "word" * number
        elif isinstance(value, list) and value:
            value = [number + 0.5 * i for i in range(len(value))]
        elif isinstance(value, list):
            element = ELEMENTS.get((kind.__name__, field.name))
            value = (
                [filled(element, i) for i in (1, 2)]
                if element
                else ["a", "bcd"]
                if field.name == "name"
                else [1.5, 2.5]
            )
        else:
            value = filled(type(value), number)
        setattr(message, field.name, value)
    return message


ELEMENTS = {
    ("RosPath", "poses"): msg.PoseStamped,
    ("TFMessage", "transforms"): msg.TransformStamped,
    ("DiagnosticStatus", "values"): msg.KeyValue,
    ("DiagnosticArray", "status"): msg.DiagnosticStatus,
    ("Polygon", "points"): msg.Point32,
    ("ObstacleArrayMsg", "obstacles"): msg.ObstacleMsg,
}


def same(ours, theirs):
    if dataclasses.is_dataclass(ours):
        names = [field.name for field in dataclasses.fields(ours)]
        other = [
            field.name
            for field in dataclasses.fields(theirs)
            if not (field.name == "__msgtype__" or field.name.isupper())
        ]
        return names == other and all(same(getattr(ours, name), getattr(theirs, name)) for name in names)
    if isinstance(ours, list):
        return len(ours) == len(theirs) and all(same(one, other) for one, other in zip(ours, theirs, strict=True))
    return ours == (theirs.item() if isinstance(theirs, np.generic) else theirs)


@pytest.mark.parametrize("kind", TYPES, ids=lambda kind: kind.__name__)
def test_an_independent_reader_of_ros_messages_reads_ours_and_we_read_its_own(kind):
    message = filled(kind)
    theirs = STORE.deserialize_cdr(message.serialize(), ros_name(kind))
    assert same(message, theirs)
    assert kind.deserialize(bytes(STORE.serialize_cdr(theirs, ros_name(kind)))) == message


def test_a_stamp_is_wall_clock_time_to_the_nanosecond():
    assert msg.time_of(msg.stamp_of(1_800_000_000_123_456_789)) == 1_800_000_000_123_456_789
    assert (msg.stamp_of(5_000_000_007).sec, msg.stamp_of(5_000_000_007).nanosec) == (5, 7)
    assert math.isfinite(msg.time_of(msg.Time()))


def test_the_control_process_imports_none_of_it():
    source = (
        "import sys, disco_hw.daemon.run, disco_hw.drive.drive_command; from drivers.pose import pose_sources; "
        "pose_sources(); "
        "print([name for name in sys.modules if name.split('.')[0] in ('cyclonedds', 'rosbags', 'foxglove') "
        "or name.startswith('disco_hw.bridge')])"
    )
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.strip() == "[]"
