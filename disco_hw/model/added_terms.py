"""Compiled code for a model's terms without a name: what they add to a step, and the means that they remember.

A term that a model lacks leaves nothing in the machine code. Of a command's term that remembers the means of both
wheels are kept, of the body's that of the sum or the difference of the wheels' speeds, which no parameter changes.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from numba import types
from numpy.typing import NDArray

from disco_hw.jit import cast_like, compiled_only, scalar_function, specialise
from disco_hw.model.coefficients import Base, Coefficients, TermCoefficients, Terms
from disco_hw.model.terms import BODY_FEATURES, COMMAND, COMMAND_FEATURES, TERMS, Feature, GenericTerm

Means: TypeAlias = Any
"""A flat array that holds means, or None where terms remember nothing."""


def _entry_type(name: str, term: GenericTerm) -> Any:
    kind: Any = namedtuple
    memory = ("by_end", "over_step") if term.memory is not None and not term.memory.slews else ("most",)
    fields = ("k", "reach", *(("per_s",) if term.memory is None else memory))
    made = kind("Term" + "".join(f"_{ord(c):x}" if not c.isalnum() else c for c in name), fields)
    made.__module__ = __name__
    return made


# A type for every term: the compiler sees in the types alone which terms a model has.
_ENTRIES: Mapping[str, Any] = MappingProxyType({name: _entry_type(name, term) for name, term in TERMS.items()})
_NAME_OF: Mapping[Any, str] = MappingProxyType({kind: name for name, kind in _ENTRIES.items()})
# Compiled code that is kept on disk finds its types by their names in this module.
globals().update({kind.__name__: kind for kind in _ENTRIES.values()})


def _feature(term: GenericTerm) -> Feature:
    if term.memory is not None:
        return term.memory.feature
    return (COMMAND_FEATURES if term.target == COMMAND else BODY_FEATURES)[term.feature]


_COMPILED: Mapping[str, Any] = MappingProxyType({name: scalar_function(_feature(term)) for name, term in TERMS.items()})
_FOLLOWED: Mapping[str, Any] = MappingProxyType(
    {name: scalar_function(term.memory.of) for name, term in TERMS.items() if term.memory is not None}
)


def table_entry(name: str, columns: tuple[NDArray[np.floating], ...]) -> TermCoefficients:
    """Return a term's coefficients, arrays (L,), in the form that the step takes."""
    made: TermCoefficients = _ENTRIES[name](*columns)
    return made


def _terms_of(kinds: Iterable[Any]) -> list[GenericTerm]:
    return [TERMS[_NAME_OF[kind]] for kind in kinds]


def _compiled_terms(terms: Any) -> list[GenericTerm]:
    """Return the terms of a tuple, given the tuple's numba type."""
    return [] if isinstance(terms, types.NoneType) else _terms_of(kind.instance_class for kind in terms.types)


def count_means(terms: Terms | None) -> int:
    """Return the number of means that are kept for terms; a constant to the compiler."""
    return sum(term.means for term in _terms_of(map(type, terms or ())))


@specialise(count_means)
def _count_means(terms: Any) -> Callable[..., Any]:
    count = sum(term.means for term in _compiled_terms(terms))
    return lambda terms: count


def new_means(effects: Coefficients) -> NDArray[np.float64] | None:
    """Return the means (n,) of a model, of commands first, before anything was; None if it remembers nothing."""
    count = count_means(effects.command_terms) + count_means(effects.body_terms)
    return np.zeros(count) if count else None


def add_to_commands(
    left: float, right: float, time_s: float, terms: Terms | None, means: Means, at: Any, apart: Any
) -> tuple[float, float]:
    """Return both commands (rad/s) with the terms that act on them; compiled code only.

    Number n of the means that terms remember is `means[at + n * apart]`, and goes on by a step.
    """
    raise compiled_only(terms)


@scalar_function
def _within(feature: float, reach: float) -> float:
    """Return a feature no larger than the log had it in which its term was found."""
    return min(max(feature, -reach), reach)


@scalar_function
def _averaged(signal: float, entry: TermCoefficients, means: Means, at: Any) -> float:
    """Return a mean over a step in which its signal stays as it is; the mean goes on to its end."""
    before = means[at]
    means[at] = before + entry.by_end * (signal - before)
    over_step: float = before + entry.over_step * (signal - before)
    return over_step


@scalar_function
def _slewed(signal: float, most: float, means: Means, at: Any) -> float:
    """Return the mean over a step of a value that follows the signal by at most `most` a step, and move it on."""
    before = means[at]
    moved = min(max(signal - before, -most), most)
    means[at] = before + moved
    over_step: float = before + moved * (cast_like(1.0, moved) - cast_like(0.5, moved) * abs(moved) / most)
    return over_step


