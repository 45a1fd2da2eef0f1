"""The features of terms without a name in numpy, written apart from `disco_hw.model.terms`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from disco_hw.effects import Value


def _sign(x: Value, rest: float) -> Value:
    """Return the sign of x, faded out below `rest`."""
    return np.sign(x) * x**2 / (x**2 + rest**2)


COMMAND_FEATURES: Mapping[str, Callable[[Value, Value, float], Value]] = {
    "u |u|": lambda u, other, t: np.sign(u) * u**2,
    "u^3": lambda u, other, t: u**3,
    "sign(u)": lambda u, other, t: _sign(u, 0.05),
    "|u|": lambda u, other, t: np.abs(u),
    "u^2": lambda u, other, t: u**2,
    "|u_other| sign(u)": lambda u, other, t: np.abs(other) * _sign(u, 0.05),
    "u_other": lambda u, other, t: other,
    "u_other |u|": lambda u, other, t: other * np.abs(u),
    "|u_other| u": lambda u, other, t: np.abs(other) * u,
    "u_other^2 sign(u)": lambda u, other, t: other**2 * _sign(u, 0.05),
    "|u - u_other| sign(u)": lambda u, other, t: np.abs(u - other) * _sign(u, 0.05),
    "u / (1 + |u|)": lambda u, other, t: u / (1.0 + np.abs(u)),
    "t/100 u": lambda u, other, t: t / 100.0 * u,
    "t/100 sign(u)": lambda u, other, t: t / 100.0 * _sign(u, 0.05),
}
BODY_FEATURES: Mapping[str, Callable[[Value, Value, Value, float], Value]] = {
    "v": lambda v, w, a, t: v,
    "|v|": lambda v, w, a, t: np.abs(v),
    "v |v|": lambda v, w, a, t: np.sign(v) * v**2,
    "v^2": lambda v, w, a, t: v**2,
    "v^3": lambda v, w, a, t: v**3,
    "omega": lambda v, w, a, t: w,
    "|omega|": lambda v, w, a, t: np.abs(w),
    "omega |omega|": lambda v, w, a, t: np.sign(w) * w**2,
    "omega^2": lambda v, w, a, t: w**2,
    "omega^3": lambda v, w, a, t: w**3,
    "sign(omega)": lambda v, w, a, t: _sign(w, 0.05),
    "sign(v)": lambda v, w, a, t: _sign(v, 0.02),
    "omega / (2 + 5 |omega|)": lambda v, w, a, t: w / (2.0 + 5.0 * np.abs(w)),
    "v omega": lambda v, w, a, t: v * w,
    "v |omega|": lambda v, w, a, t: v * np.abs(w),
    "|v| omega": lambda v, w, a, t: np.abs(v) * w,
    "v^2 omega": lambda v, w, a, t: v**2 * w,
    "v omega^2": lambda v, w, a, t: v * w**2,
    "a": lambda v, w, a, t: a,
    "|v| a": lambda v, w, a, t: np.abs(v) * a,
    "v |a|": lambda v, w, a, t: v * np.abs(a),
    "omega a": lambda v, w, a, t: w * a,
    "t/100 v": lambda v, w, a, t: t / 100.0 * v,
    "t/100 omega": lambda v, w, a, t: t / 100.0 * w,
}


@dataclass(frozen=True)
class _Memory:
    """A lag (s), what goes into it, and the feature of the motion and what comes out, in the mean over a step."""

    time_s: float
    goes_in: Callable[..., Value]
    feature: Callable[..., Value]

    def over(self, before: Value, value: Value, step_s: float) -> Value:
        """Mean of what comes out over a step, at whose start it was `before`, while `value` goes in."""
        lag = self.time_s / step_s
        return value + (before - value) * lag * (1.0 - math.exp(-1.0 / lag))

    def after(self, before: Value, value: Value, step_s: float) -> Value:
        """Return the memory at the end of a step at whose start it was `before`, under a constant input."""
        return value + (before - value) * math.exp(-step_s / self.time_s)


@dataclass(frozen=True)
class _Slewed:
    """Memory that follows its input by at most `most` a second (m/s^2), with the feature that uses it."""

    most: float
    goes_in: Callable[..., Value]
    feature: Callable[..., Value]

    def over(self, before: Value, value: Value, step_s: float) -> Value:
        """Mean of what comes out over a step, at whose start it was `before`: on its way, and there for the rest."""
        way = value - before
        arrives = np.minimum(np.abs(way) / (self.most * step_s), 1.0)
        end = self.after(before, value, step_s)
        return 0.5 * (before + end) * arrives + end * (1.0 - arrives)

    def after(self, before: Value, value: Value, step_s: float) -> Value:
        """Return the memory at the end of a step at whose start it was `before`, under a constant input."""
        return np.clip(value, before - self.most * step_s, before + self.most * step_s)


_Remembering = _Memory | _Slewed

_SHORT_TO_LONG = {"0.3": 0.3, "1": 1.0, "3": 3.0}
COMMAND_MEMORIES: Mapping[str, _Remembering] = {
    **{
        f"u mean_{name}s(|u| + |u_other|)": _Memory(
            time_s, lambda u, other: np.abs(u) + np.abs(other), lambda u, other, mean: mean * u
        )
        for name, time_s in _SHORT_TO_LONG.items()
    },
    **{
        f"(u - mean_{name}s(u))": _Memory(time_s, lambda u, other: u, lambda u, other, mean: u - mean)
        for name, time_s in (("0.3", 0.3), ("1", 1.0))
    },
    "u mean_30s(u^2)": _Memory(30.0, lambda u, other: u**2, lambda u, other, mean: mean * u),
    **{
        f"sign(u - mean_{name}s(u))": _Memory(time_s, lambda u, other: u, lambda u, other, mean: _sign(u - mean, 0.1))
        for name, time_s in _SHORT_TO_LONG.items()
    },
}
BODY_MEMORIES: Mapping[str, _Remembering] = {
    **{
        f"(v - mean_{name}s(v))": _Memory(time_s, lambda v, w: v, lambda v, w, mean: v - mean)
        for name, time_s in _SHORT_TO_LONG.items()
    },
    **{
        f"(omega - mean_{name}s(omega))": _Memory(time_s, lambda v, w: w, lambda v, w, mean: w - mean)
        for name, time_s in _SHORT_TO_LONG.items()
    },
    **{
        f"(v - slewed_{most}(v))": _Slewed(float(most), lambda v, w: v, lambda v, w, slewed: v - slewed)
        for most in ("1", "1.25", "1.6", "2", "2.5", "3.2", "4", "5", "6.3", "8")
    },
}
