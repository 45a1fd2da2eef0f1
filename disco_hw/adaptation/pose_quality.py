"""Measured quality of a stream of poses: rate, noise and delay, and whether the geometry can be learnt from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from disco_hw.adaptation.guard import (
    LEAST_RATE_HZ,
    MOST_LATENCY_S,
    MOST_POSITION_STD_M,
    MOST_YAW_STD_RAD,
    REPORT_OFF,
    REPORT_ON,
)
from drivers.types import PoseSample

# Chosen: longer knows the noise better, shorter reports a fault sooner.
WINDOW_S = 2.0
# Windows without a good one before a fault is reported: the noise of 2 s is known to about 15 %, so that poses near a
# limit may seem worse than they are at first.
REPORTED_AFTER = 5
# The median of the absolute value of a standard normal variable, and the gain of a second difference for white noise.
_MEDIAN_OF_NORMAL, _SECOND_DIFFERENCE = 0.6745, math.sqrt(6.0)


@dataclass(frozen=True, slots=True)
class PoseQuality:
    """Rate (Hz), standard deviations of position (m) and yaw (rad), and delay (s) of poses over a window."""

    rate_hz: float
    position_std_m: float
    yaw_std_rad: float
    delay_s: float

    @property
    def fault(self) -> str:
        """The first value that is not good enough to learn from, and its limit; empty if all are."""
        if self.rate_hz < LEAST_RATE_HZ:
            return f"poses come at {self.rate_hz:.1f} Hz, fewer than {LEAST_RATE_HZ:g}"
        if not self.position_std_m <= MOST_POSITION_STD_M:
            return f"positions scatter by {1e3 * self.position_std_m:.1f} mm, more than {1e3 * MOST_POSITION_STD_M:g}"
        if not self.yaw_std_rad <= MOST_YAW_STD_RAD:
            return f"headings scatter by {self.yaw_std_rad:.4f} rad, more than {MOST_YAW_STD_RAD:g}"
        if self.delay_s > MOST_LATENCY_S:
            return f"poses arrive {self.delay_s:.2f} s late, more than {MOST_LATENCY_S:g}"
        return ""

    def __str__(self) -> str:
        """Return the values in words."""
        return (
            f"poses at {self.rate_hz:.0f} Hz with {1e3 * self.position_std_m:.1f} mm and {self.yaw_std_rad:.4f} rad, "
            f"{1e3 * self.delay_s:.0f} ms late"
        )


def measured_quality(poses: Sequence[PoseSample], span_s: float) -> PoseQuality:
    """Measure the quality of the poses of one source that came within `span_s`.

    A standard deviation is the larger one of what the source says (median) and of what is measured: from second
    differences of neighbouring poses, which a steady motion does not change, by their median, which outliers do not.
    It is infinite where there are no headings or fewer than three poses.
    """
    rate_hz = len(poses) / span_s
    if len(poses) < 3:
        return PoseQuality(rate_hz, math.inf, math.inf, math.inf)
    places = np.array([[pose.x_m, pose.y_m] for pose in poses])
    yaws = np.array([pose.yaw_rad for pose in poses])
    yaw_std_rad = math.inf
    if np.isfinite(yaws).all():
        yaw_std_rad = max(_noise(np.unwrap(yaws)), float(np.median([pose.yaw_std_rad for pose in poses])))
    return PoseQuality(
        rate_hz,
        max(_noise(places), float(np.median([pose.position_std_m for pose in poses]))),
        yaw_std_rad,
        float(np.median([pose.received_ns - pose.t_ns for pose in poses])) * 1e-9,
    )


def _noise(values: NDArray[np.float64]) -> float:
    """Return the standard deviation of white noise on a smooth series (N, ...)."""
    return float(np.median(np.abs(np.diff(values, 2, axis=0)))) / (_MEDIAN_OF_NORMAL * _SECOND_DIFFERENCE)


@dataclass
class PoseWatch:
    """Evaluates the poses of the first source, window by window; `is_good` from the first good window on."""

    is_good: bool = False
    text: str = "measuring the poses"
    _poses: list[PoseSample] = field(default_factory=list)
    _since_ns: int | None = None
    _bad_windows: int = 0
    _reported: str = ""

    def step(self, now_ns: int, poses: Sequence[PoseSample]) -> str:
        """Take in poses, and return what to report to the operator: a sentence where the fault changes, or nothing."""
        if self.is_good:
            return ""
        self._poses += [pose for pose in poses if pose.source == 0]
        if self._since_ns is None:
            # The window begins with the first pose: no pose says nothing of how good poses are.
            self._since_ns = now_ns if self._poses else None
            return ""
        span_s = (now_ns - self._since_ns) * 1e-9
        if span_s < WINDOW_S:
            return ""
        quality = measured_quality(self._poses, span_s)
        self._poses, self._since_ns = [], None
        # "poses come" of "poses come at 4.1 Hz, fewer than 10": the kind of fault without its value.
        kind = " ".join(quality.fault.split()[:2])
        self.is_good = not quality.fault
        self.text = quality.fault or str(quality)
        if self.is_good:
            return f"adapt: {REPORT_ON}: {quality}"
        self._bad_windows += 1
        if self._bad_windows < REPORTED_AFTER:
            return ""
        is_new, self._reported = kind != self._reported, kind
        return f"adapt: {REPORT_OFF}: {quality.fault}" if is_new else ""
