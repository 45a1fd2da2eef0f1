"""Picking parameter points out of tables of coefficients, inside compiled code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from disco_hw.effects.registry import MOTION_EFFECTS
from disco_hw.jit import scalar_function, specialise
from disco_hw.model.coefficients import Base, Coefficients, Effects
from disco_hw.model.terms import terms_point


@scalar_function
def base_point(base: Base, i: int) -> Base:
    """Base coefficients of point i."""
    return Base(base.half_radius_m[i], base.half_turn_ratio[i], base.x_icr_m[i])


def entry(table: tuple[NDArray[np.floating], ...] | None, i: int) -> tuple[float, ...] | None:
    """Coefficients of one effect at point i: a tuple of numbers, or None where the effect is absent."""
    return None if table is None else tuple(column[i] for column in table)


# What is overloaded is chosen by numba's types; those of tuples have fields that its annotations do not know.
@specialise(entry)
def _entry(table: Any, i: types.Type) -> Callable[..., Any] | None:
    if isinstance(table, types.NoneType):
        return lambda table, i: None
    # A tuple can only be looked up at constant places in compiled code, so they are written out.
    places = "".join(f"table[{place}][i], " for place in range(len(table)))
    pick: Callable[..., Any] = eval(f"lambda table, i: ({places})")
    return pick


def effect_point(effects: Coefficients, i: int) -> Coefficients:
    """Coefficients of all effects at point i."""
    named = (entry(getattr(effects, name), i) for name in MOTION_EFFECTS)
    made: Coefficients = Effects(*named, terms_point(effects.command_terms, i), terms_point(effects.body_terms, i))
    return made


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
    """Base coefficients of a sample: the point itself, or entry i of a table with a point for every sample."""
    point: Base = base_point(base, i)
    return point


@specialise(lane_base)
def _lane_base(base: Any, i: types.Type) -> Callable[..., Any]:
    if isinstance(base.types[0], types.Array):

        def pick(base: Base, i: int) -> Any:
            return base_point(base, i)

        return pick
    return lambda base, i: base


def _first_number(kind: types.Type) -> types.Type:
    """The type of the first number, or array of numbers, in tuples within tuples."""
    while hasattr(kind, "types"):
        kind = kind.types[0]
    return kind


def lane_effects(effects: Coefficients, i: int) -> Coefficients:
    """Coefficients of all effects for a sample: the point itself, or entry i of a table."""
    return effect_point(effects, i)


@specialise(lane_effects)
def _lane_effects(effects: Any, i: types.Type) -> Callable[..., Any]:
    present = [kind for kind in effects.types if not isinstance(kind, types.NoneType)]
    if present and isinstance(_first_number(present[0]), types.Array):

        def pick(effects: Coefficients, i: int) -> Coefficients:
            return effect_point(effects, i)

        return pick
    return lambda effects, i: effects
