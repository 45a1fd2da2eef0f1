"""Checks of an inference: what simulations leave unexplained, prediction, calibration, and what the log leaves open."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_banded
from scipy.stats import kstest

from disco_hw.effects import Symptom
from disco_hw.effects.registry import REGISTRY
from disco_hw.inference.density_network import Fitted, Simulate
from disco_hw.inference.estimates import Estimates, Whitening, estimates
from disco_hw.inference.excitation import Excitation
from disco_hw.inference.noise import Noise, unexplained_share
from disco_hw.inference.simulate import NAMES, Simulator, Workers, draw_seeds

Array = NDArray[np.float64]

# What is left of a direction below this share is rounding.
_LEAST_LEFT = 1e-4


@dataclass(frozen=True, slots=True)
class ScoreTest:
    """One way to differ: a name and what it would look like."""

    name: str
    symptom: Symptom

    @property
    def effects(self) -> tuple[str, ...]:
        """The effects that leave such a pattern."""
        return tuple(effect.name for effect in REGISTRY.values() if self.symptom in effect.symptoms)


CHECKS = (
    ScoreTest("late positions", Symptom.DELAYED_POSITIONS),
    ScoreTest("sideways with speed", Symptom.SIDEWAYS_WITH_SPEED),
    ScoreTest("sideways in fast turns", Symptom.SIDEWAYS_IN_FAST_TURNS),
    ScoreTest("forward with turning", Symptom.FORWARD_WITH_TURNING),
    ScoreTest("downhill", Symptom.DOWNHILL),
    ScoreTest("downhill across", Symptom.DOWNHILL),
    ScoreTest("shorter at speed", Symptom.SHORTER_AT_SPEED),
    ScoreTest("distance changes", Symptom.DISTANCE_CHANGES),
    ScoreTest("turns on straights", Symptom.TURNS_ON_STRAIGHTS),
    ScoreTest("less turn at speed", Symptom.LESS_TURN_AT_SPEED),
    ScoreTest("late yaw", Symptom.DELAYED_YAW),
    ScoreTest("left unlike right", Symptom.LEFT_UNLIKE_RIGHT),
    ScoreTest("turning changes", Symptom.TURNING_CHANGES),
)


@dataclass(frozen=True, slots=True)
class Scores:
    """Call it with one log's poses (P, 3) for the t values of all `CHECKS`, (13,); 0 where the drive cannot show it."""

    drive: Excitation
    estimates: Estimates

    def __call__(self, poses: Array) -> Array:
        """Score tests at the geometry that fits these poses best."""
        drive = self.drive
        radius, x_icr, kappa = self.estimates.raw(poses[None])[0]
        inside = ~drive.starts
        dt_s = np.where(inside, np.diff(drive.t_s, prepend=drive.t_s[0]), 1.0)
        steps = np.where(inside[:, None], np.diff(poses, axis=0, prepend=poses[:1]), 0.0)
        middle = poses[:, 2] - 0.5 * steps[:, 2]
        cosine, sine = np.cos(middle), np.sin(middle)
        forward, turn = radius * drive.roll_rad[:, 0], kappa * drive.roll_rad[:, 1]
        chord = 2.0 * np.sin(0.5 * turn)
        later = np.where(drive.t_s > np.median(drive.t_s[drive.moving_s > 0.0]), 1.0, -1.0)

        def body(along: Array, across: Array) -> Array:
            return np.concatenate([along * cosine - across * sine, along * sine + across * cosine])

        nothing = np.zeros(forward.size)
        geometry = [body(forward, nothing), body(nothing, -chord)]
        error = np.concatenate([steps[:, 0], steps[:, 1]]) - geometry[0] - x_icr * geometry[1]
        moved_x, moved_y = np.split(geometry[0] + x_icr * geometry[1], 2)
        tested = [
            np.concatenate([_change(moved_x, drive), _change(moved_y, drive)]),
            body(nothing, forward),
            body(nothing, forward * turn / dt_s),
            body(turn, nothing),
            np.concatenate([drive.moving_s, nothing]),
            np.concatenate([nothing, drive.moving_s]),
            body(forward * np.abs(forward) / dt_s, nothing),
            body(forward * later, nothing),
        ]
        position = _scores(_both(error, geometry, tested, self.estimates.position))
        yaw_tested = [forward, turn * np.abs(turn) / dt_s, _change(turn, drive), np.abs(turn), turn * later]
        columns = np.column_stack([steps[:, 2] - turn, turn, *yaw_tested])
        yaw = _scores((_whitened(columns, self.estimates.yaw), 1))
        return np.concatenate([position, yaw])


