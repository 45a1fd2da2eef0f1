"""Makes a fence from a drive along the edge: the way of the footprint's outer side, with as few corners as it takes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from disco_hw.fence import Fence, Footprint, Polygon, fence_fault

Array = NDArray[np.float64]
# Chosen: smaller keeps more corners of the noise of the poses, larger cuts corners of the edge.
TOLERANCE_M = 0.03
# Below the 128 that a polygon of robot.toml may have.
_MOST_CORNERS = 100
# Chosen: a path that ends further from its start has not gone round.
_CLOSED_M = 0.5


class NoFence(ValueError):  # noqa: N818
    """The drive makes no fence; the message says why and what to do."""


def fence_along(poses: Array, footprint: Footprint) -> Polygon:
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


def _simplified(points: Array, tolerance_m: float) -> Array:
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
