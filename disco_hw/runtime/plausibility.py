"""Does the robot do what it should: wheels follow commands, supply holds, poses change, and the task gets on.

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
        self._poses: dict[int, tuple[tuple[float, float, float], int]] = {}

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
            before, repeats = self._poses.get(sample.source, (None, 0))
            repeats = repeats + 1 if pose == before and moving else 0
            self._poses[sample.source] = pose, repeats
            if repeats == REPEATS:
                self._counts["poses_frozen"] += 1
                events.append("the measured pose stays the same to the last digit while the wheels turn")
        return events


WINDOW_NS = 5_000_000_000
LEAST_M = 0.05
"""Who gets no further than this within the window makes no progress; less for a task that is slower than that."""
LEAST_PART = 0.25
"""Of what the task's speed makes in the window."""
ASKED_RAD_S = 0.05
"""A command below this asks for no motion."""
ROLLED_RAD = 0.5
"""Wheels that have turned less in the window stand."""


@dataclass
class _Window:
    """Since when and where the robot is; how far the wheels have turned and were asked to at most."""

    begun_ns: int
    x_m: float
    y_m: float
    angles_rad: tuple[float, float] | None
    largest_rad_s: float = 0.0
    said: bool = False


class Headway:
    """Watches a running task of this speed; one of NaN, whose places have times and may rest, is not watched."""

    def __init__(self, speed_m_s: float) -> None:
        self._least_m = min(LEAST_M, LEAST_PART * speed_m_s * WINDOW_NS * 1e-9) if speed_m_s > 0.0 else math.nan
        self._window: _Window | None = None

    def step(
        self, now_ns: int, running: bool, place_m: tuple[float, float], command_rad_s: tuple[float, float],
        wheels: WheelSample | None, planner_failure: str | None,
    ) -> tuple[str, ...]:  # fmt: skip
        """Take in a tick; returns what to say, once for each time that the robot stays."""
        if not running or math.isnan(self._least_m):
            self._window = None
            return ()
        angles = None if wheels is None else (wheels.left_angle_rad, wheels.right_angle_rad)
        window = self._window
        if window is None or math.hypot(place_m[0] - window.x_m, place_m[1] - window.y_m) > self._least_m:
            self._window = _Window(now_ns, *place_m, angles)
            return ("task: gets on again",) if window is not None and window.said else ()
        window.largest_rad_s = max(window.largest_rad_s, *map(abs, command_rad_s))
        if window.said or now_ns - window.begun_ns < WINDOW_NS:
            return ()
        window.said = True
        return (f"task: no progress for 5 s: {_obstacle(window, angles, planner_failure)}",)


def _obstacle(window: _Window, angles_rad: tuple[float, float] | None, planner_failure: str | None) -> str:
    """What stands in the way, from the commands down to the ground."""
    if planner_failure is not None:
        return f"the planner has no plan: {planner_failure}"
    if window.largest_rad_s < ASKED_RAD_S:
        return "the planner asks for no motion; look at the task and at where the robot is"
    if angles_rad is None or window.angles_rad is None:
        return f"the wheels were asked for up to {window.largest_rad_s:.2f} rad/s, and say nothing of how they turn"
    turned = max(abs(now - then) for now, then in zip(angles_rad, window.angles_rad, strict=True))
    if turned < ROLLED_RAD:
        return (
            f"the wheels stand although asked for up to {window.largest_rad_s:.2f} rad/s: blocked, or a dead band that "
            "the model does not know (disco-hw gap finds it)"
        )
    return f"the wheels have turned by {turned:.1f} rad, and the pose has not moved: slip, an obstacle, a frozen pose"
