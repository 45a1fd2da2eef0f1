"""An extended Kalman filter that learns the geometry with the pose: seconds after a change it follows.

State: x, y, yaw; wheel radius, axial distance, x_icr; and the slip of either wheel, which comes and goes by itself (a
first-order Gauss-Markov process). Driven by the turns of the wheels, corrected by the poses at their own time stamps.

What nothing excites stays as it is: a robot that stands gives no evidence at all, and the parameters may change only as
far as the robot drives (the radius) or turns (the other two), so a straight line leaves axle and x_icr alone. When
poses go on to disagree with what the filter predicts, the robot has changed, and the parameters are opened anew, never
wider than they were believed at first; when they jump, it was carried, and the pose is taken anew as well.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from drivers.types import PoseSample, WheelSample

Array = NDArray[np.float64]

SLIP_STD, SLIP_S = 0.035, 0.2
"""Slip of a wheel as a part of its way, and how long it lasts."""
DRIFT_PER_SQRT_M, DRIFT_PER_SQRT_RAD = 0.001, 0.002
"""Random walk, by size: of the radius over a metre driven, of axle and x_icr over a radian turned."""
LEAST_STD = 0.002
"""A parameter is never believed closer than this, by its size."""
OPENED = 0.12
"""Standard deviation, by size, that a parameter is opened to when the robot has changed."""
CHANGED_SIGMAS, CHANGED_S = 3.5, 1.0
"""Innovations that go on to one side (forward, left or round), averaged over so long, mean a change beyond so many
standard deviations of that average: those of a filter that knows its robot are white."""
MISFIT_POSES = 50.0
"""Over how many poses the size of the innovations is averaged, by which their standard deviations are scaled."""
EXCITED_M, EXCITED_RAD = 0.03, 0.1
"""Only a robot that has driven or turned so much in CHANGED_S can show that its radius, or axle and x_icr, changed."""
CARRIED_M, CARRIED_RAD, CARRIED_POSES = 0.15, 0.3, 6
"""Poses so far from the prediction, so many in a row: the robot was carried."""
WORST_POSE_STD_M = 0.03
"""Poses worse than this are left to the fusion."""
_GAP_NS = 300_000_000
_WAIT_NS = 600_000_000
"""Wheel samples wait so long for a pose, and a pose stamped later than that after them is none: the tick that takes
them in must not have to follow seconds of wheels at once, nor keep them for ever."""
_STANDS_RAD = 1e-4
_ROUGH_M, _ROUGH_RAD = 2e-4, 5e-4
_X, _Y, _YAW, _RADIUS, _AXLE, _X_ICR, _LEFT, _RIGHT = range(8)
_THETA = slice(_RADIUS, _X_ICR + 1)


class GeometryFilter:
    """Learns (wheel radius, axial distance, x_icr) from `mean` (3,) and `covariance` (3, 3), within `low` and `high`.

    Pure: no clock, the same samples give the same numbers bit for bit.
    """

    def __init__(self, mean: Array, covariance: Array, low: Array, high: Array) -> None:
        self._first, self._first_covariance = mean.copy(), covariance.copy()
        self._low, self._high = low, high
        self._wheels: deque[WheelSample] = deque()
        self._poses: deque[PoseSample] = deque()
        self.changes = self.carried = self.poses = 0
        self.reset()

    def reset(self) -> None:
        """Believe again what was believed at first, of a robot that may be anywhere."""
        self._state = np.zeros(8)
        self._state[_THETA] = self._first
        self._covariance = np.zeros((8, 8))
        self._covariance[_THETA, _THETA] = self._first_covariance
        self._placed = False
        self._at: WheelSample | None = None
        self._rolled_rad = 0.0
        self._misfit, self._astray = 1.0, 0
        self._one_sided, self._last_pose_ns = np.zeros(3), 0
        self._way_m = self._turn_rad = 0.0

    @property
    def mean(self) -> Array:
        """Wheel radius, axial distance, x_icr (m)."""
        return np.array(self._state[_THETA])

    @property
    def covariance(self) -> Array:
        """Of the mean, with the least standard deviation that is believed."""
        found = self._covariance[_THETA, _THETA] + np.diag((LEAST_STD * self._state[_THETA]) ** 2)
        return np.asarray(0.5 * (found + found.T))

    @property
    def misfit(self) -> float:
        """Running mean of the squared innovations over their expectation: 1 if all is as believed."""
        return self._misfit

    def add(self, wheels: tuple[WheelSample, ...], poses: tuple[PoseSample, ...]) -> None:
        """Take in what has come; a pose waits until the wheels are known up to its time."""
        self._wheels.extend(
            sample for sample in wheels if math.isfinite(sample.left_angle_rad + sample.right_angle_rad)
        )
        while self._wheels and self._wheels[-1].t_ns - self._wheels[0].t_ns > _WAIT_NS:
            self._wheels.popleft()
        newest_ns = self._wheels[-1].t_ns if self._wheels else self._at.t_ns if self._at is not None else 0
        for pose in poses:
            whole = math.isfinite(pose.x_m + pose.y_m + pose.yaw_rad)
            if whole and pose.position_std_m <= WORST_POSE_STD_M and pose.t_ns - newest_ns <= _WAIT_NS:
                self._poses.append(pose)
        while self._poses and self._wheels and self._wheels[-1].t_ns >= self._poses[0].t_ns:
            pose = self._poses.popleft()
            self._roll_to(pose.t_ns)
            if self._at is not None and self._at.t_ns <= pose.t_ns:
                self._take(pose)

    def _roll_to(self, t_ns: int) -> None:
        """Follow the wheels up to a time; between two samples they turn evenly."""
        while self._wheels and self._wheels[0].t_ns <= t_ns:
            self._roll(self._wheels.popleft())
        if self._wheels and self._at is not None and self._at.t_ns < t_ns:
            after, before = self._wheels[0], self._at
            part = (t_ns - before.t_ns) / (after.t_ns - before.t_ns)
            left = before.left_angle_rad + part * (after.left_angle_rad - before.left_angle_rad)
            right = before.right_angle_rad + part * (after.right_angle_rad - before.right_angle_rad)
            self._roll(WheelSample(t_ns, t_ns, left, right, after.left_speed_rad_s, after.right_speed_rad_s))

    def _roll(self, sample: WheelSample) -> None:
        before, self._at = self._at, sample
        if before is None or sample.t_ns <= before.t_ns:
            return
        if sample.t_ns - before.t_ns > _GAP_NS:
            # What the wheels did in between is not known.
            self._placed = False
            return
        left, right = sample.left_angle_rad - before.left_angle_rad, sample.right_angle_rad - before.right_angle_rad
        turned = abs(left) + abs(right)
        if turned < _STANDS_RAD or not self._placed:
            return
        self._rolled_rad += turned
        self._predict(left, right, (sample.t_ns - before.t_ns) * 1e-9)

    def _predict(self, left: float, right: float, dt_s: float) -> None:
        state = self._state
        _, _, yaw, radius, axle, x_icr, slip_left, slip_right = state.tolist()
        way_left, way_right = radius * left * (1.0 - slip_left), radius * right * (1.0 - slip_right)
        way, turn = 0.5 * (way_left + way_right), (way_right - way_left) / axle
        cosine, sine = math.cos(yaw + 0.5 * turn), math.sin(yaw + 0.5 * turn)
        keep = math.exp(-dt_s / SLIP_S)
        state[_X] += way * cosine + x_icr * turn * sine
        state[_Y] += way * sine - x_icr * turn * cosine
        state[_YAW] += turn
        state[_LEFT] *= keep
        state[_RIGHT] *= keep

        # Derivatives of way and turn by (radius, axle, slip left, slip right), then of the displacement.
        by_way = (way / radius, 0.0, -0.5 * radius * left, -0.5 * radius * right)
        by_turn = (turn / radius, -turn / axle, radius * left / axle, -radius * right / axle)
        x_by_turn = -0.5 * way * sine + x_icr * (sine + 0.5 * turn * cosine)
        y_by_turn = 0.5 * way * cosine - x_icr * (cosine - 0.5 * turn * sine)
        step = np.eye(8)
        step[_X, _YAW], step[_Y, _YAW] = -way * sine + x_icr * turn * cosine, way * cosine + x_icr * turn * sine
        step[_X, _X_ICR], step[_Y, _X_ICR] = turn * sine, -turn * cosine
        for column, d_way, d_turn in zip((_RADIUS, _AXLE, _LEFT, _RIGHT), by_way, by_turn, strict=True):
            step[_X, column] = d_way * cosine + d_turn * x_by_turn
            step[_Y, column] = d_way * sine + d_turn * y_by_turn
            step[_YAW, column] = d_turn
        step[_LEFT, _LEFT] = step[_RIGHT, _RIGHT] = keep
        recent = math.exp(-dt_s / CHANGED_S)
        self._way_m, self._turn_rad = recent * self._way_m + abs(way), recent * self._turn_rad + abs(turn)
        covariance = step @ self._covariance @ step.T
        distance = abs(way)
        noise = [_ROUGH_M**2 * distance / 0.01, _ROUGH_M**2 * distance / 0.01, _ROUGH_RAD**2 * distance / 0.01]
        noise.append((DRIFT_PER_SQRT_M * radius) ** 2 * distance)
        noise.append((DRIFT_PER_SQRT_RAD * axle) ** 2 * abs(turn))
        noise.append((DRIFT_PER_SQRT_RAD * x_icr) ** 2 * abs(turn))
        noise += [SLIP_STD**2 * (1.0 - keep * keep)] * 2
        covariance[np.diag_indices(8)] += noise
        self._covariance = covariance

    def _take(self, pose: PoseSample) -> None:
        if not self._placed:
            self._place(pose)
            return
        if self._rolled_rad < _STANDS_RAD:
            return
        self._rolled_rad = 0.0
        state, covariance = self._state, self._covariance
        measured = np.array([pose.x_m, pose.y_m, pose.yaw_rad])
        innovation = measured - state[:3]
        innovation[2] = math.remainder(float(innovation[2]), 2.0 * math.pi)
        variances = np.array([pose.position_std_m, pose.position_std_m, pose.yaw_std_rad]) ** 2
        expected = covariance[:3, :3] + np.diag(variances)
        far = math.hypot(*innovation[:2].tolist()) > max(CARRIED_M, 5.0 * math.sqrt(expected[0, 0] + expected[1, 1]))
        if far or abs(innovation[2]) > max(CARRIED_RAD, 5.0 * math.sqrt(expected[2, 2])):
            self._astray += 1
            if self._astray >= CARRIED_POSES:
                self.carried += 1
                self._open(True, True)
                self._place(pose)
            return
        self._astray = 0
        self.poses += 1
        gain = np.linalg.solve(expected, covariance[:3]).T
        misfit = float(innovation @ np.linalg.solve(expected, innovation)) / 3.0
        self._misfit += (min(misfit, 20.0) - self._misfit) / MISFIT_POSES
        changed = self._goes_on(pose.t_ns, innovation, expected)
        state += gain @ innovation
        covariance = covariance - gain @ expected @ gain.T
        self._covariance = 0.5 * (covariance + covariance.T)
        state[_THETA] = np.clip(state[_THETA], self._low, self._high)
        driven, turned = self._way_m > EXCITED_M, self._turn_rad > EXCITED_RAD
        if changed and (driven or turned):
            self.changes += 1
            self._open(driven, turned)

    def _goes_on(self, t_ns: int, innovation: Array, expected: Array) -> bool:
        """Whether innovations have gone on to one side of the body for so long that the robot must have changed."""
        elapsed_s, self._last_pose_ns = (t_ns - self._last_pose_ns) * 1e-9, t_ns
        part = 1.0 - math.exp(-min(elapsed_s, 1.0) / CHANGED_S)
        cosine, sine = math.cos(self._state[_YAW]), math.sin(self._state[_YAW])
        x, y, yaw = innovation.tolist()
        scale = np.sqrt(np.diag(expected) * max(self._misfit, 1.0))
        self._one_sided += part * (
            np.array([x * cosine + y * sine, y * cosine - x * sine, yaw]) / scale - self._one_sided
        )
        return bool(np.abs(self._one_sided).max() > CHANGED_SIGMAS * math.sqrt(part / (2.0 - part)))

    def _place(self, pose: PoseSample) -> None:
        """Take the pose as it was measured; what is believed of the robot stays."""
        self._state[:3] = pose.x_m, pose.y_m, pose.yaw_rad
        self._state[_LEFT:] = 0.0
        theta = self._covariance[_THETA, _THETA].copy()
        self._covariance = np.zeros((8, 8))
        self._covariance[_THETA, _THETA] = theta
        spread = [pose.position_std_m**2, pose.position_std_m**2, pose.yaw_std_rad**2]
        np.fill_diagonal(self._covariance[:3, :3], spread)
        self._covariance[_LEFT, _LEFT] = self._covariance[_RIGHT, _RIGHT] = SLIP_STD**2
        self._placed, self._rolled_rad, self._astray = True, 0.0, 0

    def _open(self, radius: bool, others: bool) -> None:
        """Let parameters be as far from the mean as they may change at once, and not further than at first."""
        self._one_sided[:] = 0.0
        at_first = np.sqrt(np.diag(self._first_covariance))
        widest = np.minimum(OPENED * np.abs(self._state[_THETA]), np.maximum(at_first, 0.0))
        wider = np.maximum(widest**2 - np.diag(self._covariance)[_THETA], 0.0) * (radius, others, others)
        self._covariance[_THETA, _THETA] += np.diag(wider)
