"""Features of terms without a name, worked out from what their names say, apart from `disco_hw.model.terms`."""

from __future__ import annotations

import math
import re

import numpy as np

from disco_hw.effects import Value

# Below these sizes a sign fades out: of a command, a yaw rate, a speed, and a command's difference from its mean.
RESTS = {"u": 0.05, "omega": 0.05, "v": 0.02, "u - mean": 0.1}
_MEMORY = re.compile(r"(?:mean_([\d.]+)s|slewed_([\d.]+))\(([^()]*)\)")


def feature(name: str, **motion: Value) -> Value:
    """The feature of a motion; `mean` is what it remembers."""
    return _evaluated(_MEMORY.sub("mean", name), motion)


def goes_in(name: str, **motion: Value) -> Value:
    """What a feature's memory follows."""
    return _evaluated(_MEMORY.search(name)[3], motion)


def over(name: str, before: Value, value: Value, step_s: float) -> Value:
    """Mean of a memory over a step, at whose start it was `before`, while `value` goes in."""
    lag_s, most, _ = _MEMORY.search(name).groups()
    if most is None:
        steps = float(lag_s) / step_s
        return value + (before - value) * steps * (1.0 - math.exp(-1.0 / steps))
    arrives = np.minimum(np.abs(value - before) / (float(most) * step_s), 1.0)
    end = after(name, before, value, step_s)
    return 0.5 * (before + end) * arrives + end * (1.0 - arrives)


def after(name: str, before: Value, value: Value, step_s: float) -> Value:
    """A memory at the end of a step, at whose start it was `before`, while `value` goes in."""
    lag_s, most, _ = _MEMORY.search(name).groups()
    if most is None:
        return value + (before - value) * math.exp(-step_s / float(lag_s))
    return np.clip(value, before - float(most) * step_s, before + float(most) * step_s)


def _evaluated(equation: str, motion: dict[str, Value]) -> Value:
    text = re.sub(r"\|([^|]+)\|", r"abs(\1)", equation).replace("^", "**")
    text = re.sub(r"sign\(([^()]+)\)", r'sign(\1, "\1")', text)
    # A space between two factors is a product.
    text = re.sub(r"(?<=[\w)]) (?=[\w(])", " * ", text)
    return eval(text, {"abs": np.abs, "sign": _sign, **motion})


def _sign(x: Value, of: str) -> Value:
    return np.sign(x) * x**2 / (x**2 + RESTS[of] ** 2)
