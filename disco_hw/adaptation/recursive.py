"""The fast estimator: sufficient statistics of the drive in closed form, with a test for a change at every instant.

All evidence since the last change counts alike, on top of what was believed before it; what is older than the window is
folded into one Gaussian. At every split of the window the new part's score is tested against what the old part
predicts: a tyre that loses air or a new floor shows within seconds, and everything from before is then forgotten except
that parameters do not change by more than `CHANGE`. Slow drift is let in as a random walk.

Evidence is kept in coordinates in which the increments between two poses are linear,

    beta = (r_w, gamma, kappa),  kappa = r_w / a_w,  gamma = x_icr kappa:

given yaw, the displacement is r_w (roll_L + roll_R)/2 along and -gamma (roll_R - roll_L) across the body, the change
of yaw kappa (roll_R - roll_L); over a longer way both directions shrink by sin(h)/h with h half the turn. Neighbouring
displacements share a pose and its noise; the bidiagonal factor of `inference.estimates` whitens them in one pass, after
which every pose adds J'J to the information and J'y to the score.
"""

from __future__ import annotations

from bisect import insort
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_banded

from disco_hw.adaptation.adapter_link import PoseReading, Samples, WheelAngles
from disco_hw.inference.estimates import Whitening, whitening
from disco_hw.inference.excitation import USUAL, Excitation, Noise, UnusableDriveError, excitation
from disco_hw.log.drive import Commands, DriveLog, Gyro, Poses
from disco_hw.log.drive import Wheels as WheelArrays

Array = NDArray[np.float64]
Index = NDArray[np.int64]

CHANGE = np.array([0.15, 0.3, 0.3])
"""What may change at once: standard deviations of x_icr (m), and of wheel radius and axial distance by their size."""

DRIFT_PER_SQRT_S = np.array([5e-4, 5e-4, 5e-4])
"""Random walk of the same three while the robot moves; half a percent of the radius in 100 s."""

_SPLIT_S = 0.5
_LEAST_VARIANCE = 1e-14


@dataclass(frozen=True, eq=False, slots=True)
class Judged:
    """What is known of theta (order of `link.NAMES`): `mean` (3,), `covariance` (3, 3).

    `data_s` of driving since `since_s` it rests on; `largest_change` is the chi-square (3 degrees) of the worst split,
    and `changed_s` when a change was found in this update, else None. `misfit` is the mean square of what this geometry
    leaves of the window, 1 if the noise is what it is taken to be.
    """

    mean: Array
    covariance: Array
    since_s: float
    data_s: float
    largest_change: float
    changed_s: float | None
    misfit: float


