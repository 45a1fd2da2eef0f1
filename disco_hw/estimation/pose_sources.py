"""Several pose sources beside one another: which are believed, and whether two contradict each other.

The filter takes their poses in order of their stamps and gates each. What no gate shows is who of two is wrong:

- Poses that leave the gate by a jump, from one pose to the next of the same source, are against wheels and other source
  at once: that source is left out until its poses fit again.
- Poses that drift apart, or disagree from the first on, do not tell who is right: the estimate is not to be driven by.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

from disco_hw.estimation.correction import MAX_POSITION_M, PoseReason, PoseUpdate, Triple
from drivers.types import PoseSample

MAX_POSE_RATE_HZ = 100.0
"""Of one source; what comes above it is left out, evenly in time."""
MEAN_WEIGHT = 0.2
"""Of a pose in the running mean of its source's innovations."""
LEAST_POSES = 10
"""So many poses of a source make that mean worth a comparison; of as few in a row does a source come back."""
# Chosen: one or two outliers in a row do not make a source suspect.
LEAST_GATED = 3
JUMP_PART = 0.7
"""Of the squared way out of the gate, made at once."""
APART_STDS = 3.0
"""Two sources contradict each other where their mean innovations are further apart than this, by their own noise."""
# For x, y and yaw, of which nothing is known yet.
_NAN3 = (math.nan, math.nan, math.nan)


class Standing(enum.Enum):
    """States of one pose source."""

    WAITING = "waiting"
    GOOD = "good"
    JUMPED = "jumped"
    DEVIATES = "deviates"
    LOST = "lost"


@dataclass(slots=True)
class TrackedSource:
    """Record of one pose source; `came_ns` is when its newest pose came, `good_ns` the stamp of the newest accepted."""

    label: str
    standing: Standing = Standing.WAITING
    came_ns: int | None = None
    good_ns: int | None = None
    period_ns: int = 0
    """Between the newest two accepted poses."""
    latency_s: float = math.nan
    position_std_m: float = math.nan
    yaw_std_rad: float = math.nan
    accepted: int = 0
    outliers: int = 0
    refused: int = 0
    refusal: str = ""
    """Why its newest pose was refused, in words; empty if it was not, or for no reason that lasts."""
    reported: set[PoseReason] = field(default_factory=set)
    in_a_row: int = 0
    """Accepted poses since the last that was not; of gated ones the negative."""
    left_by_jump: bool = False
    innovation: list[float] = field(default_factory=lambda: list(_NAN3))
    variance: list[float] = field(default_factory=lambda: list(_NAN3))
    means_of: int = 0
    _last: Triple = _NAN3

    def reset_course(self) -> None:
        """Clear what poses were off by, because the estimate has jumped elsewhere."""
        self.in_a_row, self.left_by_jump, self.means_of = 0, False, 0
        self.innovation, self.variance, self._last = list(_NAN3), list(_NAN3), _NAN3

    def add_evaluation(self, reason: PoseReason, innovation: Triple | None, variance: Triple | None) -> None:
        """Take in what the filter made of a pose."""
        if reason is PoseReason.GATED and innovation is not None and variance is not None:
            if self.in_a_row > 0:
                self.left_by_jump = self._jumped(innovation)
            self.outliers += 1
            self.in_a_row = min(self.in_a_row, 0) - 1
        elif reason.accepted:
            self.accepted += 1
            self.in_a_row = max(self.in_a_row, 0) + 1
            if reason is PoseReason.ACCEPTED and innovation is not None and variance is not None:
                self._average(innovation, variance)
                self._last = innovation
        else:
            self.refused += 1

    def _jumped(self, innovation: Triple) -> bool:
        """Whether nearly all of the way out of the gate was made since the pose before."""
        step = total = 0.0
        for new, old, spread in zip(innovation, self._last, self.variance, strict=True):
            if math.isfinite(new - old) and spread > 0.0:
                step += (new - old) ** 2 / spread
                total += new**2 / spread
        return step > JUMP_PART * total > 0.0

    def _average(self, innovation: Triple, variance: Triple) -> None:
        self.means_of += 1
        for index, (value, spread) in enumerate(zip(innovation, variance, strict=True)):
            if math.isfinite(value):
                old, old_spread = self.innovation[index], self.variance[index]
                self.innovation[index] = old + MEAN_WEIGHT * (value - old) if math.isfinite(old) else value
                self.variance[index] = (
                    old_spread + MEAN_WEIGHT * (spread - old_spread) if math.isfinite(old_spread) else spread
                )


