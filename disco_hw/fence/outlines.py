"""Lines that draw a fence, circles and a footprint."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from disco_hw.fence import Circle, Fence, Footprint

Array = NDArray[np.float64]
_ROUND = np.linspace(0.0, 2.0 * np.pi, 49)


def fence_outlines(fence: Fence) -> list[Array]:
    """Return the fence's shapes as closed lines (N, 2)."""
    shapes = [*(() if fence.keep_in is None else (fence.keep_in,)), *fence.keep_out]
    return [
        circle_outline(*shape.center, shape.radius_m) if isinstance(shape, Circle) else _closed(shape)
        for shape in shapes
    ]


def footprint_outline(footprint: Footprint, pose: tuple[float, float, float]) -> Array:
    """Return the footprint at a pose of the tracked point as a closed line (5, 2)."""
    x_m, y_m, yaw_rad = pose
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return _closed([(x_m + cos * x - sin * y, y_m + sin * x + cos * y) for x, y in footprint.corners_m()])


def circle_outline(x_m: float, y_m: float, radius_m: float) -> Array:
    """Return a circle as a closed line (N, 2)."""
    return np.stack((x_m + radius_m * np.cos(_ROUND), y_m + radius_m * np.sin(_ROUND)), axis=1)


def _closed(points: ArrayLike) -> Array:
    found = np.asarray(points, dtype=np.float64)
    return np.concatenate((found, found[:1]))
