"""Extended Kalman filters that learn the geometry with the pose: seconds after a change they follow.

State: x, y, yaw; wheel radius, axial distance, x_icr; the slip of either wheel, which comes and goes by itself (a
first-order Gauss-Markov process); how long the measured pose lags behind the wheels: tyres build up their force over
some way, a body has inertia, a time stamp is not exact; and how long the body's sideways speed lags behind its turning.
Without the first lag the yaw that a corner begins with looks like a larger axle. Driven by the turns of the wheels,
corrected by the poses at their own time stamps.

One filter is believed. Beside it run some that say "the robot has just changed": copies whose parameters, all of them
or one, were opened at different times. One that has explained the poses since then so much better that this outweighs
how seldom a robot changes is believed from then on (a generalised likelihood ratio test for the time of a change,
Willsky and Jones 1976; the least likely is replaced by a new one).

Another one runs all the time, with the other ground: a slope, which carries the robot with a constant drift in the
world frame, if the believed filter assumes level ground, and the reverse. It is believed once its evidence outweighs
how seldom the ground changes. So on level ground a change of the geometry is known as soon as without this filter.

What nothing excites stays as it is: a robot that stands gives no evidence at all, and the parameters may change only as
far as the robot drives (the radius) or turns (the other two), so a straight line leaves axle and x_icr alone. When
poses jump, the robot was carried: the pose is taken anew, and the parameters are opened.
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
LAG_S, LAG_STD_S = 0.03, 0.03
"""Of the pose behind the wheels: what is believed at first, and its standard deviation."""
LATERAL_LAG_S, LATERAL_LAG_STD_S, LONGEST_LATERAL_LAG_S = 0.03, 0.03, 0.2
"""How long the body's sideways speed lags behind its turning: what is believed at first, its standard deviation, and
the most that is possible."""
DRIFT_PER_SQRT_M, DRIFT_PER_SQRT_RAD = 0.001, 0.002
"""Random walk, by size: of the radius over a metre driven, of axle and x_icr over a radian turned."""
SMALLEST_X_ICR = 0.5
"""Size of x_icr, in axial distances, where it is smaller: what a robot is tracked by may move away from its centre. A
move by 50 mm is known after 2 to 5 s; with 0.15 a third of it was still missing then."""
LEAST_STD = 0.002
"""A parameter is never believed closer than this, by its size."""
OPENED = 0.12
"""Standard deviation, by size, that a parameter is opened to where it may have changed."""
KINDS = np.array([(1.0, 1.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
"""What may change at once: all three, or one."""
DOUBTERS, HYPOTHESIS_S, HYPOTHESIS_LASTS_S = 16, 0.5, 4.0
"""Filters beside the one that is believed, how much driving lies between their beginnings, and how much proves none."""
CHANGE_LOG_ODDS = -5.0
"""Of a change of one kind having come with one of these beginnings."""
GROUND_LOG_ODDS = -10.0
"""Of level ground having become a slope, or the other way round, at any time. Measured: with -7 what a MuJoCo robot
does on level ground, and these equations lack, passed for a slope in 7 of 20 drives, with -10 in 2."""
MOST_BY_A_POSE = 0.7
"""Log odds that one pose can win or lose for a change: a jolt, or a wrong pose, is short. All of a pose's are scaled
together, as what explains it best must stay ahead."""
INNOVATION_POSES = 50.0
"""Over how many poses the size of the innovations is averaged, by which standard deviations are scaled in that test."""
RUN_POSES, RUNS, LARGEST_RUN = 25, 10.0, 6.0
"""Innovations that are summed, over how many sums the size of these is averaged, and what one counts for at most: a
body that slides by chance shows in no single innovation, but makes them alike for a while, as a change does. The
test's variances are scaled by the square of that size, as it grows less than what slides add."""
CARRIED_M, CARRIED_RAD, CARRIED_POSES = 0.15, 0.3, 6
"""Poses so far from the prediction, so many in a row: the robot was carried."""
WORST_POSE_STD_M = 0.03
"""Poses worse than this are left to the fusion."""
DRIFT_STD_M_S, DRIFT_WALK_M_S = 0.03, 0.0003
"""What a slope carries a robot by, in the world frame, as long as nothing is known of it, and how it changes in a
second."""
# Chosen: over longer gaps the motion between two wheel samples is no arc.
_GAP_NS = 300_000_000
_WAIT_NS = 600_000_000
"""Wheel samples wait so long for a pose, and a pose stamped later than that after them is none: the tick that takes
them in must not have to follow seconds of wheels at once, nor keep them for ever."""
# Below a count of usual encoders: nothing turned.
_STATIONARY_RAD = 1e-4
# Keeps a quotient finite.
_SHORTEST_LAG_S = 1e-4
_SLIDING_STD_S = 0.04
"""What of that comes and goes by itself."""
_STRIDE_S = 0.045
"""Wheel samples between two poses are followed together, along one arc, for so long."""
_ROUGH_M, _ASIDE_M, _ROUGH_RAD = 5e-4, 7e-4, 5e-4
"""Random part of a centimetre driven, along it, to its sides and in heading, which the wheels do not show."""
_X, _Y, _YAW, _RADIUS, _AXLE, _X_ICR, _LEFT, _RIGHT, _LAG, _LATERAL_LAG, _DRIFT_X, _DRIFT_Y = range(12)
# Length of the state above.
_SIZE = 12
_DRIFTS = [_DRIFT_X, _DRIFT_Y]
# Rows of the filter that is believed, and of the one with the other ground.
_BELIEVED, _OTHER_GROUND = 0, 1
_THETA = slice(_RADIUS, _X_ICR + 1)
_SLIPS = slice(_LEFT, _RIGHT + 1)


