"""The fence of a drive along the edge, by hand or pushed: recorded and written into robot.toml, or made from a log."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from disco_hw.drive.drive_command import DriveOptions, DriveResult, run_drive
from disco_hw.errors import InputError
from disco_hw.fence import Polygon
from disco_hw.fence.recording import NoFence, fence_along
from disco_hw.first_use import in_toml
from disco_hw.first_use.commission import CommissionOptions, write_fields
from disco_hw.log.reader import open_log
from disco_hw.log.records import Estimate
from disco_hw.runtime.robot_setup import setup_of_log

OFFER = (
    "to set a fence: push or drive the robot once round along the edge with `disco-hw drive {robot}`, then "
    "`disco-hw log fence LOG` writes [fence] (docs/fence.md)"
)
"""What `init` and `commission` print at their end where nobody can be asked, or who is asked says no."""
_PROMPT = "record the fence now, by moving the robot once round along the edge? It needs poses. [y/n] "
_AGAIN = "once more? [y/n] "
# Chosen: estimates come with each tick; fewer points do for the edge.
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
    """Return the section for robot.toml."""
    return f"[fence]\nkeep_in = {in_toml([list(corner) for corner in keep_in])}\n"


def record_fence(
    robot: Path,
    ask: Callable[[str], str],
    how: str,
    link: str | None = None,
    drive: Callable[[DriveOptions], DriveResult] = run_drive,
) -> bool:
    """Offer to record the fence of a robot.toml in a drive along the edge, and to write it; whether it was written.

    `how`: what the operator does once the recording runs. `ask`: how the operator is asked. A way that makes no fence
    can be driven again. Raises InputError and WorkError as the drive does.
    """
    prompt = _PROMPT
    while _is_yes(ask(prompt)):
        print(f"{how}; Ctrl-D ends the recording", file=sys.stderr, flush=True)
        log = drive(DriveOptions(robot, link=link)).log
        try:
            keep_in = fence_of_log(log)
        except InputError as error:
            print(error, file=sys.stderr, flush=True)
            prompt = _AGAIN
            continue
        return write_fields(CommissionOptions(robot), {("fence", "keep_in"): [list(one) for one in keep_in]}, ask)
    return False


def _is_yes(reply: str) -> bool:
    return reply.strip().lower() in {"y", "yes"}
