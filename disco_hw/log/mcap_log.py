"""Batches of records -> an MCAP file: channels, schemas, times, attachments. No clock, no socket.

Log time is the wall time of the tick that recorded a message, the same for all of a tick and never decreasing;
publish time is the wall time of the record's own `t_ns`. The sequence number is that of the tick, so a gap in it
counts the ticks that were lost on the way.

Under `/view/...` the same facts in Foxglove's schemas, so that Foxglove, Lichtblick and PlotJuggler draw a log without
a plug-in; nothing of ours reads them back. Planar poses become poses in space with z = 0, in the frames "world" and
"robot". Foxglove's time is wall-clock time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import IO, Any, Protocol, TypeVar, cast

import msgspec
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.CylinderPrimitive_pb2 import CylinderPrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from disco_hw.log import Batch, BatchDecoder, End, Start, TaskScene, Time64
from disco_hw.log.encoding import encode_json, json_schema
from disco_hw.log.records import TOPICS, Estimate, Event, Fan, GuardVerdict, Plan, Record
from drivers.types import PoseSample

VIEWS: tuple[tuple[str, Any], ...] = (
    ("/view/estimate", PoseInFrame),
    ("/view/transform", FrameTransform),
    ("/view/measured_pose", PoseInFrame),
    ("/view/plan", PosesInFrame),
    ("/view/rollouts", SceneUpdate),
    ("/view/fence", SceneUpdate),
    ("/view/log", Log),
)
"""Topics and their protobuf classes."""
SCENE = "/view/scene"
"""A SceneUpdate once at the beginning of a file, where the recorder says what there is to see."""

_LEVELS = {"debug": Log.DEBUG, "info": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR, "fatal": Log.FATAL}
_WORLD = "world"
_ROBOT = "robot"


def views(record: Record, wall_ns: int) -> list[tuple[str, bytes]]:
    """Foxglove messages (topic, protobuf bytes) that show this record, true at `wall_ns`; none for most records."""
    return [(topic, message.SerializeToString()) for topic, message in _messages(record, _timestamp(wall_ns))]


def _messages(record: Record, time: Timestamp) -> list[tuple[str, Message]]:
    match record:
        case Estimate():
            pose = _pose(record.x_m, record.y_m, record.yaw_rad)
            transform = FrameTransform(
                timestamp=time,
                parent_frame_id=_WORLD,
                child_frame_id=_ROBOT,
                translation=pose.position,
                rotation=pose.orientation,
            )
            placed = PoseInFrame(timestamp=time, frame_id=_WORLD, pose=pose)
            return [("/view/estimate", placed), ("/view/transform", transform)]
        case PoseSample():
            pose = _pose(record.x_m, record.y_m, record.yaw_rad)
            return [("/view/measured_pose", PoseInFrame(timestamp=time, frame_id=_WORLD, pose=pose))]
        case Plan() if record.path_x_m:
            path = zip(record.path_x_m, record.path_y_m, record.path_yaw_rad, strict=False)
            poses = [_pose(x, y, yaw) for x, y, yaw in path]
            return [("/view/plan", PosesInFrame(timestamp=time, frame_id=_WORLD, poses=poses))]
        case Fan() if record.weights:
            return [("/view/rollouts", _rollouts(record, time))]
        case GuardVerdict() if record.path_x_m or record.obstacles:
            return [("/view/fence", _stopping(record, time))]
        case Event():
            level = _LEVELS[record.level]
            return [("/view/log", Log(timestamp=time, level=level, message=record.text, name=record.code))]
    return []


def scene_message(scene: TaskScene) -> bytes:
    """Return a SceneUpdate in protobuf: course and fence in the world, body and footprint in the robot's frame."""
    line = _line(scene.outline_m, Color(r=0.2, g=0.6, b=0.3, a=1.0))
    width, radius = scene.axial_distance_m, scene.wheel_radius_m
    body = CubePrimitive(
        pose=Pose(position=Vector3(x=0.0, y=0.0, z=1.5 * radius)),
        size=Vector3(x=1.5 * width, y=0.75 * width, z=radius),
        color=Color(r=0.9, g=0.6, b=0.1, a=0.8),
    )
    fence = [_line(outline, Color(r=0.75, g=0.1, b=0.1, a=1.0)) for outline in scene.fence_m]
    footprint = _line(scene.footprint_m, Color(r=0.9, g=0.6, b=0.1, a=1.0))
    task = SceneEntity(id="task", frame_id=_WORLD, lines=[line, *fence])
    robot = SceneEntity(id="robot", frame_id=_ROBOT, frame_locked=True, cubes=[body], lines=[footprint])
    message: bytes = SceneUpdate(entities=[task, robot]).SerializeToString()
    return message


