"""Are the wheels wired as robot.toml says? Looked at in the first motion after arming, and the robot stopped if not.

The wheels' counts are compared with what was commanded, and the measured poses with what the counts predict. A wheel
whose encoder and motor both turn the wrong way looks right to the first and not to the second.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from collections.abc import Sequence

from drivers.motor.wiring import Wiring
from drivers.types import PoseSample, WheelCommand, WheelSample

JUDGED_NS = 5_000_000_000
"""Of motion: what turned the right way so long does so."""
MOVES_RAD_S = 0.3
STANDS_RAD_S = 0.15
LEAST_RAD = 0.15
LEAST_SUM_RAD = 0.4
SAMPLES = 3
_OPPOSITE_PART = 0.25
_CROSSED_COSINE, _STRAIGHT_COSINE = 0.97, 0.93
_SLIP_PART = 0.15
_UNKNOWN_PART = 0.2
"""Of the way: a radius that is written down wrongly and slip that lasts, which every pose shows equally."""
_ENOUGH, _MOST_OF_ONE = 10.0, 4.0
"""Of log-likelihood against what robot.toml says, in all and by one pose."""
_LARGEST_TURN_RAD = 1.5
_TURNED_PARTS = (0.4, 0.6, 0.8, 1.0)
"""Of the turn of an ideal robot: a skid-steer turns less, by how much is what the model knows."""
_SIDES = ("left", "right")
Pair = tuple[float, float]


class Directions:
    """Pure, one step a tick; `radius_m` and `track_m` are the nominal ones, `wiring` what robot.toml says of it."""

    def __init__(self, radius_m: float, track_m: float, wiring: Wiring) -> None:
        self._radius_m, self._track_m, self._wiring = radius_m, track_m, wiring
        self._turned: list[tuple[int, float, float]] = []
        self._pose: PoseSample | None = None
        self._begun_ns: int | None = None
        self._last_ns = 0
        self._asked: Pair = (0.0, 0.0)
        self._before: Pair = (0.0, 0.0)
        self._signs: tuple[float, ...] = (0.0, 0.0)
        self._reversed = self._found = False
        self._in_a_row = ("", 0)
        self._evidence: dict[tuple[bool, tuple[int, ...]], float] = {}
        self._reset()

    def step(
        self,
        now_ns: int,
        wheels: Sequence[WheelSample],
        poses: Sequence[PoseSample],
        command: WheelCommand | None,
    ) -> str | None:
        """Take in a tick's samples and the command that it sends; returns once what is wrong and what to change."""
        if command is None:
            self._reset()
            return None
        if self._found or (self._begun_ns is not None and now_ns - self._begun_ns > JUDGED_NS):
            return None
        for sample in wheels:
            self._turned.append((sample.t_ns, sample.left_angle_rad, sample.right_angle_rad))
        asked = (command.left_rad_s, command.right_rad_s)
        if self._begun_ns is None:
            self._wait_for_motion(now_ns, wheels, poses, asked)
        else:
            signs = [math.copysign(1.0, speed) if abs(speed) > MOVES_RAD_S else 0.0 for speed in asked]
            self._reversed = self._reversed or any(a * b < 0.0 for a, b in zip(signs, self._signs, strict=True))
            self._signs = tuple(new or old for new, old in zip(signs, self._signs, strict=True))
            step_s = (now_ns - self._last_ns) * 1e-9
            self._asked = (self._asked[0] + step_s * self._before[0], self._asked[1] + step_s * self._before[1])
            self._before, self._last_ns = asked, now_ns
            found = self._by_commands(wheels) or self._by_poses(poses)
            self._found = found is not None
            return found
        return None

    def _reset(self) -> None:
        self._turned = []
        self._pose = None
        self._begun_ns = None
        self._last_ns = 0
        self._asked = (0.0, 0.0)
        self._before = (0.0, 0.0)
        self._signs = (0.0, 0.0)
        self._reversed = self._found = False
        self._in_a_row = ("", 0)
        every = itertools.product((False, True), itertools.product((1, -1), repeat=2))
        self._evidence = {wired: 0.0 for wired in every if wired != (False, (1, 1))}

    def _wait_for_motion(
        self, now_ns: int, wheels: Sequence[WheelSample], poses: Sequence[PoseSample], asked: Pair
    ) -> None:
        """What turns and moves from here on belongs to a motion that began at rest."""
        with_heading = [pose for pose in poses if pose.has_heading]
        self._pose = with_heading[-1] if with_heading else self._pose
        stands = all(
            max(abs(wheel.left_speed_rad_s), abs(wheel.right_speed_rad_s)) < STANDS_RAD_S for wheel in wheels[-1:]
        )
        if max(map(abs, asked)) > MOVES_RAD_S and stands and self._turned:
            self._begun_ns = self._last_ns = now_ns
            self._before = asked
            self._signs = tuple(math.copysign(1.0, speed) if abs(speed) > MOVES_RAD_S else 0.0 for speed in asked)
        del self._turned[:-1]

    def _moved(self, t_ns: int) -> Pair:
        """How far the wheels have turned at that time, in radians."""
        at = max(bisect_right(self._turned, t_ns, key=lambda entry: entry[0]) - 1, 0)
        _, left, right = self._turned[at]
        return left - self._turned[0][1], right - self._turned[0][2]

    def _by_commands(self, wheels: Sequence[WheelSample]) -> str | None:
        """Sides that turn against what was commanded, or as the other was."""
        if not wheels or self._reversed:
            return None
        turned, asked = self._moved(wheels[-1].t_ns), self._asked
        wrong = [
            side
            for side in (0, 1)
            if turned[side] * math.copysign(1.0, asked[side]) < -max(LEAST_RAD, _OPPOSITE_PART * abs(asked[side]))
        ]
        crossed = (asked[1], asked[0])
        enough = abs(turned[0]) + abs(turned[1]) > LEAST_SUM_RAD
        if enough and _cosine(turned, crossed) > _CROSSED_COSINE and _cosine(turned, asked) < _STRAIGHT_COSINE:
            return self._again(self._words_of_crossed())
        return self._again(self._words_of_opposite(wrong) if wrong else "")

    def _by_poses(self, poses: Sequence[PoseSample]) -> str | None:
        """What else than robot.toml says explains how the robot has moved since it stood."""
        start, declared = self._pose, (False, (1, 1))
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
            off_declared = max(0.0, self._off_m(ahead_m, yaw, turned, *declared) - _UNKNOWN_PART * far_m)
            for wired in self._evidence:
                off = self._off_m(ahead_m, yaw, turned, *wired)
                gain = 0.5 * (off_declared**2 - off**2) / max(variance, 1e-9)
                self._evidence[wired] += min(max(gain, -_MOST_OF_ONE), _MOST_OF_ONE)
        wired = max(self._evidence, key=self._evidence.__getitem__)
        return self._words_of_wiring(*wired) if self._evidence[wired] > _ENOUGH else None

    def _off_m(self, ahead_m: float, yaw_rad: float, turned: Pair, swapped: bool, signs: Sequence[int]) -> float:
        """How far the pose is from where wheels wired so would have taken it; a turn counts as its arc at a wheel."""
        left, right = reversed(turned) if swapped else turned
        left, right = signs[0] * left, signs[1] * right
        ahead = 0.5 * self._radius_m * (left + right)
        arc = 0.5 * self._radius_m * (right - left)
        turned_m = 0.5 * self._track_m * yaw_rad
        return min(math.hypot(ahead_m - ahead, turned_m - part * arc) for part in _TURNED_PARTS)

    def _again(self, words: str) -> str | None:
        """The words, once the same was found so a few times in a row; none are nothing found."""
        before, times = self._in_a_row
        self._in_a_row = (words, times + 1 if words == before else 1)
        return words if words and self._in_a_row[1] == SAMPLES else None

    def _words_of_opposite(self, wrong: Sequence[int]) -> str:
        names = " and the ".join(f"{_SIDES[side]} wheel" for side in wrong)
        encoder = list(self._wiring.encoder_direction)
        motor = list(self._wiring.motor_direction)
        for side in wrong:
            encoder[side], motor[side] = -encoder[side], -motor[side]
        return (
            f"the {names} counted against what was commanded: in robot.toml write wheels.encoder_direction = {encoder} "
            f"if it turned as it should, or wheels.motor_direction = {motor} if it turned the other way"
        )

    def _words_of_crossed(self) -> str:
        crossed = str(not self._wiring.encoders_swapped).lower()
        sides = str(not self._wiring.sides_swapped).lower()
        return (
            "each side counted what the other was commanded: in robot.toml write wheels.encoders_swapped = "
            f"{crossed}, and wheels.sides_swapped = {sides} as well if the robot turned the other way"
        )

    def _words_of_wiring(self, swapped: bool, signs: Sequence[int]) -> str:
        turned = self._moved(self._turned[-1][0])
        backward = [side for side in (0, 1) if signs[side] < 0]
        counted = [side for side in backward if not swapped and turned[side] * self._asked[side] < 0.0]
        motors, encoders = list(self._wiring.motor_direction), list(self._wiring.encoder_direction)
        for side in backward:
            encoders[side] = -encoders[side]
            motors[side] = motors[side] if side in counted else -motors[side]
        changes, said = [], []
        if swapped:
            said.append("left and right are swapped")
            changes.append(f"wheels.sides_swapped = {str(not self._wiring.sides_swapped).lower()}")
        for side in backward:
            way = "counted against what was commanded and turned as it should" if side in counted else "turns backward"
            said.append(f"the {_SIDES[side]} wheel {way}")
        if motors != list(self._wiring.motor_direction):
            changes.append(f"wheels.motor_direction = {motors}")
        if encoders != list(self._wiring.encoder_direction):
            changes.append(f"wheels.encoder_direction = {encoders}")
        return (
            f"the robot moved otherwise than its wheels turned: {', '.join(said)}; in robot.toml write "
            f"{' and '.join(changes)}, unless it is the poses' frame that is wrong ([pose])"
        )


def _cosine(one: Pair, other: Pair) -> float:
    return (one[0] * other[0] + one[1] * other[1]) / max(math.hypot(*one) * math.hypot(*other), 1e-9)
