"""Terms without a name: a feature of the motion, times a number, added to a command or to a velocity of the body.

What a log shows to be missing and no named effect explains becomes such a term, written as its equation, for example
`v_x += k v^3`. Terms stand in a model's list of effects; a model that has none compiles to nothing of this file.
"""

from __future__ import annotations

import re
from collections import namedtuple
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from disco_hw.effects import Channel, Effect, Parameter, Stage
from disco_hw.effects.registry import REGISTRY
from disco_hw.jit import cast_like, scalar_function, specialise
from disco_hw.model.coefficients import Base, TermCoefficients, Terms

Array = NDArray[np.float64]
Feature = Callable[..., Any]

COMMAND = "command"
BODY_TARGETS = ("v_x", "v_y", "omega")
# Below such a wheel speed, forward speed and yaw rate the sign of a motion fades out.
_REST_RAD_S = 0.05
_REST_M_S = 0.02
_REST_YAW_RAD_S = 0.05


def _sign(x: float, rest: float) -> float:
    width = cast_like(rest, x)
    return x * abs(x) / (x * x + width * width)


def _soft(x: float, rate: float) -> float:
    return x / (cast_like(1.0, x) + cast_like(rate, x) * abs(x))


def _per_100(t: float) -> float:
    return cast_like(0.01, t) * t


# Written for scalars and arrays; in compiled code, where these stand for themselves.
for _shared in (_sign, _soft, _per_100):
    specialise(_shared)(lambda *_, shared=_shared: shared)


# Of a wheel's command u and that of the other wheel (rad/s), at a time t (s). Written for scalars and arrays.
COMMAND_FEATURES: Mapping[str, Feature] = MappingProxyType(
    {
        "u |u|": lambda u, other, t: u * abs(u),
        "u^3": lambda u, other, t: u * u * u,
        "sign(u)": lambda u, other, t: _sign(u, _REST_RAD_S),
        "|u|": lambda u, other, t: abs(u),
        "u^2": lambda u, other, t: u * u,
        "|u_other| sign(u)": lambda u, other, t: abs(other) * _sign(u, _REST_RAD_S),
        "u_other": lambda u, other, t: other,
        "u_other |u|": lambda u, other, t: other * abs(u),
        "|u_other| u": lambda u, other, t: abs(other) * u,
        "u_other^2 sign(u)": lambda u, other, t: other * other * _sign(u, _REST_RAD_S),
        "|u - u_other| sign(u)": lambda u, other, t: abs(u - other) * _sign(u, _REST_RAD_S),
        "u / (1 + |u|)": lambda u, other, t: _soft(u, 1.0),
        "t/100 u": lambda u, other, t: _per_100(t) * u,
        "t/100 sign(u)": lambda u, other, t: _per_100(t) * _sign(u, _REST_RAD_S),
    }
)
# Of forward speed v (m/s), yaw rate w (rad/s) and acceleration a (m/s^2) of equal wheels without slip, at a time t (s).
BODY_FEATURES: Mapping[str, Feature] = MappingProxyType(
    {
        "v": lambda v, w, a, t: v,
        "|v|": lambda v, w, a, t: abs(v),
        "v |v|": lambda v, w, a, t: v * abs(v),
        "v^2": lambda v, w, a, t: v * v,
        "v^3": lambda v, w, a, t: v * v * v,
        "omega": lambda v, w, a, t: w,
        "|omega|": lambda v, w, a, t: abs(w),
        "omega |omega|": lambda v, w, a, t: w * abs(w),
        "omega^2": lambda v, w, a, t: w * w,
        "omega^3": lambda v, w, a, t: w * w * w,
        "sign(omega)": lambda v, w, a, t: _sign(w, _REST_YAW_RAD_S),
        "sign(v)": lambda v, w, a, t: _sign(v, _REST_M_S),
        "omega / (2 + 5 |omega|)": lambda v, w, a, t: cast_like(0.5, w) * _soft(w, 2.5),
        "v omega": lambda v, w, a, t: v * w,
        "v |omega|": lambda v, w, a, t: v * abs(w),
        "|v| omega": lambda v, w, a, t: abs(v) * w,
        "v^2 omega": lambda v, w, a, t: v * v * w,
        "v omega^2": lambda v, w, a, t: v * w * w,
        "a": lambda v, w, a, t: a,
        "|v| a": lambda v, w, a, t: abs(v) * a,
        "v |a|": lambda v, w, a, t: v * abs(a),
        "omega a": lambda v, w, a, t: w * a,
        "t/100 v": lambda v, w, a, t: _per_100(t) * v,
        "t/100 omega": lambda v, w, a, t: _per_100(t) * w,
    }
)


