"""Looks at a robot's first motion: are the wheels wired as robot.toml says? If not, the robot is stopped.

What the wheels count is compared with what was commanded, and the measured poses with what the counts predict: a wheel
whose encoder and motor both turn the wrong way looks right to the first and not to the second. Once the wiring is known
to be right, no later fault is a matter of wiring, and `wheel_faults` says what it is.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

from drivers.motor import Wiring
from drivers.types import PoseSample, WheelCommand, WheelSample

_SIDES = ("left", "right")
EVALUATED_NS = 5_000_000_000
"""Of motion: what turned the right way so long does so."""
# Chosen: a slower command may turn no wheel, so it shows nothing of the wiring.
MOVES_RAD_S = 0.3
# Chosen: half of MOVES_RAD_S, so that the noise of a measured speed is no motion.
STATIONARY_RAD_S = 0.15
# Chosen: less than this against the command may be play or a push; more is a wheel that turns the wrong way.
LEAST_RAD = 0.15
# Chosen: of both wheels together; with less, noise decides which side turned more.
LEAST_SUM_RAD = 0.4
LEAST_PART = 0.1
"""Of the other wheel's turning: one that turned by less stood, and shows nothing of which side it is on."""
# Chosen: the same finding in so many ticks in a row, as one odd sample must not stop a robot.
SAMPLES = 3
# Chosen: part of the commanded turn, so that a long command needs more evidence than LEAST_RAD.
_OPPOSITE_PART = 0.25
# Chosen: crossed must fit well and straight badly, so that commands that are nearly equal decide nothing.
_CROSSED_COSINE, _STRAIGHT_COSINE = 0.97, 0.93
# Chosen: standard deviation, as part of the way, of what a robot moves otherwise than its wheels count.
_SLIP_PART = 0.15
# Chosen: part of the commanded turn; a wheel that counts less may have an encoder that fails.
_COUNTED_PART = 0.25
_UNKNOWN_PART = 0.2
"""Of the way: a radius that is written down wrongly and slip that lasts, which every pose shows equally."""
_ENOUGH, _MOST_OF_ONE = 10.0, 4.0
"""Of log-likelihood against what robot.toml says, in all and by one pose."""
# Chosen: under a quarter turn; the line between two poses says too little of a longer arc.
_LARGEST_TURN_RAD = 1.5
_MOVED_STD, _START_STD, _MOST_STARTS = 6.0, 2.0, 50
"""Standard deviations of a pose at rest that are no motion, and of their mean; how many count."""
_TURNED_PARTS = (0.4, 0.6, 0.8, 1.0)
"""Of the turn of an ideal robot: a skid-steer turns less, by how much is what the model knows."""
Pair = tuple[float, float]


class _Start(NamedTuple):
    """The mean of poses at rest, of one source."""

    source: int
    x_m: float
    y_m: float
    yaw_rad: float
    poses: int

    @staticmethod
    def of(pose: PoseSample) -> _Start:
        """Create the mean from its first pose."""
        return _Start(pose.source, pose.x_m, pose.y_m, pose.yaw_rad, 1)

    def with_pose(self, pose: PoseSample) -> _Start:
        """Take in one more; another source, or a place that noise does not explain, begins again."""
        yaw = math.remainder(pose.yaw_rad - self.yaw_rad, 2.0 * math.pi)
        away_m = math.hypot(pose.x_m - self.x_m, pose.y_m - self.y_m)
        moved = away_m > _MOVED_STD * pose.position_std_m or abs(yaw) > _MOVED_STD * pose.yaw_std_rad
        if pose.source != self.source or moved:
            return _Start.of(pose)
        part = 1.0 / (self.poses + 1)
        x_m, y_m = self.x_m + part * (pose.x_m - self.x_m), self.y_m + part * (pose.y_m - self.y_m)
        return _Start(self.source, x_m, y_m, self.yaw_rad + part * yaw, min(self.poses + 1, _MOST_STARTS))


