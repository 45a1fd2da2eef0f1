"""Terms without a name: a feature of the motion, times a number, added to a command or to a velocity of the body.

What a log shows to be missing and no named effect explains becomes such a term, written as its equation, for example
`v_x += k v^3`. Terms stand in a model's list of effects. What the compiled step makes of them is in
`disco_hw.model.added_terms`.

Nothing says what such a form becomes beyond the motion that showed it: a cubic that was found below 0.3 rad/s is six
times as much at 0.6. So a term has a `reach`, the largest size that its feature had in the log, and stays there.

Some remember: `mean_1s(x)` is x through a first-order lag of 1 s, the mean over the past, of which what is older counts
less; `slewed_5(v)` follows v by at most 5 m/s^2. A load that drains a supply, motors that warm, a servo whose answer
depends on where it comes from, rubber that gives way and tyres that slip all depend on what was before. A model with
such a feature has what it remembers in its state; before a drive began nothing was.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects import Channel, Effect, Parameter, Stage
from disco_hw.effects.registry import REGISTRY
from disco_hw.jit import cast_like, kernel_function, scalar_function, specialise

Array = NDArray[np.float64]
Feature = Callable[..., Any]

COMMAND = "command"
BODY_TARGETS = ("v_x", "v_y", "omega")
# Below such a wheel speed, forward speed and yaw rate the sign of a motion fades out.
_REST_RAD_S = 0.05
_REST_M_S = 0.02
_REST_YAW_RAD_S = 0.05
# Below such a difference of a command from its mean its direction fades out.
_STEADY_RAD_S = 0.1


@scalar_function
def clear_memory(values: Any) -> None:
    """Set all of a buffer of means to nothing; None if there is none."""
    if values is None:
        return
    for n in range(values.size):
        values[n] = 0.0


@dataclass(frozen=True, slots=True)
class Remembered:
    """Feature with a memory: `of` the motion is followed, and `feature` gets the motion and its memory.

    The memory is that over a step, in which the motion stays as it is.
    """

    of: Feature
    time_s: float
    feature: Feature
    most: float = math.inf

    @property
    def slews(self) -> bool:
        """Whether the memory follows at a limited rate instead of as a mean."""
        return self.most < math.inf

    def follows(self, step_s: float) -> tuple[float, float]:
        """Return the shares of its way to `of` that the mean goes in a step: by its end, and in the mean over it."""
        gone = -math.expm1(-step_s / self.time_s)
        return gone, 1.0 - gone * self.time_s / step_s

    def after(self, before: float, signal: float, for_s: float, unit: float) -> float:
        """Return the memory after a constant signal of duration `for_s`, in signals of which one is `unit` (m/s)."""
        if self.slews:
            most = self.most * max(for_s, 0.0) / unit
            return before + min(max(signal - before, -most), most)
        return signal + (before - signal) * math.exp(-max(for_s, 0.0) / self.time_s)

    def at_nodes(self, step_s: float, *motion: Array) -> Array:
        """Return the feature of a motion that is known all along, each (M, ...), in steps of `step_s`.

        Nothing was before.
        """
        from scipy.signal import lfilter  # noqa: PLC0415  (slow to import, and no robot that drives needs it)

        signal = np.asarray(self.of(*motion))
        if self.slews:
            over = np.empty_like(signal)
            _slew(signal, self.most * step_s, over)
            return np.asarray(self.feature(*motion, over))
        by_end, over_step = self.follows(step_s)
        after = lfilter([by_end], [1.0, by_end - 1.0], signal, axis=0)
        before = np.concatenate([np.zeros_like(after[:1]), after[:-1]])
        return np.asarray(self.feature(*motion, before + over_step * (signal - before)))


@kernel_function
def _slew(signal: Array, most: float, over: Array) -> None:
    """Fill `over` (M,) with the mean, over each step, of a value that follows the signal by at most `most` a step."""
    now = 0.0
    for k in range(signal.shape[0]):
        moved = min(max(signal[k] - now, -most), most)
        over[k] = now + moved * (1.0 - 0.5 * abs(moved) / most)
        now += moved


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


# Of a wheel's command u and that of the other wheel (rad/s).
COMMAND_MEMORIES: Mapping[str, Remembered] = MappingProxyType(
    {
        f"u mean_{time_s:g}s(|u| + |u_other|)": Remembered(
            lambda u, other: abs(u) + abs(other), time_s, lambda u, other, mean: u * mean
        )
        for time_s in (0.3, 1.0, 3.0)
    }
    | {
        f"(u - mean_{time_s:g}s(u))": Remembered(lambda u, other: u, time_s, lambda u, other, mean: u - mean)
        for time_s in (0.3, 1.0)
    }
    | {"u mean_30s(u^2)": Remembered(lambda u, other: u * u, 30.0, lambda u, other, mean: u * mean)}
    | {
        f"sign(u - mean_{time_s:g}s(u))": Remembered(
            lambda u, other: u, time_s, lambda u, other, mean: _sign(u - mean, _STEADY_RAD_S)
        )
        for time_s in (0.3, 1.0, 3.0)
    }
)
# Of forward speed v (m/s) and yaw rate w (rad/s); the mean is of one of them. Tyres push a robot with no more than they
# grip: its speed follows the wheels' by so much a second (m/s^2).
BODY_MEMORIES: Mapping[str, Mapping[str, Remembered]] = MappingProxyType(
    {
        "v_x": {
            f"(v - mean_{time_s:g}s(v))": Remembered(lambda v, w: v, time_s, lambda v, w, mean: v - mean)
            for time_s in (0.3, 1.0, 3.0)
        }
        | {
            f"(v - slewed_{most:g}(v))": Remembered(lambda v, w: v, 0.0, lambda v, w, slewed: v - slewed, most)
            for most in (1.0, 1.25, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.3, 8.0)
        },
        "v_y": {},
        "omega": {
            f"(omega - mean_{time_s:g}s(omega))": Remembered(lambda v, w: w, time_s, lambda v, w, mean: w - mean)
            for time_s in (0.3, 1.0, 3.0)
        },
    }
)


def of_wheels(memory: Remembered, left_rad_s: float, right_rad_s: float) -> float:
    """Return the wheel speeds' quantity (rad/s) that a memory of the body averages: their sum, or right minus left."""
    return float(memory.of(left_rad_s + right_rad_s, right_rad_s - left_rad_s))


