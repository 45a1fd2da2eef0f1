"""The messages of ROS 2 that the bridge speaks, as DDS types: the fields of the .msg files and the names on the wire.

A type `nav_msgs/msg/Odometry` is `nav_msgs::msg::dds_::Odometry_` on the wire, and a topic `/odom` is `rt/odom`.
"""

# No `from __future__ import annotations`: cyclonedds reads the annotations as the classes are made.

import math
from dataclasses import dataclass, field

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float32, float64, int32, int64, sequence, uint8, uint32

LOOPBACK = """<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast>
<Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""
"""Settings of a DDS domain that stays on this computer."""


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """Wall-clock time, or zero where a message has none."""

    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """Header of a message: when, and in which frame."""

    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    """ROS 2 message with a text."""

    data: str = ""


@dataclass
class Bool(IdlStruct, typename="std_msgs::msg::dds_::Bool_"):
    """ROS 2 message with a truth value."""

    data: bool = False


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    """Vector in m, m/s or rad/s."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    """Point in space, in m."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    """Rotation as a unit quaternion."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass
class RosPose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    """Pose as position and orientation."""

    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


def _zeros() -> list[float]:
    return [0.0] * 36


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovariance_"):
    """Pose with its `covariance`: 6 x 6 of x, y, z and the rotations about them, row by row."""

    pose: RosPose = field(default_factory=RosPose)
    covariance: array[float64, 36] = field(default_factory=_zeros)


@dataclass
class PoseStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    """A pose at a time."""

    header: Header = field(default_factory=Header)
    pose: RosPose = field(default_factory=RosPose)


@dataclass
class PoseWithCovarianceStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovarianceStamped_"):
    """A pose at a time, and how sure it is."""

    header: Header = field(default_factory=Header)
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)


@dataclass
class Twist(IdlStruct, typename="geometry_msgs::msg::dds_::Twist_"):
    """Speeds of the body: `linear.x` forward (m/s), `angular.z` to the left (rad/s)."""

    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass
class TwistStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TwistStamped_"):
    """Speeds of the body at a time."""

    header: Header = field(default_factory=Header)
    twist: Twist = field(default_factory=Twist)


@dataclass
class TwistWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::TwistWithCovariance_"):
    """Speeds of the body, and how sure they are."""

    twist: Twist = field(default_factory=Twist)
    covariance: array[float64, 36] = field(default_factory=_zeros)


@dataclass
class Odometry(IdlStruct, typename="nav_msgs::msg::dds_::Odometry_"):
    """Pose in `header.frame_id`, speeds in `child_frame_id`."""

    header: Header = field(default_factory=Header)
    child_frame_id: str = ""
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    twist: TwistWithCovariance = field(default_factory=TwistWithCovariance)


@dataclass
class RosPath(IdlStruct, typename="nav_msgs::msg::dds_::Path_"):
    """Poses one after the other."""

    header: Header = field(default_factory=Header)
    poses: sequence[PoseStamped] = field(default_factory=list)


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    """Angles (rad) and speeds (rad/s) of the joints `name`."""

    header: Header = field(default_factory=Header)
    name: sequence[str] = field(default_factory=list)
    position: sequence[float64] = field(default_factory=list)
    velocity: sequence[float64] = field(default_factory=list)
    effort: sequence[float64] = field(default_factory=list)


@dataclass
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    """Transform from one frame to another."""

    translation: Vector3 = field(default_factory=Vector3)
    rotation: Quaternion = field(default_factory=Quaternion)


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    """Where `child_frame_id` is in `header.frame_id`."""

    header: Header = field(default_factory=Header)
    child_frame_id: str = ""
    transform: Transform = field(default_factory=Transform)


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    """List of transforms, as published on tf."""

    transforms: sequence[TransformStamped] = field(default_factory=list)


@dataclass
class KeyValue(IdlStruct, typename="diagnostic_msgs::msg::dds_::KeyValue_"):
    """A line of a diagnosis."""

    key: str = ""
    value: str = ""


@dataclass
class DiagnosticStatus(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticStatus_"):
    """Status of one component: `level` 0 well, 1 a warning, 2 an error, 3 silent."""

    level: uint8 = 0
    name: str = ""
    message: str = ""
    hardware_id: str = ""
    values: sequence[KeyValue] = field(default_factory=list)


@dataclass
class DiagnosticArray(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticArray_"):
    """List of the statuses of all components."""

    header: Header = field(default_factory=Header)
    status: sequence[DiagnosticStatus] = field(default_factory=list)


@dataclass
class Point32(IdlStruct, typename="geometry_msgs::msg::dds_::Point32_"):
    """Point in single precision, in m."""

    x: float32 = 0.0
    y: float32 = 0.0
    z: float32 = 0.0


@dataclass
class Polygon(IdlStruct, typename="geometry_msgs::msg::dds_::Polygon_"):
    """Corners one after the other."""

    points: sequence[Point32] = field(default_factory=list)


@dataclass
class ObstacleMsg(IdlStruct, typename="costmap_converter_msgs::msg::dds_::ObstacleMsg_"):
    """Obstacle in the plane: a circle if `polygon` is one point, with its `radius` (m) around all points otherwise."""

    header: Header = field(default_factory=Header)
    polygon: Polygon = field(default_factory=Polygon)
    radius: float64 = 0.0
    id: int64 = 0
    orientation: Quaternion = field(default_factory=Quaternion)
    velocities: TwistWithCovariance = field(default_factory=TwistWithCovariance)


@dataclass
class ObstacleArrayMsg(IdlStruct, typename="costmap_converter_msgs::msg::dds_::ObstacleArrayMsg_"):
    """List of obstacles, as costmap_converter publishes it."""

    header: Header = field(default_factory=Header)
    obstacles: sequence[ObstacleMsg] = field(default_factory=list)


def about_z(yaw_rad: float) -> Quaternion:
    """Return the rotation by a yaw, counter-clockwise."""
    return Quaternion(0.0, 0.0, math.sin(0.5 * yaw_rad), math.cos(0.5 * yaw_rad))


def yaw_of(turned: Quaternion) -> float:
    """Return the yaw of a rotation in rad, in (-pi, pi]."""
    return math.atan2(
        2.0 * (turned.w * turned.z + turned.x * turned.y), 1.0 - 2.0 * (turned.y * turned.y + turned.z * turned.z)
    )


def stamp_of(time_ns: int) -> Time:
    """Return a wall-clock time in ns as a message has it."""
    return Time(time_ns // 1_000_000_000, time_ns % 1_000_000_000)


def time_of(stamp: Time) -> int:
    """Return the wall-clock time of a stamp in ns; 0 is none."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
