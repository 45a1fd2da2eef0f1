"""The same facts in Foxglove's schemas, so that Foxglove, Lichtblick and PlotJuggler draw a log without a plug-in.

Derived from our own records when they are written, under `/view/...`; nothing of ours reads them back. Planar poses
become poses in space with z = 0, in the frames "world" and "robot". Foxglove's time is wall-clock time.
"""

from __future__ import annotations

import math
from typing import Any

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from disco_hw.log.records import Estimate, Event, Plan, Record
from drivers.types import PoseSample

VIEW_PREFIX = "/view/"

VIEWS: tuple[tuple[str, Any], ...] = (
    ("/view/estimate", PoseInFrame),
    ("/view/transform", FrameTransform),
    ("/view/measured_pose", PoseInFrame),
    ("/view/plan", PosesInFrame),
    ("/view/log", Log),
)
"""Topics and their protobuf classes."""

_LEVELS = {"debug": Log.DEBUG, "info": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR, "fatal": Log.FATAL}
_WORLD = "world"
_ROBOT = "robot"


def views(record: Record, wall_ns: int) -> list[tuple[str, bytes]]:
    """Foxglove messages (topic, protobuf bytes) that show this record, true at `wall_ns`; none for most records."""
    time = _timestamp(wall_ns)
    match record:
        case Estimate():
            pose = PoseInFrame(timestamp=time, frame_id=_WORLD, pose=_pose(record.x_m, record.y_m, record.yaw_rad))
            transform = FrameTransform(
                timestamp=time,
                parent_frame_id=_WORLD,
                child_frame_id=_ROBOT,
                translation=Vector3(x=record.x_m, y=record.y_m, z=0.0),
                rotation=_rotation(record.yaw_rad),
            )
            return [
                ("/view/estimate", pose.SerializeToString()),
                ("/view/transform", transform.SerializeToString()),
            ]
        case PoseSample():
            measured = PoseInFrame(timestamp=time, frame_id=_WORLD, pose=_pose(record.x_m, record.y_m, record.yaw_rad))
            return [("/view/measured_pose", measured.SerializeToString())]
        case Plan() if record.path_x_m:
            path = zip(record.path_x_m, record.path_y_m, record.path_yaw_rad, strict=False)
            plan = PosesInFrame(
                timestamp=time,
                frame_id=_WORLD,
                poses=[_pose(x, y, yaw) for x, y, yaw in path],
            )
            return [("/view/plan", plan.SerializeToString())]
        case Event():
            log = Log(
                timestamp=time,
                level=_LEVELS[record.level],
                message=record.text,
                name=record.code,
            )
            return [("/view/log", log.SerializeToString())]
    return []


def _timestamp(wall_ns: int) -> Timestamp:
    seconds, nanos = divmod(wall_ns, 1_000_000_000)
    return Timestamp(seconds=seconds, nanos=nanos)


def _pose(x_m: float, y_m: float, yaw_rad: float) -> Pose:
    return Pose(position=Vector3(x=x_m, y=y_m, z=0.0), orientation=_rotation(yaw_rad))


def _rotation(yaw_rad: float) -> Quaternion:
    half = 0.5 * yaw_rad
    # sin and cos of an infinity raise; a broken estimate must still be seen in the log.
    if not math.isfinite(half):
        return Quaternion(x=0.0, y=0.0, z=math.nan, w=math.nan)
    return Quaternion(x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))
