"""Finds a wheel that does not obey: by its commands, its counts and the measured poses, as three witnesses.

Two cumulative sums (one-sided CUSUM, Page 1954) watch each wheel, both in radians. `missing` grows while a wheel
turns by less than half of what it is expected to: the least command of the time in which delay and lag may still hold
it back, less what the wheel has shown to lose of its commands (dead band, sag, load). `beyond` grows while it turns
faster than any command explains. The poses are the third witness: straight lines through the newest of them say how
fast each wheel truly turned. They tell an encoder from a motor, and they find an encoder that does not count where
commands are too slow to expect anything.

A robot with slip, dead band, stiction, lag, lifted wheels or rough ground stays below: its wheels lose a part of what
is expected, and what they lose for long is learnt.
"""

from __future__ import annotations

import enum
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from disco_hw.estimation.odometry import OdometryParameters
from disco_hw.runtime.pose_travel import KEPT_NS, PoseTravel
from drivers.types import PoseSample, WheelCommand, WheelSample

DELAY_NS = 600_000_000
"""Delay and lag of a wheel together: what was commanded so long ago may still be on its way."""
EXPECTED_PART = 0.5
"""A wheel that turns by this part of what it is expected to follows; drift of the CUSUM between sound and standing."""
# Chosen: smaller stops a robot for a stone or loose gears; larger lets a blocked wheel turn the robot further first.
MISSING_RAD = 0.08
SHORTEST_NS = 300_000_000
"""A wheel may stand for less against a stone."""
LONGEST_NS = 400_000_000
# Chosen: an encoder too coarse for its robot looks so several times a second.
REPORTED_AGAIN_NS = 5_000_000_000
"""So long after the first sign at most is waited for poses that tell the cause; not with a controller that stops
by a ramp of its own, which takes longer.
"""
UNKNOWN_LOSS_RAD_S = 1.5
"""Dead band and stiction of a wheel that has not turned since it stood."""
# Chosen: an overshoot of the speed loop stays below part and amount; the angle lets no single sample decide.
FASTER_PART, FASTER_RAD_S, BEYOND_RAD = 1.25, 0.5, 0.1
BODY_TURN_PART = 1.5
"""A base that is given speeds of the body may turn by wheels that differ by so much more than those asked for."""
# Chosen: as LEAST_RAD of plausibility, more than play or a push.
FOLLOWED_RAD = 0.15
# Chosen: below it, commanded and counted, a wheel is at rest, and may stick when it starts again.
RESTS_RAD_S = 0.1
# Chosen: time constant of a command as a speed loop may follow it; longer expects less after each change.
_SMOOTH_S = 0.15
# Chosen: a smaller loss is learnt sooner than a larger one, so that a failing wheel is not soon taken for what is
# expected.
_FILTER_S, _LOSES_LESS_S, _LOSES_MORE_S = 0.3, 0.5, 2.0
_SIDES = ("left", "right")


class Cause(enum.Enum):
    """Causes of a wheel fault, as text for the operator; {side} is filled in."""

    ENCODER_SILENT = (
        "the {side} wheel turns, as the poses show, but its encoder does not count: the encoder is frozen or "
        "disconnected; check its plug and cable"
    )
    ENCODER_REVERSED = (
        "the {side} wheel's encoder suddenly counts backwards, but the poses show that the wheel turns as "
        "commanded; check the encoder's cable and channels"
    )
    STANDS = (
        "the {side} wheel does not turn although it is commanded to: it is blocked, its motor has no power, or "
        "the motor controller has lost its encoder; free the wheel, check the cables of motor and encoder"
    )
    RUNS_AWAY = (
        "the {side} wheel runs away: it turns much faster than commanded; check the motor controller, and the cables "
        "of motor and encoder"
    )
    TURNS_BACKWARD = (
        "the {side} wheel turns opposite to its command, as its encoder and the poses show; check the motor "
        "controller and the motor's cable"
    )
    SILENT = (
        "the {side} wheel's encoder does not count although the wheel is commanded to turn, and the poses do not "
        "show whether it turns: the encoder is frozen or disconnected, or the wheel is blocked; check both"
    )
    OPPOSED = (
        "the {side} wheel suddenly counts opposite to its command, and the poses do not show which way it turns: "
        "its encoder is reversed, or its motor turns the wrong way; check the cables of both"
    )


