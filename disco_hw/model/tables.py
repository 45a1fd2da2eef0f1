"""Picking one parameter point out of tables of coefficients, inside compiled code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import types

from disco_hw.model.effects import REGISTRY
from disco_hw.model.jit import scalar_function, specialise
from disco_hw.model.step import Base, Effects


@scalar_function
def base_point(base: Any, i: int) -> Any:
    """Base coefficients of point i."""
    return Base(base.half_radius_m[i], base.half_turn_ratio[i], base.x_icr_m[i])


def entry(table: Any, i: int) -> Any:
    """Coefficients of one effect at point i: a tuple of numbers, or None where the effect is absent."""
    return None if table is None else tuple(column[i] for column in table)


@specialise(entry)
def _entry(table: Any, i: Any) -> Callable[..., Any] | None:
    if isinstance(table, types.NoneType):
        return lambda table, i: None
    picks: dict[int, Callable[..., Any]] = {
        1: lambda table, i: (table[0][i],),
        2: lambda table, i: (table[0][i], table[1][i]),
        3: lambda table, i: (table[0][i], table[1][i], table[2][i]),
        4: lambda table, i: (table[0][i], table[1][i], table[2][i], table[3][i]),
    }
    return picks[len(table)]


def effect_point(effects: Any, i: int) -> Any:
    """Coefficients of all effects at point i."""
    return Effects(*(entry(table, i) for table in effects))


@specialise(effect_point)
def _effect_point(effects: Any, i: Any) -> Callable[..., Any]:
    # A tuple of mixed types cannot be looped over in compiled code, so the call is written out from the registry.
    picks = ", ".join(f"entry(effects.{name}, i)" for name in REGISTRY)
    scope: dict[str, Any] = {"Effects": Effects, "entry": entry}
    exec(f"def pick(effects, i):\n    return Effects({picks})", scope)
    pick: Callable[..., Any] = scope["pick"]
    return pick
