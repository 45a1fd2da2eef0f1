"""Features of the motion that remember: means that fade, and what follows from them.

`mean_1s(x)` is x through a first-order lag of 1 s: the mean over the past, of which what is older counts less. A load
that drains a supply, motors that warm, a servo whose answer depends on where it comes from and rubber that gives way
all depend on what was before. A model with such a feature has its means in its state; before a drive began nothing was.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disco_hw.jit import cast_like, scalar_function, specialise

Array = NDArray[np.float64]
Feature = Callable[..., Any]
# Below such a difference of a command from its mean its direction fades out.
_STEADY_RAD_S = 0.1


@scalar_function
def forget(values: Any) -> None:
    """Set all of a buffer of means to nothing; None if there is none."""
    if values is None:
        return
    for n in range(values.size):
        values[n] = 0.0


@dataclass(frozen=True, slots=True)
class Remembered:
    """A feature with a memory: `of` the motion is averaged, older than `time_s` (s) counts little, and `feature` gets
    the motion and that mean over a step, in which the motion stays as it is.
    """

    of: Feature
    time_s: float
    feature: Feature

    def follows(self, step_s: float) -> tuple[float, float]:
        """How much of its way to `of` the mean goes in a step: by its end, and in the mean over it."""
        gone = -math.expm1(-step_s / self.time_s)
        return gone, 1.0 - gone * self.time_s / step_s

    def at_nodes(self, step_s: float, *motion: Array) -> Array:
        """The feature of a motion that is known all along, each (M, ...), in steps of `step_s`; nothing was before."""
        from scipy.signal import lfilter  # noqa: PLC0415  (slow to import, and no robot that drives needs it)

        by_end, over_step = self.follows(step_s)
        signal = np.asarray(self.of(*motion))
        after = lfilter([by_end], [1.0, by_end - 1.0], signal, axis=0)
        before = np.concatenate([np.zeros_like(after[:1]), after[:-1]])
        return np.asarray(self.feature(*motion, before + over_step * (signal - before)))


def _direction(difference: Any) -> Any:
    width = cast_like(_STEADY_RAD_S, difference)
    return difference * abs(difference) / (difference * difference + width * width)


# Written for scalars and arrays; in compiled code, where it stands for itself.
specialise(_direction)(lambda _: _direction)


# Of a wheel's command u and that of the other wheel (rad/s).
COMMAND_MEMORIES: Mapping[str, Remembered] = MappingProxyType(
    {
        f"u mean_{time_s:g}s(|u| + |u_other|)": Remembered(
            lambda u, other: abs(u) + abs(other), time_s, lambda u, other, mean: u * mean
        )
        for time_s in (0.3, 1.0, 3.0)
    }
    | {"u mean_30s(u^2)": Remembered(lambda u, other: u * u, 30.0, lambda u, other, mean: u * mean)}
    | {
        f"sign(u - mean_{time_s:g}s(u))": Remembered(
            lambda u, other: u, time_s, lambda u, other, mean: _direction(u - mean)
        )
        for time_s in (0.3, 1.0, 3.0)
    }
)
# Of forward speed v (m/s) and yaw rate w (rad/s); the mean is of one of them.
BODY_MEMORIES: Mapping[str, Mapping[str, Remembered]] = MappingProxyType(
    {
        "v_x": {
            f"(v - mean_{time_s:g}s(v))": Remembered(lambda v, w: v, time_s, lambda v, w, mean: v - mean)
            for time_s in (0.3, 1.0, 3.0)
        },
        "v_y": {},
        "omega": {
            f"(omega - mean_{time_s:g}s(omega))": Remembered(lambda v, w: w, time_s, lambda v, w, mean: w - mean)
            for time_s in (0.3, 1.0, 3.0)
        },
    }
)


def of_wheels(memory: Remembered, left_rad_s: float, right_rad_s: float) -> float:
    """What a memory of the body averages of wheel speeds: their sum, or right minus left (rad/s)."""
    return float(memory.of(left_rad_s + right_rad_s, right_rad_s - left_rad_s))