def _stopping(record: GuardVerdict, time: Timestamp) -> SceneUpdate:
    """Return the fence guard's stopping path, red where it holds the robot, and the obstacles."""
    free = record.verdict in {"free", "scaled"}
    colour = Color(r=0.1, g=0.6, b=0.2, a=1.0) if free else Color(r=0.8, g=0.1, b=0.1, a=1.0)
    path = _line(zip(record.path_x_m, record.path_y_m, strict=False), colour)
    numbers = record.obstacles
    obstacles = [
        CylinderPrimitive(
            pose=_pose(x, y, 0.0),
            size=Vector3(x=2.0 * radius, y=2.0 * radius, z=0.3),
            bottom_scale=1.0,
            top_scale=1.0,
            color=Color(r=0.9, g=0.4, b=0.1, a=0.7),
        )
        for x, y, radius in zip(numbers[::3], numbers[1::3], numbers[2::3], strict=False)
    ]
    entity = SceneEntity(timestamp=time, id="stopping path", frame_id=_WORLD, lines=[path], cylinders=obstacles)
    return SceneUpdate(entities=[entity])


def _line(points: Iterable[tuple[float, float]], colour: Color, thickness_m: float = 0.02) -> LinePrimitive:
    """Return a line through these points on the floor."""
    return LinePrimitive(
        type=LinePrimitive.LINE_STRIP,
        pose=_pose(0.0, 0.0, 0.0),
        thickness=thickness_m,
        color=colour,
        points=[Point3(x=x, y=y, z=0.0) for x, y in points],
    )


def _rollouts(fan: Fan, time: Timestamp) -> SceneUpdate:
    """Return a line for each sequence, the fainter the less it weighs."""
    # A broken plan must still be seen in the log: neither as many points as weights promise, nor a weight, are certain.
    points = list(zip(fan.x_m, fan.y_m, strict=False))
    count, heaviest = len(points) // len(fan.weights), fan.weights[0] or 1.0
    lines = [
        _line(points[k * count : (k + 1) * count], Color(r=0.3, g=0.5, b=0.9, a=0.15 + 0.85 * weight / heaviest), 0.005)
        for k, weight in enumerate(fan.weights)
    ]
    return SceneUpdate(entities=[SceneEntity(timestamp=time, id="rollouts", frame_id=_WORLD, lines=lines)])


def _timestamp(wall_ns: int) -> Timestamp:
    seconds, nanos = divmod(wall_ns, 1_000_000_000)
    return Timestamp(seconds=seconds, nanos=nanos)


def _pose(x_m: float, y_m: float, yaw_rad: float) -> Pose:
    half = 0.5 * yaw_rad
    # sin and cos of an infinity raise; a broken estimate must still be seen in the log.
    z, w = (math.sin(half), math.cos(half)) if math.isfinite(half) else (math.nan, math.nan)
    return Pose(position=Vector3(x=x_m, y=y_m, z=0.0), orientation=Quaternion(x=0.0, y=0.0, z=z, w=w))


PROFILE = ""
LIBRARY = "disco-hw"
METADATA = "disco-hw"
RECOVERY = "disco-hw-recovery"
ENDING = "disco-hw-end"
"""Metadata: about the log, of a mended one, and the recorder's last word, without which nobody ended the log."""
FORMAT = "2"
"""Since 2 a log that its recorder ended has a last word."""
# Chosen: larger chunks pack better, and lose more where a file is cut.
CHUNK_BYTES = 64 * 1024

# The writer never ends a chunk itself: `flush` does, between two ticks.
_NO_LIMIT = 2**62
# MCAP specification: opcode 1, length 8, channel 2, sequence 4 and two times of 8.
_MESSAGE_OVERHEAD = 31
# MCAP times are uint64.
_MAX_TIME_NS = 2**64 - 1


class ByteSink(Protocol):
    """Protocol of the destination of a log: append-only bytes."""

    def write(self, data: bytes) -> int:
        """Append all of the bytes; raises OSError if that fails."""

    def tell(self) -> int:
        """Return the number of bytes written."""

    def flush(self) -> None:
        """Hand everything on to the operating system."""


