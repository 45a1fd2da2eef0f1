"""Import of logs in foreign formats into our MCAP log, for `disco-hw import`.

The formats are modules here, each with a `FORMAT`, recognised by their first bytes. A format gives the arrays of a
drive; here they become records of the log, and its metadata says which of wheel angles and speeds were measured.
`drive_from_log` reads the same arrays again, with one more segment after each silence of the wheels. The gyro is left
out.
"""

from __future__ import annotations

import importlib
import math
import pkgutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

import msgspec

from disco_hw.config import RobotConfig, Ros2, load_robot_config
from disco_hw.errors import InputError, LogError
from disco_hw.files import LOG, begin_of
from disco_hw.files import ROBOT_TOML as ROBOT_FILE
from disco_hw.log import ROBOT_TOML, Attachment, End, Start, attachment, batch_encoder, version
from disco_hw.log.container import MAGIC
from disco_hw.log.drive import LONGEST_COMMAND_S, DriveLog, rows
from disco_hw.log.importing.losses import WARNING, warnings_first, without_standing_headings
from disco_hw.log.importing.rosbag_file import METADATA, SUFFIXES, is_bag
from disco_hw.log.mcap_log import McapLog
from disco_hw.log.records import Command, Record
from disco_hw.log.writer import LogFile
from drivers.types import PoseSample, WheelSample

# Chosen: enough of a file's beginning to tell its format.
LONGEST_BEGIN_BYTES = 64


@dataclass(frozen=True, slots=True)
class LogFormat:
    """Format of a foreign log: `recognises` tells from the first bytes of a file (64 at most) whether it is this one.

    `read` takes path and robot.toml and returns the arrays of the drive; it raises LogError with one line
    that names the file, the place and the remedy. Of two formats that recognise a file the one with the lower `order`
    reads it; one that takes whatever is left comes last. `has_topics`: [ros2] and `--topic` say what of it is read.
    `read_channel` reads one of several channels, where a file can have these.
    """

    name: str
    recognises: Callable[[bytes], bool]
    read: Callable[[Path, RobotConfig], DriveLog]
    order: int = 100
    has_topics: bool = False
    read_channel: Callable[[Path, RobotConfig, str], DriveLog] | None = None


@cache
def log_formats() -> tuple[LogFormat, ...]:
    """Return all formats, in the order in which they are tried."""
    names = [module.name for module in pkgutil.iter_modules(__path__)]
    modules = [importlib.import_module(f"{__name__}.{name}") for name in names]
    found = [module.FORMAT for module in modules if hasattr(module, "FORMAT")]
    return tuple(sorted(found, key=lambda each: (each.order, each.name)))


def format_of(begin: bytes) -> LogFormat | None:
    """Return the format of a file that begins with these bytes, None if it is none of them."""
    return next((each for each in log_formats() if each.recognises(begin)), None)


SOURCE = "import"
_LONGEST_S = 9e9
"""Nanoseconds of more do not fit into the 64 bits that a log has for them."""
# Year 2096, as for stamps of a bag: later ones are no dates.
_LATEST_BEGIN_NS = 4 * 10**18

_Timed = tuple[int, int, Record]


def write_log(drive: DriveLog, path: Path, robot: str, attachments: tuple[Attachment, ...] = ()) -> int:
    """Write a new log and return how many records it has; its time 0 is the drive's, and so is its date if known.

    A change of segment leaves out one tick's number. Raises LogError if the file exists or cannot be
    written.
    """
    if drive.end_s > _LONGEST_S:
        raise LogError(f"{', '.join(drive.sources)}: its times span {drive.end_s:.3g} s; correct the clock that jumps")
    encode = batch_encoder()
    try:
        file = LogFile(path)
    except FileExistsError:
        raise LogError(f"{path}: already exists; give another name") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be created ({error.strerror}); give another place") from None
    try:
        angle, speed = drive.wheels.angle_measured, drive.wheels.speed_measured
        offset_ns = drive.began_ns if 0 < drive.began_ns < _LATEST_BEGIN_NS else 0
        start = Start(
            str(path), robot, version(), 0, offset_ns, part=0, attachments=attachments,
            angle_measured=angle, speed_measured=speed,
        )  # fmt: skip
        log = McapLog(file, start)
        last_ns, last_tick, last_segment = 0, 0, 0
        for t_ns, samples in groupby(_samples(drive), key=lambda sample: sample[0]):
            together = list(samples)
            segment = max(sample[1] for sample in together)
            last_ns, last_tick = t_ns, last_tick + 1 + (segment != last_segment)
            last_segment = segment
            log.write(encode(last_tick, t_ns, [record for _, _, record in together]))
        log.end(End(last_ns, last_tick, 0))
        log.finish()
        file.sync()
    except BaseException as error:
        # Half a log would only be in the way of the next try.
        path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise LogError(f"{path}: cannot be written ({error.strerror}); give another place") from None
        raise
    finally:
        file.close()
    return log.records


