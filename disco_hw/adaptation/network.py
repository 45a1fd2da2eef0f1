"""The density estimator of adaptation: trained once, then conditioned on the samples of one window after the other.

BayesSim trains on repetitions of one drive; here every simulation has a drive of its own, and the statistics say what a
drive was worth instead of what it was: the closed-form estimate, how well it is determined, and what it leaves
unexplained. The network learns the posterior of the parameters in units of that estimate's own uncertainty, so that one
network serves every drive (amortised; Cranmer, Brehmer and Louppe, 2020). It is uniform over its training range, so
what it gives is the posterior under a flat prior there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.adaptation.adapter_link import NAMES
from disco_hw.adaptation.recursive import Evidence, drive_of, evidence, from_linear, to_linear
from disco_hw.inference.density_network import DensityNetwork, NetworkSettings, train
from disco_hw.inference.excitation import STEP_S, Excitation, Noise
from disco_hw.inference.simulate import Simulator, draw_seeds
from disco_hw.model import Model

Array = NDArray[np.float64]

_SETTINGS = NetworkSettings(members=2, components=2, hidden=32, epochs=80, patience=12)
_VAGUE = np.array([0.3, 0.5, 0.5])
_SHORTEST_S, _LONGEST_S = 3.0, 30.0
_SHORTEST_HOLD_S, _LONGEST_HOLD_S = 1.0, 12.0
_SLEW_RAD_S2 = 5.0
_LARGEST_TARGET = 8.0
_NOISE_SPREAD = 0.4
_SLOW_S = 1.5
_MISFIT_MARGIN = 1.2


@dataclass(frozen=True, slots=True)
class Training:
    """What is simulated: parameters uniform between `low` and `high` (3,) in the order of `link.NAMES`, wheel
    speeds up to `wheel_rad_s`, poses at `pose_hz`, on so many drives with so many simulations of each.
    """

    low: Array
    high: Array
    wheel_rad_s: float
    pose_hz: float = 25.0
    drives: int = 240
    of_each: int = 12
    seed: int = 1


@dataclass(frozen=True, eq=False, slots=True)
class Conditioned:
    """The posterior of one window: `mean` (3,), `covariance` (3, 3).

    `widening` (3,) is its standard deviation by that of the closed form; `doubt` says why the network cannot tell.
    """

    mean: Array
    covariance: Array
    widening: Array
    doubt: str


@dataclass(frozen=True, eq=False)
class WindowNetwork:
    """A trained estimator; `largest_misfit` is the largest that was simulated, about."""

    training: Training
    network: DensityNetwork
    largest_misfit: float

    def condition(self, window: Evidence) -> Conditioned:
        """The posterior given one window of driving."""
        statistics, centre, root = _statistics(window, self.training)
        mixture = self.network.mixtures(statistics[None])
        weights = np.exp(mixture.log_weight[0])
        weights = weights / weights.sum()
        inverse = np.linalg.inv(mixture.factor[0])
        covariances = inverse @ inverse.transpose(0, 2, 1)
        unit = weights @ mixture.mean[0]
        offset = mixture.mean[0] - unit
        spread = np.einsum("c,cij->ij", weights, covariances + offset[:, :, None] * offset[:, None, :])
        mean, covariance = centre + root @ unit, root @ spread @ root.T
        widening = np.sqrt(np.diag(covariance) / np.diag(root @ root.T))
        return Conditioned(mean, 0.5 * (covariance + covariance.T), widening, self._doubt(mean, _misfit(window)))

    def _doubt(self, mean: Array, misfit: float) -> str:
        outside = (mean < self.training.low) | (mean > self.training.high)
        if outside.any():
            return f"{NAMES[int(np.argmax(outside))]} is outside what was simulated"
        if misfit > self.largest_misfit:
            return f"the driving fits no geometry that was simulated (misfit {misfit:.1f}); look with `disco-hw gap`"
        return ""


def training_range(mean: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """What to train on for a robot believed at `mean`: half to twice of it, x_icr within 0.3 m; inside the prior."""
    around = np.array([[mean[0] - 0.3, 0.5 * mean[1], 0.5 * mean[2]], [mean[0] + 0.3, 2.0 * mean[1], 2.0 * mean[2]]])
    return np.maximum(low, around[0]), np.minimum(high, around[1])


def train_network(training: Training, noise: Noise, model: Model) -> WindowNetwork:
    """Simulate and train; pure for a seed. Evidence is weighted with `noise`, the simulations' own varies about it."""
    rng = np.random.default_rng(training.seed)
    statistics, targets, misfits = [], [], []
    for _ in range(training.drives):
        drive = _random_drive(training, rng)
        scale = np.exp(_NOISE_SPREAD * rng.standard_normal(5))
        simulator = Simulator(model, drive, Noise(*(noise.vector() * scale).tolist()))
        theta = rng.uniform(training.low, training.high, (training.of_each, 3))
        for truth, poses in zip(theta, simulator.poses(theta, draw_seeds(training.of_each, rng)), strict=True):
            window = evidence(_measured(drive, poses), noise)
            found, centre, root = _statistics(window, training)
            statistics.append(found)
            targets.append(np.clip(np.linalg.solve(root, truth - centre), -_LARGEST_TARGET, _LARGEST_TARGET))
            misfits.append(_misfit(window))
    network = train(np.array(statistics), np.array(targets), _SETTINGS, training.seed)
    return WindowNetwork(training, network, _MISFIT_MARGIN * float(np.quantile(misfits, 0.995)))


