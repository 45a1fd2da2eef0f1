"""Leaves out headings that are no measurement: their variance says so, or they stand still while the wheels turn.

A sender without a heading often fills in a constant one, mostly 0, and a sensor that has died repeats its last one.
Such a heading looks certain. Real ones never repeat to the last digit while the robot turns.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec

from drivers.pose import is_variance_known
from drivers.types import PoseSample

SAME_RAD = 1e-6
"""Headings that differ by less are the same one, repeated."""
# Chosen: a sensor may repeat a heading for some poses where its own measurement is slower.
LEAST_POSES = 5
LEFT_OUT_RAD = 0.15
"""A repeated heading is not used once the wheels have turned the robot by so much meanwhile."""
NEVER_MEASURED_RAD = 0.35
"""One that was the same from the first pose on is then no measurement, nor is the estimate that rests on it."""
CHANGES = 10
"""So many poses with a new heading each, and headings are used again."""
REPORTED_AFTER = 10
"""So many poses in a row that have no heading, or have one again, are reported."""


class Heading(enum.Enum):
    """States of the headings of one pose source."""

    WAITING = "waiting"
    MEASURED = "measured"
    NONE = "none"
    FROZEN = "stands still"


@dataclass(slots=True)
class _Source:
    label: str
    offset: tuple[float, float]
    current: Heading = Heading.WAITING
    yaw_rad: float = math.nan
    repeats: int = 0
    least_rad: float = 0.0
    most_rad: float = 0.0
    has_varied: bool = False
    changes: int = 0
    others_in_a_row: int = 0


class HeadingWatch:
    """Follows the headings of each pose source; pure, and the same calls give the same answers."""

    def __init__(self, labels: Sequence[str], offsets: Sequence[tuple[float, float]] = ()) -> None:
        places = [*offsets, *((0.0, 0.0) for _ in labels[len(offsets) :])]
        self._sources = [_Source(label, place) for label, place in zip(labels, places, strict=True)]
        self._messages: list[str] = []

    @property
    def current(self) -> tuple[Heading, ...]:
        """State of the headings of each source."""
        return tuple(one.current for one in self._sources)

    @property
    def measures_none(self) -> bool:
        """Whether the newest poses have no heading that is a measurement, of whichever source; False before any."""
        return {Heading.NONE, Heading.FROZEN} >= set(self.current) - {Heading.WAITING} != set()

    def screen(self, sample: PoseSample, difference_rad: float, turn_per_rad: float) -> tuple[PoseSample, bool]:
        """Return the pose, without its heading where that is no measurement.

        `difference_rad`: how much further the right wheel has turned than the left since the start; the robot turns by
        `turn_per_rad` of it. The second result says that the heading never was a measurement: an estimate that rests on
        it is wrong.
        """
        if not 0 <= sample.source < len(self._sources) or not math.isfinite(sample.x_m + sample.y_m):
            return sample, False
        one = self._sources[sample.source]
        if not sample.has_heading:
            self._note(one, Heading.NONE)
            return sample, False
        std_rad = sample.yaw_std_rad
        if not math.isfinite(sample.yaw_rad) or not is_variance_known(math.copysign(std_rad * std_rad, std_rad)):
            self._note(one, Heading.NONE)
            return _without_heading(sample, one.offset), False
        is_frozen, never_measured = self._follow(one, sample.yaw_rad, difference_rad, turn_per_rad)
        if is_frozen:
            return _without_heading(sample, one.offset), never_measured
        self._note(one, Heading.MEASURED)
        return sample, False

    def new_messages(self) -> list[str]:
        """Return sentences for the operator since the last call."""
        messages, self._messages = self._messages, []
        return messages

    def _follow(self, one: _Source, yaw_rad: float, difference_rad: float, turn_per_rad: float) -> tuple[bool, bool]:
        """Whether the heading stands still by now, and whether this pose shows that it always has."""
        if abs(math.remainder(yaw_rad - one.yaw_rad, math.tau)) <= SAME_RAD:
            one.repeats += 1
            one.least_rad, one.most_rad = min(one.least_rad, difference_rad), max(one.most_rad, difference_rad)
        else:
            one.has_varied = one.has_varied or math.isfinite(one.yaw_rad)
            one.yaw_rad, one.repeats = yaw_rad, 1
            one.least_rad = one.most_rad = difference_rad
            one.changes += 1
        if one.current is Heading.FROZEN and one.changes < CHANGES:
            return True, False
        turn_rad = abs(turn_per_rad) * (one.most_rad - one.least_rad)
        if one.repeats < LEAST_POSES or turn_rad < LEFT_OUT_RAD:
            return False, False
        never_measured = not one.has_varied and turn_rad >= NEVER_MEASURED_RAD
        if one.has_varied or never_measured:
            one.current, one.changes, one.others_in_a_row = Heading.FROZEN, 0, 0
            self._messages.append(
                f"{one.label}: the heading stays at {one.yaw_rad:.2f} rad while the wheels turn the robot by "
                f"{turn_rad:.2f} rad; only the positions are used; check the pose sensor"
            )
        return True, never_measured

    def _note(self, one: _Source, seen: Heading) -> None:
        """Change what is held of a source: at once in the beginning, then after enough poses in a row."""
        if seen is one.current:
            one.others_in_a_row = 0
            return
        one.others_in_a_row += 1
        is_first = one.current is Heading.WAITING
        if not is_first and one.others_in_a_row < REPORTED_AFTER:
            return
        one.current, one.others_in_a_row = seen, 0
        if seen is Heading.NONE:
            self._messages.append(
                f"{one.label}: its poses have no heading, or a covariance that marks it as unknown; only the "
                "positions are used"
            )
        elif not is_first:
            self._messages.append(f"{one.label}: its headings are used again")


def _without_heading(sample: PoseSample, offset: tuple[float, float]) -> PoseSample:
    """Return the sensor's own position, because the tracked point is unknown without a heading."""
    cosine = sine = 0.0
    if math.isfinite(sample.yaw_rad):
        cosine, sine = math.cos(sample.yaw_rad), math.sin(sample.yaw_rad)
    ahead, left = offset
    share_m = math.hypot(ahead, left) * sample.yaw_std_rad
    variance = sample.position_std_m**2 - share_m * share_m
    return msgspec.structs.replace(
        sample,
        x_m=sample.x_m + cosine * ahead - sine * left,
        y_m=sample.y_m + sine * ahead + cosine * left,
        yaw_rad=math.nan,
        yaw_std_rad=math.nan,
        position_std_m=math.sqrt(variance) if variance > 0.0 else sample.position_std_m,
        lever_x_m=ahead,
        lever_y_m=left,
    )