def term_name(target: str, feature: str) -> str:
    """Name of the term in model files and reports: its equation."""
    return f"{target} += k {feature}"


def _nothing_plain() -> None:
    """`disco_hw.model.plain` has the features itself."""


def _coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """k and steps a second, each (L,)."""
    return values[:, 0], np.full(values.shape[0], 1.0 / step_s)


@dataclass(frozen=True, slots=True)
class GenericTerm:
    """A term: `target` of `COMMAND` and `BODY_TARGETS` gains k times the feature."""

    target: str
    feature: str

    @property
    def name(self) -> str:
        """Its equation."""
        return term_name(self.target, self.feature)

    @property
    def effect(self) -> Effect:
        """The term as an effect of a model; k is in SI units."""
        return Effect(
            name=self.name,
            channel=Channel.COMMAND_TO_WHEEL if self.target == COMMAND else Channel.WHEEL_TO_BODY,
            stage=Stage.TERMS,
            parameters=(Parameter("k", "SI", -np.inf, np.inf, 0.0),),
            plain=_nothing_plain,
            coefficients=_coefficients,
            may_turn_more=self.target == "omega",
            excitation="the drive in which it was found",
            script="excite",
            sentence=f"{self.target} += {{k:.4g}} {self.feature}",
        )

    def rescaled(self, radius_ratio: float, axial_ratio: float) -> float:
        """Factor of k if the speeds in it are to be those of other wheels, with `new / old` radius and axial distance.

        Good for features that are powers; those that level off keep their number.
        """
        if self.target == COMMAND:
            return 1.0
        forward = (
            len(re.findall(r"\bv\b|\ba\b", self.feature)) + 1 * ("v^2" in self.feature) + 2 * ("v^3" in self.feature)
        )
        turning = self.feature.count("omega") + 1 * ("omega^2" in self.feature) + 2 * ("omega^3" in self.feature)
        if "sign" in self.feature or "/ (" in self.feature:
            return 1.0
        return float(radius_ratio ** -(forward + turning) * axial_ratio**turning)


TERMS: Mapping[str, GenericTerm] = MappingProxyType(
    {
        term.name: term
        for target, features in ((COMMAND, COMMAND_FEATURES), *((axis, BODY_FEATURES) for axis in BODY_TARGETS))
        for term in (GenericTerm(target, feature) for feature in features)
    }
)


_TERM_EFFECTS: Mapping[str, Effect] = MappingProxyType({name: term.effect for name, term in TERMS.items()})


def effect_of(name: str) -> Effect:
    """A named effect or a term; raises KeyError for what is neither."""
    return REGISTRY[name] if name in REGISTRY else _TERM_EFFECTS[name]


def _entry_type(name: str) -> Any:
    kind: Any = namedtuple
    made = kind("Term" + "".join(f"_{ord(c):x}" if not c.isalnum() else c for c in name), ("k", "per_s"))
    made.__module__ = __name__
    return made


# A type for every term: the compiler sees in the types alone which terms a model has.
_ENTRIES: Mapping[str, Any] = MappingProxyType({name: _entry_type(name) for name in TERMS})
_NAME_OF: Mapping[Any, str] = MappingProxyType({kind: name for name, kind in _ENTRIES.items()})
# Compiled code that is kept on disk finds its types by their names in this module.
globals().update({kind.__name__: kind for kind in _ENTRIES.values()})
_COMPILED: Mapping[str, Any] = MappingProxyType(
    {
        name: scalar_function((COMMAND_FEATURES if term.target == COMMAND else BODY_FEATURES)[term.feature])
        for name, term in TERMS.items()
    }
)


def table_entry(name: str, columns: tuple[NDArray[np.floating], ...]) -> TermCoefficients:
    """A term's coefficients, arrays (L,), in the form that the step takes."""
    made: TermCoefficients = _ENTRIES[name](*columns)
    return made


def add_to_commands(left: float, right: float, time_s: float, terms: Terms | None) -> tuple[float, float]:
    """Both commands (rad/s) with the terms that act on them."""
    if terms is None:
        return left, right
    new_left, new_right = left, right
    for term in terms:
        feature = COMMAND_FEATURES[TERMS[_NAME_OF[type(term)]].feature]
        new_left = new_left + term.k * feature(left, right, time_s)
        new_right = new_right + term.k * feature(right, left, time_s)
    return new_left, new_right