class PoseSources:
    """Follows the sources of one estimate; pure, and the same calls give the same verdicts."""

    def __init__(self, labels: Sequence[str], timeout_s: float, history_s: float) -> None:
        self.all = tuple(TrackedSource(label) for label in labels)
        self.contradiction = ""
        """Which two contradict each other, in words, while the estimate must not be driven by; else empty."""
        self._timeout_ns = round(timeout_s * 1e9)
        self._history_s = history_s
        self._messages: list[str] = []

    def add_sample(self, sample: PoseSample, update: PoseUpdate, now_ns: int) -> None:
        """Take in a pose of a source that came at `now_ns`, and what the filter made of it."""
        if not 0 <= sample.source < len(self.all):
            return
        source = self.all[sample.source]
        age_s = (now_ns - sample.t_ns) * 1e-9
        first = not math.isfinite(source.latency_s)
        source.latency_s = age_s if first else source.latency_s + MEAN_WEIGHT * (age_s - source.latency_s)
        source.came_ns = now_ns
        source.position_std_m, source.yaw_std_rad = sample.position_std_m, sample.yaw_std_rad
        if update.reason is PoseReason.REINITIALISED:
            for one in self.all:
                one.reset_course()
        source.add_evaluation(update.reason, update.innovation, update.innovation_variance)
        text = _describe_refusal(sample, update, self._history_s)
        refusal = text and f"{source.label}: {text}"
        # One too many says nothing about those that are used.
        source.refusal = "" if update.reason is PoseReason.OVERFLOW else refusal
        if refusal and update.reason not in source.reported:
            source.reported.add(update.reason)
            self._messages.append(refusal)
        if update.accepted:
            source.period_ns = 0 if source.good_ns is None else sample.t_ns - source.good_ns
            source.good_ns = max(sample.t_ns, source.good_ns or sample.t_ns)

    def step(self, now_ns: int) -> None:
        """Judge the sources at the time of a tick; with one alone there is nothing to judge."""
        if len(self.all) < 2:
            return
        for source in self.all:
            self._update_standing(source, now_ns)
        apart = self._apart()
        if apart and not self.contradiction:
            self._messages.append(f"{apart}; the task stops, because it is unknown which source is right")
        if self.contradiction and not apart:
            self._messages.append("the pose sources agree again")
        self.contradiction = apart

    def new_messages(self) -> list[str]:
        """Sentences for the operator since the last call."""
        messages, self._messages = self._messages, []
        return messages

    def refusal(self, now_ns: int) -> str:
        """Why the newest pose of a source was refused, or too old before the next came, in words; empty if neither.

        A refusal that does not last is left out, and so is a source that is silent: that is then why there is no pose.
        """
        came = (one for one in self.all if one.came_ns is not None and now_ns - one.came_ns <= self._timeout_ns)
        refused = next((one.refusal for one in came if one.refusal), "")
        return refused or next((text for one in self.all if (text := self._describe_period(one, now_ns))), "")

    def _describe_period(self, source: TrackedSource, now_ns: int) -> str:
        """Say that a source's poses come too rarely to be used throughout; empty if they do not, or no longer come."""
        period_ns = source.period_ns
        is_enough = not period_ns or not period_ns + 1e9 * source.latency_s > self._timeout_ns
        if is_enough or source.came_ns is None or now_ns - source.came_ns > 2 * period_ns:
            return ""
        return (
            f"{source.label}: poses come {period_ns * 1e-9:.2g} s apart and {source.latency_s:.2g} s late, with "
            f"estimation.pose_timeout_s = {self._timeout_ns * 1e-9:g}; raise that, or send poses more often"
        )

    def is_good(self, number: int) -> bool:
        """Whether poses of this source are believed; of a single one they always are."""
        return len(self.all) < 2 or self.all[number].standing is Standing.GOOD

    def counts(self) -> dict[str, int]:
        """Return accepted poses, outliers and refused ones of each source by name, where there are several."""
        if len(self.all) < 2:
            return {}
        return {
            f"{one.label} {name}": getattr(one, name)
            for one in self.all
            for name in ("accepted", "outliers", "refused")
        }

    def status(self, now_ns: int) -> list[dict[str, Any]]:
        """Return each source's status for the operator or page; what is not known is None."""
        return [
            {
                "source": one.label,
                "standing": one.standing.value if len(self.all) > 1 else None,
                "age_s": None if one.came_ns is None else (now_ns - one.came_ns) * 1e-9,
                "latency_s": _known(one.latency_s),
                "position_std_m": _known(one.position_std_m),
                "yaw_std_rad": _known(one.yaw_std_rad),
                "accepted": one.accepted,
                "outliers": one.outliers,
                "refused": one.refused,
            }
            for one in self.all
        ]

    def _update_standing(self, source: TrackedSource, now_ns: int) -> None:
        before = source.standing
        if source.came_ns is None:
            return
        if now_ns - source.came_ns > self._timeout_ns:
            source.standing = Standing.LOST
        elif source.in_a_row <= -LEAST_GATED and now_ns - (source.good_ns or 0) > self._timeout_ns:
            source.standing = Standing.JUMPED if source.left_by_jump else Standing.DEVIATES
        elif source.in_a_row >= LEAST_POSES or (source.in_a_row > 0 and before in (Standing.WAITING, Standing.LOST)):
            source.standing = Standing.GOOD
        if source.standing is before:
            return
        good = ", ".join(one.label for one in self.all if one.standing is Standing.GOOD)
        going_on = f"continuing with {good}" if good else "no other source is left"
        if source.standing is Standing.LOST:
            source.reset_course()
            self._messages.append(f"{source.label}: no pose for {self._timeout_ns * 1e-9:g} s; {going_on}")
        elif source.standing is Standing.JUMPED:
            self._messages.append(
                f"{source.label}: its poses jumped, which the wheels do not explain, and are not used; {going_on}"
            )
        elif source.standing is Standing.GOOD:
            self._messages.append(f"{source.label}: its poses are used")

    def _apart(self) -> str:
        """Return which sources do not agree where it is unknown which one is right."""
        live = [one for one in self.all if one.standing in (Standing.GOOD, Standing.DEVIATES)]
        for one in live:
            others = [other for other in live if other is not one and other.standing is Standing.GOOD]
            if one.standing is Standing.DEVIATES and others:
                return f"{one.label} and {others[0].label} disagree by more than their stated noise"
        for one, other in combinations([one for one in live if one.means_of >= LEAST_POSES], 2):
            difference = _difference(one, other)
            if difference:
                return f"{one.label} and {other.label} disagree: {difference} more than their stated noise"
        return ""


