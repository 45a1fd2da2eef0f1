"""Encoder counts that wrap round or are set anew: found from the counts themselves, and made continuous.

A counter of 8 or 16 bits jumps by its span when it overflows. The jump is recognised by what is left when the span is
taken out: the motion of the samples around it. A counter that is set to zero leaves something else, and begins a new
segment. Nothing here knows of units: counts and radians are treated alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from disco_hw.errors import LogError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WIDTHS_BITS = (8, 10, 12, 14, 16, 20, 24, 32)
"""Widths of counters and of absolute encoders that are in use."""
# Chosen: longer finds more neighbours, which a change of speed makes less alike.
_WINDOW_S = 0.25
_NEIGHBOURS = 5
"""The motion expected of a step is that of the neighbours within this time, and of so many at least."""
_JUMP_SHARE = 0.3
"""Steps longer than this share of all values' reach are jumps."""
_AMBIGUOUS_SHARE = 0.25
"""If many steps are longer than this share of the span, any of them may be one way or the other."""
_UNKNOWN_SHARE = 0.4
"""Where a step of this share of the span is expected, nobody can tell how often the counter wrapped."""
_FITTING_SHARE = 0.8
"""So many of the jumps have to be wraps of the span, or it is none."""
_FULL_SHARE = 0.5
"""Counts of a counter that wraps all the time fill at least this share of its span."""
_TOO_FAST_SHARE = 0.05
"""A counter of which more steps than this may be over half its span cannot be read."""
# Chosen: of the steps; fewer jumps can be mended one by one.
_JUMPS_ALL_THE_TIME_SHARE = 0.1
_OFTEN = 3
"""Without a usual width, so many jumps of one size are a span."""
_SAME_SHARE = 0.05
"""Jumps that differ by less than this share of themselves are of one size."""
_NEAR_SHARE = 0.005
"""A usual span this near to the size of the jumps is theirs: 4096 is not 4000."""
_RESOLUTION = 2.0
"""Counts by which steps differ that are the same motion; of a position in rad, this share of 1000 of the span."""


@dataclass(frozen=True, slots=True)
class Unwrapped:
    """Counts of an encoder made continuous: `values` (N,); `span` that was taken out `wraps` times, 0 without wraps.

    `uncertain` (N,) marks values before which so much time passed that the number of wraps is not known. `fault` says
    why the counts cannot be made continuous, and is empty if they can.
    """

    values: Array
    uncertain: Mask
    span: float = 0.0
    wraps: int = 0
    fault: str = ""


@dataclass(frozen=True, slots=True)
class _Steps:
    """Steps from value to value (N - 1,): duration, step, and the motion expected by the neighbours.

    A step within `tolerance` of what is expected is motion, and so is one within `longest`, which the fastest of all
    samples would make. `is_inside` is False across a change of segment; `is_jump` marks what is no motion.
    """

    dt_s: Array
    steps: Array
    expected: Array
    tolerance: Array
    longest: Array
    is_inside: Mask
    is_jump: Mask


def unwrap_counter(
    t_s: Array,
    values: Array,
    spans: Sequence[float],
    begins: Mask,
    speeds: Array,
    unit: str = "counts",
) -> Unwrapped:
    """Make a counter continuous that jumps by a constant span whenever it overflows.

    `t_s` (N,) increases. `spans` are tried beside those of the usual widths; any other span has to show in three jumps
    of one size. `begins` (N,) marks where segments begin. `speeds` (N,), in units a second, are the commanded or
    measured ones, NaN where not known: they show a counter that wraps faster than it is read. Counts that fit no span
    are returned as they are.
    """
    unchanged = Unwrapped(values, np.zeros(values.size, dtype=bool))
    if values.size <= _NEIGHBOURS:
        return unchanged
    reach = float(np.ptp(values))
    motion = _steps(t_s, values, begins, reach, unit)
    if not motion.is_jump.any():
        return unchanged
    usual = sorted({float(2**bits) for bits in WIDTHS_BITS} | {float(span) for span in spans})
    span = _span_of(motion, [each for each in usual if reach < each <= 2.0 * reach], reach, unit)
    if span is not None:
        if _is_too_fast(motion, speeds, span):
            return replace(unchanged, fault=_faster_than_read(span, unit))
        found = _without_wraps(motion, values, span)
        if found is not None:
            return found
    return replace(unchanged, fault=_too_fast(motion, speeds, reach, usual, unit))


