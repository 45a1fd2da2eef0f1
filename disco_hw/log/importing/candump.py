"""A candump of a robot that speaks our protocol -> the arrays of a drive: its lines -> frames -> samples.

`candump -l` and `-L` write `(1700000000.123456) can0 110#0102...`, the screen format is
`(1700000000.123456)  can0  110   [8]  01 02 ...`. Time stamps are absolute, from zero on (-tz), a date (-tA) or the
differences between frames (-td), which are summed up.
"""

from __future__ import annotations

import re
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from disco_hw.config import RobotConfig
from disco_hw.errors import LogError
from disco_hw.files import CANDUMP, read_lines
from disco_hw.log.drive import DriveLog, Index, Samples, drive_of
from disco_hw.log.importing import LogFormat
from disco_hw.log.importing.losses import loss_note, warnings_first
from drivers.device_clock import DeviceClock
from drivers.motor.reference_frames import POSE_MESSAGES, WHEEL_MESSAGES, FrameReception, Telemetry
from drivers.pose import AS_OURS
from drivers.pose.robot import SOURCE as POSES_OF_ROBOT
from drivers.types import Frame, ReceivedFrame
from firmware_protocol.codec import Codec, Decoded

_LINE = re.compile(
    r"\s*\((?P<time>[^()]{1,40})\)\s+(?P<channel>\S{1,64})\s+(?:[RT]X\s+[-BE\s]*)?(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
    r"(?:#(?P<packed>\S*)|\s+\[\s*(?P<length>\d{1,2})\]\s*(?P<spaced>[0-9A-Fa-f ]*?|remote request.*)"
    r"(?:\s+(?:ERRORFRAME.*|'.*'))?)(?:\s+[RT])?\s*"
)
_SCREEN = re.compile(r"\s*\S{1,64}\s+(?:[RT]X\s+[-BE\s]*)?[0-9A-Fa-f]{3,8}\s+\[\s*\d{1,2}\]")
_HEX = re.compile(r"(?:[0-9A-Fa-f]{2}){0,8}")
_SECONDS = re.compile(r"(\d{1,12})(?:\.(\d{1,9}))?")
# CAN_ERR_FLAG of linux/can.h.
_ERROR_FLAG = 0x20000000
# Chosen: no pause between frames lasts a minute, and a clock that goes back is not that young.
_LARGEST_DIFFERENCE_NS = 60_000_000_000
_BACK_SHARE = 0.05
"""A clock that goes back this often counts from frame to frame."""
_LARGEST_DISORDER_NS = 100_000_000
"""Frames of two interfaces are written in another order than they came by less than this."""


@dataclass(frozen=True, slots=True)
class Dump:
    """A candump that was read once: `t_ns` (N,) of its frames since the first, and how many each channel has.

    `began_ns`: the time stamp of the first.
    """

    path: Path
    t_ns: Index
    channels: dict[str, int]
    notes: tuple[str, ...]
    began_ns: int

    def frames(self, channel: str) -> Iterator[ReceivedFrame]:
        """Yield the data frames with a standard identifier that came on this channel."""
        number = 0
        for parsed in map(_parsed, read_lines(self.path, CANDUMP)):
            if parsed is None:
                continue
            _, where, frame = parsed
            if where == channel and frame is not None:
                yield ReceivedFrame(int(self.t_ns[number]), frame)
            number += 1


def is_candump(begin: bytes) -> bool:
    """Return whether a file that begins with these bytes is a candump, in whichever format."""
    text = begin.decode("ascii", "replace").lstrip()
    return text.startswith("(") or _SCREEN.match(text) is not None


