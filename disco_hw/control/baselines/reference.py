"""A line on the ground as poses and speeds of a robot whose tracked point follows it exactly."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from disco_hw.tasks.line.inverse import SMALLEST_X_ICR_M, stable_yaw

Array = NDArray[np.float64]

SPACING_M = 0.01
LOOK_BACK_M, LOOK_AHEAD_M = 0.3, 0.6


@dataclass(frozen=True, eq=False)
class Reference:
    """Way-points (N, 2) m driven at `speed_m_s` by a robot of this `x_icr_m`; closed if the last one is the first.

    `places_m` (M, 2), `along_rad`, `yaw_rad`, `forward_m_s` and `turn_rad_s` (M,) at equal distances `spacing_m`.
    """

    waypoints_m: Array
    speed_m_s: float
    x_icr_m: float
    places_m: Array = field(init=False, repr=False)
    along_rad: Array = field(init=False, repr=False)
    yaw_rad: Array = field(init=False, repr=False)
    forward_m_s: Array = field(init=False, repr=False)
    turn_rad_s: Array = field(init=False, repr=False)
    spacing_m: float = field(init=False, repr=False)
    closed: bool = field(init=False, repr=False)

    def __post_init__(self) -> None:
        behind = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.waypoints_m, axis=0).T))])
        count = max(round(float(behind[-1]) / SPACING_M), 2)
        at = np.linspace(0.0, behind[-1], count + 1)
        places = np.column_stack([np.interp(at, behind, column) for column in self.waypoints_m.T])
        steps = np.diff(places, axis=0)
        along = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
        spacing = float(behind[-1]) / count
        closed = bool(np.hypot(*(places[0] - places[-1])) < SPACING_M)
        yaw = stable_yaw(along, spacing, self.x_icr_m, closed)[:-1]
        off = np.clip(yaw - along, -0.5 * math.pi, 0.5 * math.pi)
        x_icr_m = math.copysign(max(abs(self.x_icr_m), SMALLEST_X_ICR_M), self.x_icr_m)
        values = {
            "places_m": places[:-1],
            "along_rad": along,
            "yaw_rad": yaw,
            "forward_m_s": self.speed_m_s * np.cos(off),
            "turn_rad_s": self.speed_m_s * np.sin(off) / x_icr_m,
            "spacing_m": spacing,
            "closed": closed,
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def place(self, x_m: float, y_m: float, before: int | None) -> int:
        """Index of the place nearest to a position, near the one before."""
        count = len(self.places_m)
        if before is None:
            near = np.arange(count)
        else:
            back, ahead = round(LOOK_BACK_M / self.spacing_m), round(LOOK_AHEAD_M / self.spacing_m)
            near = self.beyond(before, np.arange(-back, ahead + 1))
        square = (self.places_m[near, 0] - x_m) ** 2 + (self.places_m[near, 1] - y_m) ** 2
        return int(near[int(square.argmin())])

    def beyond(self, place: int, entries: NDArray[np.int64]) -> NDArray[np.int64]:
        """Indices so many entries further on: round and round, or up to the ends."""
        count = len(self.places_m)
        return np.asarray((place + entries) % count if self.closed else np.clip(place + entries, 0, count - 1))

    def ahead(self, place: int, distance_m: float) -> int:
        """Index of the place so much further on."""
        return int(self.beyond(place, np.array([round(distance_m / self.spacing_m)]))[0])

    def offset_m(self, place: int, x_m: float, y_m: float) -> float:
        """Distance of a position to the left of the line at a place."""
        (at_x, at_y), along = self.places_m[place].tolist(), float(self.along_rad[place])
        return float((y_m - at_y) * math.cos(along) - (x_m - at_x) * math.sin(along))

    def axle_m(self, place: int) -> tuple[float, float]:
        """Where the centre of rotation is when the tracked point is at a place."""
        (at_x, at_y), yaw = self.places_m[place].tolist(), float(self.yaw_rad[place])
        return at_x + self.x_icr_m * math.cos(yaw), at_y + self.x_icr_m * math.sin(yaw)
