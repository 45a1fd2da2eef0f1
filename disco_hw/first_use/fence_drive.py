"""The fence of a drive along the edge, by hand or pushed, from its log: lines for robot.toml."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from disco_hw.errors import InputError
from disco_hw.fence import Polygon
from disco_hw.fence.recording import NoFence, fence_along
from disco_hw.first_use import in_toml
from disco_hw.log.reader import open_log
from disco_hw.log.records import Estimate
from disco_hw.runtime.robot_setup import setup_of_log

OFFER = (
    "to fence it in: push or drive it once round along the edge with `disco-hw drive {robot}`, then "
    "`disco-hw log fence LOG` writes the [fence] (docs/fence.md)"
)
"""What `init` and `commission` offer at their end."""
_EVERY = 5


def fence_of_log(log: Path) -> Polygon:
    """Return the fence that the robot of a log went round. Raises InputError for a log that makes none."""
    with open_log(log) as opened:
        setup = setup_of_log(opened, "give a log of `disco-hw drive` or `run`")
        poses = [
            (one.x_m, one.y_m, one.yaw_rad)
            for one in (entry.record for entry in opened.records(("/estimate",)))
            if isinstance(one, Estimate) and one.pose_healthy
        ]
    try:
        return fence_along(np.array(poses[::_EVERY]).reshape(-1, 3), setup.config.robot.footprint)
    except NoFence as error:
        raise InputError(f"{log}: {error}") from None


def fence_toml(keep_in: Polygon) -> str:
    """The section for robot.toml."""
    return f"[fence]\nkeep_in = {in_toml([list(corner) for corner in keep_in])}\n"
