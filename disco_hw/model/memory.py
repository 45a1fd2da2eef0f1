"""Features of the motion that remember: means that fade, and what follows from them.

`mean_1s(x)` is x through a first-order lag of 1 s: the mean over the past, of which what is older counts less. A load
that drains a supply, motors that warm, a servo whose answer depends on where it comes from and rubber that gives way
all depend on what was before, and none of them on the state that a step begins with.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

Array = NDArray[np.float64]
Feature = Callable[..., Any]
# Below such a difference of a command from its mean its direction fades out.
_STEADY_RAD_S = 0.1


@dataclass(frozen=True, slots=True)
class Remembered:
    """A feature with a memory: `of` the motion is averaged, older than `time_s` (s) counts little, and `feature` gets
    the motion and that mean.
    """

    of: Feature
    time_s: float
    feature: Feature

    def at_nodes(self, step_s: float, *motion: Array) -> Array:
        """The feature of a motion that is known all along, each (M, ...), in steps of `step_s`; nothing was before."""
        keep = math.exp(-step_s / self.time_s)
        mean = lfilter([1.0 - keep], [1.0, -keep], self.of(*motion), axis=0)
        return np.asarray(self.feature(*motion, mean))


def _direction(difference: Any) -> Any:
    return difference * abs(difference) / (difference * difference + _STEADY_RAD_S**2)


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
# Of forward speed v (m/s) and yaw rate w (rad/s).
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
