"""A candump of a robot that speaks our protocol -> the arrays of a drive.

Lines as `candump -l` writes them: `(1700000000.123456) can0 110#0102...`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TextIO, cast

import can
import numpy as np

from disco_hw.config import Robot
from disco_hw.errors import LogError
from disco_hw.files import CANDUMP, read_lines
from disco_hw.log.drive import Array, Commands, DriveLog, Gyro, Poses, Wheels
from disco_hw.log.importing import LogFormat
from drivers.device_clock import DeviceClock
from drivers.motor.reference_frames import POSE_MESSAGES, WHEEL_MESSAGES, FrameReception, Telemetry
from drivers.types import Frame, ReceivedFrame
from firmware_protocol.codec import Codec, Decoded

_COMMAND = "WHEEL_COMMAND"
_LONGEST_SILENCE_NS = 500_000_000
Row = tuple[float, ...]


def read_candump(path: Path, robot: Robot) -> DriveLog:
    """Commands, wheels and poses of a dump, stamped with their reception; raises LogError.

    A command counts until the next one or as long as it is valid; frames that fail their check are left out, with a
    note. Ticks per revolution and the largest speed, which distinguish a jump from motion, are robot.toml's.
    """
    codec = Codec()
    reception, telemetry = FrameReception(codec), Telemetry(DeviceClock())
    telemetry.configure(round(robot.ticks_per_rev), robot.max_wheel_speed_rad_s)
    commands: list[Row] = []
    wheels: list[Row] = []
    poses: list[Row] = []
    frames = 0
    for received in _frames(path):
        frames += 1
        decoded = codec.decode(received.frame.can_id, received.frame.data)
        if isinstance(decoded, Decoded) and decoded.name == _COMMAND:
            values = decoded.values
            given = codec.choice_name(_COMMAND, "mode", values["mode"]) == "SPEED"
            speeds = (values["left_speed"], values["right_speed"]) if given else (np.nan, np.nan)
            commands.append((received.t_ns, *speeds, values["valid_for"]))
            continue
        believed = reception.accept(received)
        if believed is None:
            continue
        if believed.name in WHEEL_MESSAGES:
            wheel = telemetry.wheels(believed, received.t_ns)
            if wheel is not None:
                angles = (wheel.left_angle_rad, wheel.right_angle_rad)
                wheels.append((received.t_ns, *angles, wheel.left_speed_rad_s, wheel.right_speed_rad_s))
        elif believed.name in POSE_MESSAGES:
            pose = telemetry.pose(believed, received.t_ns)
            if pose is not None:
                poses.append((received.t_ns, pose.x_m, pose.y_m, pose.yaw_rad))
    if not (commands or wheels or poses):
        raise LogError(f"{path}: {frames} frames, none of them a command, wheel sample or pose of our protocol")
    refused = reception.rejected_crc + reception.rejected_sequence + reception.rejected_length
    notes = (f"{path}: {refused} of {frames} frames failed their check and were left out",) if refused else ()
    return _drive(path, _expired(commands), wheels, poses, notes)


def _frames(path: Path) -> Iterator[ReceivedFrame]:
    first_ns = last_ns = whole = 0
    try:
        # It takes any iterator of lines that can be closed, not only files.
        with can.CanutilsLogReader(cast(TextIO, read_lines(path, CANDUMP))) as reader:
            for number, message in enumerate(reader, start=1):
                t_ns = round(message.timestamp * 1e9)
                # Since the first frame: nanoseconds since 1970 need more digits than a float has.
                first_ns = first_ns or t_ns
                if t_ns < last_ns:
                    raise LogError(f"{path}: frame {number}: the clock goes backwards; sort the lines by time")
                last_ns, whole = t_ns, number
                if not (message.is_error_frame or message.is_remote_frame or message.is_extended_id):
                    yield ReceivedFrame(t_ns - first_ns, Frame(message.arbitration_id, bytes(message.data)))
    except (ValueError, IndexError, OverflowError) as error:
        if whole:
            raise LogError(
                f"{path}: after {whole} frames comes a line that is no frame ({error}); take it out"
            ) from None
        raise LogError(f"{path}: not a candump ({error}); record with `candump -l`") from None


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
    "candump", lambda begin: begin.startswith(b"("), lambda path, config: read_candump(path, config.robot), order=10
)