def continuous_wheels(
    names: tuple[str, str],
    t_s: Array,
    values: Array,
    spans: Sequence[float],
    begins: Mask,
    speeds: Array,
    notes: list[str],
    unit: str = "counts",
) -> tuple[Array, Mask]:
    """Make the counters of both wheels continuous, `values` and `speeds` (N, 2); each wheel is judged by itself.

    Also returns where the number of wraps is not known, (N,). The counters are of one kind: a span that one wheel shows
    is tried on the other, which may wrap too rarely. `names` begin with the file's. Raises LogError for a counter that
    cannot be made continuous.
    """

    def unwrap(side: int, spans: Sequence[float]) -> Unwrapped:
        return unwrap_counter(t_s, values[:, side], spans, begins, speeds[:, side], unit)

    first = unwrap(0, spans), unwrap(1, spans)
    shown = [*spans, *(one.span for one in first if one.wraps)]
    left, right = (one if one.wraps or one.fault else unwrap(side, shown) for side, one in enumerate(first))
    for name, one in zip(names, (left, right), strict=True):
        if one.fault:
            raise LogError(f"{name}: {one.fault}")
        if one.wraps:
            notes.append(f"{name} wraps at {one.span:.10g} {unit}: made continuous at {one.wraps} places")
    return np.column_stack([left.values, right.values]), left.uncertain | right.uncertain


def _steps(t_s: Array, values: Array, begins: Mask, reach: float, unit: str) -> _Steps:
    dt_s, steps = np.maximum(np.diff(t_s), 1e-9), np.diff(values)
    inside = ~begins[1:]
    jumps = inside & (np.abs(steps) > _JUMP_SHARE * reach) & (reach > 0.0)
    usable = inside & ~jumps
    expected = _expected(dt_s, steps, usable)
    has_motion = bool(usable.any())
    spread = float(np.quantile(np.abs(steps - expected)[usable], 0.95)) if has_motion else 0.0
    fastest = float(np.quantile((np.abs(steps) / dt_s)[usable], 0.99)) if has_motion else 0.0
    resolution = _RESOLUTION if unit == "counts" else 1e-3 * _RESOLUTION * reach
    longer = np.maximum(1.0, dt_s / np.median(dt_s))
    tolerance = np.maximum(4.0 * spread * longer, 0.5 * np.abs(expected)) + resolution
    return _Steps(dt_s, steps, expected, tolerance, 1.2 * fastest * dt_s + resolution, inside, jumps)