class Directions:
    """Pure, one step a tick; `radius_m` and `track_m` are the nominal ones, `wiring` what robot.toml says of it.

    The wiring is judged once: after five seconds of motion without a finding it is known to be right.
    """

    def __init__(self, radius_m: float, track_m: float, wiring: Wiring) -> None:
        self._radius_m, self._track_m, self._wiring = radius_m, track_m, wiring
        self.is_evaluated = False
        self._reset()

    def _reset(self) -> None:
        self._turned: list[tuple[int, float, float]] = []
        self._start: _Start | None = None
        self._begun_ns: int | None = None
        self._last_ns = 0
        self._commanded: Pair = (0.0, 0.0)
        self._before: Pair = (0.0, 0.0)
        self._signs: tuple[float, ...] = (0.0, 0.0)
        self._reversed = self._found = False
        self._in_a_row = ("", 0)
        every = itertools.product((False, True), itertools.product((1, -1), repeat=2))
        self._evidence: dict[tuple[bool, tuple[int, ...]], float]
        self._evidence = {wired: 0.0 for wired in every if wired != (False, (1, 1))}

    def step(
        self,
        now_ns: int,
        wheels: Sequence[WheelSample],
        poses: Sequence[PoseSample],
        command: WheelCommand | None,
        has_followed: tuple[bool, bool] = (False, False),
        is_suspect: bool = False,
    ) -> str | None:
        """Take in a tick's samples and the command that it sends; returns once what is wrong and what to change.

        `has_followed`: wheels that have counted as commanded before, which cannot be wired the other way round.
        `is_suspect`: a wheel does not follow now, so that poses do not show how it is wired.
        """
        if command is None:
            self._reset()
            return None
        self.is_evaluated = self.is_evaluated or (self._begun_ns is not None and now_ns - self._begun_ns > EVALUATED_NS)
        if self._found or self.is_evaluated:
            return None
        for sample in wheels:
            self._turned.append((sample.t_ns, sample.left_angle_rad, sample.right_angle_rad))
        commanded = (command.left_rad_s, command.right_rad_s)
        if self._begun_ns is None:
            self._wait_for_motion(now_ns, wheels, poses, commanded)
        else:
            signs = _signs(commanded)
            self._reversed = self._reversed or any(a * b < 0.0 for a, b in zip(signs, self._signs, strict=True))
            self._signs = tuple(new or old for new, old in zip(signs, self._signs, strict=True))
            step_s = (now_ns - self._last_ns) * 1e-9
            self._commanded = (
                self._commanded[0] + step_s * self._before[0],
                self._commanded[1] + step_s * self._before[1],
            )
            self._before, self._last_ns = commanded, now_ns
            found = self._by_commands(wheels, has_followed) or (None if is_suspect else self._by_poses(poses))
            self._found = found is not None
            return found
        return None

    def _wait_for_motion(
        self, now_ns: int, wheels: Sequence[WheelSample], poses: Sequence[PoseSample], commanded: Pair
    ) -> None:
        """Update the mean pose at rest, and begin an observed motion once the robot is commanded to move from rest."""
        for pose in poses:
            if pose.has_heading:
                self._start = _Start.of(pose) if self._start is None else self._start.with_pose(pose)
        is_stationary = all(
            max(abs(wheel.left_speed_rad_s), abs(wheel.right_speed_rad_s)) < STATIONARY_RAD_S for wheel in wheels[-1:]
        )
        if max(map(abs, commanded)) > MOVES_RAD_S and is_stationary and self._turned:
            self._begun_ns = self._last_ns = now_ns
            self._before = commanded
            self._signs = _signs(commanded)
        del self._turned[:-1]

    def _moved(self, t_ns: int) -> Pair:
        """Return by how much (rad) the wheels have turned from the first kept sample to that time."""
        at = max(bisect_right(self._turned, t_ns, key=lambda entry: entry[0]) - 1, 0)
        _, left, right = self._turned[at]
        return left - self._turned[0][1], right - self._turned[0][2]

    def _by_commands(self, wheels: Sequence[WheelSample], has_followed: tuple[bool, bool]) -> str | None:
        """Sides that turn against what was commanded, or as the other was."""
        if not wheels or self._reversed:
            return None
        turned, commanded = self._moved(wheels[-1].t_ns), self._commanded
        wrong = [
            side
            for side in (0, 1)
            if not has_followed[side]
            and turned[side] * math.copysign(1.0, commanded[side])
            < -max(LEAST_RAD, _OPPOSITE_PART * abs(commanded[side]))
        ]
        crossed = (commanded[1], commanded[0])
        enough = abs(turned[0]) + abs(turned[1]) > LEAST_SUM_RAD and min(map(abs, turned)) > LEAST_PART * max(
            map(abs, turned)
        )
        if enough and _cosine(turned, crossed) > _CROSSED_COSINE and _cosine(turned, commanded) < _STRAIGHT_COSINE:
            return self._again(self._describe_crossed())
        return self._again(self._describe_opposite(wrong) if wrong else "")

    def _by_poses(self, poses: Sequence[PoseSample]) -> str | None:
        """Return the wiring, other than that of robot.toml, that explains the motion since rest; None if none does."""
        start, declared = self._start, (False, (1, 1))
        counted = self._moved(self._turned[-1][0])
        if any(
            abs(turn) < _COUNTED_PART * abs(commanded) for turn, commanded in zip(counted, self._commanded, strict=True)
        ):
            # A wheel that does not count says nothing of how it is wired.
            return None
        for pose in poses:
            if start is None or not pose.has_heading or pose.source != start.source:
                continue
            turned = self._moved(pose.t_ns)
            yaw = math.remainder(pose.yaw_rad - start.yaw_rad, 2.0 * math.pi)
            if abs(yaw) > _LARGEST_TURN_RAD:
                continue
            along = start.yaw_rad + 0.5 * yaw
            ahead_m = (pose.x_m - start.x_m) * math.cos(along) + (pose.y_m - start.y_m) * math.sin(along)
            far_m = 0.5 * self._radius_m * (abs(turned[0]) + abs(turned[1]))
            arc_std_m = 0.5 * self._track_m * pose.yaw_std_rad
            variance = 2.0 * (pose.position_std_m**2 + arc_std_m**2) + (_SLIP_PART * far_m) ** 2
            # All poses share the start's error, which may be no evidence.
            start_m = _START_STD * math.hypot(pose.position_std_m, arc_std_m) / math.sqrt(start.poses)
            off_declared = max(0.0, self._off_m(ahead_m, yaw, turned, *declared) - _UNKNOWN_PART * far_m - start_m)
            for wired in self._evidence:
                off = self._off_m(ahead_m, yaw, turned, *wired)
                gain = 0.5 * (off_declared**2 - off**2) / max(variance, 1e-9)
                self._evidence[wired] += min(max(gain, -_MOST_OF_ONE), _MOST_OF_ONE)
        wired = max(self._evidence, key=self._evidence.__getitem__)
        return self._describe_wiring(*wired) if self._evidence[wired] > _ENOUGH else None

    def _off_m(self, ahead_m: float, yaw_rad: float, turned: Pair, swapped: bool, signs: Sequence[int]) -> float:
        """Return the distance (m) of the pose from where wheels wired so lead; a turn counts as its arc at a wheel."""
        left, right = reversed(turned) if swapped else turned
        left, right = signs[0] * left, signs[1] * right
        ahead = 0.5 * self._radius_m * (left + right)
        arc = 0.5 * self._radius_m * (right - left)
        turned_m = 0.5 * self._track_m * yaw_rad
        return min(math.hypot(ahead_m - ahead, turned_m - part * arc) for part in _TURNED_PARTS)

    def _again(self, text: str) -> str | None:
        """Return the words once the same was found a few times in a row; no words mean that nothing was found."""
        before, times = self._in_a_row
        self._in_a_row = (text, times + 1 if text == before else 1)
        return text if text and self._in_a_row[1] == SAMPLES else None

    def _describe_opposite(self, wrong: Sequence[int]) -> str:
        names = " and the ".join(f"{_SIDES[side]} wheel" for side in wrong)
        encoder = list(self._wiring.encoder_direction)
        motor = list(self._wiring.motor_direction)
        for side in wrong:
            encoder[side], motor[side] = -encoder[side], -motor[side]
        return (
            f"the {names} counted opposite to the command: in robot.toml write wheels.encoder_direction = {encoder} "
            f"if it turned as commanded, or wheels.motor_direction = {motor} if it turned the other way"
        )

    def _describe_crossed(self) -> str:
        crossed = str(not self._wiring.encoders_swapped).lower()
        sides = str(not self._wiring.sides_swapped).lower()
        return (
            "each side counted what the other side was commanded: in robot.toml write wheels.encoders_swapped = "
            f"{crossed}, and wheels.sides_swapped = {sides} as well if the robot turned the other way"
        )

    def _describe_wiring(self, swapped: bool, signs: Sequence[int]) -> str:
        turned = self._moved(self._turned[-1][0])
        backward = [side for side in (0, 1) if signs[side] < 0]
        counted = [side for side in backward if not swapped and turned[side] * self._commanded[side] < 0.0]
        motors, encoders = list(self._wiring.motor_direction), list(self._wiring.encoder_direction)
        for side in backward:
            encoders[side] = -encoders[side]
            motors[side] = motors[side] if side in counted else -motors[side]
        changes, texts = [], []
        if swapped:
            texts.append("left and right are swapped")
            changes.append(f"wheels.sides_swapped = {str(not self._wiring.sides_swapped).lower()}")
        for side in backward:
            way = "counted opposite to its command but turned as commanded" if side in counted else "turns backward"
            texts.append(f"the {_SIDES[side]} wheel {way}")
        if motors != list(self._wiring.motor_direction):
            changes.append(f"wheels.motor_direction = {motors}")
        if encoders != list(self._wiring.encoder_direction):
            changes.append(f"wheels.encoder_direction = {encoders}")
        return (
            f"the poses and the wheels show different motion: {', '.join(texts)}; in robot.toml write "
            f"{' and '.join(changes)}, or correct [pose] if the frame of the poses is wrong"
        )


def _signs(speeds: Pair) -> tuple[float, ...]:
    """Return the direction of each commanded wheel; 0 for one that may not turn."""
    return tuple(math.copysign(1.0, speed) if abs(speed) > MOVES_RAD_S else 0.0 for speed in speeds)


def _cosine(one: Pair, other: Pair) -> float:
    return (one[0] * other[0] + one[1] * other[1]) / max(math.hypot(*one) * math.hypot(*other), 1e-9)