# What is overloaded is chosen by numba's types; those of tuples have fields that its annotations do not know.
@specialise(add_to_commands)
def _add_to_commands(
    left: types.Type, right: types.Type, time_s: types.Type, terms: Any, means: Any, at: types.Type, apart: types.Type
) -> Callable[..., Any]:
    arguments = "left, right, time_s, terms, means, at, apart"
    if isinstance(terms, types.NoneType):
        return written_out("add_to_commands", arguments, ["return left, right"], {})
    scope: dict[str, Any] = {"averaged": _averaged, "within": _within, "place": np.uintp}
    lines, place = ["new_left, new_right = left, right"], 0
    for n, term in enumerate(_compiled_terms(terms)):
        scope[f"feature{n}"] = _COMPILED[term.name]
        if term.memory is None:
            lines += [
                f"new_left = new_left + terms[{n}].k * within(feature{n}(left, right, time_s), terms[{n}].reach)",
                f"new_right = new_right + terms[{n}].k * within(feature{n}(right, left, time_s), terms[{n}].reach)",
            ]
            continue
        scope[f"of{n}"] = _FOLLOWED[term.name]
        lines += [
            f"mean_left = averaged(of{n}(left, right), terms[{n}], means, at + place({place}) * apart)",
            f"mean_right = averaged(of{n}(right, left), terms[{n}], means, at + place({place + 1}) * apart)",
            f"new_left = new_left + terms[{n}].k * within(feature{n}(left, right, mean_left), terms[{n}].reach)",
            f"new_right = new_right + terms[{n}].k * within(feature{n}(right, left, mean_right), terms[{n}].reach)",
        ]
        place += term.means
    return written_out("add_to_commands", arguments, [*lines, "return new_left, new_right"], scope)


@scalar_function
def _plus(lateral: float | None, more: float) -> float:
    if lateral is None:
        return more
    return lateral + more


def add_to_velocity(
    forward: float, lateral: float | None, turn: float, wheel_sum: float, difference: float, change: float,
    time_s: float, base: Base, terms: Terms | None, means: Means, at: Any, apart: Any,
) -> tuple[float, float | None, float]:  # fmt: skip
    """Return forward and lateral speed (m/s) and half the yaw rate (rad/s) with the terms that act on them.

    Wheels as for `body_velocity`, means as for `add_to_commands`. Compiled code only.
    """
    raise compiled_only(terms)


@specialise(add_to_velocity)
def _add_to_velocity(
    forward: types.Type, lateral: types.Type, turn: types.Type, wheel_sum: types.Type, difference: types.Type,
    change: types.Type, time_s: types.Type, base: types.Type, terms: Any, means: Any, at: types.Type, apart: types.Type,
) -> Callable[..., Any]:  # fmt: skip
    arguments = "forward, lateral, turn, wheel_sum, difference, change, time_s, base, terms, means, at, apart"
    if isinstance(terms, types.NoneType):
        return written_out("add_to_velocity", arguments, ["return forward, lateral, turn"], {})
    scope: dict[str, Any] = {
        "plus": _plus, "cast_like": cast_like, "averaged": _averaged, "slewed": _slewed, "within": _within,
        "place": np.uintp,
    }  # fmt: skip
    lines = [
        "v = base.half_radius_m * wheel_sum",
        "w = (base.half_turn_ratio + base.half_turn_ratio) * difference",
        "new_forward, new_turn, lateral0 = forward, turn, lateral",
    ]
    across = place = 0
    for n, term in enumerate(_compiled_terms(terms)):
        scope[f"feature{n}"] = _COMPILED[term.name]
        if term.memory is None:
            acceleration = f"base.half_radius_m * change * terms[{n}].per_s" if term.needs_acceleration else "v"
            feature = f"feature{n}(v, w, {acceleration}, time_s)"
        else:
            scope[f"of{n}"] = _FOLLOWED[term.name]
            slews = term.memory.slews
            follow, how = ("slewed", f"terms[{n}].most / unit") if slews else ("averaged", f"terms[{n}]")
            lines += [
                f"unit = of{n}(base.half_radius_m, base.half_turn_ratio + base.half_turn_ratio)",
                f"followed = unit * {follow}(of{n}(wheel_sum, difference), {how}, means, at + place({place}) * apart)",
            ]
            feature = f"feature{n}(v, w, followed)"
            place += term.means
        more = f"terms[{n}].k * within({feature}, terms[{n}].reach)"
        match term.target:
            case "v_x":
                lines.append(f"new_forward = new_forward + {more}")
            case "v_y":
                lines.append(f"lateral{across + 1} = plus(lateral{across}, {more})")
                across += 1
            case _:
                lines.append(f"new_turn = new_turn + cast_like(0.5, turn) * ({more})")
    return written_out("add_to_velocity", arguments, [*lines, f"return new_forward, lateral{across}, new_turn"], scope)


def terms_need_change(terms: Terms | None) -> bool:
    """Whether any of the body's terms depends on the acceleration; a constant of compiled code."""
    raise compiled_only(terms)


@specialise(terms_need_change)
def _terms_need_change(terms: Any) -> Callable[..., Any]:
    if any(term.needs_acceleration for term in _compiled_terms(terms)):
        return lambda terms: True
    return lambda terms: False


def written_out(name: str, arguments: str, lines: list[str], scope: dict[str, Any]) -> Callable[..., Any]:
    """Return a function of these lines, which compiled code calls: it cannot loop over a tuple of mixed types."""
    body = "\n".join(f"    {line}" for line in lines)
    exec(f"def {name}({arguments}):\n{body}", scope)
    made: Callable[..., Any] = scope[name]
    return made
