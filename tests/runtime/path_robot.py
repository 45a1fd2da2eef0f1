"""The shipped robot with a path, or anything else, for its task."""

from __future__ import annotations

import shutil
from pathlib import Path

from disco_hw.config import SHIPPED_ROBOT

ROBOTS = SHIPPED_ROBOT.parent
_CIRCLE = 'kind = "circle"\nradius_m = 0.75\nspeed_m_s = 0.2\n'


def path_robot(directory: Path, csv: str | None = None, speed_m_s: float = 0.3) -> Path:
    """Write robot.toml, model and path.csv (the shipped figure of eight if None); returns robot.toml."""
    (directory / "path.csv").write_text((ROBOTS / "eight.csv").read_text() if csv is None else csv)
    return task_robot(directory, f'path = "path.csv"\nspeed_m_s = {speed_m_s}\n')


def timed_path_robot(directory: Path, csv: str) -> Path:
    """Write robot.toml, model and path.csv, with times; returns robot.toml."""
    (directory / "path.csv").write_text(csv)
    return task_robot(directory, 'kind = "timed_path"\npath = "path.csv"\n')


def task_robot(directory: Path, task: str) -> Path:
    """Write robot.toml with this task, and the model; returns robot.toml."""
    text = (ROBOTS / "wombot.toml").read_text()
    assert _CIRCLE in text
    robot = directory / "robot.toml"
    robot.write_text(text.replace(_CIRCLE, task))
    shutil.copy(ROBOTS / "wombot_model.toml", directory)
    return robot