def _diagonals(matrices: Array) -> Array:
    """Return a view of the diagonals (N, 12) of contiguous matrices (N, 12, 12)."""
    view: Array = matrices.reshape(len(matrices), -1)[:, :: _SIZE + 1]
    return view


class _Bank:
    """Some filters, each a row of `state` (N, 12) and `covariance` (N, 12, 12) in the order above."""

    def __init__(self, theta: Array, covariance: Array) -> None:
        self.state, self.covariance = np.zeros((1, _SIZE)), np.zeros((1, _SIZE, _SIZE))
        self.state[0, _THETA], self.covariance[0, _THETA, _THETA] = theta, covariance
        self.state[0, _LAG], self.covariance[0, _LAG, _LAG] = LAG_S, LAG_STD_S**2
        self.state[0, _LATERAL_LAG] = LATERAL_LAG_S
        self.covariance[0, _LATERAL_LAG, _LATERAL_LAG] = LATERAL_LAG_STD_S**2
        self._velocity, self._sliding_rad_s = np.zeros((1, 3)), np.zeros(1)

    @property
    def on_slope(self) -> NDArray[np.bool_]:
        """Whether the ground may carry the robot, (N,)."""
        return np.asarray(self.covariance[:, _DRIFT_X, _DRIFT_X] > 0.0)

    def predict(self, left: float, right: float, dt_s: float) -> None:
        """Follow wheels that turned so far (rad)."""
        state = self.state
        _, _, yaw, radius, axle, x_icr, slip_left, slip_right = state[:, : _RIGHT + 1].T
        way_left, way_right = radius * left * (1.0 - slip_left), radius * right * (1.0 - slip_right)
        way, turn = 0.5 * (way_left + way_right), (way_right - way_left) / axle
        cosine, sine = np.cos(yaw + 0.5 * turn), np.sin(yaw + 0.5 * turn)
        keep = math.exp(-dt_s / SLIP_S)

        # Derivatives of way and turn by (radius, axle, slip left, slip right), then of the displacement.
        by_way = np.array([way / radius, 0.0 * way, -0.5 * radius * left, -0.5 * radius * right])
        by_turn = np.array([turn / radius, -turn / axle, radius * left / axle, -radius * right / axle])
        x_by_turn = -0.5 * way * sine + x_icr * (sine + 0.5 * turn * cosine)
        y_by_turn = 0.5 * way * cosine - x_icr * (cosine - 0.5 * turn * sine)
        # A body that begins or ends a turn slides to its new motion.
        lags_rad_s, lag_s = turn / dt_s - self._sliding_rad_s, np.maximum(state[:, _LATERAL_LAG], _SHORTEST_LAG_S)
        slides = -np.expm1(-dt_s / lag_s)
        sideways = turn - lags_rad_s * lag_s * slides
        self._sliding_rad_s = self._sliding_rad_s + slides * lags_rad_s
        move_x, move_y = way * cosine + x_icr * sideways * sine, way * sine - x_icr * sideways * cosine
        move_x, move_y = move_x + state[:, _DRIFT_X] * dt_s, move_y + state[:, _DRIFT_Y] * dt_s
        step = np.zeros((len(state), _SIZE, _SIZE))
        _diagonals(step)[:] = 1.0
        step[:, _X, _YAW], step[:, _Y, _YAW] = -move_y, move_x
        step[:, _X, _X_ICR], step[:, _Y, _X_ICR] = sideways * sine, -sideways * cosine
        # How much it lags by now is taken as known: to first order a longer lag misses so much more way.
        missed_m_s = x_icr * lags_rad_s * slides
        step[:, _X, _LATERAL_LAG], step[:, _Y, _LATERAL_LAG] = -missed_m_s * sine, missed_m_s * cosine
        for row, by_driven in (
            (_X, by_way * cosine + by_turn * x_by_turn),
            (_Y, by_way * sine + by_turn * y_by_turn),
            (_YAW, by_turn),
        ):
            # Two slices: numpy takes twice as long to put numbers at a list of places.
            step[:, row, _RADIUS : _AXLE + 1], step[:, row, _SLIPS] = by_driven[:2].T, by_driven[2:].T
        step[:, _X, _DRIFT_X] = step[:, _Y, _DRIFT_Y] = dt_s
        step[:, _LEFT, _LEFT] = step[:, _RIGHT, _RIGHT] = keep

        noise = np.zeros((len(state), _SIZE))
        distance = np.abs(way)
        slid_m = x_icr * _SLIDING_STD_S * (turn / dt_s - self._velocity[:, 2])
        self._velocity = np.stack([move_x, move_y, turn], axis=1) / dt_s
        noise[:, _X] = noise[:, _Y] = _ROUGH_M**2 * distance / 0.01 + slid_m**2
        aside_m2 = (_ASIDE_M**2 - _ROUGH_M**2) * distance / 0.01
        noise[:, _YAW] = _ROUGH_RAD**2 * distance / 0.01
        noise[:, _RADIUS] = (DRIFT_PER_SQRT_M * radius) ** 2 * distance
        noise[:, _AXLE] = (DRIFT_PER_SQRT_RAD * axle) ** 2 * np.abs(turn)
        noise[:, _X_ICR] = (DRIFT_PER_SQRT_RAD * np.maximum(np.abs(x_icr), SMALLEST_X_ICR * axle)) ** 2 * np.abs(turn)
        noise[:, _SLIPS] = SLIP_STD**2 * (1.0 - keep * keep)
        noise[:, _DRIFT_X : _DRIFT_Y + 1] = self.on_slope[:, None] * DRIFT_WALK_M_S**2 * dt_s
        covariance = step @ self.covariance @ step.transpose(0, 2, 1)
        _diagonals(covariance)[:] += noise
        across = np.stack([-sine, cosine], axis=1)
        covariance[:, :2, :2] += aside_m2[:, None, None] * across[:, :, None] * across[:, None, :]
        self.covariance = covariance
        state[:, _X] += move_x
        state[:, _Y] += move_y
        state[:, _YAW] += turn
        state[:, _SLIPS] *= keep

    def expect(self, pose: PoseSample) -> tuple[Array, Array]:
        """Innovations (N, 3) of a pose, and their covariances (N, 3, 3)."""
        lagging = self.state[:, :3] - self.state[:, _LAG, None] * self._velocity
        innovation = np.array([pose.x_m, pose.y_m, pose.yaw_rad]) - lagging
        innovation[:, 2] -= 2.0 * math.pi * np.round(innovation[:, 2] / (2.0 * math.pi))
        variances = np.array([pose.position_std_m, pose.position_std_m, pose.yaw_std_rad]) ** 2
        with_all = self._with_pose()
        return innovation, with_all[:, :3] - self._velocity[:, :, None] * with_all[:, _LAG, None] + np.diag(variances)

    def correct(self, innovation: Array, expected: Array, low: Array, high: Array) -> None:
        """Take a pose in; the parameters stay between `low` and `high`."""
        gain = np.linalg.solve(expected, self._with_pose().transpose(0, 2, 1)).transpose(0, 2, 1)
        self.state += (gain @ innovation[:, :, None])[:, :, 0]
        covariance = self.covariance - gain @ expected @ gain.transpose(0, 2, 1)
        self.covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
        self.state[:, _THETA] = np.clip(self.state[:, _THETA], low, high)
        self.state[:, _LATERAL_LAG] = np.clip(self.state[:, _LATERAL_LAG], 0.0, LONGEST_LATERAL_LAG_S)

    def _with_pose(self) -> Array:
        """Covariances (N, 12, 3) of the state with the pose that is measured."""
        return self.covariance[:, :, :3] - self.covariance[:, :, _LAG, None] * self._velocity[:, None]

    def keep(self, rows: NDArray[np.int64]) -> None:
        """Go on with these rows only, in this order; one may come twice."""
        self.state, self.covariance = self.state[rows], self.covariance[rows]
        self._velocity, self._sliding_rad_s = self._velocity[rows], self._sliding_rad_s[rows]

    def widen(self, row: int, widest: Array) -> None:
        """Let the parameters of a row be as wide as this (3,), or as they are."""
        block = self.covariance[row, _THETA, _THETA]
        block += np.diag(np.maximum(widest**2 - np.diag(block), 0.0))

    def toggle_ground(self, row: int) -> None:
        """Turn level ground into a slope of unknown drift for this row, or a slope into level ground."""
        is_level = not self.on_slope[row]
        self.state[row, _DRIFTS] = 0.0
        self.covariance[row, _DRIFTS] = self.covariance[row, :, _DRIFTS] = 0.0
        self.covariance[row, _DRIFTS, _DRIFTS] = DRIFT_STD_M_S**2 if is_level else 0.0

    def place(self, pose: PoseSample) -> None:
        """Take the pose as it was measured; what is believed of the robot stays."""
        self.state[:, :3] = np.array([pose.x_m, pose.y_m, pose.yaw_rad]) + self.state[:, _LAG, None] * self._velocity
        self.state[:, _SLIPS] = 0.0
        theta, lag = self.covariance[:, _THETA, _THETA].copy(), self.covariance[:, _LAG, _LAG].copy()
        lateral = self.covariance[:, _LATERAL_LAG, _LATERAL_LAG].copy()
        self.covariance[:] = 0.0
        self.covariance[:, _THETA, _THETA], self.covariance[:, _LAG, _LAG] = theta, lag
        self.covariance[:, _LATERAL_LAG, _LATERAL_LAG] = lateral
        spread = np.diag(np.array([pose.position_std_m, pose.position_std_m, pose.yaw_std_rad]) ** 2)
        with_lag = self._velocity * lag[:, None]
        self.covariance[:, :3, :3] = spread + self._velocity[:, :, None] * with_lag[:, None]
        self.covariance[:, :3, _LAG] = self.covariance[:, _LAG, :3] = with_lag
        self.covariance[:, _LEFT, _LEFT] = self.covariance[:, _RIGHT, _RIGHT] = SLIP_STD**2
        self.state[:, _DRIFTS] = 0.0