def _change(values: Array, drive: Excitation) -> Array:
    """Change from the increment before to the one after, per second, (P,); 0 next to the ends of runs."""
    change = np.zeros(values.size)
    starts = drive.starts
    inner = ~(starts[1:-1] | starts[2:] | np.roll(starts, 1)[1:-1])
    span_s = np.maximum(drive.t_s[2:] - drive.t_s[:-2], 1e-6)
    change[1:-1] = np.where(inner, (values[2:] - values[:-2]) / span_s, 0.0)
    return change


def _both(error: Array, geometry: list[Array], tested: list[Array], factor: Whitening) -> tuple[Array, int]:
    """Whitened columns for x and y one below the other, (2 P, 1 + nominal + tested), and the number of nominal ones."""
    columns = np.column_stack([error, *geometry, *tested])
    half = columns.shape[0] // 2
    return np.vstack([_whitened(columns[:half], factor), _whitened(columns[half:], factor)]), len(geometry)


def _whitened(columns: Array, factor: Whitening) -> Array:
    band = np.vstack([factor.diagonal, np.append(factor.carry[1:], 0.0)])
    return np.asarray(solve_banded((1, 0), band, columns, check_finite=False))


def _scores(whitened: tuple[Array, int]) -> Array:
    """Return t values of the tested columns, (tested,); the first column is the error, then come the nominal ones."""
    columns, nominal = whitened
    base, _ = np.linalg.qr(columns[:, 1 : 1 + nominal])
    tested = columns[:, 1 + nominal :]
    left = tested - base @ (base.T @ tested)
    error = columns[:, 0] - base @ (base.T @ columns[:, 0])
    length, before = np.linalg.norm(left, axis=0), np.linalg.norm(tested, axis=0)
    spread = max(float(error.std()), 1e-12)
    seen = length > _LEAST_LEFT * np.maximum(before, 1e-300)
    return np.asarray(np.where(seen, left.T @ error / np.where(seen, length, 1.0) / spread, 0.0))


# On logs of robots without any difference the largest of all values stays below this (study: docs/results.md).
LARGEST_DEVIATION = 5.0
# More than this of the motion within a second, and no geometry and no slip of a usable robot is behind it.
LARGEST_UNEXPLAINED = 0.5
_EDGE_DEVIATIONS = 1.5
_OUTSIDE_SHARE = 0.01
_EDGE_WIDTH = 0.1


@dataclass(frozen=True)
class Predictive:
    """Comparison of the log with simulations under the posterior.

    `deviations` (13,): how far the log's value of each of `CHECKS` is from the simulated ones, in their standard
    deviations; `estimate_deviations` (3,) the same for the estimates of wheel radius, x_icr and kappa. `edge` names
    parameters whose posterior is pressed against the prior's edge. `unexplained` is the part of the motion that counts
    as noise, and that no comparison with simulations which have that noise could find.
    """

    deviations: Array
    estimate_deviations: Array
    edge: tuple[str, ...]
    unexplained: float = 0.0

    @property
    def outside_simulated(self) -> bool:
        """Whether the log is unlike every simulation under the posterior."""
        largest = max(np.abs(self.deviations).max(), np.abs(self.estimate_deviations).max())
        return bool(largest > LARGEST_DEVIATION) or bool(self.edge) or self.unexplained > LARGEST_UNEXPLAINED

    @property
    def disagreements(self) -> list[tuple[ScoreTest, float]]:
        """The checks that disagree, the worst first, with their deviations."""
        order = np.argsort(-np.abs(self.deviations))
        return [(CHECKS[i], float(self.deviations[i])) for i in order if abs(self.deviations[i]) > LARGEST_DEVIATION]


def predictive(
    drive: Excitation,
    noise: Noise,
    simulator: Simulator,
    draws: Array,
    low: Array,
    high: Array,
    seed: int,
    workers: Workers | None = None,
    done: Callable[[int], None] = lambda _: None,
) -> Predictive:
    """Compare a log with simulations at posterior `draws` (n, 3), one each; `low`, `high` (3,) bound the prior.

    `workers` and `done` as for `Simulator.summaries`.
    """
    weights = estimates(drive, noise)
    scores = Scores(drive, weights)
    seeds = draw_seeds(draws.shape[0], np.random.default_rng(seed))

    def both(poses: Array) -> Array:
        return np.column_stack([np.array([scores(one) for one in poses]), weights.raw(poses)])

    simulated, fits = np.split(simulator.summaries(draws, seeds, both, workers, done), [len(CHECKS)], axis=1)
    deviations = _deviations(scores(drive.pose), simulated)
    fit_deviations = _deviations(weights.raw(drive.pose[None])[0], fits)
    plain = weights.theta(drive.pose[None])[0]
    edge = edge_parameters(draws, low, high, plain)
    return Predictive(deviations, fit_deviations, edge, unexplained_share(drive, plain))