class RecursiveGeometry:
    """The estimator; `mean` (3,) and `covariance` (3, 3) of theta are what is believed before the drive.

    `change_limit`: chi-square above which a split is a change; evidence from before `since_s` does not count. Pure: no
    clock, the same calls give the same results.
    """

    def __init__(self, mean: Array, covariance: Array, change_limit: float, since_s: float = 0.0) -> None:
        self._change_limit = change_limit
        self._mean, self._covariance = to_linear(mean, covariance)
        self._folded_s = self._since_s = since_s
        self._data_s = 0.0

    def judge(self, window: Evidence, fold_before_s: float) -> Judged:
        """Take in the window's evidence; what is older than `fold_before_s` need not come again."""
        part = window.part(window.t_s > self._folded_s)
        split_s, worst = self._worst_split(part)
        changed_s = None
        if worst > self._change_limit and split_s is not None:
            changed_s = split_s
            self._open(split_s)
            part = window.part(window.t_s > self._folded_s)
        mean, covariance = self._with(part)
        misfit = _misfit(part, mean)
        theta, spread = from_linear(mean, covariance)
        judged = Judged(theta, spread, self._since_s, self._data_s + _moving_s(part), worst, changed_s, misfit)
        self._fold(part, fold_before_s)
        return judged

    def _worst_split(self, part: Evidence) -> tuple[float | None, float]:
        """When what follows fits worst to what was before, and the chi-square of that."""
        if part.t_s.size < 3:
            return None, 0.0
        splits = np.arange(part.t_s[0], part.t_s[-1] - _SPLIT_S, _SPLIT_S)
        first = np.searchsorted(part.t_s, splits)
        total, score = part.information.sum(axis=0), part.score.sum(axis=0)
        before = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(part.information, axis=0)])[first]
        score_before = np.concatenate([np.zeros((1, 3)), np.cumsum(part.score, axis=0)])[first]
        prior = np.linalg.inv(self._covariance)
        known = np.linalg.inv(before + prior)
        old = np.einsum("sij,sj->si", known, score_before + prior @ self._mean)
        later = total - before
        surprise = score - score_before - np.einsum("sij,sj->si", later, old)
        spread = later + later @ known @ later
        # Directions that nothing was learnt of say nothing; the scale makes "nothing" comparable between them.
        scale = np.sqrt(np.maximum(np.diagonal(spread, axis1=1, axis2=2), 1e-12))
        unit = spread / (scale[:, :, None] * scale[:, None, :]) + 1e-9 * np.eye(3)
        surprise = surprise / scale
        distance2 = np.einsum("si,si->s", surprise, np.linalg.solve(unit, surprise[..., None])[..., 0])
        worst = int(np.argmax(distance2))
        return float(splits[worst]), float(distance2[worst])

    def _open(self, split_s: float) -> None:
        """Forget what was before: the old mean, plus all that may have changed."""
        theta, spread = from_linear(self._mean, self._covariance)
        sizes = CHANGE * np.array([1.0, theta[1], theta[2]])
        self._mean, self._covariance = to_linear(theta, spread + np.diag(sizes**2))
        self._folded_s = self._since_s = split_s
        self._data_s = 0.0

    def _with(self, part: Evidence) -> tuple[Array, Array]:
        prior = np.linalg.inv(self._covariance)
        covariance = np.linalg.inv(prior + part.information.sum(axis=0))
        mean = covariance @ (prior @ self._mean + part.score.sum(axis=0))
        return mean, 0.5 * (covariance + covariance.T) + _LEAST_VARIANCE * np.eye(3)

    def _fold(self, part: Evidence, before_s: float) -> None:
        old = part.part(part.t_s <= before_s)
        if not old.t_s.size:
            return
        self._mean, covariance = self._with(old)
        moved_s = _moving_s(old)
        theta, _ = from_linear(self._mean, covariance)
        sizes = DRIFT_PER_SQRT_S * np.array([1.0, theta[1], theta[2]])
        _, drift = to_linear(theta, moved_s * np.diag(sizes**2))
        self._covariance = covariance + drift
        self._folded_s = float(old.t_s[-1])
        self._data_s += moved_s


def _moving_s(part: Evidence) -> float:
    return float(part.moving_s.sum())


def _misfit(part: Evidence, mean: Array) -> float:
    values = float(part.values.sum())
    if values < 9.0:
        return 1.0
    information, score = part.information.sum(axis=0), part.score.sum(axis=0)
    return float((part.square.sum() - 2.0 * mean @ score + mean @ information @ mean) / (values - 3.0))


@dataclass(frozen=True, eq=False, slots=True)
class Evidence:
    """Of poses at `t_s` (P,): `information` (P, 3, 3) and `score` (P, 3) of beta, `square` (P,) of what was measured.

    Everything is whitened. `rows` (P, 3, 4): of x, y and yaw what was measured, and its coefficients of beta. `values`
    (P,) counts the measured numbers: 3, or 0 at the start of a run; `moving_s` (P,) is the time in motion since the
    pose before.
    """

    t_s: Array
    information: Array
    score: Array
    square: Array
    values: Array
    moving_s: Array
    rows: Array

    def part(self, chosen: NDArray[np.bool_]) -> Evidence:
        """The evidence of some of the poses."""
        return Evidence(
            self.t_s[chosen],
            self.information[chosen],
            self.score[chosen],
            self.square[chosen],
            self.values[chosen],
            self.moving_s[chosen],
            self.rows[chosen],
        )


