"""Wheel encoders: whole ticks of the true wheel angle, and the speed that a motor controller makes of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from sim.compiled import compiled
from sim.effects import HiddenEffects
from sim.plant_parameters import PlantParameters
from sim.wheel_dynamics import WheelPieces

_ENCODER = np.dtype(
    [("scale", "f8"), ("start", "i8"), ("ticks", "i8"), ("observed_ticks", "f8"), ("speed", "f8")], align=True
)


class Encoders:
    """Both encoders, left and right.

    Ticks are cumulative and never wrap here; the width of a counter is its reader's affair. The speed comes from a
    second-order tracking observer of the ticks (critically damped, rad/s), held at zero below what one tick can mean.
    """

    def __init__(self, parameters: PlantParameters, effects: HiddenEffects) -> None:
        ticks_per_rad = parameters.ticks_per_rev / (2.0 * math.pi)
        self._ticks_per_rad = ticks_per_rad
        self._bandwidth_rad_s = parameters.speed_observer_bandwidth_rad_s
        self._state = np.zeros(2, dtype=_ENCODER)
        self._state["scale"] = [(1.0 + scale) * ticks_per_rad for scale in effects.values("encoder_scale")]
        start = [parameters.encoder_start_left_ticks, parameters.encoder_start_right_ticks]
        self._state["start"] = start
        self._state["ticks"] = start
        self._state["observed_ticks"] = np.array(start) + 0.5

    @property
    def ticks(self) -> tuple[int, int]:
        """Cumulative ticks, left and right."""
        left, right = self._state["ticks"].tolist()
        return left, right

    @property
    def speeds_rad_s(self) -> tuple[float, float]:
        """Wheel speeds as the controller knows them, left and right."""
        left, right = self._state["speed"].tolist()
        return left, right

    def advance(self, now_us: int, pieces: WheelPieces, count: int) -> None:
        """Read the encoders at the ends of the first `count` pieces, the first of which begins at `now_us`."""
        _advance(self._state, self._ticks_per_rad, self._bandwidth_rad_s, now_us, pieces.times_us, pieces.angles, count)


@compiled
def _advance(
    encoders: Any,
    ticks_per_rad: float,
    bandwidth: float,
    now_us: int,
    times_us: npt.NDArray[np.int64],
    angles: npt.NDArray[np.float64],
    count: int,
) -> None:
    for piece in range(count):
        dt = (times_us[piece] - now_us) * 1e-6
        now_us = times_us[piece]
        smallest = 0.5 * dt * bandwidth * bandwidth / ticks_per_rad
        for side in range(2):
            encoder = encoders[side]
            ticks = encoder["start"] + math.floor(angles[piece, side] * encoder["scale"])
            encoder["ticks"] = ticks
            expected = encoder["observed_ticks"] + dt * encoder["speed"] * ticks_per_rad
            surprise = ticks + 0.5 - expected
            encoder["observed_ticks"] = expected + 2.0 * bandwidth * dt * surprise
            speed = encoder["speed"] + dt * bandwidth * bandwidth * surprise / ticks_per_rad
            if abs(speed) < smallest:
                speed = 0.0
            encoder["speed"] = speed