def edge_parameters(draws: Array, low: Array, high: Array, estimate: Array) -> tuple[str, ...]:
    """Parameters determined well (sd below a tenth of the range) that the prior cuts off.

    Their mean is within 1.5 sd of an edge (the half of a Gaussian that an edge leaves has its mean 1.3 of its own sd
    away from it), or the plain `estimate` (3,) is outside by a hundredth of the range.
    """
    span = high - low
    mean, sd = draws.mean(axis=0), draws.std(axis=0)
    pressed = np.minimum(mean - low, high - mean) < _EDGE_DEVIATIONS * sd
    pressed |= np.minimum(estimate - low, high - estimate) < -_OUTSIDE_SHARE * span
    pressed &= sd < _EDGE_WIDTH * span
    return tuple(name for name, flag in zip(NAMES, pressed.tolist(), strict=True) if flag)


def _deviations(observed: Array, simulated: Array) -> Array:
    spread = simulated.std(axis=0)
    seen = spread > 1e-12
    return np.asarray(np.where(seen, (observed - simulated.mean(axis=0)) / np.where(seen, spread, 1.0), 0.0))


# Chosen: usual levels of a region; draws for ranks, of which more take longer.
LEVELS = (0.5, 0.8, 0.9, 0.95)
_DRAWS = 200


@dataclass(frozen=True)
class Calibration:
    """Calibration from fresh simulations at parameters drawn from the last region.

    `ranks` (n, 3) in [0, 1] of the true parameters among posterior draws, uniform if calibrated, and `p_values` (3,) of
    the Kolmogorov-Smirnov test for that; `coverage` (levels,) of the joint highest-density regions of `LEVELS`.
    """

    ranks: Array
    p_values: Array
    coverage: Array


def widening(fitted: Fitted, simulate: Simulate, draws: Array, seed: int) -> Array:
    """Return the factors (P,) that widen the network's posteriors to hold the truth as often as they state.

    Simulates at `draws` (n, P) of the posterior: root mean square of what was simulated minus the mean that the network
    gives, over its standard deviation.
    """
    statistics = simulate(draws, draw_seeds(draws.shape[0], np.random.default_rng(seed)))
    mean, covariance = fitted.network.mixtures(statistics).moments()
    factor = fitted.region.factor
    std = np.sqrt(np.einsum("ij,njk,ik->ni", factor, covariance, factor))
    return np.asarray(np.sqrt(np.mean(((draws - fitted.region.points(mean)) / std) ** 2, axis=0)))


def calibrate(fitted: Fitted, simulate: Simulate, count: int, seed: int) -> Calibration:
    """Simulation-based calibration (Talts et al., 2018) and expected coverage, on `count` fresh simulations."""
    rng = np.random.default_rng(seed)
    truth = fitted.region.draw(count, rng)
    statistics = simulate(truth, draw_seeds(count, rng))
    draws, _ = fitted.draw(statistics, _DRAWS, rng)
    # A rank between two draws is anywhere between them.
    ranks = ((draws < truth[:, None]).sum(axis=1) + rng.random(truth.shape)) / (_DRAWS + 1.0)
    mixtures = fitted.posteriors(statistics)
    size = truth.shape[1]
    unit = fitted.region.unit(draws.reshape(-1, size)).reshape(draws.shape)
    density = mixtures.log_density(unit)
    at_truth = mixtures.log_density(fitted.region.unit(truth)[:, None])[:, 0]
    mass = (density > at_truth[:, None]).mean(axis=1)
    return Calibration(
        ranks,
        np.array([float(kstest(column, "uniform").pvalue) for column in ranks.T]),
        np.array([float((mass <= level).mean()) for level in LEVELS]),
    )


def effective_simulations(fitted: Fitted, observed: Array) -> float:
    """Return how many simulations of the last region the posterior rests on: (sum w)^2 / sum w^2, w its density."""
    mixtures = fitted.posteriors(observed[None])
    log_weight = mixtures.log_density(fitted.region.unit(fitted.theta)[None])[0]
    weight = np.exp(log_weight - log_weight.max())
    return float(weight.sum() ** 2 / (weight**2).sum())


PARAMETER_NAMES = ("x_icr", "the wheel radius", "the axial distance")
# Chosen: what counts as wide, involved, straight, little and steady where a report says what a log leaves open.
WIDE = 0.2
_SHARE = 0.45
_STRAIGHT = 0.08
_LITTLE_ROLL_RAD = 12.0
_LITTLE_TURN_RAD = 6.0
_STEADY_SPREAD = 0.12
_STEADY_SHARE = 0.8

