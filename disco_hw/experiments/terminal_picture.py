"""Points of the floor as a picture of braille characters: two by four dots in each, for a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
_BLANK = 0x2800
NARROWEST = 60
"""Columns of a terminal in which a picture still leaves room for what stands beside it."""

Point = tuple[float, float]


def picture(layers: Sequence[Iterable[Point]], low: Point, high: Point, rows: int) -> list[str]:
    """Points (x, y in metres) between two corners as lines of text, `rows` of them; x to the right, y up.

    A metre is as long upwards as it is to the right. What lies outside is left out. Raises ValueError for corners that
    hold no floor between them.
    """
    width_m, height_m = high[0] - low[0], high[1] - low[1]
    if not (width_m > 0.0 and height_m > 0.0 and rows > 0):
        raise ValueError("a picture needs corners that are apart, and a row")
    dot_m = height_m / (4 * rows)
    columns = math.ceil(width_m / (2.0 * dot_m))
    cells = [[0] * columns for _ in range(rows)]
    for points in layers:
        for x, y in points:
            if not (math.isfinite(x) and math.isfinite(y)):
                continue
            across, down = math.floor((x - low[0]) / dot_m), math.floor((high[1] - y) / dot_m)
            if 0 <= across < 2 * columns and 0 <= down < 4 * rows:
                cells[down // 4][across // 2] |= _DOTS[down % 4][across % 2]
    return ["".join(chr(_BLANK + dots) for dots in row).rstrip(chr(_BLANK)) for row in cells]


def circle_points(centre: Point, radius_m: float, count: int = 48) -> list[Point]:
    """Points around a circle, far enough apart to be told from a line."""
    turns = (2.0 * math.pi * k / count for k in range(count))
    return [(centre[0] + radius_m * math.cos(turn), centre[1] + radius_m * math.sin(turn)) for turn in turns]