def _expected(dt_s: Array, steps: Array, usable: Mask) -> Array:
    """Return the steps (N,) at the mean rate of the neighbours that are usable."""
    known = np.flatnonzero(usable)
    if not known.size:
        return np.zeros_like(steps)
    count = min(max(_NEIGHBOURS, round(_WINDOW_S / float(np.median(dt_s)))), known.size)
    first = np.clip(np.searchsorted(known, np.arange(steps.size)) - count // 2, 0, known.size - count)
    moved = np.concatenate([[0.0], np.cumsum(steps[known])])
    passed_s = np.concatenate([[0.0], np.cumsum(dt_s[known])])
    rate = (moved[first + count] - moved[first]) / (passed_s[first + count] - passed_s[first])
    return np.asarray(rate * dt_s)


def _left_over(motion: _Steps, span: float) -> tuple[Array, Array, Mask]:
    """Return turns of the span in each step (N,), what they leave beside the expected motion, and if that is motion."""
    turns = np.where(motion.is_inside, np.round((motion.steps - motion.expected) / span), 0.0)
    left = motion.steps - span * turns
    difference = np.abs(left - motion.expected)
    return turns, difference, (difference <= motion.tolerance) | (np.abs(left) <= motion.longest)


def _span_of(motion: _Steps, usual: Sequence[float], reach: float, unit: str) -> float | None:
    """Return the span that explains the jumps: one of the usual ones, or the one that they show; None if none does."""
    jumps = motion.is_jump

    def fits(span: float) -> int:
        turns, _, is_motion = _left_over(motion, span)
        return int(np.count_nonzero(jumps & (turns != 0.0) & is_motion))

    def off(span: float) -> float:
        return float(np.median(_left_over(motion, span)[1][jumps]))

    best = max(usual, key=lambda span: (fits(span), -off(span)), default=None)
    measured, tolerance = _span_of_jumps(motion, unit) or (None, 0.0)
    enough = max(1.0, _FITTING_SHARE * np.count_nonzero(jumps))
    resolution = _RESOLUTION if unit == "counts" else 1e-3 * _RESOLUTION * reach
    if best is not None and fits(best) >= enough:
        if measured is None or fits(measured) < enough:
            return best
        return best if abs(best - measured) <= max(tolerance, resolution) else measured
    return measured if measured is not None and fits(measured) >= enough else None


def _span_of_jumps(motion: _Steps, unit: str) -> tuple[float, float] | None:
    """Return the span that jumps of one size show, again and again, with its tolerance.

    None if they are few or differ.
    """
    jumps = motion.is_jump
    if np.count_nonzero(jumps) < _OFTEN:
        return None
    sizes = np.abs(motion.steps - motion.expected)[jumps]
    span = float(np.median(sizes))
    alike = np.abs(sizes - span) <= _SAME_SHARE * span
    if np.count_nonzero(alike) < max(_OFTEN, _FITTING_SHARE * sizes.size):
        return None
    return float(round(span)) if unit == "counts" else span, max(
        3.0 * float(np.median(np.abs(sizes - span))), _NEAR_SHARE * span
    )


def _without_wraps(motion: _Steps, values: Array, span: float) -> Unwrapped | None:
    """Take the span out of some values (N,); None if many steps are so long that they could be one way or the other.

    Jumps that leave something else than motion are those of a counter that was set anew: they stay as they are.
    """
    turns, _, is_motion = _left_over(motion, span)
    wraps = (turns != 0.0) & (~motion.is_jump | is_motion)
    left = np.where(wraps, motion.steps - span * turns, motion.steps)
    if float(np.quantile(np.abs(left[motion.is_inside]), 0.9)) > _AMBIGUOUS_SHARE * span:
        return None
    uncertain = motion.is_inside & (
        (np.abs(motion.expected) > _UNKNOWN_SHARE * span) | (motion.longest > _UNKNOWN_SHARE * 1.5 * span)
    )
    if np.count_nonzero(uncertain) > _TOO_FAST_SHARE * uncertain.size:
        return None
    return Unwrapped(
        np.concatenate([values[:1], values[0] + np.cumsum(left)]),
        np.concatenate([[False], uncertain]),
        span,
        int(np.count_nonzero(wraps)),
    )


def _is_too_fast(motion: _Steps, speeds: Array, span: float) -> bool:
    """Whether speeds (N,) carry a counter over half its span from one value to the next, more than now and then."""
    lengths = np.abs(speeds[:-1]) * motion.dt_s
    known = motion.is_inside & np.isfinite(lengths)
    too_long = int(np.count_nonzero(lengths[known] > 0.5 * span))
    return too_long > _TOO_FAST_SHARE * int(np.count_nonzero(known))


def _too_fast(motion: _Steps, speeds: Array, reach: float, spans: Sequence[float], unit: str) -> str:
    """Describe a counter that wraps within so few samples that its direction is unknown; empty if none does."""
    if np.mean(motion.is_jump) <= _JUMPS_ALL_THE_TIME_SHARE:
        return ""
    # How far speeds that are known carry the wheel, to and fro.
    driven = float(np.nansum(np.abs(speeds[:-1]) * motion.dt_s))
    for span in spans:
        if _FULL_SHARE * span <= reach < span:
            shortest = np.abs(motion.steps - span * np.round(motion.steps / span))
            if np.quantile(shortest, 0.75) > _AMBIGUOUS_SHARE * span or driven > 2.0 * span:
                return _faster_than_read(span, unit)
    return ""


def _faster_than_read(span: float, unit: str) -> str:
    return (
        f"{unit} stay within {span:.10g} and jump all the time: the counter wraps faster than it is read; "
        "record a wider counter, or read it more often"
    )


def restarts(t_s: Array, angles_rad: Array) -> Mask:
    """Return which samples (N,) begin again because an encoder was set, from wheel angles (N, 2).

    That is a step of more than ten turns, or one of a radian that is several times as fast as the wheel turns else, or
    faster than it turns else and to zero.
    """
    if t_s.size < 2:
        return np.zeros(t_s.size, dtype=bool)
    dt_s = np.maximum(np.diff(t_s), 1e-3)[:, np.newaxis]
    steps = np.abs(np.diff(angles_rad, axis=0))
    rate_rad_s = steps / dt_s
    # Without the few fastest, which are those that are looked for.
    rarest = min(max(_FEW, steps.shape[0] // 100), steps.shape[0] - 1)
    usual_rad_s = np.sort(rate_rad_s, axis=0)[-1 - rarest]
    # Samples that come in bursts seem fast as well, but take small steps.
    is_long = steps > _NO_WHEELS_STEP_RAD
    sudden = is_long & (rate_rad_s > np.maximum(_FAST_WHEEL_RAD_S, _TIMES_AS_FAST * usual_rad_s))
    at_zero = np.abs(angles_rad[1:]) <= usual_rad_s * dt_s
    to_zero = is_long & at_zero & (rate_rad_s > _FASTER_TO_ZERO * usual_rad_s)
    return np.concatenate([[False], ((steps > _LARGEST_STEP_RAD) | sudden | to_zero).any(axis=1)])


# Chosen: ten turns from sample to sample are no wheel, however fast.
_LARGEST_STEP_RAD = 20.0 * math.pi
# Chosen: a step this long at this speed and so many times above the usual is no wheel; so many steps may be the usual
# fastest.
_NO_WHEELS_STEP_RAD, _FAST_WHEEL_RAD_S, _FEW = 1.0, 30.0, 3
# Chosen: a step to zero needs less than others, as it is where a counter begins.
_TIMES_AS_FAST, _FASTER_TO_ZERO = 3.0, 2.0
