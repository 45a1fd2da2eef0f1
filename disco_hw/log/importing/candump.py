"""A candump of a robot that speaks our protocol -> the arrays of a drive."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from disco_hw.config import Robot
from disco_hw.errors import LogError
from disco_hw.log.drive import Array, Commands, DriveLog, Gyro, Poses, Wheels
from disco_hw.log.importing import LogFormat
from disco_hw.log.importing.candump_lines import Dump, is_candump, read_dump
from disco_hw.log.importing.losses import loss_note, warnings_first
from drivers.device_clock import DeviceClock
from drivers.motor.reference_frames import POSE_MESSAGES, WHEEL_MESSAGES, FrameReception, Telemetry
from firmware_protocol.codec import Codec, Decoded

_COMMAND = "WHEEL_COMMAND"
_LONGEST_SILENCE_NS = 500_000_000
Row = tuple[float, ...]


@dataclass(slots=True)
class _Rows:
    """Decoded frames of one channel; `refused` counts frames of the protocol that failed their check."""

    commands: list[Row] = field(default_factory=list)
    wheels: list[Row] = field(default_factory=list)
    poses: list[Row] = field(default_factory=list)
    frames: int = 0
    refused: int = 0

    @property
    def count(self) -> int:
        """Number of commands, wheel samples and poses."""
        return len(self.commands) + len(self.wheels) + len(self.poses)


def read_candump(path: Path, robot: Robot, channel: str = "", usual_channel: str = "") -> DriveLog:
    """Read commands, wheels and poses of a dump, stamped with their reception.

    A command counts until the next one or as long as it is valid. Frames that fail their check are left out and
    counted. Ticks per revolution and the largest speed, which distinguish a jump from motion, are robot.toml's. Of
    several channels `channel` is read, or the only one that speaks the protocol, or else `usual_channel`. Raises
    LogError, also for several robots of which none is named.
    """
    dump = read_dump(path)
    if channel and channel not in dump.channels:
        raise LogError(f"{path}: no channel {channel}; it has {', '.join(dump.channels)}")
    wanted = [channel] if channel else list(dump.channels)
    found = {each: _decoded(dump, each, robot) for each in wanted}
    robots = {each: rows for each, rows in found.items() if rows.count}
    if not robots:
        frames = sum(rows.frames for rows in found.values())
        raise LogError(f"{path}: {frames} frames, none of them a command, wheel sample or pose of our protocol")
    if len(robots) > 1 and usual_channel not in robots:
        counts = ", ".join(f"{each} with {rows.count} records" for each, rows in robots.items())
        raise LogError(f"{path}: several channels hold a robot ({counts}); name one with --channel")
    taken = usual_channel if usual_channel in robots else next(iter(robots))
    rows, notes = robots[taken], list(dump.notes)
    if len(dump.channels) > 1:
        others = ", ".join(each for each in dump.channels if each != taken)
        notes.append(f"{path}: channel {taken} was read, and {others} left out; --channel takes another")
    if rows.refused:
        notes.append(
            loss_note(
                str(path), f"frames of {taken}", rows.refused, rows.frames,
                "failed their check and were left out", "look for a second sender, or name another channel",
            )
        )  # fmt: skip
    return _drive(path, _expired(rows.commands), rows.wheels, rows.poses, warnings_first(tuple(notes)))


def _decoded(dump: Dump, channel: str, robot: Robot) -> _Rows:
    """Decode the frames of one channel."""
    codec = Codec()
    reception, telemetry = FrameReception(codec), Telemetry(DeviceClock())
    telemetry.configure(round(robot.ticks_per_rev), robot.max_wheel_speed_rad_s)
    rows = _Rows()
    for received in dump.frames(channel):
        rows.frames += 1
        decoded = codec.decode(received.frame.can_id, received.frame.data)
        if isinstance(decoded, Decoded) and decoded.name == _COMMAND:
            values = decoded.values
            given = codec.choice_name(_COMMAND, "mode", values["mode"]) == "SPEED"
            speeds = (values["left_speed"], values["right_speed"]) if given else (np.nan, np.nan)
            rows.commands.append((received.t_ns, *speeds, values["valid_for"]))
            continue
        believed = reception.accept(received)
        if believed is None:
            continue
        if believed.name in WHEEL_MESSAGES:
            wheel = telemetry.wheels(believed, received.t_ns)
            if wheel is not None:
                angles = (wheel.left_angle_rad, wheel.right_angle_rad)
                rows.wheels.append((received.t_ns, *angles, wheel.left_speed_rad_s, wheel.right_speed_rad_s))
        elif believed.name in POSE_MESSAGES:
            pose = telemetry.pose(believed, received.t_ns)
            if pose is not None:
                rows.poses.append((received.t_ns, pose.x_m, pose.y_m, pose.yaw_rad))
    rows.refused = reception.rejected_crc + reception.rejected_sequence + reception.rejected_length
    return rows


def _expired(commands: list[Row]) -> list[Row]:
    """Commands with a row of NaN where one has run out before the next came."""
    rows: list[Row] = []
    for at, (t_ns, left, right, valid_s) in enumerate(commands):
        rows.append((t_ns, left, right))
        end_ns = t_ns + valid_s * 1e9
        if at + 1 == len(commands) or commands[at + 1][0] > end_ns:
            rows.append((end_ns, np.nan, np.nan))
    return rows


def _drive(path: Path, commands: list[Row], wheels: list[Row], poses: list[Row], notes: tuple[str, ...]) -> DriveLog:
    began_ns = min(rows[0][0] for rows in (commands, wheels, poses) if rows)
    command, wheel, pose = _table(commands, 3), _table(wheels, 5), _table(poses, 4)
    wheel_ns = wheel[:, 0]
    # What was driven while no wheel was heard is not known.
    breaks_ns = wheel_ns[1:][np.diff(wheel_ns) > _LONGEST_SILENCE_NS]

    def when(t_ns: Array) -> tuple[Array, np.ndarray]:
        return (t_ns - began_ns) * 1e-9, np.searchsorted(breaks_ns, t_ns, side="right").astype(np.int64)

    (command_s, command_segment), (wheel_s, wheel_segment) = when(command[:, 0]), when(wheel_ns)
    pose_s, pose_segment = when(pose[:, 0])
    measured = bool(wheel_s.size)
    none = np.empty(0)
    return DriveLog(
        (str(path),),
        Commands(command_s, command[:, 1], command[:, 2], command_segment),
        Wheels(wheel_s, wheel[:, 1], wheel[:, 2], wheel[:, 3], wheel[:, 4], wheel_segment, measured, measured),
        Poses(pose_s, pose[:, 1], pose[:, 2], pose[:, 3], pose_segment),
        Gyro(none, none, np.empty(0, dtype=np.int64)),
        notes,
    )


def _table(rows: list[Row], width: int) -> Array:
    """Rows as an array (N, width) in order of time, the last of several with one time."""
    table = np.array(rows, dtype=np.float64).reshape(-1, width)
    return table[np.append(np.diff(table[:, 0]) > 0.0, True)] if rows else table


FORMAT = LogFormat(
    "candump",
    is_candump,
    lambda path, config: read_candump(path, config.robot, usual_channel=config.link.channel),
    order=10,
    read_channel=lambda path, config, channel: read_candump(path, config.robot, channel),
)
