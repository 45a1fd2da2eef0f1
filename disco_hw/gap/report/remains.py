"""Summary of the prediction error: the share that is explained, and where most of the rest lies."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from disco_hw.effects import Channel
from disco_hw.gap.search.cross_validation import PredictionErrors

# What regimes are called in a sentence.
_WHILE = {
    "standstill": "the robot stands still",
    "turning on the spot": "the robot turns on the spot",
    "speeding up and braking": "the robot speeds up and brakes",
    "curves": "the robot drives curves",
    "straight ahead": "the robot drives straight ahead",
    "straight back": "the robot drives straight back",
}
# Errors of more than so many times the sensors' noise are only partly explained.
_EXPLAINED = 2.0
# Chosen: errors above the noise by no more than this share of it are the noise, as well as that is known.
_LEAST_GAP = 0.05


@dataclass(frozen=True, slots=True)
class Remains:
    """Errors of `timed`, of the model that is handed out, and of the sensors' noise, in position (m) and heading (rad).

    `regime` and `channel`: what the robot does, and which half of the way from command to pose it is, where most of the
    rest lies, in position or in heading, whichever is the larger in units of the noise. None where that is not known.
    `event`: the rare event, in words, that makes up most of the mismatch of that half.
    """

    before: tuple[float, float]
    after: tuple[float, float]
    floor: tuple[float, float]
    regime: str | None
    channel: Channel | None
    event: str | None = None

    @classmethod
    def of(
        cls, timed: PredictionErrors, offered: PredictionErrors, floor: PredictionErrors, body: PredictionErrors | None
    ) -> Remains | None:
        """Return what remains of errors; None if nothing was predicted. `body`: those from measured wheel motion."""
        if not math.isfinite(offered.position_m):
            return None
        before, after, noise = ((one.position_m, one.yaw_rad) for one in (timed, offered, floor))
        larger = int(after[1] * noise[0] > after[0] * noise[1])
        above = {
            regime: squares[larger] - floor.regime_squares.get(regime, (0.0, 0.0))[larger]
            for regime, squares in offered.regime_squares.items()
        }
        channel = None
        if body is not None:
            of_body = (body.position_m, body.yaw_rad)[larger]
            channel = Channel.WHEEL_TO_BODY if of_body**2 > 0.5 * after[larger] ** 2 else Channel.COMMAND_TO_WHEEL
        return cls(before, after, noise, max(above, key=above.__getitem__, default=None), channel)

    @property
    def closed(self) -> tuple[float | None, float | None]:
        """Share of the gap between `timed` and noise that is closed, 0 to 1: position, heading; None for no gap."""
        ends = zip(self.before, self.after, self.floor, strict=True)
        position, heading = (
            min(max((b - a) / (b - f), 0.0), 1.0) if b > (1.0 + _LEAST_GAP) * f else None for b, a, f in ends
        )
        return position, heading

    @property
    def is_explained(self) -> bool:
        """Whether errors are at most twice what the sensors' noise makes, in position and in heading."""
        return all(after <= _EXPLAINED * floor for after, floor in zip(self.after, self.floor, strict=True))

    def describe(self) -> str:
        """Which share of the gap is closed, and where most of the rest lies."""
        shares = [
            f"{share:.0%} in {name}" for share, name in zip(self.closed, ("position", "heading"), strict=True)
            if share is not None
        ]  # fmt: skip
        closed = f"Of what is more than the sensors' noise this explains {' and '.join(shares)}." if shares else ""
        if self.is_explained:
            return closed or "What is left is the sensors' noise."
        if self.event is not None:
            return f"{closed} Most of the rest is one event: {self.event}.".strip()
        if self.regime is None:
            return closed
        part = {Channel.WHEEL_TO_BODY: ", between wheels and body", Channel.COMMAND_TO_WHEEL: ", from command to wheel"}
        where = f"while {_WHILE.get(self.regime, self.regime)}{part[self.channel] if self.channel else ''}"
        return f"{closed} Most of the rest is {where}.".strip()

    def as_dict(self) -> Mapping[str, object]:
        """Return the content of `remains` in report.json."""
        position, heading = self.closed
        return {
            "closed_position": position,
            "closed_heading": heading,
            "explained": self.is_explained,
            "regime": self.regime,
            "channel": None if self.channel is None else self.channel.value,
            "event": self.event,
        }