# What is overloaded is chosen by numba's types; those of tuples have fields that its annotations do not know.
@specialise(add_to_commands)
def _add_to_commands(left: types.Type, right: types.Type, time_s: types.Type, terms: Any) -> Callable[..., Any]:
    if isinstance(terms, types.NoneType):
        return lambda left, right, time_s, terms: (left, right)
    scope, lines = {}, ["new_left, new_right = left, right"]
    for n, kind in enumerate(terms.types):
        scope[f"feature{n}"] = _COMPILED[_NAME_OF[kind.instance_class]]
        lines += [
            f"new_left = new_left + terms[{n}].k * feature{n}(left, right, time_s)",
            f"new_right = new_right + terms[{n}].k * feature{n}(right, left, time_s)",
        ]
    return _made("add_to_commands", "left, right, time_s, terms", [*lines, "return new_left, new_right"], scope)


@scalar_function
def _plus(lateral: float | None, more: float) -> float:
    if lateral is None:
        return more
    return lateral + more


def add_to_velocity(
    forward: float, lateral: float | None, turn: float, wheel_sum: float, difference: float, change: float,
    time_s: float, base: Base, terms: Terms | None,
) -> tuple[float, float | None, float]:  # fmt: skip
    """Forward and lateral speed (m/s) and half the yaw rate (rad/s) with the terms; wheels as for `body_velocity`."""
    if terms is None:
        return forward, lateral, turn
    v, w = base.half_radius_m * wheel_sum, 2.0 * base.half_turn_ratio * difference
    for term in terms:
        made = TERMS[_NAME_OF[type(term)]]
        more = term.k * BODY_FEATURES[made.feature](v, w, base.half_radius_m * change * term.per_s, time_s)
        match made.target:
            case "v_x":
                forward = forward + more
            case "v_y":
                lateral = more if lateral is None else lateral + more
            case _:
                turn = turn + 0.5 * more
    return forward, lateral, turn


@specialise(add_to_velocity)
def _add_to_velocity(
    forward: types.Type, lateral: types.Type, turn: types.Type, wheel_sum: types.Type, difference: types.Type,
    change: types.Type, time_s: types.Type, base: types.Type, terms: Any,
) -> Callable[..., Any]:  # fmt: skip
    arguments = "forward, lateral, turn, wheel_sum, difference, change, time_s, base, terms"
    if isinstance(terms, types.NoneType):
        return _made("add_to_velocity", arguments, ["return forward, lateral, turn"], {})
    scope: dict[str, Any] = {"plus": _plus, "cast_like": cast_like}
    lines = [
        "v = base.half_radius_m * wheel_sum",
        "w = (base.half_turn_ratio + base.half_turn_ratio) * difference",
        "new_forward, new_turn, lateral0 = forward, turn, lateral",
    ]
    across = 0
    for n, kind in enumerate(terms.types):
        term = TERMS[_NAME_OF[kind.instance_class]]
        scope[f"feature{n}"] = _COMPILED[term.name]
        acceleration = f"base.half_radius_m * change * terms[{n}].per_s" if _reads_change(term) else "v"
        more = f"terms[{n}].k * feature{n}(v, w, {acceleration}, time_s)"
        match term.target:
            case "v_x":
                lines.append(f"new_forward = new_forward + {more}")
            case "v_y":
                lines.append(f"lateral{across + 1} = plus(lateral{across}, {more})")
                across += 1
            case _:
                lines.append(f"new_turn = new_turn + cast_like(0.5, turn) * ({more})")
    return _made("add_to_velocity", arguments, [*lines, f"return new_forward, lateral{across}, new_turn"], scope)


def _reads_change(term: GenericTerm) -> bool:
    return re.search(r"\ba\b", term.feature) is not None


def terms_need_change(terms: Terms | None) -> bool:
    """Whether any of the body's terms depends on the acceleration; a constant to the compiler."""
    return terms is not None and any(_reads_change(TERMS[_NAME_OF[type(term)]]) for term in terms)


@specialise(terms_need_change)
def _terms_need_change(terms: Any) -> Callable[..., Any]:
    present = [] if isinstance(terms, types.NoneType) else [_NAME_OF[kind.instance_class] for kind in terms.types]
    if any(_reads_change(TERMS[name]) for name in present):
        return lambda terms: True
    return lambda terms: False


def _made(name: str, arguments: str, lines: list[str], scope: dict[str, Any]) -> Callable[..., Any]:
    """A function of these lines; a tuple of mixed types cannot be looped over in compiled code."""
    body = "\n".join(f"    {line}" for line in lines)
    exec(f"def {name}({arguments}):\n{body}", scope)
    made: Callable[..., Any] = scope[name]
    return made