PAPER = (
    "the paper's statistics (mean x, mean y, mean dx, mean dy) hold the centre of the path and the way from its first "
    "to its last pose divided by the number of samples: on a circle the centre tells x_icr and the axial distance, but "
    "the wheel radius enters only through the angle at which the drive happens to end, so it stays about as wide as "
    "the prior; run without --paper"
)


@dataclass(frozen=True, slots=True)
class Driven:
    """Summary of the motion in a log.

    How far the wheels rolled (rad, mean of both) straight ahead, in reverse; their difference in left and right turns
    (rad); and whether nearly all of the motion was at one speed and one turn.
    """

    straight_rad: float
    reverse_rad: float
    left_rad: float
    right_rad: float
    steady: bool


def driven(drive: Excitation) -> Driven:
    """Take stock of a drive."""
    left, right = drive.wheel_rad_s.T
    mean, difference = 0.5 * (left + right), right - left
    moving = drive.moving > 0.0
    straight = moving & (np.abs(difference) < _STRAIGHT * np.abs(mean))
    return Driven(
        float(np.abs(mean[straight]).sum() * drive.step_s),
        float(-mean[mean < 0.0].sum() * drive.step_s),
        float(difference[difference > 0.0].sum() * drive.step_s),
        float(-difference[difference < 0.0].sum() * drive.step_s),
        _is_steady(mean[moving], difference[moving]),
    )


def _is_steady(mean: Array, difference: Array) -> bool:
    speed, turn = float(np.median(mean)), float(np.median(difference))
    size = abs(speed) + 0.5 * abs(turn)
    if size == 0.0:
        return False
    # Quantised encoders make every sample coarse; half a second smooths that out.
    window = np.ones(25) / 25.0
    if mean.size < 4 * window.size:
        return False
    smooth_mean, smooth_turn = (np.convolve(values, window, mode="valid") for values in (mean, difference))
    near = (np.abs(smooth_mean - speed) + 0.5 * np.abs(smooth_turn - turn)) < _STEADY_SPREAD * size
    return bool(near.mean() > _STEADY_SHARE) and abs(turn) > _STRAIGHT * abs(speed)


def undetermined(draws: Array, low: Array, high: Array, drive: Excitation, paper: bool) -> list[str]:
    """Sentences on what `draws` (n, 3) in the order of `NAMES` leave open within the prior (3,), the widest first."""
    found = [*_wide_directions(draws, low, high, drive)]
    if paper:
        found.append(PAPER)
    if driven(drive).steady:
        found.append(
            "a steady circle cannot tell the wheel radius from slip in proportion to speed, the axial distance from "
            "slip in turns or from wheels of different size, nor x_icr from side slip or a heading bias of the sensor; "
            "drive a straight line, then turn both ways at two speeds"
        )
    return found


def _wide_directions(draws: Array, low: Array, high: Array, drive: Excitation) -> list[str]:
    """Return the posterior's main axes, in units of the prior's standard deviation, that are still wide."""
    prior_sd = (high - low) / np.sqrt(12.0)
    variances, axes = np.linalg.eigh(np.cov((draws / prior_sd).T))
    sentences = []
    for variance, axis in sorted(zip(variances, axes.T, strict=True), key=lambda pair: -pair[0]):
        wide = float(np.sqrt(max(variance, 0.0)))
        if wide < WIDE:
            continue
        involved = [index for index in range(len(NAMES)) if abs(axis[index]) > _SHARE]
        names = " and ".join(PARAMETER_NAMES[index] for index in involved)
        together = " together" if len(involved) > 1 else ""
        sentences.append(
            f"{names}{together} {'are' if together else 'is'} left open: {100.0 * min(wide, 1.0):.0f} % of the prior's "
            f"width remains{_combination(involved, axis)}; {_hint(involved, driven(drive))}"
        )
    return sentences


def _combination(involved: list[int], axis: Array) -> str:
    if len(involved) != 2:
        return ""
    same = axis[involved[0]] * axis[involved[1]] > 0.0
    return ", they can grow together" if same else ", one can grow while the other shrinks"


def _hint(involved: list[int], done: Driven) -> str:
    wishes = []
    if 1 in involved and done.straight_rad < _LITTLE_ROLL_RAD:
        wishes.append("drive straight lines of a metre or more")
    if 0 in involved or 2 in involved:
        if min(done.left_rad, done.right_rad) < _LITTLE_TURN_RAD:
            wishes.append("turn left and right on the spot, a full turn or more each")
        else:
            wishes.append("turn more and at several speeds")
    return " and ".join(wishes) if wishes else "drive longer"
