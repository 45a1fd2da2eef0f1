"""What `disco-hw log info`, `recover` and `export` do; the verbs return the text to print."""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from heapq import merge
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
from mcap.writer import CompressionType, Writer

from disco_hw.errors import InputError, LogError
from disco_hw.files import LOG, open_file
from disco_hw.log.container import (
    Contents,
    DamagedError,
    McapCopy,
    messages,
    read_attachment,
    read_chunk,
    read_contents,
    read_profile,
)
from disco_hw.log.drive import DriveLog, rows
from disco_hw.log.importing.csv_drive import write_csv
from disco_hw.log.load import drive_from_log, nominal_robot
from disco_hw.log.mcap_log import CHUNK_BYTES, LIBRARY, RECOVERY
from disco_hw.log.reader import LogSummary, open_log
from disco_hw.log.records import Controller
from drivers.types import SOURCE_TEXTS, Identity, SaidBy


def info(path: Path, as_json: bool) -> str:
    """Summarise the contents of a log and what of it is lost. Raises LogError."""
    with open_log(path) as log:
        summary = log.summary()
        if as_json:
            return msgspec.json.encode(summary).decode()
        answered = list(log.records(("/controller",))) if "/controller" in summary.topics else []
    controllers = [_controller(entry.record) for entry in answered if isinstance(entry.record, Controller)]
    return "\n".join([_describe(summary), *dict.fromkeys(controllers)])


def recover(path: Path, out: Path, as_json: bool) -> str:
    """Copy everything whole from a damaged log into a new one; raises LogError."""
    recovered = recover_log(path, out)
    if as_json:
        return json.dumps({"out": str(out)} | asdict(recovered))
    lines = [f"{out}: {recovered.messages} messages in {recovered.chunks} chunks, {recovered.attachments} attachments"]
    lines += [f"lost: {loss}" for loss in recovered.lost] or ["nothing was lost"]
    return "\n".join(lines)


def export(path: Path, out: Path, as_json: bool) -> str:
    """Write commands, encoders and poses of a log as CSV; raises LogError."""
    with open_log(path) as log:
        drive = drive_from_log(log)
        ticks_per_rev = nominal_robot(log).get("ticks_per_rev")
        count = write_csv(drive, out, ticks_per_rev)
    if drive.wheels.angle_measured and ticks_per_rev is None:
        note = f"{path}: the wheel angles were left out: its robot.toml does not say how many ticks a revolution has"
        drive = replace(drive, notes=(*drive.notes, note))
    return _exported(out, "rows", count, drive, as_json)


def export_rosbag(path: Path, out: Path, as_json: bool) -> str:
    """Write commands, wheels and poses of a log as a bag of ROS 2; raises LogError, InputError without `rosbags`."""
    with open_log(path) as log:
        drive = drive_from_log(log)
        robot = nominal_robot(log)
        radius_m, axial_m = robot.get("wheel_radius_m"), robot.get("axial_distance_m")
        geometry = None if radius_m is None or axial_m is None else (radius_m, axial_m)
        messages = write_rosbag(drive, out, drive.began_ns + log.metadata.wall_offset_ns, geometry)
    return _exported(out, "messages", messages, drive, as_json)


def _exported(out: Path, what: str, count: int, drive: DriveLog, as_json: bool) -> str:
    if as_json:
        return json.dumps({"out": str(out), what: count, "segments": drive.segments, "notes": drive.notes})
    return "\n".join([f"{out}: {count} {what}, {drive.segments} segment{'s' * (drive.segments != 1)}", *drive.notes])


def _controller(record: Controller) -> str:
    """Return which controller answered, and its limits by who states them."""
    identity = Identity(record.controller, record.firmware, cast(SaidBy, record.said_by), record.details)
    limits: dict[SaidBy, dict[str, float]] = {
        "device": record.told,
        "fixed": record.fixed,
        "robot.toml": record.declared,
    }
    parts = [
        f"{', '.join(f'{name} {value:g}' for name, value in values.items())} ({SOURCE_TEXTS[source]})"
        for source, values in limits.items()
        if values
    ]
    return f"controller: {identity.describe()}; {'; '.join(parts)}"