def _describe_refusal(sample: PoseSample, update: PoseUpdate, history_s: float) -> str:
    """Return what is wrong with a pose and what to do; empty if it was used, or refused for no reason that lasts."""
    match update.reason:
        case PoseReason.NOT_FINITE:
            return "poses hold what is not a number; check the pose sensor"
        case PoseReason.OUT_OF_RANGE if max(abs(sample.x_m), abs(sample.y_m)) > MAX_POSITION_M:
            place = f"({sample.x_m:.0f}, {sample.y_m:.0f}) m"
            return f"poses at {place} are over {MAX_POSITION_M:.0f} m from the origin; set pose.origin"
        case PoseReason.OUT_OF_RANGE:
            return "poses have an impossible heading or offset; check the pose sensor and pose.offset"
        case PoseReason.FUTURE:
            return f"poses are stamped {-update.age_s:.2f} s in the future; correct the clock of the pose sensor"
        # Younger ones are from before the first wheel sample.
        case PoseReason.TOO_OLD if update.age_s > history_s:
            age = f"{update.age_s:.1f} s old, over estimation.history_s = {history_s:g}"
            return f"poses are {age}; raise it, or correct the clock of the pose sensor"
        case PoseReason.OVERFLOW:
            return f"more than {MAX_POSE_RATE_HZ:.0f} poses a second; the rest is left out"
    return ""


def _difference(one: TrackedSource, other: TrackedSource) -> str:
    """Return by how much two sources differ, where that is more than their noise; else empty."""
    x, y, yaw = (a - b for a, b in zip(one.innovation, other.innovation, strict=True))
    xx, yy, tt = (a + b for a, b in zip(one.variance, other.variance, strict=True))
    if x * x / xx + y * y / yy > APART_STDS**2:
        return f"{math.hypot(x, y):.2f} m apart,"
    if math.isfinite(yaw) and yaw * yaw / tt > APART_STDS**2:
        return f"{abs(yaw):.2f} rad apart,"
    return ""


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
