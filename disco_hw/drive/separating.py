"""Scripts of at most a minute that show what another drive could not: each effect of the model names the one for it.

`separate` is all of them in one. Shares below are of the largest wheel speed: (forward, turn to the left).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

from disco_hw.drive.script import Manoeuvre, Pieces, Script

_STRAIGHT = "wheel radius against gains, slope and unequal wheels: two speeds, both ways"
_SPIN = "axial distance against slip in turns, and where it turns about: two rates, both ways"
_CURVE = "side slip and heading bias, which need speed and turning at once: two speeds, both ways"
_START = "lag, delay, late poses and slip under acceleration"
_STEER = "delay told from lag"
_RAMP = "deadband told from stiction, slowly through zero"


def _slow_straights(pieces: Pieces, each_s: float) -> list[Manoeuvre]:
    return pieces.each(_STRAIGHT, ("slow straight", each_s, 0.4, 0.0), ("slow reverse", each_s, -0.4, 0.0))


def _fast_straights(pieces: Pieces, each_s: float) -> list[Manoeuvre]:
    return pieces.each(_STRAIGHT, ("full speed straight", each_s, 1.0, 0.0), ("full speed reverse", each_s, -1.0, 0.0))


def _slow_spins(pieces: Pieces, each_s: float) -> list[Manoeuvre]:
    return pieces.each(_SPIN, ("slow turn left", each_s, 0.0, 0.3), ("slow turn right", each_s, 0.0, -0.3))


def _fast_spins(pieces: Pieces, each_s: float) -> list[Manoeuvre]:
    return pieces.each(_SPIN, ("fast turn left", each_s, 0.0, 0.85), ("fast turn right", each_s, 0.0, -0.85))


def _curves(pieces: Pieces, long_s: float, short_s: float) -> list[Manoeuvre]:
    return pieces.each(
        _CURVE,
        ("slow curve left", long_s, 0.3, 0.14),
        ("slow curve right", long_s, 0.3, -0.14),
        ("fast curve left", short_s, 0.65, 0.3),
        ("fast curve right", short_s, 0.65, -0.3),
    )


def _starts(pieces: Pieces, count: int) -> list[Manoeuvre]:
    # Slip under acceleration grows with the square of the speed reached, being late in proportion to it: two speeds.
    found: list[Manoeuvre] = []
    for number in range(count):
        forward = (1.0, -1.0, 0.5, -0.5)[number % 4]
        found += [pieces.hold(f"start and stop {number + 1}", _START, 0.8, forward, 0.0), pieces.rest()]
    return found


def _steering(pieces: Pieces, duration_s: float) -> list[Manoeuvre]:
    steer = pieces.play("steering", _STEER, duration_s, lambda t_s: (0.4, 0.35 * math.cos(math.pi * t_s)))
    return [steer, pieces.rest()]


def _ramps(pieces: Pieces, duration_s: float) -> list[Manoeuvre]:
    def wave(t_s: float) -> float:
        return 0.25 * 2.0 / math.pi * math.asin(math.sin(2.0 * math.pi * t_s / duration_s))

    return [
        pieces.play("ramp through zero", _RAMP, duration_s, lambda t_s: (wave(t_s), 0.0)),
        pieces.play("turning ramp through zero", _RAMP, duration_s, lambda t_s: (0.0, wave(t_s))),
        pieces.rest(),
    ]


def _built(pieces: Pieces) -> dict[str, list[Manoeuvre]]:
    return {
        "straights": 2 * (_slow_straights(pieces, 4.0) + _fast_straights(pieces, 3.0)),
        "spins": 2 * (_slow_spins(pieces, 4.0) + _fast_spins(pieces, 3.0)),
        "curves": 2 * _curves(pieces, 4.0, 3.0),
        "starts": _starts(pieces, 12) + _steering(pieces, 10.0),
        "ramps": 2 * _ramps(pieces, 8.0),
        # Turns and straights at either end, for what changes on the way.
        "separate": [
            *_slow_straights(pieces, 2.0),
            *_fast_spins(pieces, 1.5),
            *_curves(pieces, 2.0, 2.0),
            *_starts(pieces, 6),
            *_steering(pieces, 4.0),
            *_ramps(pieces, 5.0),
            *_slow_spins(pieces, 2.0),
            *_fast_spins(pieces, 1.5),
            *_fast_straights(pieces, 2.0),
        ],
    }


PURPOSES: Mapping[str, str] = MappingProxyType(
    {
        "straights": _STRAIGHT,
        "spins": _SPIN,
        "curves": _CURVE,
        "starts": _START,
        "ramps": _RAMP,
        "separate": "all of these in a minute",
    }
)
SEPARATING = tuple(PURPOSES)


def separating(name: str, top_rad_s: float) -> Script:
    """The script of that name with wheel speeds up to `top_rad_s`, from rest to rest; raises KeyError."""
    pieces = Pieces(top_rad_s)
    return Script(name, (pieces.rest(1.0), *_built(pieces)[name], pieces.rest(1.0)))