def _describe_end(summary: LogSummary) -> str:
    """Describe in words whether the log ended properly."""
    if summary.ended and summary.continued and summary.complete:
        return "ended properly as it was full; what came after is in the next part"
    if summary.ended:
        return "ended properly" if summary.complete else "ended by its recorder, but the file is not whole"
    if summary.ended is None:
        index = "whole" if summary.complete else "without its end"
        return f"the file is {index}, and its version did not record whether its recorder ended it"
    return (
        f"nothing recorded after {summary.end}: the daemon or its recorder had ended, or the log is still being written"
    )


# Chosen: above the drift of a clock in hours.
_CLOCK_CHANGE_S = 1.0


def _describe(summary: LogSummary) -> str:
    size_mb = summary.bytes / 1e6
    count = summary.segment_breaks
    breaks = f", {count} segment break{'s' * (count != 1)}" if count else ""
    lines = [
        f"{summary.path}: {summary.robot}, {summary.duration_s:.1f} s from {summary.start}, {size_mb:.2f} MB",
        f"recorded by disco-hw {summary.version or 'of unknown version'}, part {summary.part}",
        f"{summary.ticks} ticks, {summary.missing_ticks} missing{breaks}; {_describe_end(summary)}",
    ]
    lines += [f"continues {summary.continues}"] if summary.continues else []
    ahead_s = summary.wall_clock_change_s
    if abs(ahead_s) >= _CLOCK_CHANGE_S:
        ahead = "ahead of" if ahead_s > 0.0 else "behind"
        lines.append(
            f"at its end the wall clock was {abs(ahead_s):.1f} s {ahead} the wall-clock times of the log: the computer "
            "was suspended, or its clock was set"
        )
    lines += [
        f"  {topic:<24} {item.count:>9}  {item.rate_hz:8.1f} Hz" for topic, item in sorted(summary.topics.items())
    ]
    lines += [f"  attached: {name}, {size} bytes" for name, size in summary.attachments.items()]
    lines += [f"lost: {loss}" for loss in summary.damage]
    return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class Recovered:
    """Result of a recovery: what was copied, and in words what was lost."""

    messages: int
    chunks: int
    attachments: int
    lost: tuple[str, ...]


def recover_log(source: Path, target: Path) -> Recovered:
    """Copy all complete chunks, attachments and metadata; the source stays as it is.

    Works on any MCAP file, of any size, with zstd or no compression. Raises LogError if the source is no MCAP file or
    has no message that can be read, or the target exists or cannot be written; a half-written target is removed.
    """
    fd = open_file(source, replace(LOG, most_bytes=sys.maxsize))
    try:
        contents = read_contents(fd, str(source))
        try:
            stream = target.open("xb")
        except FileExistsError:
            raise LogError(f"{target}: already exists; give another name") from None
        try:
            with stream:
                writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
                recovered = _copy(fd, contents, writer, source.name)
            if not recovered.messages:
                raise LogError(f"{source}: no message in it can be read; there is nothing to recover")
        except BaseException:
            target.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise LogError(f"{source} -> {target}: {error.strerror}; give a place that can be written to") from None
    finally:
        os.close(fd)
    return recovered


def _copy(fd: int, contents: Contents, writer: Writer, name: str) -> Recovered:
    all_damage = list(contents.damage)
    writer.start(profile=read_profile(fd), library=LIBRARY)
    for metadata in contents.metadata:
        writer.add_metadata(metadata.name, metadata.metadata)
    attachments = 0
    for ref in contents.attachments:
        try:
            writer.add_attachment(ref.create_time, ref.log_time, ref.name, ref.media_type, read_attachment(fd, ref))
            attachments += 1
        except DamagedError as damage:
            all_damage.append(str(damage))
    copy = McapCopy(writer)
    for schema in contents.schemas.values():
        copy.describe(schema)
    for channel in contents.channels.values():
        copy.describe(channel)
    count, chunks = 0, 0
    for chunk in contents.chunks:
        try:
            found = list(messages(read_chunk(fd, chunk)))
        except DamagedError as damage:
            all_damage.append(f"at byte {chunk.offset}: {damage}; {chunk.length} bytes are lost")
            continue
        chunks += 1
        count += sum(map(copy.add, found))
    writer.add_metadata(RECOVERY, {"source": name, "lost": "\n".join(all_damage)})
    writer.finish()  # type: ignore[no-untyped-call]
    return Recovered(count, chunks, attachments, tuple(all_damage))


