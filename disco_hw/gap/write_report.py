"""What `disco-hw gap` does: read logs and model, find the gap, write report, amended model and pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from disco_hw.config import load_robot_config
from disco_hw.errors import WorkError
from disco_hw.gap.find import find_gap
from disco_hw.gap.report.findings import GapReport
from disco_hw.gap.report.page import as_text, page
from disco_hw.log.load import load_drive
from disco_hw.model import Model, load_model, save_model
from disco_hw.reports.outputs import as_json, refuse_directory

WRITTEN = ("report.json", "report.html", "model.toml")


@dataclass(frozen=True)
class GapResult:
    """A report and the directory it was written to."""

    report: GapReport
    directory: Path

    def as_dict(self) -> dict[str, Any]:
        """The content of report.json."""
        return self.report.as_dict()

    def as_text(self) -> str:
        """For a terminal."""
        return f"{as_text(self.report)}\n\nwritten: {self.directory}/report.html, report.json, model.toml"


def gap(
    logs: Sequence[Path],
    robot: Path,
    out: Path,
    model: Path | None = None,
    progress: Callable[[str], None] | None = None,
) -> GapResult:
    """Find what a model misses in logs and write everything to the directory `out`.

    Raises InputError for files that cannot be used and for an `out` that cannot be written, or where an input would be
    written over; WorkError if it cannot be written after all.
    """
    refuse_directory(out, WRITTEN, [*logs, robot, *([model] if model is not None else [])])
    config = load_robot_config(robot)
    start = load_model(model) if model is not None else Model.nominal(config.robot)
    drive = load_drive(list(logs), config.robot.ticks_per_rev, config.robot.wheel_radius_m)
    report = find_gap(drive, start, progress, pictures=True, top_rad_s=config.robot.max_wheel_speed_rad_s)
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "report.json").write_text(as_json(report.as_dict(), indent=1), encoding="utf-8")
        (out / "report.html").write_text(page(report), encoding="utf-8")
        save_model(report.model, out / "model.toml")
        for name, picture in report.pictures.items():
            (out / f"{name}.png").write_bytes(picture)
    except OSError as error:
        raise WorkError(f"{out}: cannot be written ({error.strerror}); give another directory") from None
    return GapResult(report, out)
