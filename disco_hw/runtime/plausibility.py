"""Does the robot do what it should: wheels follow commands, the supply holds, poses change when the robot moves.

Nothing is stopped here. It counts and reports what the rest of the stack tolerates: faults too short or too small for
the firmware's own limits, before they grow.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

from drivers.types import PoseSample, PowerSample, WheelCommand, WheelSample

COMMANDS_OF_LATE_NS = 600_000_000
"""Delay and lag of the wheels together: what was commanded so long ago may still be on its way."""
SLACK_RAD_S = 0.5
SLACK_PART = 0.2
SAMPLES_OUTSIDE = 3
SUPPLY_MEAN_S = 10.0
DIP_PART = 0.94
DIP_OVER_PART = 0.97
REPEATS = 2
MOVING_RAD_S = 0.3
_SIDES = ("left", "right")


@dataclass(frozen=True, slots=True)
class PlausibilityStats:
    """Times that a wheel was elsewhere than its commands could have taken it, that the supply dipped, and that the pose
    stayed the same to the last digit while the wheels turned; each counts once, at its beginning.
    """

    wheels_not_following: int = 0
    supply_dips: int = 0
    poses_frozen: int = 0


class Plausibility:
    """Compares what the robot reports with what it was commanded; pure, one step a tick.

    A wheel follows if its speed lies within what it was commanded over the last 0.6 s, give or take 0.5 rad/s and a
    fifth; it does not after three samples in a row outside. The supply dips by 6 % below its mean over 10 s, and has
    recovered above 3 %. A pose that is repeated twice to the last digit is frozen.
    """

    def __init__(self) -> None:
        self._counts = asdict(PlausibilityStats())
        self._sent: deque[tuple[int, float, float]] = deque()
        self._outside = [0, 0]
        self._supply_v: float | None = None
        self._supply_ns = 0
        self._dipped = False
        self._pose: tuple[float, float, float] | None = None
        self._repeats = 0

    @property
    def stats(self) -> PlausibilityStats:
        """A snapshot of the counters."""
        return PlausibilityStats(**self._counts)

    def step(
        self,
        now_ns: int,
        wheels: Sequence[WheelSample],
        poses: Sequence[PoseSample],
        power: Sequence[PowerSample],
        command: WheelCommand | None,
    ) -> tuple[str, ...]:
        """Take in a tick's samples and the command that it sends (None for none); returns what began, in words."""
        events = [*self._watch_wheels(wheels), *self._watch_supply(power), *self._watch_poses(poses, wheels)]
        if command is None:
            self._sent.clear()
            self._outside = [0, 0]
        else:
            self._sent.append((now_ns, command.left_rad_s, command.right_rad_s))
            while now_ns - self._sent[0][0] > COMMANDS_OF_LATE_NS:
                self._sent.popleft()
        return tuple(events)

    def _watch_wheels(self, wheels: Sequence[WheelSample]) -> list[str]:
        sent = self._sent
        if not wheels or not sent or sent[-1][0] - sent[0][0] < COMMANDS_OF_LATE_NS // 2:
            return []
        _, lefts, rights = zip(*sent, strict=True)
        events = [
            *self._watch_wheel(0, min(lefts), max(lefts), [sample.left_speed_rad_s for sample in wheels]),
            *self._watch_wheel(1, min(rights), max(rights), [sample.right_speed_rad_s for sample in wheels]),
        ]
        self._counts["wheels_not_following"] += len(events)
        return events

    def _watch_wheel(self, side: int, low: float, high: float, speeds: Sequence[float]) -> Iterator[str]:
        least = low - SLACK_RAD_S - SLACK_PART * abs(low)
        most = high + SLACK_RAD_S + SLACK_PART * abs(high)
        for speed in speeds:
            self._outside[side] = 0 if least <= speed <= most else self._outside[side] + 1
            if self._outside[side] == SAMPLES_OUTSIDE:
                yield (
                    f"the {_SIDES[side]} wheel does not follow: {speed:.1f} rad/s, commanded {low:.1f} to {high:.1f}"
                )

    def _watch_supply(self, power: Sequence[PowerSample]) -> list[str]:
        events = []
        for sample in power:
            volts = sample.voltage_v
            if not math.isfinite(volts) or volts <= 0.0:
                continue
            mean = volts if self._supply_v is None else self._supply_v
            if not self._dipped and volts < DIP_PART * mean:
                self._dipped = True
                self._counts["supply_dips"] += 1
                events.append(f"the supply dipped from {mean:.1f} V to {volts:.1f} V")
            elif self._dipped and volts > DIP_OVER_PART * mean:
                self._dipped = False
            elapsed_s = max(sample.t_ns - self._supply_ns, 0) * 1e-9
            self._supply_v = mean + (volts - mean) * (1.0 - math.exp(-elapsed_s / SUPPLY_MEAN_S))
            self._supply_ns = sample.t_ns
        return events

    def _watch_poses(self, poses: Sequence[PoseSample], wheels: Sequence[WheelSample]) -> list[str]:
        events = []
        moving = any(max(abs(w.left_speed_rad_s), abs(w.right_speed_rad_s)) > MOVING_RAD_S for w in wheels)
        for sample in poses:
            pose = (sample.x_m, sample.y_m, sample.yaw_rad if sample.has_heading else 0.0)
            same = pose == self._pose and moving
            self._pose = pose
            self._repeats = self._repeats + 1 if same else 0
            if self._repeats == REPEATS:
                self._counts["poses_frozen"] += 1
                events.append("the measured pose stays the same to the last digit while the wheels turn")
        return events