MAP_FRAME, BASE_FRAME = "map", "base_link"
JOINTS = ("left_wheel_joint", "right_wheel_joint")
COMMAND_TOPIC, WHEEL_TOPIC, POSE_TOPIC, TWIST_TOPIC = "/wheel_commands", "/joint_states", "/pose", "/cmd_vel"

# A stamp of 0 counts as none on import, so times are moved to begin at 1 s at least.
_EARLIEST_NS = 1_000_000_000
_Timed = tuple[int, str, Any]  # Any: a message, whose class `rosbags` makes.


def write_rosbag(drive: DriveLog, path: Path, start_ns: int, geometry: tuple[float, float] | None) -> int:
    """Write a new folder with an MCAP file and metadata.yaml; return the number of messages.

    `start_ns`: the wall-clock time of the drive's time 0. Wheel speeds that were commanded are JointState messages, one
    without velocities where none is in force. Those of the wheels hold what was measured. With `geometry`, nominal
    wheel radius and axial distance (m), also TwistStamped. Raises LogError if the path exists or cannot be written,
    InputError without `rosbags`.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer, WriterError  # noqa: PLC0415
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ImportError:
        raise InputError(f"{path}: writing a bag needs rosbags; pip install 'disco-hw[ros2]'") from None
    store = get_typestore(Stores.ROS2_HUMBLE)
    messages = _Messages(store.types, max(start_ns, _EARLIEST_NS))
    count = 0
    try:
        with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
            connections: dict[str, Any] = {}  # Any: the library's.
            for t_ns, topic, message in messages.all_of(drive, geometry):
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(connections[topic], t_ns, store.serialize_cdr(message, kind))
                count += 1
    except WriterError:
        raise LogError(f"{path}: already exists; give another name") from None
    except BaseException as error:
        # Half a bag would pass for a whole one.
        shutil.rmtree(path, ignore_errors=True)
        if isinstance(error, OSError):
            raise LogError(f"{path}: cannot be written ({error.strerror}); give another place") from None
        raise
    return count


class _Messages:
    """Makes messages of a drive's samples, stamped with wall-clock time."""

    def __init__(self, types: Any, start_ns: int) -> None:  # Any: the library's classes by their names.
        self._types = types
        self._start_ns = start_ns

    def all_of(self, drive: DriveLog, geometry: tuple[float, float] | None) -> Iterator[_Timed]:
        """Return all messages in order of time."""
        parts = [self._commands(drive), self._wheels(drive), self._poses(drive)]
        if geometry is not None:
            parts.append(self._twists(drive, *geometry))
        return merge(*parts, key=lambda one: one[0])

    def _commands(self, drive: DriveLog) -> Iterator[_Timed]:
        for t_s, left, right, _ in rows(drive.commands):
            yield self._joints(t_s, COMMAND_TOPIC, [], [] if math.isnan(left) else [left, right])

    def _twists(self, drive: DriveLog, radius_m: float, axial_m: float) -> Iterator[_Timed]:
        vector = self._types["geometry_msgs/msg/Vector3"]
        for t_s, left, right, _ in rows(drive.commands):
            if math.isnan(left):
                continue
            forward = vector(0.5 * radius_m * (left + right), 0.0, 0.0)
            turning = vector(0.0, 0.0, radius_m * (right - left) / axial_m)
            twist = self._types["geometry_msgs/msg/Twist"](forward, turning)
            t_ns, header = self._header(t_s, BASE_FRAME)
            yield t_ns, TWIST_TOPIC, self._types["geometry_msgs/msg/TwistStamped"](header, twist)

    def _wheels(self, drive: DriveLog) -> Iterator[_Timed]:
        wheels = drive.wheels
        for t_s, left, right, left_speed, right_speed, _ in rows(wheels):
            angles = [left, right] if wheels.angle_measured else []
            speeds = [left_speed, right_speed] if wheels.speed_measured else []
            yield self._joints(t_s, WHEEL_TOPIC, angles, speeds)

    def _poses(self, drive: DriveLog) -> Iterator[_Timed]:
        for t_s, x_m, y_m, yaw_rad, _ in rows(drive.poses):
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