def read_dump(path: Path) -> Dump:
    """Read times and channels of a candump; lines that are no frame are counted.

    Raises LogError if over half of the lines are none, or if they have no time stamps.
    """
    t_ns, channels = array("q"), Counter[str]()
    filled = bad = first_bad = 0
    last_is_bad = is_complete = False
    for number, line in enumerate(read_lines(path, CANDUMP), start=1):
        if not line.strip():
            continue
        filled, is_complete = filled + 1, line.endswith(("\n", "\r"))
        parsed = _parsed(line)
        last_is_bad = parsed is None
        if parsed is None:
            if _SCREEN.match(line):
                raise LogError(
                    f"{path}: line {number}: candump's screen format without time stamps; record with `candump -L`"
                )
            bad, first_bad = bad + 1, first_bad or number
            continue
        t_ns.append(parsed[0])
        channels[parsed[1]] += 1
    notes = []
    if last_is_bad and not is_complete and channels:
        notes.append(f"{path}: the last line is cut off and was left out; the recording did not end regularly")
        bad, filled = bad - 1, filled - 1
    if bad:
        what = f"are no frame and were left out, the first is line {first_bad}"
        hint = "not a candump; record with `candump -L`" if bad == filled else f"correct them, first line {first_bad}"
        notes.append(loss_note(str(path), "lines", bad, filled, what, hint))
    if not channels:
        raise LogError(f"{path}: holds no frame; record with `candump -L`")
    since_ns = _increasing(path, np.array(t_ns, dtype=np.int64), notes)
    return Dump(path, since_ns, dict(channels), tuple(notes), t_ns[0])


def _increasing(path: Path, stamps_ns: Index, notes: list[str]) -> Index:
    """Return times since the first frame that never go back, of stamps in the order of the lines."""
    back = np.diff(stamps_ns) < 0
    if np.count_nonzero(back) > _BACK_SHARE * max(back.size, 1) and stamps_ns.max() < _LARGEST_DIFFERENCE_NS:
        notes.append(f"{path}: the time stamps are differences between frames (candump -td) and were summed up")
        return np.asarray(np.cumsum(stamps_ns) - stamps_ns[0])
    ahead_ns = np.maximum.accumulate(stamps_ns)[:-1] - stamps_ns[1:]
    set_back = np.flatnonzero(ahead_ns > _LARGEST_DISORDER_NS)
    t_ns = stamps_ns.astype(np.int64)
    jumps = 0
    for at in set_back.tolist():
        # Once shifted, what follows is ahead no more.
        by_ns = int(t_ns[: at + 1].max() - t_ns[at + 1])
        if by_ns > _LARGEST_DISORDER_NS:
            t_ns[at + 1 :] += by_ns
            jumps += 1
    if jumps:
        notes.append(f"{path}: the clock was set back {jumps} times, which was taken out")
    return np.asarray(np.maximum.accumulate(t_ns) - t_ns[0])


def _parsed(line: str) -> tuple[int, str, Frame | None] | None:
    """Time stamp (ns), channel and frame of a line, None for the frame of another kind; None if the line is none."""
    found = _LINE.fullmatch(line.rstrip("\r\n"))
    t_ns = None if found is None else _nanoseconds(found["time"])
    if found is None or t_ns is None:
        return None
    can_id = int(found["id"], 16)
    packed = found["packed"]
    if packed is None:
        spaced = found["spaced"]
        if len(found["id"]) > 3 or can_id & _ERROR_FLAG or not _HEX.fullmatch(spaced.replace(" ", "")):
            return t_ns, found["channel"], None
        data = bytes.fromhex(spaced)
        return (t_ns, found["channel"], Frame(can_id, data)) if len(data) == int(found["length"]) else None
    if len(found["id"]) > 3 or packed.startswith(("#", "R", "r")):
        return t_ns, found["channel"], None
    plain = packed.replace(".", "")
    return (t_ns, found["channel"], Frame(can_id, bytes.fromhex(plain))) if _HEX.fullmatch(plain) else None


def _nanoseconds(text: str) -> int | None:
    """Return a time stamp in ns: seconds, or a date and time of day in UTC; None if it is neither."""
    found = _SECONDS.fullmatch(text.strip())
    if found is not None:
        return int(found[1]) * 1_000_000_000 + int((found[2] or "").ljust(9, "0"))
    try:
        moment = datetime.fromisoformat(text.strip()).replace(tzinfo=UTC)
    except ValueError:
        return None
    return round(moment.timestamp() * 1e6) * 1000


_COMMAND = "WHEEL_COMMAND"
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


