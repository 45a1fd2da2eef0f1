"""What `disco-hw import` does."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from disco_hw.config import load_robot_config
from disco_hw.config.input_file import LOG, begin_of
from disco_hw.config.input_file import ROBOT_TOML as ROBOT_FILE
from disco_hw.log.container import MAGIC
from disco_hw.log.errors import LogError
from disco_hw.log.importing.registry import LONGEST_BEGIN_BYTES, format_of, log_formats
from disco_hw.log.importing.write import write_log
from disco_hw.log.provenance import ROBOT_TOML, attachment


@dataclass(frozen=True, slots=True)
class Imported:
    """What was written where, and what a person should know of it."""

    out: Path
    records: int
    segments: int
    duration_s: float
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """For machines."""
        return {**asdict(self), "out": str(self.out)}

    def as_text(self) -> str:
        """For a person."""
        written = f"{self.out}: {self.records} records, {self.duration_s:.1f} s, {self.segments} segments"
        return "\n".join([written, *(f"note: {note}" for note in self.notes)])


def import_log(path: Path, robot: Path, out: Path) -> Imported:
    """Write a foreign log, of whichever format it is, as an MCAP log of ours.

    robot.toml goes into the log. Raises LogError for what can be no such file, and InputError.
    """
    config = load_robot_config(robot)
    begin = begin_of(path, LOG, LONGEST_BEGIN_BYTES)
    if begin.startswith(MAGIC):
        raise LogError(
            f"{path}: an MCAP log; ours needs no import, and of others none can be imported yet: write a CSV"
        )
    log_format = format_of(begin)
    if log_format is None:
        names = ", ".join(each.name for each in log_formats())
        raise LogError(f"{path}: none of the formats that can be imported ({names}); write a CSV")
    drive = log_format.read(path, config.robot)
    records = write_log(drive, out, config.robot.name, (attachment(robot, ROBOT_TOML, ROBOT_FILE),))
    notes = drive.notes
    if drive.gyro.t_s.size:
        notes += (f"{path}: the gyro was left out; a log of ours has none",)
    return Imported(out, records, drive.segments, drive.end_s, notes)
