"""Reports what is odd, and stops nothing: the supply dips, poses freeze or jump, the task or the planner is stuck.

They are faults too short or too small for the firmware's own limits, which the rest of the stack tolerates: counted and
said before they grow. Everything here is pure, one step a tick.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from disco_hw.control.plan import WheelPlan
from disco_hw.estimation import PoseEstimate
from disco_hw.estimation.correction import PoseReason, PoseUpdate
from disco_hw.runtime.pipeline import Source
from drivers.types import PoseSample, PowerSample, WheelSample

# Chosen: longer than a dip, so that it hardly moves the mean, and shorter than the emptying of a battery.
SUPPLY_MEAN_S = 10.0
# Chosen: parts of the mean at which a dip begins and ends; apart, so that noise does not count one dip twice.
DIP_PART = 0.94
DIP_OVER_PART = 0.97
# Two repeats are three equal poses: one repeat may be the same measurement, sent twice.
REPEATS = 2
# Chosen: slower wheels may leave a pose unchanged in its digits.
MOVING_RAD_S = 0.3


@dataclass(frozen=True, slots=True)
class PlausibilityStats:
    """Counters of implausible behaviour.

    Times that a wheel began not to follow its commands (`wheel_faults.WheelFaults` counts them), that the supply
    dipped, and that the pose stayed the same to the last digit while the wheels turned.
    """

    wheels_not_following: int = 0
    supply_dips: int = 0
    poses_frozen: int = 0


class Plausibility:
    """Watches supply and poses.

    The supply dips by 6 % below its mean over 10 s, and has recovered above 3 %. A pose that is repeated twice to the
    last digit is frozen.
    """

    def __init__(self) -> None:
        self.supply_dips = self.poses_frozen = 0
        self._supply_v: float | None = None
        self._supply_ns = 0
        self._dipped = False
        self._poses: dict[int, tuple[tuple[float, float, float], int]] = {}

    def step(
        self, wheels: Sequence[WheelSample], poses: Sequence[PoseSample], power: Sequence[PowerSample]
    ) -> tuple[str, ...]:
        """Take in a tick's samples; returns what began, in words."""
        return (*self._watch_supply(power), *self._watch_poses(poses, wheels))

    def _watch_supply(self, power: Sequence[PowerSample]) -> list[str]:
        events = []
        for sample in power:
            volts = sample.voltage_v
            if not math.isfinite(volts) or volts <= 0.0:
                continue
            mean = volts if self._supply_v is None else self._supply_v
            if not self._dipped and volts < DIP_PART * mean:
                self._dipped = True
                self.supply_dips += 1
                events.append(f"the supply voltage dropped from {mean:.1f} V to {volts:.1f} V")
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
                self.poses_frozen += 1
                events.append("the measured pose does not change while the wheels turn; check the pose sensor")
        return events


# Chosen: shorter reports a robot that only turns on the spot; longer reports a robot that is stuck later. A message
# names it.
WINDOW_NS = 5_000_000_000
LEAST_M = 0.05
"""Who gets no further than this within the window makes no progress; less for a task that is slower than that."""
LEAST_WAY_PART = 0.25
"""Of what the task's speed makes in the window."""
COMMANDED_RAD_S = 0.05
"""A command below this asks for no motion."""
ROLLED_RAD = 0.5
"""Wheels that have turned less in the window stand."""
FOLLOWED_PART = 0.5
"""Unless they have turned by more than this part of what their commands came to."""


class _Span:
    """How far a wheel is from where it began, and how far its extremes lie apart (rad)."""

    def __init__(self) -> None:
        self.now_rad = self._low_rad = self._high_rad = 0.0

    def move_to(self, rad: float) -> None:
        self.now_rad, self._low_rad, self._high_rad = rad, min(self._low_rad, rad), max(self._high_rad, rad)

    @property
    def size_rad(self) -> float:
        return self._high_rad - self._low_rad