def _statistics(window: Evidence, training: Training) -> tuple[Array, Array, Array]:
    """Statistics (13,) of a window, and the closed-form estimate that they are relative to: centre, root (3, 3)."""
    middle = 0.5 * (training.low + training.high)
    prior_mean, prior = to_linear(middle, np.diag((_VAGUE * np.array([1.0, middle[1], middle[2]])) ** 2))
    precision = np.linalg.inv(prior)
    covariance = np.linalg.inv(precision + window.information.sum(axis=0))
    mean = covariance @ (precision @ prior_mean + window.score.sum(axis=0))
    mean[2] = np.copysign(max(abs(mean[2]), 1e-3), prior_mean[2])
    centre, spread = from_linear(mean, covariance)
    std = np.sqrt(np.diag(spread))
    root = np.linalg.cholesky(spread + 1e-12 * np.diag(std**2))
    correlation = (spread / np.outer(std, std))[np.triu_indices(3, 1)]
    sizes = np.array([1.0, middle[1], middle[2]])
    scaled = (centre - middle) / sizes
    duration = np.log(max(float(window.moving_s.sum()), 0.1))
    misfit = np.log(max(_misfit(window), 1e-3))
    slow = np.log(np.maximum(_slow_misfit(window), 1e-3))
    statistics = np.concatenate([scaled, np.log(std / sizes), correlation, [misfit, duration], slow])
    return statistics, centre, np.asarray(root)


def _misfit(window: Evidence) -> float:
    """Mean square of what the best geometry leaves of a window."""
    left = window.square.sum() - window.score.sum(axis=0) @ _best(window)
    return float(left / max(window.values.sum() - 3.0, 1.0))


def _slow_misfit(window: Evidence) -> Array:
    """The same of its slow part, position and yaw (2,): 1 if slip is what it was taken to be.

    From pose to pose the sensor's noise drowns slip, over a second or two slip is most of what is left; sums of what is
    white have the variance of its parts.
    """
    left = window.rows[:, :, 0] - window.rows[:, :, 1:] @ _best(window)
    period_s = float(np.median(np.diff(window.t_s)))
    count = min(max(round(_SLOW_S / period_s), 1), left.shape[0] // 2)
    sums = np.cumsum(left, axis=0)
    power = np.mean((sums[count:] - sums[:-count]) ** 2, axis=0) / count
    return np.array([0.5 * (power[0] + power[1]), power[2]])


def _best(window: Evidence) -> Array:
    """The linear coordinates (3,) that leave least of a window."""
    return np.linalg.solve(window.information.sum(axis=0) + 1e-9 * np.eye(3), window.score.sum(axis=0))


def _random_drive(training: Training, rng: np.random.Generator) -> Excitation:
    """Wheel speeds held for a while and changed at a limited rate, with poses at their rate."""
    length_s = float(np.exp(rng.uniform(np.log(_SHORTEST_S), np.log(_LONGEST_S))))
    steps = round(length_s / STEP_S) + 2
    wanted = np.empty((steps, 2))
    at = 0
    while at < steps:
        held = round(rng.uniform(_SHORTEST_HOLD_S, _LONGEST_HOLD_S) / STEP_S)
        mean, half = rng.uniform(0.1, 0.8), rng.uniform(-0.3, 0.3)
        wanted[at : at + held] = training.wheel_rad_s * np.array([mean - half, mean + half])
        at += held
    speed = np.empty((steps, 2))
    now = wanted[0].copy()
    for k in range(steps):
        now += np.clip(wanted[k] - now, -_SLEW_RAD_S2 * STEP_S, _SLEW_RAD_S2 * STEP_S)
        speed[k] = now
    t_s = STEP_S * np.arange(steps, dtype=np.float64)
    angle: Array = np.cumsum(speed, axis=0) * STEP_S
    pose_s = np.arange(0.0, t_s[-1] - STEP_S, 1.0 / training.pose_hz)
    # The poses are those of the simulation; these only have to look like motion.
    x_m = np.interp(pose_s, t_s, angle.mean(axis=1))
    poses = np.column_stack([x_m, np.zeros((x_m.size, 2))])
    return drive_of(t_s, angle, np.zeros(steps, dtype=np.int64), pose_s, poses, np.zeros(x_m.size, dtype=np.int64))


def _measured(drive: Excitation, poses: Array) -> Excitation:
    """The same drive with other poses (P, 3)."""
    return Excitation(
        drive.source, drive.step_s, drive.wheel_rad_s, drive.moving, drive.t_s, drive.node, drive.fraction, poses,
        drive.roll_rad, drive.moving_s, drive.run_node, drive.run_pose,
    )  # fmt: skip


Index = NDArray[np.int64]
