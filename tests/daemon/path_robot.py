"""The shipped robot with a path for its task."""

from __future__ import annotations

import shutil
from pathlib import Path

import disco_hw

ROBOTS = Path(disco_hw.__file__).parent / "robots"
_CIRCLE = 'kind = "circle"\nradius_m = 0.75\nspeed_m_s = 0.2\n'


def path_robot(directory: Path, csv: str | None = None, speed_m_s: float = 0.3) -> Path:
    """Write robot.toml, model and path.csv (the shipped figure of eight if None); returns robot.toml."""
    text = (ROBOTS / "wombot.toml").read_text()
    assert _CIRCLE in text
    robot = directory / "robot.toml"
    robot.write_text(text.replace(_CIRCLE, f'path = "path.csv"\nspeed_m_s = {speed_m_s}\n'))
    shutil.copy(ROBOTS / "wombot_model.toml", directory)
    (directory / "path.csv").write_text((ROBOTS / "eight.csv").read_text() if csv is None else csv)
    return robot
