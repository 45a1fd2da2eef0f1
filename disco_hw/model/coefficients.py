"""Coefficients for the compiled step: of one parameter point of a model, or tables of many and the pick of one."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from numba import types
from numpy.typing import NDArray

from disco_hw.effects.registry import MOTION_EFFECTS
from disco_hw.jit import compiled_only, scalar_function, specialise


class Base(NamedTuple):
    """Base coefficients of one parameter point, or arrays (L,) of many: r/2 (m), r/(2a) (1), x_icr (m)."""

    half_radius_m: Any
    half_turn_ratio: Any
    x_icr_m: Any


class TermCoefficients(Protocol):
    """Coefficients of a term without a name, of one parameter point or arrays (L,) of many; it has some of these.

    `k`: factor of the feature, which stays within `reach`. `per_s`: steps in a second. Of a term that remembers
    `by_end`, `over_step`: the share of the way to its signal that the mean has gone by the end of a step, and averaged
    over it; or `most`: the largest step (m/s) of what follows at a limited rate.
    """

    k: Any
    reach: Any
    per_s: Any
    by_end: Any
    over_step: Any
    most: Any


Terms = tuple[TermCoefficients, ...]


class Coefficients(Protocol):
    """Coefficients of a model's effects, as `Effects` holds them.

    There is a field for every effect that moves the robot, None where absent, else what its `coefficients` returned;
    and one each for the terms without a name that act on commands and on the body.
    """

    command_terms: Terms | None
    body_terms: Terms | None


_effects_type: Any = namedtuple
Effects = _effects_type("Effects", (*MOTION_EFFECTS, "command_terms", "body_terms"), defaults=(None, None))


class Integration(NamedTuple):
    """Length of a step, and what the sine and cosine of half a step's turn need.

    With z = turn * step, step * sin(z) / z and cos(z) are polynomials in turn^2: `chord0` (the step) to `chord3`, 1 and
    `cos1` to `cos3`. They are good for 0.2 rad; `wide` is None, or anything else to work on a sixteenth of z
    and double it four times, which is good for 4 rad. `euler` is None, or anything else for steps straight along the
    heading that they begin with, in place of the exact arc.
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
    euler: object


@scalar_function
def base_point(base: Base, i: int) -> Base:
    """Return base coefficients of point i."""
    return Base(base.half_radius_m[i], base.half_turn_ratio[i], base.x_icr_m[i])


def entry(table: tuple[NDArray[np.floating], ...] | None, i: int) -> tuple[float, ...] | None:
    """Coefficients of one effect at point i, numbers, or None where it is absent; compiled code only."""
    raise compiled_only(table)


# What is overloaded is chosen by numba's types; those of tuples have fields that its annotations do not know.
@specialise(entry)
def _entry(table: Any, i: types.Type) -> Callable[..., Any] | None:
    if isinstance(table, types.NoneType):
        return lambda table, i: None
    # A tuple can only be looked up at constant places in compiled code, so they are written out.
    places = "".join(f"table[{place}][i], " for place in range(len(table)))
    pick: Callable[..., Any] = eval(f"lambda table, i: ({places})")
    return pick


def terms_point(terms: Terms | None, i: int) -> Terms | None:
    """Coefficients of all terms without a name at point i, None if there are none; compiled code only."""
    raise compiled_only(terms)


@specialise(terms_point)
def _terms_point(terms: Any, i: types.Type) -> Callable[..., Any]:
    if isinstance(terms, types.NoneType):
        return lambda terms, i: None
    # A tuple of mixed types cannot be looped over in compiled code, so the call is written out for every term.
    scope = {kind.instance_class.__name__: kind.instance_class for kind in terms.types}
    picks = ""
    for place, kind in enumerate(terms.types):
        columns = ", ".join(f"terms[{place}].{field}[i]" for field in kind.instance_class._fields)
        picks += f"{kind.instance_class.__name__}({columns}), "
    pick: Callable[..., Any] = eval(f"lambda terms, i: ({picks})", scope)
    return pick


def effect_point(effects: Coefficients, i: int) -> Coefficients:
    """Coefficients of all effects at point i; compiled code only."""
    raise compiled_only(effects)


@specialise(effect_point)
def _effect_point(effects: types.Type, i: types.Type) -> Callable[..., Any]:
    # A tuple of mixed types cannot be looped over in compiled code, so the call is written out for every effect.
    calls = [f"entry(effects.{name}, i)" for name in MOTION_EFFECTS]
    picks = ", ".join([*calls, "terms_point(effects.command_terms, i)", "terms_point(effects.body_terms, i)"])
    scope: dict[str, Any] = {"Effects": Effects, "entry": entry, "terms_point": terms_point}
    exec(f"def pick(effects, i):\n    return Effects({picks})", scope)
    pick: Callable[..., Any] = scope["pick"]
    return pick


def lane_base(base: Base, i: int) -> Base:
    """Return base coefficients of a sample: the point itself, or entry i of a table with a point for every sample.

    Compiled code only.
    """
    raise compiled_only(base)


@specialise(lane_base)
def _lane_base(base: Any, i: types.Type) -> Callable[..., Any]:
    if isinstance(base.types[0], types.Array):

        def pick(base: Base, i: int) -> Any:
            return base_point(base, i)

        return pick
    return lambda base, i: base


def _first_number(kind: types.Type) -> types.Type:
    """Return the type of the first number, or array of numbers, in tuples within tuples."""
    while hasattr(kind, "types"):
        kind = kind.types[0]
    return kind


def lane_effects(effects: Coefficients, i: int) -> Coefficients:
    """Coefficients of all effects for a sample: the point itself, or entry i of a table; compiled code only."""
    raise compiled_only(effects)


@specialise(lane_effects)
def _lane_effects(effects: Any, i: types.Type) -> Callable[..., Any]:
    present = [kind for kind in effects.types if not isinstance(kind, types.NoneType)]
    if present and isinstance(_first_number(present[0]), types.Array):

        def pick(effects: Coefficients, i: int) -> Coefficients:
            return effect_point(effects, i)

        return pick
    return lambda effects, i: effects