def term_name(target: str, feature: str) -> str:
    """Name of the term in model files and reports: its equation."""
    return f"{target} += k {feature}"


def _nothing_plain() -> None:
    """Terms have features instead, which `disco_hw.model.plain` adds up."""


def _coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """k, reach and steps a second, each (L,)."""
    return values[:, 0], values[:, 1], np.full(values.shape[0], 1.0 / step_s)


def _following(memory: Remembered, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Return k, reach, and how the mean follows; each (L,).

    It follows by the end of a step and in the mean over it, or by how much at most in a step (m/s).
    """
    if memory.slews:
        return values[:, 0], values[:, 1], np.full(values.shape[0], memory.most * step_s)
    return values[:, 0], values[:, 1], *(np.full(values.shape[0], part) for part in memory.follows(step_s))


REACH = Parameter("reach", "SI", 0.0, 1e9, 1e9, neutral=1e9)
"""The size at which a term's feature stays, however fast the robot moves; neutral where no robot gets to."""


@dataclass(frozen=True, slots=True)
class GenericTerm:
    """Term of the model without a name: `target` gains k times the feature, which stays within its reach."""

    target: str
    feature: str

    @property
    def name(self) -> str:
        """Name of the term, which is its equation."""
        return term_name(self.target, self.feature)

    @property
    def memory(self) -> Remembered | None:
        """Memory that the feature uses; None for a term of present values alone."""
        return (COMMAND_MEMORIES if self.target == COMMAND else BODY_MEMORIES[self.target]).get(self.feature)

    def describe(self, k: float) -> str | None:
        """Describe a robot that shows this term with the factor `k`; None where only the equation is known."""
        if self.memory is None:
            return None
        if self.target == COMMAND and self.feature.startswith("(u - "):
            what = "overshoot" if k > 0.0 else "at first fall short of"
            fades = f"which fades with a time constant of {self.memory.time_s:g} s"
            return f"the wheels {what} a change of their command by up to {abs(k):.0%} of it, {fades}"
        if not self.memory.slews or k > -0.5:
            return None
        return f"tyres slip: the robot follows its wheels by about {self.memory.most:g} m/s^2 at most"

    @property
    def means(self) -> int:
        """Number of means that are kept for it: one for each wheel's command, or one of the body."""
        return 0 if self.memory is None else 2 if self.target == COMMAND else 1

    @property
    def needs_acceleration(self) -> bool:
        """Whether its feature is of the acceleration."""
        return re.search(r"\ba\b", self.feature) is not None

    @property
    def effect(self) -> Effect:
        """The term as an effect of a model; k and reach are in SI units."""
        return Effect(
            name=self.name,
            channel=Channel.COMMAND_TO_WHEEL if self.target == COMMAND else Channel.WHEEL_TO_BODY,
            stage=Stage.TERMS,
            parameters=(Parameter("k", "SI", -np.inf, np.inf, 0.0), REACH),
            plain=_nothing_plain,
            coefficients=_coefficients if self.memory is None else partial(_following, self.memory),
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
        if self.memory is not None:
            return float(radius_ratio**-1.0 * axial_ratio ** self.feature.startswith("(omega"))
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
        for target, features in (
            (COMMAND, (*COMMAND_FEATURES, *COMMAND_MEMORIES)),
            *((axis, (*BODY_FEATURES, *BODY_MEMORIES[axis])) for axis in BODY_TARGETS),
        )
        for term in (GenericTerm(target, feature) for feature in features)
    }
)


_TERM_EFFECTS: Mapping[str, Effect] = MappingProxyType({name: term.effect for name, term in TERMS.items()})


def effect_of(name: str) -> Effect:
    """Return a named effect or a term; raises KeyError for what is neither."""
    return REGISTRY[name] if name in REGISTRY else _TERM_EFFECTS[name]


def memories_of(names: Iterable[str]) -> tuple[tuple[Remembered, ...], tuple[Remembered, ...]]:
    """Return the memories of a model's terms, of commands and of the body, in the order of their means."""
    remembering = [term for term in (TERMS.get(name) for name in names) if term is not None and term.memory is not None]
    of_commands, of_body = (
        tuple(term.memory for term in remembering if term.memory is not None and (term.target == COMMAND) is has_memory)
        for has_memory in (True, False)
    )
    return of_commands, of_body
