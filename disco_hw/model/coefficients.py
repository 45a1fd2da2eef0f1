"""What the compiled step is given of a model: numbers of one parameter point, or tables of many."""

from __future__ import annotations

from collections import namedtuple
from typing import Any, NamedTuple, Protocol

from disco_hw.effects.registry import MOTION_EFFECTS


class Base(NamedTuple):
    """Base coefficients of one parameter point, or arrays (L,) of many: r/2 (m), r/(2a) (1), x_icr (m)."""

    half_radius_m: Any
    half_turn_ratio: Any
    x_icr_m: Any


class TermCoefficients(Protocol):
    """Coefficients of a term without a name: k and steps a second, of one parameter point or arrays (L,) of many."""

    @property
    def k(self) -> Any:
        """The term's number."""

    @property
    def per_s(self) -> Any:
        """Steps a second."""


class Coefficients(Protocol):
    """What `Effects` holds: a field for every effect that moves the robot, None where absent, else what its
    `coefficients` returned; and one each for the terms without a name that act on commands and on the body.
    """

    @property
    def command_terms(self) -> tuple[TermCoefficients, ...] | None:
        """Terms that act on commands."""

    @property
    def body_terms(self) -> tuple[TermCoefficients, ...] | None:
        """Terms that act on the body."""


_effects_type: Any = namedtuple
Effects = _effects_type("Effects", (*MOTION_EFFECTS, "command_terms", "body_terms"), defaults=(None, None))


class Integration(NamedTuple):
    """Length of a step, and what the sine and cosine of half a step's turn need.

    With z = turn * step, step * sin(z) / z and cos(z) are polynomials in turn^2: `chord0` (the step) to `chord3`, 1 and
    `cos1` to `cos3`. They are good for 0.2 rad; `wide` is None, or anything else to work on a sixteenth of z
    and double it four times, which is good for 4 rad.
    """

    step_s: float
    chord0: float
    chord1: float
    chord2: float
    chord3: float
    cos1: float
    cos2: float
    cos3: float
    wide: object