def evidence(drive: Excitation, noise: Noise) -> Evidence:
    """The evidence of each pose of a drive under this noise."""
    slip_m = float(np.hypot(noise.slip_forward_m_sqrt_s, noise.slip_left_m_sqrt_s)) * np.sqrt(0.5)
    inside = ~drive.starts
    steps = np.where(inside[:, None], np.diff(drive.pose, axis=0, prepend=drive.pose[:1]), 0.0)
    middle = drive.pose[:, 2] - 0.5 * steps[:, 2]
    cosine, sine = np.cos(middle), np.sin(middle)
    # np.sinc(x) is sin(pi x) / (pi x).
    shrink = np.sinc(steps[:, 2] / (2.0 * np.pi))
    along, across = drive.roll_rad[:, 0] * shrink, drive.roll_rad[:, 1] * shrink
    in_x = np.column_stack([steps[:, 0], along * cosine, across * sine])
    in_y = np.column_stack([steps[:, 1], along * sine, -across * cosine])
    turned = np.column_stack([steps[:, 2], drive.roll_rad[:, 1]])
    x, y = np.hsplit(_whitened(np.hstack([in_x, in_y]), whitening(drive, noise.position_m, slip_m, drive.moving_s)), 2)
    yaw = _whitened(turned, whitening(drive, noise.yaw_rad, noise.slip_yaw_rad_sqrt_s, drive.moving_s))
    x, y, yaw = (np.where(inside[:, None], part, 0.0) for part in (x, y, yaw))

    information = np.zeros((drive.t_s.size, 3, 3))
    information[:, :2, :2] = x[:, 1:, None] * x[:, None, 1:] + y[:, 1:, None] * y[:, None, 1:]
    information[:, 2, 2] = yaw[:, 1] ** 2
    score = np.column_stack([x[:, 1:] * x[:, :1] + y[:, 1:] * y[:, :1], yaw[:, 1] * yaw[:, 0]])
    square = x[:, 0] ** 2 + y[:, 0] ** 2 + yaw[:, 0] ** 2
    rows = np.zeros((drive.t_s.size, 3, 4))
    rows[:, 0, :3], rows[:, 1, :3], rows[:, 2, 0], rows[:, 2, 3] = x, y, yaw[:, 0], yaw[:, 1]
    return Evidence(drive.t_s, information, score, square, np.where(inside, 3.0, 0.0), drive.moving_s, rows)


def _whitened(columns: Array, factor: Whitening) -> Array:
    band = np.vstack([factor.diagonal, np.append(factor.carry[1:], 0.0)])
    return np.asarray(solve_banded((1, 0), band, columns, check_finite=False))


# A stretch is a few dozen independent errors of the slip: one alone is off by half.
_USUAL_COUNTS_FOR = 3.0
_LONGEST_MEMORY = 12.0


class RunningNoise:
    """A mean of variances over stretches of driving, which begins as `USUAL`."""

    def __init__(self) -> None:
        self._weight = _USUAL_COUNTS_FOR
        self._variance: Array = USUAL.vector() ** 2

    @property
    def noise(self) -> Noise:
        """The noise now."""
        return Noise(*np.sqrt(self._variance).tolist())

    def add(self, measured: Noise) -> None:
        """Take in the noise of one stretch."""
        self._weight = min(self._weight + 1.0, _LONGEST_MEMORY)
        self._variance += (measured.vector() ** 2 - self._variance) / self._weight


"""The order of theta, as everywhere in inference."""


def to_linear(mean: Array, covariance: Array) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of beta from those of theta in the order of `NAMES`, to first order."""
    x_icr, radius, axial = mean.tolist()
    kappa = radius / axial
    by_theta = np.array(
        [
            [0.0, 1.0, 0.0],
            [kappa, x_icr / axial, -x_icr * kappa / axial],
            [0.0, 1.0 / axial, -kappa / axial],
        ]
    )
    return np.array([radius, x_icr * kappa, kappa]), by_theta @ covariance @ by_theta.T


def from_linear(mean: Array, covariance: Array) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of theta from those of beta, to first order."""
    radius, gamma, kappa = mean.tolist()
    by_beta = np.array(
        [
            [0.0, 1.0 / kappa, -gamma / kappa**2],
            [1.0, 0.0, 0.0],
            [1.0 / kappa, 0.0, -radius / kappa**2],
        ]
    )
    spread = by_beta @ covariance @ by_beta.T
    return np.array([gamma / kappa, radius, radius / kappa]), 0.5 * (spread + spread.T)


