"""Which wheel speeds a robot really reaches: found by asking for the fastest, both ways, straight and turning; pure."""

from __future__ import annotations

from collections import defaultdict
from statistics import median

from disco_hw.drive.script import Wheels

KEPT = 0.95
"""Reached is what comes so close to what was asked."""

_LARGEST = 1.0


class WheelLimits:
    """Shares of what was asked that each wheel reached forward and backward, in the manoeuvre where it reached least.

    Where nothing was observed, all of it counts as reached.
    """

    def __init__(self) -> None:
        self._shares: dict[tuple[int, bool], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
        self._asked: dict[tuple[int, bool], float] = {}

    def observe(self, manoeuvre: str, asked: Wheels, measured: Wheels) -> None:
        """Take in wheel speeds (rad/s, left and right) after they had time to settle."""
        for wheel, (wanted, reached) in enumerate(zip(asked, measured, strict=True)):
            if wanted != 0.0:
                self._shares[wheel, wanted > 0.0][manoeuvre].append(reached / wanted)
                self._asked[wheel, wanted > 0.0] = wanted

    def share(self, wheel: int, *, forward: bool) -> float:
        """Of the speed asked for, in [0, 1], for wheel 0 (left) or 1 (right)."""
        found = [median(shares) for shares in self._shares[wheel, forward].values()]
        least = min(found, default=_LARGEST)
        return _LARGEST if not least < KEPT else max(0.0, least)

    def within(self, asked: Wheels) -> Wheels:
        """Wheel speeds scaled into the limits that were found."""
        left, right = (speed * self.share(wheel, forward=speed > 0.0) for wheel, speed in enumerate(asked))
        return left, right

    def in_words(self) -> str:
        """The limits for a person."""
        if len(self._asked) < 4:
            return "limits not found: no wheel speeds were measured"
        reached = {key: asked * self.share(key[0], forward=key[1]) for key, asked in self._asked.items()}
        left, right = (f"{reached[wheel, False]:+.1f} to {reached[wheel, True]:+.1f}" for wheel in (0, 1))
        return f"found: left {left}, right {right} rad/s"
