"""The fence of a drive along the edge, by hand or pushed: recorded and written into robot.toml, or made from a log.

It is the way of the footprint's outer side, with as few corners as it takes.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from disco_hw.drive.drive_command import DriveOptions, DriveResult, run_drive
from disco_hw.errors import InputError
from disco_hw.fence import Fence, Footprint, Polygon, fence_fault
from disco_hw.first_use import in_toml
from disco_hw.first_use.commission import CommissionOptions, is_yes, write_fields
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
# Chosen: smaller keeps more corners of the noise of the poses, larger cuts corners of the edge.
TOLERANCE_M = 0.03
# Below the 128 that a polygon of robot.toml may have.
_MOST_CORNERS = 100
# Chosen: a path that ends further from its start has not gone round.
_CLOSED_M = 0.5


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
    while is_yes(ask(prompt)):
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


class NoFence(ValueError):  # noqa: N818
    """The drive makes no fence; the message says why and what to do."""


def fence_along(poses: NDArray[np.float64], footprint: Footprint) -> Polygon:
    """Return the polygon that a robot went round on poses (N, 3) of its tracked point, x, y (m), yaw (rad).

    The footprint was inside all the way: the corners are of its side that faces outwards. Raises NoFence for a way that
    does not come back to where it began, or that crosses itself.
    """
    if len(poses) < 3:
        raise NoFence("the log holds no poses; drive once round along the edge, with poses")
    gap_m = float(np.hypot(*(poses[-1, :2] - poses[0, :2])))
    if gap_m > _CLOSED_M:
        raise NoFence(f"the path ends {gap_m:.1f} m from its start; drive once round, back to the start")
    x, y = poses[:, 0], poses[:, 1]
    is_left_turning = float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) > 0.0
    aside = -0.5 * footprint.width if is_left_turning else 0.5 * footprint.width
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    outer = np.column_stack(
        [x + footprint.ahead * cos - aside * sin, y + footprint.ahead * sin + aside * cos]
    )  # fmt: skip
    tolerance_m = TOLERANCE_M
    kept = _simplified(outer, tolerance_m)
    while len(kept) > _MOST_CORNERS:
        tolerance_m *= 1.5
        kept = _simplified(outer, tolerance_m)
    if len(kept) > 3 and np.hypot(*(kept[-1] - kept[0])) < 2.0 * tolerance_m:
        kept = kept[:-1]
    polygon = tuple((round(a, 3), round(b, 3)) for a, b in kept.tolist())
    fault = fence_fault(Fence(keep_in=polygon), footprint)
    if fault is not None:
        raise NoFence(f"the path makes no fence: it {fault.fault}; drive once round, without crossing the path")
    return polygon


def _simplified(points: NDArray[np.float64], tolerance_m: float) -> NDArray[np.float64]:
    """Return the points of a line that are needed to stay within a tolerance of it (Douglas and Peucker, 1973)."""
    keep = np.zeros(len(points), dtype=bool)
    keep[[0, -1]] = True
    waiting = [(0, len(points) - 1)]
    while waiting:
        first, last = waiting.pop()
        if last - first < 2:
            continue
        way, off = points[last] - points[first], points[first + 1 : last] - points[first]
        length = float(way @ way)
        part = np.clip(off @ way / length, 0.0, 1.0) if length > 0.0 else np.zeros(len(off))
        away = np.hypot(*(off - part[:, None] * way).T)
        farthest = int(away.argmax())
        if away[farthest] > tolerance_m:
            middle = first + 1 + farthest
            keep[middle] = True
            waiting += [(first, middle), (middle, last)]
    return points[keep]
