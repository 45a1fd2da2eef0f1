"""What `disco-hw import` does."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from disco_hw.config import load_robot_config
from disco_hw.config.input_file import LOG, begin_of
from disco_hw.config.input_file import ROBOT_TOML as ROBOT_FILE
from disco_hw.log.container import MAGIC
from disco_hw.log.csv_import import read_csv
from disco_hw.log.errors import LogError
from disco_hw.log.importing.candump import read_candump
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
    """Write a foreign log, a CSV file or a candump of our protocol, as an MCAP log of ours.

    robot.toml goes into the log. Raises LogError for what can be no such file, and InputError.
    """
    config = load_robot_config(robot)
    if _begins(path).startswith(b"("):
        drive = read_candump(path, config.robot)
    else:
        drive = read_csv(path, config.robot.ticks_per_rev, config.robot.wheel_radius_m)
    records = write_log(drive, out, config.robot.name, (attachment(robot, ROBOT_TOML, ROBOT_FILE),))
    notes = drive.notes
    if drive.gyro.t_s.size:
        notes += (f"{path}: the gyro was left out; a log of ours has none",)
    return Imported(out, records, drive.segments, drive.end_s, notes)


def _begins(path: Path) -> bytes:
    begin = begin_of(path, LOG, len(MAGIC))
    if begin == MAGIC:
        raise LogError(
            f"{path}: an MCAP log; ours needs no import, and of others none can be imported yet: write a CSV"
        )
    return begin