_LONGEST_GAP_NS = 500_000_000
_NOTHING: Array = np.empty(0)
_NO_SEGMENT: Index = np.empty(0, dtype=np.int64)


class SampleWindow:
    """Samples of the last `length_s`, in the order of their stamps; times in seconds since the first sample."""

    def __init__(self, length_s: float) -> None:
        self._length_ns = round(length_s * 1e9)
        self._wheels: list[WheelAngles] = []
        self._poses: list[PoseReading] = []
        self._zero_ns: int | None = None

    def add(self, samples: Samples) -> None:
        """Take in what came with one tick; repeated stamps and values that are not finite are left out."""
        for wheels in samples.wheels:
            if np.isfinite([wheels.left_rad, wheels.right_rad]).all():
                _insert(self._wheels, wheels)
        for pose in samples.poses:
            if np.isfinite([pose.x_m, pose.y_m, pose.yaw_rad]).all():
                _insert(self._poses, pose)
        if self._zero_ns is None and self._wheels:
            self._zero_ns = self._wheels[0].t_ns
        oldest_ns = samples.now_ns - self._length_ns
        _trim(self._wheels, oldest_ns)
        _trim(self._poses, oldest_ns)

    def seconds(self, t_ns: int) -> float:
        """A time as in the drive."""
        return 0.0 if self._zero_ns is None else (t_ns - self._zero_ns) * 1e-9

    def newest_ns(self) -> int:
        """Stamp of the newest pose; 0 without one."""
        return self._poses[-1].t_ns if self._poses else 0

    def drive(self, since_s: float = -np.inf) -> Excitation:
        """The drive from `since_s` on; raises UnusableDriveError where it says nothing."""
        wheels = [w for w in self._wheels if self.seconds(w.t_ns) >= since_s]
        poses = [p for p in self._poses if self.seconds(p.t_ns) >= since_s]
        if len(wheels) < 2 or len(poses) < 2:
            raise UnusableDriveError("no wheel samples or poses")
        wheel_ns = np.array([w.t_ns for w in wheels])
        pose_ns = np.array([p.t_ns for p in poses])
        breaks = wheel_ns[1:][np.diff(wheel_ns) > _LONGEST_GAP_NS]
        return drive_of(
            np.array([self.seconds(w.t_ns) for w in wheels]),
            np.array([(w.left_rad, w.right_rad) for w in wheels]),
            np.searchsorted(breaks, wheel_ns, side="right"),
            np.array([self.seconds(p.t_ns) for p in poses]),
            np.array([(p.x_m, p.y_m, p.yaw_rad) for p in poses]),
            np.searchsorted(breaks, pose_ns, side="right"),
        )


def drive_of(
    wheel_s: Array, angle_rad: Array, wheel_segment: Index, pose_s: Array, pose: Array, pose_segment: Index
) -> Excitation:
    """A drive of wheel angles (W, 2) and poses (P, 3), each with its times and segments; raises UnusableDriveError."""
    speed = np.gradient(angle_rad, wheel_s, axis=0)
    log = DriveLog(
        ("the running drive",),
        Commands(_NOTHING, _NOTHING, _NOTHING, _NO_SEGMENT),
        WheelArrays(wheel_s, angle_rad[:, 0], angle_rad[:, 1], speed[:, 0], speed[:, 1], wheel_segment, True, True),
        Poses(pose_s, pose[:, 0], pose[:, 1], pose[:, 2], pose_segment),
        Gyro(_NOTHING, _NOTHING, _NO_SEGMENT),
    )
    return excitation(log, "encoders")


def _insert(samples: list, sample: WheelAngles | PoseReading) -> None:  # type: ignore[type-arg]
    if not samples or sample.t_ns > samples[-1].t_ns:
        samples.append(sample)
    elif all(sample.t_ns != other.t_ns for other in samples[-20:]):
        insort(samples, sample, key=lambda each: each.t_ns)


def _trim(samples: list, oldest_ns: int) -> None:  # type: ignore[type-arg]
    count = 0
    while count < len(samples) and samples[count].t_ns < oldest_ns:
        count += 1
    del samples[:count]