class _Window:
    """Since when and where the robot is; how far each wheel has turned there, and was commanded to."""

    def __init__(self, now_ns: int, place_m: tuple[float, float], angles_rad: tuple[float, float] | None) -> None:
        self.begun_ns, self.place_m, self.is_reported = now_ns, place_m, False
        self.largest_rad_s = 0.0
        self.turned, self.commanded = (_Span(), _Span()), (_Span(), _Span())
        self.has_wheels = False
        self._last_ns, self._first_rad = now_ns, angles_rad

    def add(self, now_ns: int, command_rad_s: tuple[float, float], angles_rad: tuple[float, float] | None) -> None:
        """Take in a tick, with the command that it ends with."""
        self.largest_rad_s = max(self.largest_rad_s, *map(abs, command_rad_s))
        since_s, self._last_ns = (now_ns - self._last_ns) * 1e-9, now_ns
        for commanded, speed in zip(self.commanded, command_rad_s, strict=True):
            commanded.move_to(commanded.now_rad + speed * since_s)
        self.has_wheels = angles_rad is not None and self._first_rad is not None
        if angles_rad is not None and self._first_rad is not None:
            for turned, now_rad, first_rad in zip(self.turned, angles_rad, self._first_rad, strict=True):
                turned.move_to(now_rad - first_rad)


class Headway:
    """Watches a running task of this speed; one of NaN, whose places have times and may rest, once these are over."""

    def __init__(self, speed_m_s: float) -> None:
        self._may_rest = math.isnan(speed_m_s)
        self._least_m = LEAST_M if self._may_rest else min(LEAST_M, LEAST_WAY_PART * speed_m_s * WINDOW_NS * 1e-9)
        self._window: _Window | None = None

    def step(
        self, now_ns: int, running: bool, place_m: tuple[float, float], command_rad_s: tuple[float, float],
        wheels: WheelSample | None, planner_failure: str | None, all_due: bool = False,
    ) -> tuple[str, ...]:  # fmt: skip
        """Take in a tick; returns what to say, once for each time that the robot stays.

        `all_due`: the robot should be at the task's end.
        """
        if not running or (self._may_rest and not all_due):
            self._window = None
            return ()
        angles = None if wheels is None else (wheels.left_angle_rad, wheels.right_angle_rad)
        window = self._window
        if window is None or math.dist(place_m, window.place_m) > self._least_m:
            self._window = _Window(now_ns, place_m, angles)
            return ("task: the robot makes progress again",) if window is not None and window.is_reported else ()
        window.add(now_ns, command_rad_s, angles)
        if window.is_reported or now_ns - window.begun_ns < WINDOW_NS:
            return ()
        window.is_reported = True
        return (f"task: no progress for 5 s: {_obstacle(window, planner_failure)}",)


def _obstacle(window: _Window, planner_failure: str | None) -> str:
    """Return the likely reason why the robot does not move, looked for from the commands down to the ground."""
    if planner_failure is not None:
        return f"the planner has no plan: {planner_failure}"
    if window.largest_rad_s < COMMANDED_RAD_S:
        return "the planner commands no motion; check the task and the position of the robot"
    if not window.has_wheels:
        return (
            f"the wheels are commanded up to {window.largest_rad_s:.2f} rad/s, but no wheel data arrive; check the "
            "encoders"
        )
    turned_rad = max(span.size_rad for span in window.turned)
    commanded_rad = max(span.size_rad for span in window.commanded)
    ahead_rad = 0.5 * abs(sum(span.now_rad for span in window.turned))
    if turned_rad < min(ROLLED_RAD, FOLLOWED_PART * commanded_rad):
        return (
            f"the wheels do not turn although commanded up to {window.largest_rad_s:.2f} rad/s: they are blocked, "
            "or have a dead band that the model lacks; free them, or find the dead band with `disco-hw gap`"
        )
    if ahead_rad < ROLLED_RAD:
        return (
            f"the wheels follow their commands, up to {window.largest_rad_s:.2f} rad/s, but these turn the robot on "
            "the spot or to and fro; check the task and the position of the robot"
        )
    return (
        f"the wheels have turned by {turned_rad:.1f} rad, but the pose has not changed: check for slip, an obstacle or "
        "a frozen pose sensor"
    )


MISFITS = 3
"""So many poses in a row outside the gate are reported; by chance that happens once in a billion poses."""
FITS = 10
"""So many that fit, one after the other, end that."""