@dataclass(frozen=True, slots=True)
class WheelFault:
    """Cause of a wheel fault, and at which wheel or both."""

    cause: Cause
    side: str

    @property
    def status_text(self) -> str:
        """For a person, with what to look at."""
        return self.cause.value.format(side=self.side)


class _Commanded(NamedTuple):
    """A command of one wheel (rad/s): the slowest it may mean, as it stands and smoothed, and the fastest.

    Smoothed, as a wheel's angle is the integral of its commands: what a planner adds and takes away again is no loss.
    `widened`: by how much the slowest is less than the command itself, for a base that turns more than it is asked to.
    """

    slowest: float = 0.0
    smoothed: float = 0.0
    fastest: float = 0.0
    widened: float = 0.0


def _commanded(speed: float, other: float, turn_part: float, before: _Commanded, elapsed_s: float) -> _Commanded:
    """Return the command of one wheel given the other's; wheels may differ by up to `turn_part` of it."""
    mean = 0.5 * (speed + other)
    turned = mean + turn_part * (speed - mean)
    slowest = min((speed, turned), key=abs) if turned * speed > 0.0 else 0.0
    smoothed = before.smoothed + (slowest - before.smoothed) * -math.expm1(-elapsed_s / _SMOOTH_S)
    return _Commanded(slowest, smoothed, max(abs(speed), abs(turned)), abs(speed - slowest))


@dataclass(slots=True)
class _Wheel:
    """State of one wheel.

    Angles and speeds are in the direction of its command, `angle_rad` and `speed_rad_s` as counted.
    """

    angle_rad: float = math.nan
    speed_rad_s: float = 0.0
    loss_rad_s: float = UNKNOWN_LOSS_RAD_S
    missing_rad: float = 0.0
    beyond_rad: float = 0.0
    since_ns: int = 0
    expected_rad: float = 0.0
    counted_rad: float = 0.0
    followed_rad: float = 0.0
    direction: float = 1.0
    is_reported: bool = False
    reported_ns: int | None = None

    def rest(self) -> None:
        """Clear what is expected of the wheel, because nothing is commanded."""
        self.missing_rad = self.beyond_rad = self.expected_rad = self.counted_rad = 0.0
        self.loss_rad_s, self.is_reported = UNKNOWN_LOSS_RAD_S, False

    def step(self, t_ns: int, dt_s: float, turned_rad: float, commands: Sequence[_Commanded]) -> None:
        """Take in by how much it was counted, and the commands that may be in force meanwhile."""
        low = high = newest = commands[-1].slowest
        _, _, most, widened = commands[0]
        # By comparisons, as the smallest of lists take twice as long, in every tick.
        for _, smoothed, fastest, wider in commands:
            if smoothed < low:
                low = smoothed
            elif smoothed > high:
                high = smoothed
            most = fastest if fastest > most else most
            widened = wider if wider < widened else widened
        is_one_way = low >= 0.0 < high or low < 0.0 >= high
        if is_one_way:
            self.direction = 1.0 if high > 0.0 else -1.0
        least = max(low, -high, 0.0)
        progress = self.direction * turned_rad
        self._learn(dt_s, turned_rad, least, max(abs(low), abs(high)), abs(newest), widened)
        expected = max(least - max(self.loss_rad_s, -widened), 0.0) * dt_s
        self.beyond_rad = max(self.beyond_rad + abs(turned_rad) - (FASTER_PART * most + FASTER_RAD_S) * dt_s, 0.0)
        # Without a command that must be in force by now a wheel may turn either way.
        self.missing_rad = self.missing_rad + EXPECTED_PART * expected - progress if least > 0.0 else 0.0
        # Bounded, so that a wheel that follows again is soon clear of what was.
        self.missing_rad = min(self.missing_rad, 2.0 * MISSING_RAD)
        if self.missing_rad <= 0.0:
            self.missing_rad, self.since_ns = 0.0, t_ns
            self.expected_rad = self.counted_rad = 0.0
            self.is_reported = False
            self.followed_rad += max(progress, 0.0) if is_one_way else 0.0
        else:
            self.expected_rad += expected
            self.counted_rad += progress

    def _learn(
        self, dt_s: float, turned_rad: float, least_rad_s: float, most_rad_s: float, newest_rad_s: float,
        widened_rad_s: float,
    ) -> None:  # fmt: skip
        """Learn what it loses of its commands while it turns by them; a wheel that came to rest may stick again.

        While commands change, a wheel that lags behind them seems to lose less, or more, than it does. So it loses less
        than was known only if that holds by the largest command that may be in force, and more only by the least.
        The loss is negative, by `widened_rad_s` at most, where the base does not turn more than it is asked to.
        """
        if dt_s > 0.0:
            self.speed_rad_s += (turned_rad / dt_s - self.speed_rad_s) * -math.expm1(-dt_s / _FILTER_S)
        speed, commanded_rad_s = self.direction * self.speed_rad_s, 0.5 * (least_rad_s + most_rad_s)
        if newest_rad_s < RESTS_RAD_S and abs(speed) < RESTS_RAD_S:
            self.loss_rad_s = UNKNOWN_LOSS_RAD_S
        elif speed > EXPECTED_PART * max(commanded_rad_s - self.loss_rad_s, 0.1 * commanded_rad_s):
            known = self.loss_rad_s
            loses = max(min(max(known, least_rad_s - speed), most_rad_s - speed), -widened_rad_s)
            time_s = _LOSES_LESS_S if loses < known else _LOSES_MORE_S
            self.loss_rad_s += (loses - known) * -math.expm1(-dt_s / time_s)

    @property
    def has_followed(self) -> bool:
        """Whether the wheel has ever counted as commanded, for long enough to know how it is wired."""
        return self.followed_rad > FOLLOWED_RAD

    @property
    def is_suspect(self) -> bool:
        """Whether less of the evidence than stops the robot speaks against it."""
        return self.missing_rad > 0.5 * MISSING_RAD or self.beyond_rad > 0.5 * BEYOND_RAD

    def is_missing(self, now_ns: int) -> bool:
        """Return whether the counts show that the wheel does not follow its command."""
        return self.missing_rad > MISSING_RAD and now_ns - self.since_ns >= SHORTEST_NS

    @property
    def is_backward(self) -> bool:
        """Whether the wheel counted backward during the motion that does not follow its command."""
        return self.counted_rad < -0.25 * max(self.expected_rad, 0.5 * self.missing_rad)