class Metadata(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Metadata of a log: wall-clock time is monotonic time plus `wall_offset_ns`.

    `planner`: version of the planner (`control.plan.PLANNER_VERSION`); 0 where none is named, as in logs of version 1.
    A later part `continues` the file of that path, which holds ticks up to number `continues_sequence`; None if that
    was not recorded. `angle_measured`, `speed_measured`: False where an imported log has wheel angles, or speeds, that
    were derived from the other.
    """

    format: str = ""
    robot: str
    version: str
    part: int
    start_ns: Time64
    wall_offset_ns: Time64
    continues: str = ""
    continues_sequence: int | None = None
    planner: int = 0
    angle_measured: bool = True
    speed_measured: bool = True


_T = TypeVar("_T")


def as_text(values: Metadata | End) -> dict[str, str]:
    """Return metadata in the form kept in the file."""
    return {name: str(value) for name, value in msgspec.to_builtins(values).items()}


def from_text(text: dict[str, str], kind: type[_T]) -> _T:
    """Read what `as_text` wrote; raises msgspec.ValidationError on anything else."""
    return msgspec.convert(text, kind, strict=False)


class McapLog:
    """An MCAP file in the making; raises OSError from the sink.

    A record that cannot be decoded is refused and counted, never raised: the rest of its tick is kept. A tick is never
    split between chunks, so whatever cuts the file short, a tick is in it whole or not at all.

    `records` were written. `refused` are records and whole messages that were not what they should be, `last_refusal`
    says in words which was the newest. `flushed_sequence`: the last tick that was handed to the sink, 0 if none was;
    `flushed_refused`: refused records up to there.
    """

    def __init__(self, sink: ByteSink, start: Start) -> None:
        # The library's annotation asks for a whole file; it uses the three calls of ByteSink.
        self._writer = Writer(cast("IO[bytes]", sink), chunk_size=_NO_LIMIT, compression=CompressionType.ZSTD)
        self._decoder = BatchDecoder()
        self._offset_ns = start.wall_offset_ns
        self._pending_bytes = 0
        self._sequence = self.flushed_sequence = 0
        self.records = 0
        self.refused = self.flushed_refused = 0
        self.last_refusal = ""
        self._writer.start(profile=PROFILE, library=LIBRARY)
        wall_ns = start.start_ns + start.wall_offset_ns
        metadata = msgspec.structs.replace(msgspec.convert(start, Metadata, from_attributes=True), format=FORMAT)
        self._writer.add_metadata(METADATA, as_text(metadata))
        for attachment in start.attachments:
            self._writer.add_attachment(wall_ns, wall_ns, attachment.name, attachment.media_type, attachment.data)
        self._channels = tuple(self._json_channel(topic.name, topic.record) for topic in TOPICS)
        self._view_channels = self._register_views(() if start.scene is None else ((SCENE, SceneUpdate),))
        self._scene = None if start.scene is None else scene_message(start.scene)
        self._states: tuple[tuple[int, msgspec.Raw], ...] = ()
        self._writer.flush()  # type: ignore[no-untyped-call]

    def begin_with(self, message: bytes) -> None:
        """Write the records of this message with the first tick: what was in force where the former part ended."""
        batch = self._batch(message)
        if batch is not None:
            self._states = batch.records

    def write(self, message: bytes) -> None:
        """Write the records of one message of the recorder."""
        batch = self._batch(message)
        if batch is None:
            return
        self._sequence = batch.sequence
        log_time = batch.now_ns + self._offset_ns
        if not 0 <= log_time <= _MAX_TIME_NS:
            self._refuse(f"a tick at the impossible time {batch.now_ns}")
            return
        if self._scene is not None:
            # With the first tick, as each message belongs to one.
            sequence, scene = batch.sequence & 0xFFFFFFFF, self._scene
            self._writer.add_message(self._view_channels[SCENE], log_time, scene, log_time, sequence)
            self._scene = None
        for topic_index, data in (*self._states, *batch.records):
            self._write_record(batch, log_time, topic_index, data)
        self._states = ()
        if self._pending_bytes > CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        """End the chunk and hand it on, so that a reader can have everything written so far."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._pending_bytes = 0
        self.flushed_sequence = self._sequence
        self.flushed_refused = self.refused

    def end(self, end: End) -> None:
        """Write the recorder's last word; no tick comes after it."""
        self.flush()
        self._writer.add_metadata(ENDING, as_text(end))

    def finish(self) -> None:
        """Finish the file with its index; nothing can be written after it."""
        self.flush()
        self._writer.finish()  # type: ignore[no-untyped-call]

    def _batch(self, message: bytes) -> Batch | None:
        try:
            return self._decoder.batch(message)
        except msgspec.MsgspecError as error:
            self._refuse(f"a message of {len(message)} bytes: {error}")
            return None

    def _write_record(self, batch: Batch, log_time: int, topic_index: int, data: msgspec.Raw) -> None:
        try:
            record = self._decoder.record(topic_index, data)
        except msgspec.MsgspecError as error:
            self._refuse(f"topic {topic_index}: {error}")
            return
        publish_time = min(max(record.t_ns + self._offset_ns, 0), _MAX_TIME_NS)
        payloads = [(self._channels[topic_index], encode_json(record))]
        payloads += [(self._view_channels[topic], payload) for topic, payload in views(record, publish_time)]
        for channel, payload in payloads:
            self._writer.add_message(channel, log_time, payload, publish_time, batch.sequence & 0xFFFFFFFF)
            self._pending_bytes += len(payload) + _MESSAGE_OVERHEAD
        self.records += 1

    def _refuse(self, why: str) -> None:
        self.refused += 1
        self.last_refusal = why

    def _json_channel(self, topic: str, record: type) -> int:
        schema = self._writer.register_schema(
            f"disco_hw.{record.__name__}", SchemaEncoding.JSONSchema, json_schema(record)
        )
        return self._writer.register_channel(topic, MessageEncoding.JSON, schema)

    def _register_views(self, more: tuple[tuple[str, Any], ...]) -> dict[str, int]:
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for topic, message_class in (*VIEWS, *more):
            name = message_class.DESCRIPTOR.full_name
            if name not in schemas:
                descriptor = build_file_descriptor_set(message_class).SerializeToString()
                schemas[name] = self._writer.register_schema(name, SchemaEncoding.Protobuf, descriptor)
            channels[topic] = self._writer.register_channel(topic, MessageEncoding.Protobuf, schemas[name])
        return channels