def read_candump(path: Path, config: RobotConfig, channel: str = "") -> DriveLog:
    """Read commands, wheels and poses of a dump, stamped with their reception.

    Wheels are wired, and poses are converted, as robot.toml says. A command counts until the next one or as long as it
    is valid. Frames that fail their check are left out and counted. Ticks per revolution and the largest speed, which
    distinguish a jump from motion, are robot.toml's. Of several channels `channel` is read, or the only one that speaks
    the protocol, or else `link.channel`. Raises LogError, also for several robots of which none is named.
    """
    dump = read_dump(path)
    if channel and channel not in dump.channels:
        raise LogError(f"{path}: no channel {channel}; it has {', '.join(dump.channels)}")
    selected = [channel] if channel else list(dump.channels)
    found = {each: _decoded(dump, each, config) for each in selected}
    robots = {each: rows for each, rows in found.items() if rows.count}
    if not robots:
        frames = sum(rows.frames for rows in found.values())
        raise LogError(
            f"{path}: {frames} frames, none of them a command, wheel sample or pose of the reference protocol"
        )
    usual_channel = config.link.channel
    if len(robots) > 1 and usual_channel not in robots:
        counts = ", ".join(f"{each} with {rows.count} records" for each, rows in robots.items())
        raise LogError(f"{path}: several channels hold a robot ({counts}); name one with --channel")
    bus = usual_channel if usual_channel in robots else next(iter(robots))
    rows, notes = robots[bus], list(dump.notes)
    if len(dump.channels) > 1:
        others = ", ".join(each for each in dump.channels if each != bus)
        notes.append(f"{path}: channel {bus} was read, and {others} left out; --channel takes another")
    if rows.refused:
        notes.append(
            loss_note(
                str(path), f"frames of {bus}", rows.refused, rows.frames,
                "failed their check and were left out", "look for a second sender, or name another channel",
            )
        )  # fmt: skip
    commands, wheels, poses = _samples(_expired(rows.commands), 3), _samples(rows.wheels, 5), _samples(rows.poses, 4)
    drive = drive_of(str(path), commands, wheels, poses, notes=warnings_first(tuple(notes)))
    return replace(drive, began_ns=dump.began_ns + drive.began_ns)


def _decoded(dump: Dump, channel: str, config: RobotConfig) -> _Rows:
    """Decode the frames of one channel."""
    codec, robot, wiring = Codec(), config.robot, config.wheels
    source = config.pose.of(POSES_OF_ROBOT)
    convention = AS_OURS if source is None else source.convention()
    reception, telemetry = FrameReception(codec), Telemetry(DeviceClock())
    telemetry.configure(round(robot.ticks_per_rev), robot.max_wheel_speed_rad_s / wiring.turn_ratio)
    rows = _Rows()
    for received in dump.frames(channel):
        rows.frames += 1
        decoded = codec.decode(received.frame.can_id, received.frame.data)
        if isinstance(decoded, Decoded) and decoded.name == _COMMAND:
            values = decoded.values
            given = codec.choice_name(_COMMAND, "mode", values["mode"]) == "SPEED"
            speeds = (values["left_speed"], values["right_speed"]) if given else (np.nan, np.nan)
            rows.commands.append((received.t_ns, *wiring.from_controller(*speeds), values["valid_for"]))
            continue
        believed = reception.accept(received)
        if believed is None:
            continue
        if believed.name in WHEEL_MESSAGES:
            wheel = telemetry.wheels(believed, received.t_ns)
            if wheel is not None:
                wheel = wiring.true_wheels(wheel)
                angles = (wheel.left_angle_rad, wheel.right_angle_rad)
                rows.wheels.append((received.t_ns, *angles, wheel.left_speed_rad_s, wheel.right_speed_rad_s))
        elif believed.name in POSE_MESSAGES:
            pose = telemetry.pose(believed, received.t_ns)
            if pose is not None:
                pose = convention.converted(pose)
                rows.poses.append((pose.t_ns, pose.x_m, pose.y_m, pose.yaw_rad))
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


def _samples(rows: list[Row], width: int) -> Samples:
    """Return rows (N, width) that begin with their time in order of time, the last of several with one time."""
    table = np.array(rows, dtype=np.float64).reshape(-1, width)
    table = table[np.append(np.diff(table[:, 0]) > 0.0, True)] if rows else table
    return table[:, 0], table[:, 1:]


FORMAT = LogFormat("candump", is_candump, read_candump, order=10, read_channel=read_candump)
