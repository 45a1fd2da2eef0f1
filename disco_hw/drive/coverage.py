"""Coverage of a drive: which motions needed to identify the model have been driven, and which are missing; pure.

The list is what separates pairs of parameters and effects that look the same otherwise: both turning directions, two
speeds, backwards, starts and stops, steering, slow ramps through zero, rests.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

# Chosen: shares of the top speed, below which a robot stands, above which it moves and is fast; between the first two
# it creeps.
_STATIONARY = 0.02
_MOVING = 0.08
_FAST = 0.5
# Chosen: share of turn in forward speed, or the other way round, that is no curve.
_STRAIGHT = 0.08
# Chosen: a pause of the samples counts as driving for no longer.
_LONGEST_SAMPLE_S = 0.1
# Chosen: to this share of the top speed, or from it, within this time is a hard start or stop.
_LAUNCH_S = 0.7
_LAUNCH = 0.3
# Chosen: a turn of this share of the top speed that changes sides within this time is quick steering.
_SWING = 0.12
_SWING_S = 1.6
# Chosen: a faster change of direction shows nothing of dead band and stiction.
_SLOW_CROSSING_S = 0.25


@dataclass(frozen=True, slots=True)
class Item:
    """One thing to excite: how much of it there is and should be, in `unit` (s or times)."""

    name: str
    purpose: str
    unit: str
    target: float
    found: float = 0.0

    @property
    def covered(self) -> bool:
        """Whether there is enough."""
        return self.found >= self.target

    def describe(self) -> str:
        """Return the name with the found and the wanted amount as text."""
        unit = "" if self.unit == "times" else f" {self.unit}"
        return f"{self.name} {min(self.found, self.target):.0f}/{self.target:.0f}{unit}"


_ITEMS = (
    Item("straight slow", "wheel radius", "s", 3.0),
    Item("straight fast", "wheel radius apart from what grows with speed", "s", 2.0),
    Item("reverse slow", "offsets that change sign with the direction", "s", 3.0),
    Item("reverse fast", "offsets apart from what grows with speed", "s", 2.0),
    Item("turn left slow", "axial distance", "s", 3.0),
    Item("turn left fast", "axial distance apart from slip in turns", "s", 2.0),
    Item("turn right slow", "left apart from right", "s", 3.0),
    Item("turn right fast", "left apart from right, slip in turns", "s", 2.0),
    Item("curve left slow", "x_icr", "s", 3.0),
    Item("curve left fast", "x_icr apart from side slip", "s", 3.0),
    Item("curve right slow", "pose latency apart from a heading bias", "s", 3.0),
    Item("curve right fast", "pose latency apart from a heading bias", "s", 3.0),
    Item("rest", "noise of the poses", "s", 5.0),
    Item("hard start", "lag and delay, slip under acceleration", "times", 6.0),
    Item("hard stop", "lag and delay, slip under braking", "times", 6.0),
    Item("quick steering", "delay apart from lag", "times", 6.0),
    Item("slow crossing of zero", "deadband apart from stiction", "times", 2.0),
)


class Coverage:
    """Counts from the commands executed; thresholds are shares of the fastest wheel speed that is driven, `top_rad_s`.

    Starts and stops count when they take less than 0.7 s between rest and 0.3 of it; swings when the turn changes sides
    within 1.6 s; crossings of zero when a wheel takes more than 0.25 s through +-0.08 of it without resting there.
    """

    def __init__(self, top_rad_s: float) -> None:
        self._top_rad_s = top_rad_s
        self._found: dict[str, float] = dict.fromkeys([item.name for item in _ITEMS], 0.0)
        self._t_ns: int | None = None
        self._stationary_ns: int | None = None
        self._fast_ns: int | None = None
        self._swing: tuple[int, int] | None = None
        self._crossing: list[tuple[int, int] | None] = [None, None]
        self._rested_ns = [0, 0]
        self.driven_s = 0.0

    def add(self, t_ns: int, left_rad_s: float, right_rad_s: float) -> None:
        """Count the time since the last call as driven at these wheel speeds; ignore older times and NaN."""
        if self._t_ns is not None and t_ns <= self._t_ns:
            return
        left, right = left_rad_s / self._top_rad_s, right_rad_s / self._top_rad_s
        size = max(abs(left), abs(right))
        if not size < 1e3:
            return
        dt_s = 0.0 if self._t_ns is None else min((t_ns - self._t_ns) * 1e-9, _LONGEST_SAMPLE_S)
        self._t_ns = t_ns
        self.driven_s += dt_s
        forward, turn = 0.5 * (left + right), 0.5 * (right - left)
        regime = _regime(forward, turn, size)
        if regime is not None:
            self._found[regime] += dt_s
        self._count_launches(t_ns, size)
        self._count_swings(t_ns, turn)
        for wheel, speed in enumerate((left, right)):
            self._count_crossings(t_ns, dt_s, wheel, speed)

    def pause(self) -> None:
        """Interrupt the counting, so that nothing is counted across a pause of the drive."""
        self._t_ns = self._stationary_ns = self._fast_ns = self._swing = None
        self._crossing = [None, None]

    def items(self) -> tuple[Item, ...]:
        """Return everything that counts, covered or not."""
        return tuple(replace(item, found=self._found[item.name]) for item in _ITEMS)

    def missing(self) -> tuple[Item, ...]:
        """Return the items of which too little has been driven."""
        return tuple(item for item in self.items() if not item.covered)

    def describe(self) -> str:
        """One line for the operator: how much is done, and the first things that are missing."""
        items, missing = self.items(), self.missing()
        done = f"{self.driven_s:.0f} s driven, {len(items) - len(missing)} of {len(items)} motions"
        if not missing:
            return f"{done}; nothing is missing"
        more = f" and {len(missing) - 4} more" if len(missing) > 4 else ""
        return f"{done}; missing: {', '.join(item.describe() for item in missing[:4])}{more}"

    def as_dict(self) -> dict[str, Any]:
        """Return the coverage as a JSON-serialisable dict; `missing` holds names."""
        return {
            "driven_s": round(self.driven_s, 3),
            "items": [
                {
                    "name": item.name,
                    "purpose": item.purpose,
                    "unit": item.unit,
                    "found": round(item.found, 3),
                    "wanted": item.target,
                    "covered": item.covered,
                }
                for item in self.items()
            ],
            "missing": [item.name for item in self.missing()],
        }

    def _count_launches(self, t_ns: int, size: float) -> None:
        """Count hard starts and hard stops; `size` is the faster wheel's speed as a share of the top speed."""
        if size <= _STATIONARY:
            if self._fast_ns is not None and t_ns - self._fast_ns <= _LAUNCH_S * 1e9:
                self._found["hard stop"] += 1.0
            self._stationary_ns, self._fast_ns = t_ns, None
        elif size >= _LAUNCH:
            if self._stationary_ns is not None and t_ns - self._stationary_ns <= _LAUNCH_S * 1e9:
                self._found["hard start"] += 1.0
            self._stationary_ns, self._fast_ns = None, t_ns

    def _count_swings(self, t_ns: int, turn: float) -> None:
        """Count fast changes of the turn from one side to the other, within 1.6 s."""
        if abs(turn) < _SWING:
            return
        side = 1 if turn > 0.0 else -1
        if self._swing is not None and self._swing[0] != side and t_ns - self._swing[1] <= _SWING_S * 1e9:
            self._found["quick steering"] += 1.0
        if self._swing is None or self._swing[0] != side:
            self._swing = (side, t_ns)

    def _count_crossings(self, t_ns: int, dt_s: float, wheel: int, speed: float) -> None:
        """Count slow crossings of zero: from beyond the band on one side to beyond it on the other."""
        if abs(speed) < _MOVING:
            self._rested_ns[wheel] += round(dt_s * 1e9) if abs(speed) <= _STATIONARY else 0
            return
        side = 1 if speed > 0.0 else -1
        before, self._crossing[wheel] = self._crossing[wheel], (side, t_ns)
        rested_ns, self._rested_ns[wheel] = self._rested_ns[wheel], 0
        if before is None or before[0] == side:
            return
        took_ns = t_ns - before[1]
        if took_ns >= _SLOW_CROSSING_S * 1e9 and rested_ns < 0.5 * took_ns:
            self._found["slow crossing of zero"] += 1.0


def _regime(forward: float, turn: float, size: float) -> str | None:
    """Return the kind of motion; None for creeping, which counts for nothing."""
    if size <= _STATIONARY:
        return "rest"
    if size < _MOVING:
        return None
    pace = "fast" if size >= _FAST else "slow"
    if abs(turn) <= _STRAIGHT * abs(forward):
        return f"{'straight' if forward > 0.0 else 'reverse'} {pace}"
    side = "left" if turn > 0.0 else "right"
    return f"{'turn' if abs(forward) <= _STRAIGHT * abs(turn) else 'curve'} {side} {pace}"