class GeometryFilter:
    """Learns (wheel radius, axial distance, x_icr) from `mean` (3,) and `covariance` (3, 3), within `low` and `high`.

    Learns too whether the ground carries the robot, as a slope does, and by how much. Pure: no clock, the same samples
    give the same numbers bit for bit.
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
        self._bank = _Bank(self._first, self._first_covariance)
        self._log_odds, self._age_s, self._moved_s = np.zeros(1), np.zeros(1), 0.0
        self._placed = False
        self._at: WheelSample | None = None
        self._rolled_rad, self._due = 0.0, np.zeros(3)
        # Running mean of the squared innovations over their expectation: 1 if all is as believed.
        self.innovation_ratio, self._astray = 1.0, 0
        self._run, self._run_poses, self._run_innovation_ratio = np.zeros(3), 0, 1.0

    @property
    def mean(self) -> Array:
        """Wheel radius, axial distance, x_icr (m)."""
        return np.array(self._bank.state[0, _THETA])

    @property
    def drift_m_s(self) -> tuple[float, float]:
        """How fast the ground carries the moving robot along x and y of the world."""
        x_m_s, y_m_s = self._bank.state[_BELIEVED, _DRIFTS].tolist()
        return x_m_s, y_m_s

    @property
    def lateral_lag_s(self) -> float:
        """How long the body's sideways speed lags behind its turning."""
        return float(self._bank.state[_BELIEVED, _LATERAL_LAG])

    @property
    def lateral_lag_std_s(self) -> float:
        """Standard deviation of that."""
        return float(np.sqrt(self._bank.covariance[_BELIEVED, _LATERAL_LAG, _LATERAL_LAG]))

    @property
    def drift_std_m_s(self) -> float:
        """Standard deviation of the part of the drift that is known better; 0 on level ground."""
        return float(np.sqrt(self._bank.covariance[_BELIEVED, _DRIFTS, _DRIFTS].min()))

    @property
    def on_slope(self) -> bool:
        """Whether the ground is believed to carry the robot."""
        return bool(self._bank.on_slope[_BELIEVED])

    @property
    def covariance(self) -> Array:
        """Covariance (3, 3) of the mean, m^2, scaled by how much larger the innovations are than expected.

        On rough ground the wheels slip more than is assumed. Without the scale the 90 % intervals of the axial distance
        held the truth 65 % of the time there, with it 82 %.
        """
        found = self._variance_scale * self._bank.covariance[0, _THETA, _THETA] + np.diag((LEAST_STD * self._size) ** 2)
        return np.asarray(0.5 * (found + found.T))

    @property
    def mismatch(self) -> float:
        """Ratio of squared innovations to expected ones, of single poses or of sums, the larger one; 1 if they fit."""
        return max(self.innovation_ratio, self._run_innovation_ratio)

    @property
    def _size(self) -> Array:
        """Sizes (3,) of the parameters, m, by which they may change."""
        radius, axle, x_icr = self.mean.tolist()
        return np.array([radius, axle, max(abs(x_icr), SMALLEST_X_ICR * axle)])

    @property
    def _variance_scale(self) -> float:
        """Ratio of the innovations' variance to the expected one, of single poses or of sums of them; at least 1."""
        return max(self.innovation_ratio, self._run_innovation_ratio**2, 1.0)

    def add(self, wheels: tuple[WheelSample, ...], poses: tuple[PoseSample, ...]) -> None:
        """Take in what has come; a pose waits until the wheels are known up to its time."""
        self._wheels.extend(
            sample for sample in wheels if math.isfinite(sample.left_angle_rad + sample.right_angle_rad)
        )
        while self._wheels and self._wheels[-1].t_ns - self._wheels[0].t_ns > _WAIT_NS:
            self._wheels.popleft()
        newest_ns = self._wheels[-1].t_ns if self._wheels else self._at.t_ns if self._at is not None else 0
        for pose in poses:
            is_complete = math.isfinite(pose.x_m + pose.y_m + pose.yaw_rad)
            if is_complete and pose.position_std_m <= WORST_POSE_STD_M and pose.t_ns - newest_ns <= _WAIT_NS:
                self._poses.append(pose)
        while self._poses and self._wheels and self._wheels[-1].t_ns >= self._poses[0].t_ns:
            pose = self._poses.popleft()
            self._roll_to(pose.t_ns)
            if self._at is not None and self._at.t_ns <= pose.t_ns:
                self._update(pose)

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
        if turned < _STATIONARY_RAD or not self._placed:
            return
        self._rolled_rad += turned
        self._due += (left, right, (sample.t_ns - before.t_ns) * 1e-9)
        if self._due[2] > _STRIDE_S:
            self._predict()

    def _predict(self) -> None:
        """Follow the wheels since the last prediction."""
        left, right, dt_s = self._due.tolist()
        self._due[:] = 0.0
        self._moved_s += dt_s
        if dt_s > 0.0:
            self._bank.predict(left, right, dt_s)

    def _update(self, pose: PoseSample) -> None:
        if not self._placed:
            self._place(pose)
            return
        if self._rolled_rad < _STATIONARY_RAD:
            return
        self._rolled_rad = 0.0
        self._predict()
        innovations, spreads = self._bank.expect(pose)
        innovation, expected = innovations[0], spreads[0]
        far = math.hypot(*innovation[:2].tolist()) > max(CARRIED_M, 5.0 * math.sqrt(expected[0, 0] + expected[1, 1]))
        if far or abs(innovation[2]) > max(CARRIED_RAD, 5.0 * math.sqrt(expected[2, 2])):
            self._astray += 1
            if self._astray >= CARRIED_POSES:
                self.carried += 1
                self._bank.widen(0, self._widest())
                self._place(pose)
            return
        self._astray = 0
        self.poses += 1
        squares = np.einsum("ni,ni->n", innovations, np.linalg.solve(spreads, innovations[:, :, None])[:, :, 0])
        self.innovation_ratio += (min(float(squares[0]) / 3.0, 20.0) - self.innovation_ratio) / INNOVATION_POSES
        self._follow_run(innovation, expected)
        surprise = 0.5 * (squares / self._variance_scale + np.linalg.slogdet(spreads)[1])
        won = surprise[0] - surprise
        self._log_odds += won * min(1.0, MOST_BY_A_POSE / max(float(np.abs(won).max()), MOST_BY_A_POSE))
        self._bank.correct(innovations, spreads, self._low, self._high)
        # As the ground may change at any time, the evidence against it is never larger.
        self._log_odds[_OTHER_GROUND] = max(self._log_odds[_OTHER_GROUND], GROUND_LOG_ODDS)
        best = int(np.argmax(self._log_odds))
        if best != _BELIEVED:
            self.changes += best != _OTHER_GROUND
            self._only(best)
        elif self._moved_s > HYPOTHESIS_S:
            self._add_hypotheses()
            is_old = self._age_s[_OTHER_GROUND] > HYPOTHESIS_LASTS_S
            if is_old and self._log_odds[_OTHER_GROUND] == GROUND_LOG_ODDS:
                self._restart_other_ground()

    def _follow_run(self, innovation: Array, expected: Array) -> None:
        """Take one innovation into the sum, and the sum into the mean of their sizes: 1 if they are independent."""
        self._run += np.linalg.solve(np.linalg.cholesky(expected), innovation)
        self._run_poses += 1
        if self._run_poses == RUN_POSES:
            size = min(float(self._run @ self._run) / (3.0 * RUN_POSES), LARGEST_RUN)
            self._run_innovation_ratio += (size - self._run_innovation_ratio) / RUNS
            self._run[:], self._run_poses = 0.0, 0

    def _add_hypotheses(self) -> None:
        """Let new filters, one of each kind, say that the robot changes now; the least likely go."""
        self._moved_s = 0.0
        self._age_s += HYPOTHESIS_S
        lasting = [_BELIEVED, _OTHER_GROUND]
        young = len(lasting) + np.flatnonzero(self._age_s[len(lasting) :] < HYPOTHESIS_LASTS_S)
        likeliest = young[np.argsort(-self._log_odds[young], kind="stable")[: DOUBTERS - len(KINDS)]]
        kept = np.concatenate([lasting, np.sort(likeliest)])
        self._bank.keep(np.concatenate([kept, np.zeros(len(KINDS), dtype=np.int64)]))
        self._log_odds = np.concatenate([self._log_odds[kept], np.full(len(KINDS), CHANGE_LOG_ODDS)])
        self._age_s = np.concatenate([self._age_s[kept], np.zeros(len(KINDS))])
        for row, kind in enumerate(KINDS, start=len(kept)):
            self._bank.widen(row, self._widest() * kind)

    def _only(self, row: int) -> None:
        """Believe this filter, and drop the others except that of the other ground."""
        # After a change of the geometry a new filter with a slope would explain too much: the old one stays.
        is_change = row > _OTHER_GROUND
        rows = np.array([row, _OTHER_GROUND if is_change else row])
        self._bank.keep(rows)
        self._log_odds, self._age_s, self._moved_s = self._log_odds[rows] - self._log_odds[row], self._age_s[rows], 0.0
        if not is_change:
            self._restart_other_ground()

    def _restart_other_ground(self) -> None:
        """Restart the filter of the other ground from the believed one, with the geometry opened."""
        rows = np.arange(len(self._log_odds))
        rows[_OTHER_GROUND] = _BELIEVED
        self._bank.keep(rows)
        self._bank.toggle_ground(_OTHER_GROUND)
        self._bank.widen(_OTHER_GROUND, self._widest())
        self._log_odds[_OTHER_GROUND], self._age_s[_OTHER_GROUND] = GROUND_LOG_ODDS, 0.0

    def _widest(self) -> Array:
        """Return standard deviations (3,) of what may have changed, within the prior."""
        return np.minimum(OPENED * self._size, (self._high - self._low) / math.sqrt(12.0))

    def _place(self, pose: PoseSample) -> None:
        """Take the pose as it was measured."""
        self._bank.place(pose)
        self._only(_BELIEVED)
        self._placed, self._rolled_rad, self._astray = True, 0.0, 0
        self._due[:] = 0.0
