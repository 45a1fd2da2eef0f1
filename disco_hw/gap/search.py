"""Search of one channel: learn its noise from a rich model, hold it, then select."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.body_noise import BodyNoise
from disco_hw.gap.candidates import indices
from disco_hw.gap.channels import BodyChannel, WheelChannel
from disco_hw.gap.fit import Fit, fit
from disco_hw.gap.horizon import displacement, starts_of
from disco_hw.gap.noise_fit import learn_body_noise, learn_wheel_noise
from disco_hw.gap.selection import Names, Selector, Thresholds
from disco_hw.gap.timeline import CELL_S, Timeline
from disco_hw.gap.wheel_noise import WheelNoise

Array = NDArray[np.float64]

AHEAD_S = 2.0
_ROUGH = Thresholds(score=20.0, moves_m=0.0)
_SMOOTH_WHEEL = ("motor_lag", "command_delay", "deadband", "battery_sag", "wheel_gain")
_SMOOTH_BODY = (
    "wheel_radius_asymmetry",
    "turn_slip",
    "acceleration_slip",
    "side_slip",
    "lateral_icr",
    "slope",
    "pose_latency",
    "heading_bias",
)


@dataclass(frozen=True)
class Found:
    """What a channel's search ended with: its selector (noise held, all fits kept) and the accepted effects."""

    selector: Selector
    names: Names

    @property
    def fit(self) -> Fit:
        """The fit of the accepted effects."""
        return self.selector.fit(self.names)


def wheel_moves(channel: WheelChannel, geometry: Array) -> Callable[[Fit, Fit], float]:
    """How far two fits of the wheels lie apart `AHEAD_S` ahead, m (root mean square, lever arm of half the way)."""
    line = channel.timeline
    usable = np.isfinite(line.command_rad_s[:, 0])
    start = starts_of(line.first, usable, AHEAD_S)
    ahead = round(AHEAD_S / CELL_S)

    def moves(small: Fit, big: Fit) -> float:
        if not start.size:
            return 0.0
        difference = channel.angles(big.vector) - channel.angles(small.vector)
        step = difference[start + ahead] - difference[start]
        way = line.angle_rad[start + ahead] - line.angle_rad[start]
        forward = 0.5 * geometry[0] * step.sum(axis=1)
        yaw = geometry[0] / geometry[1] * (step[:, 1] - step[:, 0])
        lever = np.abs(0.25 * geometry[0] * way.sum(axis=1)) + abs(geometry[2])
        return float(np.sqrt(np.mean(forward**2 + (lever * yaw) ** 2)))

    return moves


def body_moves(channel: BodyChannel) -> Callable[[Fit, Fit], float]:
    """How far two fits of the body lie apart `AHEAD_S` ahead, m (root mean square)."""
    line = channel.timeline
    start = starts_of(line.first, np.ones(line.t_s.size, dtype=bool), AHEAD_S)
    heading = np.interp(line.t_s[start], channel.samples.t_s, channel.measured[:, 2])

    def moves(small: Fit, big: Fit) -> float:
        if not start.size:
            return 0.0
        ends = [
            displacement(found.vector, channel.track(found.vector), channel.moving_s, start, heading, AHEAD_S)
            for found in (small, big)
        ]
        apart = ends[1] - ends[0]
        lever = 0.5 * np.hypot(ends[1][:, 0], ends[1][:, 1])
        return float(np.sqrt(np.mean(apart[:, 0] ** 2 + apart[:, 1] ** 2 + (lever * apart[:, 2]) ** 2)))

    return moves


def search_wheels(line: Timeline, geometry: Array, start: Array, given: Names = ()) -> Found:
    """Effects between command and wheel.

    `geometry` (3,) tells how far they move the robot; `start` is the vector without what is missing, in which effects
    `given` are known already.
    """
    channel = WheelChannel.build(line, WheelNoise(reading_rad=max(line.quantum_rad, 2e-4)), geometry)
    moves = wheel_moves(channel, geometry)
    rough = Selector(channel, moves, _ROUGH, given=given, start=start)
    names = rough.greedy()
    rich = (*names, *(name for name in _SMOOTH_WHEEL if name not in names))
    channel = learn_wheel_noise(channel, fit(channel, rough.fit(names).vector, indices(channel, rich)).vector)
    selector = Selector(channel, moves, given=given, start=rough.fit(given).vector)
    return Found(selector, selector.select())


def search_body(line: Timeline, start: Array, given: Names = ()) -> Found:
    """Effects between measured wheel angles and measured poses; `start` and `given` as for the wheels."""
    channel = BodyChannel.build(line, BodyNoise(), start)
    nominal = fit(channel, start, indices(channel, given))
    channel = learn_body_noise(channel, nominal.vector, 4)
    rough = Selector(channel, body_moves(channel), _ROUGH, given=given, start=nominal.vector)
    names = rough.greedy()
    rich = (*names, *(name for name in _SMOOTH_BODY if name not in names))
    channel = learn_body_noise(channel, fit(channel, rough.fit(names).vector, indices(channel, rich)).vector)
    selector = Selector(channel, body_moves(channel), given=given, start=rough.fit(given).vector)
    return Found(selector, selector.select())