DECIDED = 2.5
"""Standard deviations from the middle between two explanations."""
COUNTED_PART = 0.2
"""A wheel counts if it counts this part of what the poses show."""
SLIP_PART = 0.1
"""By so much of its speed a wheel may slip."""
SEEN = 4.0
"""Standard deviations of a motion that the counts deny."""
# Chosen: sooner after the first sign, poses may show the motion before it.
_SETTLED_NS = 60_000_000


class WheelFaults:
    """Pure, one step a tick and, after it, the command that the tick sent.

    `events` of a step say when a wheel begins not to follow; `not_following` counts them. `takes_body_speeds`: the base
    makes wheel speeds of its own. `stops_by_own_ramp`: see `SafetyCard`.
    """

    def __init__(self, takes_body_speeds: bool = False, stops_by_own_ramp: bool = False) -> None:
        self._turn_part = BODY_TURN_PART if takes_body_speeds else 1.0
        self._longest_ns = SHORTEST_NS if stops_by_own_ramp else LONGEST_NS
        self._wheels = (_Wheel(), _Wheel())
        self._travel = PoseTravel()
        self._commands: deque[tuple[int, tuple[_Commanded, _Commanded]]] = deque()
        self._counted: deque[tuple[int, float, float]] = deque()
        self.not_following = 0
        self.events: tuple[str, ...] = ()

    @property
    def has_followed(self) -> tuple[bool, bool]:
        """Whether left and right have ever counted as commanded: from then on the wiring is known to be right."""
        left, right = self._wheels
        return left.has_followed, right.has_followed

    @property
    def is_suspect(self) -> bool:
        """Whether a wheel does not follow now, so that poses cannot say how it is wired."""
        return any(wheel.is_suspect for wheel in self._wheels)

    def commanded(self, now_ns: int, command: WheelCommand | None) -> None:
        """Take in what a tick sent; None for nothing."""
        if command is None:
            self._commands.clear()
            for wheel in self._wheels:
                wheel.rest()
            return
        left, right = command.left_rad_s, command.right_rad_s
        before_ns, before = self._commands[-1] if self._commands else (now_ns, (_Commanded(), _Commanded()))
        elapsed_s = max(now_ns - before_ns, 0) * 1e-9
        commanded = (
            _commanded(left, right, self._turn_part, before[0], elapsed_s),
            _commanded(right, left, self._turn_part, before[1], elapsed_s),
        )
        self._commands.append((now_ns, commanded))

    def step(
        self, now_ns: int, wheels: Sequence[WheelSample], poses: Sequence[PoseSample], geometry: OdometryParameters,
        is_wiring_known: bool = True,
    ) -> WheelFault | None:  # fmt: skip
        """Take in a tick's samples; returns what is wrong, for as long as it is.

        Without `is_wiring_known` a wheel that never counted as commanded and counts backward is left to others.
        """
        has_new_pose = sum(self._travel.add(pose) for pose in poses) > 0
        events: list[str] = []
        for sample in wheels:
            self._handle(sample)
            events += self._begun(sample.t_ns)
        self.events = tuple(events)
        if not self._commands or now_ns - self._commands[0][0] < DELAY_NS // 2:
            return None
        return (
            self._runaway(geometry)
            or self._missing(now_ns, geometry, is_wiring_known)
            or (self._unseen(geometry) if has_new_pose else None)
        )

    def _handle(self, sample: WheelSample) -> None:
        counted = self._counted
        dt_s = max(sample.t_ns - counted[-1][0], 0) * 1e-9 if counted else 0.0
        counted.append((sample.t_ns, sample.left_angle_rad, sample.right_angle_rad))
        while sample.t_ns - counted[0][0] > KEPT_NS:
            counted.popleft()
        sent = self._commands
        while len(sent) > 1 and sample.t_ns - sent[1][0] > DELAY_NS:
            sent.popleft()
        for side, angle in enumerate((sample.left_angle_rad, sample.right_angle_rad)):
            wheel = self._wheels[side]
            turned, wheel.angle_rad = angle - wheel.angle_rad, angle
            if sent and math.isfinite(turned):
                wheel.step(sample.t_ns, dt_s, turned, [commanded[side] for _, commanded in sent])

    def _begun(self, t_ns: int) -> list[str]:
        """Words for each wheel that begins not to follow, and of which nothing was said for a while."""
        messages = []
        for wheel, name in zip(self._wheels, _SIDES, strict=True):
            if wheel.is_suspect and not wheel.is_reported:
                wheel.is_reported = True
                self.not_following += 1
                if wheel.reported_ns is not None and t_ns - wheel.reported_ns < REPORTED_AGAIN_NS:
                    continue
                wheel.reported_ns = t_ns
                commanded = self._commands[-1][1][_SIDES.index(name)].slowest
                messages.append(
                    f"the {name} wheel does not follow its command: {wheel.speed_rad_s:.1f} rad/s, commanded "
                    f"{commanded:.1f} rad/s"
                )
        return messages

    def _runaway(self, geometry: OdometryParameters) -> WheelFault | None:
        found = [side for side in (0, 1) if self._wheels[side].beyond_rad > BEYOND_RAD]
        if not found:
            return None
        wheel = self._wheels[found[0]]
        if wheel.is_backward and wheel.missing_rad > MISSING_RAD:
            # Its loop runs away with an encoder that is reversed, or it runs away backward.
            turns = self._turns(found[0], geometry)
            if turns is not None and turns > 0:
                return WheelFault(Cause.ENCODER_REVERSED, _names(found))
        return WheelFault(Cause.RUNS_AWAY, _names(found))

    def _missing(self, now_ns: int, geometry: OdometryParameters, is_wiring_known: bool) -> WheelFault | None:
        known = [is_wiring_known or self._wheels[side].has_followed for side in (0, 1)]
        suspect = [side for side in (0, 1) if self._wheels[side].missing_rad > 0.5 * MISSING_RAD]
        suspect = [side for side in suspect if known[side] or not self._wheels[side].is_backward]
        found = [side for side in suspect if self._wheels[side].is_missing(now_ns)]
        if not found:
            # Where the poses deny the counts, nothing may be waited for: the loop may be running away. A wheel that
            # slows down from the middle does not look so, so that the poses count from the first sign on.
            found = [side for side in suspect if self._turns(side, geometry, SEEN, 0) == 1]
        if not found:
            return None
        wheel = self._wheels[found[0]]
        turns = self._turns(found[0], geometry)
        if turns is None and self._travel.newest_ns is not None and now_ns - wheel.since_ns < self._longest_ns:
            return None
        if wheel.is_backward:
            causes = {1: Cause.ENCODER_REVERSED, -1: Cause.TURNS_BACKWARD, 0: Cause.OPPOSED, None: Cause.OPPOSED}
        else:
            causes = {1: Cause.ENCODER_SILENT, -1: Cause.ENCODER_SILENT, 0: Cause.STANDS, None: Cause.SILENT}
        return WheelFault(causes[turns], _names(found))

    def _turns(
        self, side: int, geometry: OdometryParameters, sure: float = DECIDED, settled_ns: int = _SETTLED_NS
    ) -> int | None:
        """Return how a wheel that does not follow turns: 1 as commanded, 0 not, -1 backward; None if unclear."""
        wheel = self._wheels[side]
        seen = self._travel.wheel_speeds(wheel.since_ns + settled_ns, geometry)
        newest_ns = self._travel.newest_ns
        if seen is None or newest_ns is None:
            return None
        lasted_s = (newest_ns - wheel.since_ns) * 1e-9
        speed = wheel.direction * seen[side]
        middle = 0.5 * max(wheel.expected_rad, abs(wheel.counted_rad)) / lasted_s
        std = math.hypot(seen.std_rad_s, SLIP_PART * 2.0 * middle)
        if speed - middle > sure * std:
            return 1
        if speed + middle < -sure * std:
            return -1
        return 0 if middle - abs(speed) > sure * std else None

    def _unseen(self, geometry: OdometryParameters) -> WheelFault | None:
        """Return a wheel that the poses show to turn as it is asked to, and that does not count; the other one does."""
        since_ns, newest = self._commands[0][0], self._commands[-1][1]
        # One that has turned since it stood is known by what it is expected to do.
        quiet = [
            side
            for side, wheel in enumerate(self._wheels)
            if wheel.loss_rad_s > 0.5 * UNKNOWN_LOSS_RAD_S
            and abs(wheel.speed_rad_s) < COUNTED_PART * abs(newest[side].slowest)
        ]
        seen = self._travel.wheel_speeds(since_ns, geometry) if len(quiet) == 1 else None
        counted = None if seen is None else self._counted_speeds(since_ns)
        if seen is None or counted is None:
            return None
        (side,) = quiet
        commanded = newest[side].slowest
        speed = math.copysign(1.0, commanded) * seen[side]
        std = math.hypot(seen.std_rad_s, SLIP_PART * max(map(abs, seen[:2])))
        counts = abs(counted[side]) > COUNTED_PART * speed
        agrees = abs(seen[1 - side] - counted[1 - side]) < DECIDED * std + 0.2 * abs(speed)
        if counts or not agrees or speed < max(SEEN * std, 0.5 * abs(commanded)):
            return None
        return WheelFault(Cause.ENCODER_SILENT, _SIDES[side])

    def _counted_speeds(self, since_ns: int) -> tuple[float, float] | None:
        """Mean speeds that were counted since then."""
        used = [entry for entry in self._counted if entry[0] >= since_ns]
        lasted_s = (used[-1][0] - used[0][0]) * 1e-9 if used else 0.0
        if lasted_s <= 0.0:
            return None
        return (used[-1][1] - used[0][1]) / lasted_s, (used[-1][2] - used[0][2]) / lasted_s


def _names(sides: Sequence[int]) -> str:
    return " and the ".join(_SIDES[side] for side in sides)