def _samples(drive: DriveLog) -> list[_Timed]:
    """Return records with their time (ns) and segment, in order of time."""
    found: list[_Timed] = []
    for t_s, left, right, segment in rows(drive.commands):
        t_ns, known = _ns(t_s), not math.isnan(left)
        given = (left, right) if known else (0.0, 0.0)
        command = Command(
            t_ns, given[0], given[1], given[0], given[1], LONGEST_COMMAND_S, in_force=known, source=SOURCE
        )
        found.append((t_ns, segment, command))
    for t_s, *values, segment in rows(drive.wheels):
        found.append((_ns(t_s), segment, WheelSample(_ns(t_s), _ns(t_s), *values)))
    for t_s, x_m, y_m, yaw_rad, segment in rows(drive.poses):
        found.append((_ns(t_s), segment, PoseSample(_ns(t_s), _ns(t_s), x_m, y_m, yaw_rad, math.nan, math.nan)))
    return sorted(found, key=lambda sample: sample[0])


def _ns(t_s: float) -> int:
    return round(t_s * 1e9)


@dataclass(frozen=True, slots=True)
class Imported:
    """Result of an import: the path written, and notes for the operator."""

    out: Path
    records: int
    segments: int
    duration_s: float
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the result as a JSON-serialisable dict; the warnings are among the notes, and a list of their own."""
        warnings = [note.removeprefix(WARNING) for note in self._warnings]
        return {**asdict(self), "out": str(self.out), "warnings": warnings}

    def as_text(self) -> str:
        """Return the result as lines: warnings first, then what was written, then notes."""
        segments = f"{self.segments} segment{'s' * (self.segments != 1)}"
        written = f"{self.out}: {self.records} records, {self.duration_s:.1f} s, {segments}"
        notes = (f"note: {note}" for note in self.notes if note not in self._warnings)
        return "\n".join([*self._warnings, written, *notes])

    @property
    def _warnings(self) -> tuple[str, ...]:
        return tuple(note for note in self.notes if note.startswith(WARNING))


def import_log(path: Path, robot: Path, out: Path, topics: Sequence[str] = (), channel: str = "") -> Imported:
    """Write a foreign log, of whichever format it is, as an MCAP log of ours.

    robot.toml goes into the log. `topics`, of a bag: ROLE=NAME, ahead of robot.toml's [ros2]. `channel`: of a candump.
    Raises LogError for what can be no such file, and InputError.
    """
    config = load_robot_config(robot)
    begin = begin_of(_existing_path(path), LOG, LONGEST_BEGIN_BYTES)
    log_format = format_of(begin)
    if begin.startswith(MAGIC) and (log_format is None or not log_format.has_topics):
        raise LogError(
            f"{path}: an MCAP log; a log of disco-hw needs no import, and of others only those of ROS 2 can be imported"
        )
    if log_format is None:
        names = ", ".join(each.name for each in log_formats())
        raise LogError(f"{path}: none of the formats that can be imported ({names}); write a CSV")
    if topics and not log_format.has_topics:
        raise InputError(f"--topic: {path} is a {log_format.name}, which has no topics; leave it out")
    if channel and log_format.read_channel is None:
        raise InputError(f"--channel: {path} is a {log_format.name}, which has no channels; leave it out")
    config = msgspec.structs.replace(config, ros2=_with_topics(config.ros2, topics))
    if channel and log_format.read_channel is not None:
        drive = log_format.read_channel(path, config, channel)
    else:
        drive = log_format.read(path, config)
    drive = without_standing_headings(drive)
    records = write_log(drive, out, config.robot.name, (attachment(robot, ROBOT_TOML, ROBOT_FILE),))
    notes = warnings_first(drive.notes)
    if drive.gyro.t_s.size:
        notes += (f"{path}: the gyro was left out; the logs of disco-hw have no place for it",)
    return Imported(out, records, drive.segments, drive.end_s, notes)


def _existing_path(path: Path) -> Path:
    """Return the file that shows the format: of a bag's folder its metadata.yaml, or else the first bag in it."""
    if not path.is_dir():
        return path
    inside = sorted(one for one in path.iterdir() if one.suffix in SUFFIXES.values())
    possible = [path / METADATA, *inside] if (path / METADATA).exists() else inside
    return next((one for one in possible if is_bag(begin_of(one, LOG, LONGEST_BEGIN_BYTES))), [*possible, path][0])


def _with_topics(settings: Ros2, topics: Sequence[str]) -> Ros2:
    """Return the settings of [ros2] with its topics replaced by those given as ROLE=NAME."""
    fields = {"commands": "command_topic", "wheels": "wheel_topic", "poses": "pose_topic"}
    given: dict[str, str] = {}
    for one in topics:
        role, _, name = one.partition("=")
        if role not in fields or not name:
            raise InputError(f"--topic: {one!r} is not ROLE=NAME; write commands=, wheels= or poses= and the topic")
        if fields[role] in given:
            raise InputError(f"--topic: {role} is given twice; give it once")
        given[fields[role]] = name
    return msgspec.structs.replace(settings, **given)
