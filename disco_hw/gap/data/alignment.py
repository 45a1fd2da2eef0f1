"""What every search for a delay shares: pairs of samples, a robust regression on both wheels, the least of a scan."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from disco_hw.jit import kernel_function, scalar_function

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_ROUNDS = 4
# Finer than any pose is measured; keeps a log without any noise finite.
_LEAST_SQUARE = 1e-10
# A column of which the other one leaves less than this share of its square says nothing of its own.
_LEAST_OWN = 1e-12
# So closely the least of a misfit is searched: a hundredth of what a cell of the grid holds.
_CLOSE_S = 1e-4


def apart(t_s: Array, segment: Index, span_s: float) -> tuple[Index, Index]:
    """Pairs of samples of one segment that lie `span_s` apart, or little more."""
    later = np.searchsorted(t_s, t_s + span_s - 1e-9)
    first = np.flatnonzero(later < t_s.size)
    second = later[first]
    near = (segment[first] == segment[second]) & (t_s[second] - t_s[first] < 1.6 * span_s)
    return first[near], second[near]


def lowest(misfits: Callable[[Array], Array], about_s: float, step_s: float) -> tuple[float, float]:
    """Where a misfit is least within a step of a delay (s), wherever a scan's steps lie, and what it is there."""

    def at(delay_s: float) -> float:
        return min(float(misfits(np.full(1, delay_s))[0]), 1e3)

    bounds = (about_s - step_s, about_s + step_s)
    found = minimize_scalar(at, bounds=bounds, method="bounded", options={"xatol": _CLOSE_S})
    return float(found.x), float(found.fun)


@scalar_function
def projected(aa: float, ab: float, bb: float, ay: float, by: float) -> tuple[float, float]:
    """Coefficients of two columns by normal equations, `aa` not the smaller; of the second 0 where they are alike."""
    if aa == 0.0:
        return 0.0, 0.0
    own = bb - ab * ab / aa
    second = (by - ab * ay / aa) / own if own > _LEAST_OWN * bb else 0.0
    return (ay - ab * second) / aa, second


@kernel_function
def misfit_of(difference: Array, total: Array, measured: Array) -> float:
    """Minus the log likelihood per sample of a robust regression on two columns (n,) whose variance is unknown."""
    count = measured.shape[0]
    left = np.zeros(count)
    limit = math.inf
    for _ in range(_ROUNDS):
        aa = ab = bb = ay = by = 0.0
        for k in range(count):
            a, b, y = difference[k], total[k], measured[k]
            weight = min(1.0, limit / max(left[k], 1e-12))
            aa += weight * a * a
            ab += weight * a * b
            bb += weight * b * b
            ay += weight * a * y
            by += weight * b * y
        if aa >= bb:
            of_a, of_b = projected(aa, ab, bb, ay, by)
        else:
            of_b, of_a = projected(bb, ab, aa, by, ay)
        for k in range(count):
            left[k] = abs(measured[k] - of_a * difference[k] - of_b * total[k])
        limit = 2.0 * 1.4826 * np.median(left) + 1e-9
    loss = 0.0
    for k in range(count):
        loss += left[k] * left[k] if left[k] < limit else limit * (2.0 * left[k] - limit)
    return 0.5 * math.log(loss / count + _LEAST_SQUARE)