class PoseJumps:
    """Reports when the estimate of the pose has jumped, and when poses in a row do not fit what the wheels did."""

    def __init__(self) -> None:
        self._before: PoseEstimate | None = None
        self._in_a_row = 0
        self._is_mismatch = False
        self._messages: list[str] = []

    def step(self, estimate: PoseEstimate, updates: Sequence[PoseUpdate]) -> str:
        """Return in words how the estimate has jumped since the tick before; empty if it followed the wheels."""
        for update in updates:
            self._count(update)
        before, self._before = self._before, estimate
        if before is None or estimate.reinitialisations == before.reinitialisations:
            return ""
        moved_m = math.hypot(estimate.x_m - before.x_m, estimate.y_m - before.y_m)
        if not (before.heading_known and estimate.heading_known):
            text = f"the pose jumped by {moved_m:.2f} m, and the heading is no longer known"
        else:
            turned_rad = abs(math.remainder(estimate.yaw_rad - before.yaw_rad, math.tau))
            text = (
                f"the pose jumped by {moved_m:.2f} m and {turned_rad:.2f} rad, which the motion of the wheels does "
                "not explain"
            )
        self._messages.append(
            f"{text}: the robot was carried or has slipped, or the measured poses are wrong; check the pose sensor"
        )
        return text

    def new_messages(self) -> list[str]:
        """Return sentences for the operator since the last call."""
        messages, self._messages = self._messages, []
        return messages

    def _count(self, update: PoseUpdate) -> None:
        if update.reason is PoseReason.GATED and update.innovation is not None:
            self._in_a_row = min(self._in_a_row, 0) - 1
            if self._in_a_row == -MISFITS and not self._is_mismatch:
                self._is_mismatch = True
                off_m = math.hypot(*update.innovation[:2])
                self._messages.append(
                    f"{MISFITS} poses in a row disagree with the wheels, by {off_m:.2f} m, and are not used; check "
                    "the pose sensor"
                )
        elif update.accepted:
            self._in_a_row = max(self._in_a_row, 0) + 1
            self._is_mismatch = self._is_mismatch and self._in_a_row < FITS


# Chosen: a smaller loss of speed is within what a robot's speed varies by anyway.
LIMITED_PART = 0.95
# Chosen: a place that takes so much more of the task's speed is another to know of.
MORE_LIMITED = 0.1
FOLLOWS = (Source.PLAN, Source.TAIL, Source.FALLBACK, Source.RAMP)
"""Sources of the command of a robot that follows its task."""


class PlannerEvents:
    """Says once when the planner begins and ceases to fail, to fall back, or to plan from too few samples.

    A speed that the wheels limit is reported once in a drive, and again where they limit it clearly more. `fallback`
    names the law that drives without a plan.
    """

    def __init__(self, fallback: str) -> None:
        self._fallback = fallback
        self._failing = self._collapsed = self._fell_back = False
        # Part of the task's speed: the last one that was reported in this drive, and that of the last plan.
        self._reported_part = self._last_part = 1.0

    def step(self, source: Source, plan: WheelPlan | None, failure: str | None) -> tuple[str, ...]:
        """Return the events of a tick with this command's source, this new plan, or this failure to make one."""
        events: list[str] = []
        failing = failure is not None
        if failing != self._failing:
            events.append(f"planner: {failure}" if failing else "planner: recovered")
        self._failing = failing
        if source not in FOLLOWS:
            self._reported_part = 1.0
        if plan is None:
            return tuple(events)
        found = plan.diagnostics
        fell_back = source is Source.FALLBACK
        if fell_back is not self._fell_back:
            events.append(
                f"planner: no valid plan; the fallback controller {self._fallback} follows the line instead"
                if fell_back
                else "planner: valid plan again; the planner drives"
            )
        self._fell_back = fell_back
        if found.collapsed != self._collapsed:
            few = f"planner: plans rest on {found.ess:.1f} effective samples, too few to trust the plan"
            events.append(few if found.collapsed else "planner: enough effective samples again")
        self._collapsed = found.collapsed
        if self._is_news(found.speed_part):
            self._reported_part = found.speed_part
            events.append(
                f"planner: the wheels limit the speed here, to {found.speed_part:.0%} of the task's; "
                "the robot follows its line more slowly"
            )
        self._last_part = found.speed_part
        return tuple(events)

    def _is_news(self, part: float) -> bool:
        """Whether the speed is limited for the first time, or clearly more. While the part falls, a corner is near."""
        if self._reported_part == 1.0:
            return part < LIMITED_PART
        return self._last_part <= part < self._reported_part - MORE_LIMITED
