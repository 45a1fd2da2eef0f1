"""Encoder counts that wrap round or are set anew: found from the counts alone, and made continuous.

A counter of 8 or 16 bits jumps by its span when it overflows. The jump is recognised by what is left when the span is
taken out: the motion of the samples around it. A counter that is set to zero leaves something else, and begins a new
segment. Nothing here knows of units: counts, radians and degrees are treated alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WIDTHS_BITS = (8, 10, 12, 14, 16, 20, 24, 32)
"""Widths of counters and of absolute encoders that are in use."""
_NEIGHBOURS = 5
"""Steps whose median is the motion that is expected of the next one."""
_AMBIGUOUS_SHARE = 0.25
"""Steps longer than this share of the span could be one way or the other."""
_FIT_SHARE, _SLACK_SHARE, _CHANGE = 0.2, 0.02, 3.0
"""A wrap leaves a step within the first share of the span of what is expected, and within the second of it but for a
change by three usual steps: an outlier leaves something else."""
_FULL_SHARE = 0.8
"""Counts of a counter that wraps all the time fill this share of its span."""
_OFTEN = 3
"""Without a usual width, so many jumps of one size are a span."""
_SAME_SHARE = 0.05
"""Jumps that differ by less than this share of themselves are of one size."""
_TOLERANCE_SHARE, _TOLERANCE_COUNTS = 0.005, 2.0
"""A usual span this near to the size of the jumps is theirs: 4096 is not 4000."""


@dataclass(frozen=True, slots=True)
class Unwrapped:
    """Counts made continuous: `values` (N,); `span` that was taken out `wraps` times, 0 if the counts did not wrap.

    `fault` says why the counts cannot be made continuous, and is empty if they can.
    """

    values: Array
    span: float = 0.0
    wraps: int = 0
    fault: str = ""


def unwrap_counter(t_s: Array, values: Array, spans: Sequence[float] = (), *, unit: str = "counts") -> Unwrapped:
    """Make a counter continuous that jumps by a constant span whenever it overflows.

    `t_s` (N,) increases. `spans` are tried beside those of the usual widths; any other span has to show in three jumps
    of one size. Counts that fit no span are returned as they are.
    """
    steps = np.diff(values)
    reach = float(np.ptp(values)) if values.size else 0.0
    if steps.size < _NEIGHBOURS or reach == 0.0 or np.abs(steps).max() <= 0.5 * reach:
        return Unwrapped(values)
    dt_s = np.maximum(np.diff(t_s), 1e-9)
    usual = sorted({float(2**bits) for bits in WIDTHS_BITS} | {float(span) for span in spans})
    possible = [span for span in usual if reach < span <= 2.0 * reach]
    measured = _span_of_jumps(dt_s, steps, reach, unit == "counts")
    if measured is not None:
        size, tolerance = measured
        possible = [span for span in possible if abs(span - size) <= tolerance] + [size]
    for span in possible:
        found = _taken_out(dt_s, steps, values, span)
        if found is not None:
            return found
    return Unwrapped(values, fault=_too_fast(steps, reach, usual, unit))


def _taken_out(dt_s: Array, steps: Array, values: Array, span: float) -> Unwrapped | None:
    """Take a span out of the steps (N - 1,) of some values (N,); None if what is left is not the motion around it."""
    shortest = steps - span * np.round(steps / span)
    expected = _expected(dt_s, shortest, np.abs(steps) <= 0.5 * span)
    turns = np.round((steps - expected) / span)
    left = steps - span * turns
    wraps = turns != 0.0
    if not wraps.any():
        return None
    motion = np.maximum(np.abs(expected), np.quantile(np.abs(shortest), 0.9))
    fits = np.abs(left - expected) <= np.minimum(_FIT_SHARE * span, _SLACK_SHARE * span + _CHANGE * motion)
    # Jumps that leave something else are those of a counter that was set anew: they stay as they are.
    if np.count_nonzero(wraps & ~fits) > 0.2 * np.count_nonzero(wraps):
        return None
    if np.quantile(np.abs(left), 0.9) > _AMBIGUOUS_SHARE * span:
        return None
    left = np.where(wraps & ~fits, steps, left)
    return Unwrapped(
        np.concatenate([values[:1], values[0] + np.cumsum(left)]), span, int(np.count_nonzero(wraps & fits))
    )


def _expected(dt_s: Array, steps: Array, usable: Mask) -> Array:
    """Steps (N,) that the rates of the neighbours let expect, the median of five of them that are usable."""
    rates = np.where(usable, steps / dt_s, np.nan)
    known = np.flatnonzero(usable)
    if not known.size:
        return np.zeros_like(steps)
    place = np.clip(
        np.searchsorted(known, np.arange(steps.size)) - _NEIGHBOURS // 2, 0, max(known.size - _NEIGHBOURS, 0)
    )
    columns = np.minimum(place[:, np.newaxis] + np.arange(_NEIGHBOURS), known.size - 1)
    return np.asarray(np.median(rates[known[columns]], axis=1) * dt_s)


def _span_of_jumps(dt_s: Array, steps: Array, reach: float, whole: bool) -> tuple[float, float] | None:
    """The span that jumps of one size show, again and again, and its tolerance; None if they are few or differ."""
    jumps = np.abs(steps) > 0.5 * reach
    if np.count_nonzero(jumps) < _OFTEN:
        return None
    sizes = np.abs(steps - _expected(dt_s, steps, ~jumps))[jumps]
    span = float(np.median(sizes))
    alike = np.abs(sizes - span) <= _SAME_SHARE * span
    if np.count_nonzero(alike) < max(_OFTEN, 0.8 * sizes.size):
        return None
    spread = 3.0 * float(np.median(np.abs(sizes - span)))
    tolerance = max(_TOLERANCE_SHARE * span, spread, _TOLERANCE_COUNTS if whole else 0.0)
    return max(float(round(span)) if whole else span, reach * (1.0 + 1e-9)), tolerance


def _too_fast(steps: Array, reach: float, spans: Sequence[float], unit: str) -> str:
    """That a counter turns round within few samples, so that nobody can tell which way; empty if none does."""
    for span in spans:
        if _FULL_SHARE * span <= reach < span:
            shortest = np.abs(steps - span * np.round(steps / span))
            if np.quantile(shortest, 0.75) > _AMBIGUOUS_SHARE * span and np.mean(np.abs(steps) > 0.5 * span) > 0.1:
                return (
                    f"{unit} stay within {span:.10g} and jump all the time: the counter wraps faster than it is read; "
                    "record a wider counter, or read it more often"
                )
    return ""


def set_anew(t_s: Array, angles_rad: Array) -> Mask:
    """Return which samples (N,) begin anew because an encoder was set, from wheel angles (N, 2).

    That is a step of more than ten turns, or of one radian that no wheel turns in that time.
    """
    if t_s.size < 2:
        return np.zeros(t_s.size, dtype=bool)
    steps = np.abs(np.diff(angles_rad, axis=0)).max(axis=1, initial=0.0)
    rate_rad_s = steps / np.maximum(np.diff(t_s), 1e-3)
    usual_rad_s = float(np.quantile(rate_rad_s, 0.99))
    # Samples that come in bursts seem fast as well, but take small steps.
    sudden = (steps > _NO_WHEELS_STEP_RAD) & (rate_rad_s > max(_NO_WHEEL_RAD_S, 5.0 * usual_rad_s))
    return np.concatenate([[False], (steps > _LARGEST_STEP_RAD) | sudden])


_LARGEST_STEP_RAD = 20.0 * math.pi
_NO_WHEEL_RAD_S, _NO_WHEELS_STEP_RAD = 150.0, 1.0
