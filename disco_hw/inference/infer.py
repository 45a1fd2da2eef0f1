"""BayesSim from a logged drive to a posterior over the robot's geometry, as a belief for the model.

The log's noise is measured, and again on simulations of the same drive: a minute of circling holds some twenty
stretches of the length that slip shows itself over, so slip is measured to 10 to 25 %, and a little too small, because
the geometry is fitted to the same poses. A posterior that takes it for known is too narrow as often as it comes out
small.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from disco_hw.config import RobotConfig
from disco_hw.errors import InputError
from disco_hw.inference.checks import (
    Calibration,
    Predictive,
    calibrate,
    effective_simulations,
    predictive,
    undetermined,
    widening,
)
from disco_hw.inference.density_network import (
    EmptyRegionError,
    Fitted,
    Mixtures,
    NetworkSettings,
    Region,
    RoundSettings,
    run_rounds,
)
from disco_hw.inference.estimates import CrossCorrelation, PaperStatistics, estimates
from disco_hw.inference.excitation import Excitation, excitation
from disco_hw.inference.noise import USUAL, Noise, measured_noise
from disco_hw.inference.simulate import (
    NAMES,
    ReportProgress,
    Seeds,
    Simulator,
    Summary,
    Tally,
    Workers,
    draw_seeds,
    physical_range,
)
from disco_hw.log.drive import DriveLog
from disco_hw.model import Gaussian, Mixture, Model

Array = NDArray[np.float64]

# Chosen: more are more exact and take longer, in proportion; the paper's number where it gives one.
POSTERIOR_DRAWS = 4000
PREDICTIVE_SIMULATIONS = 120
WIDENING_SIMULATIONS = 400
CALIBRATION_SIMULATIONS = 300
DEFAULT_SIMULATIONS = 3000
PAPER_SIMULATIONS = 1000
_FEWEST_SIMULATIONS = 200
# Chosen: each pass takes the noise from a better geometry, and takes as long.
_NOISE_PASSES = 3
# Further outside the prior than this is excluded by it; nearer, the posterior is pressed against the edge, and says so.
_EXCLUDED_DEVIATIONS = 8.0
_EXCLUDED_SHARE = 0.01

DEFAULT_ROUNDS = RoundSettings()
# One round over the whole prior, as the paper has it; five components, as its pendulum's posterior.
PAPER_ROUNDS = RoundSettings(shares=(1.0,), network=NetworkSettings(components=5, hidden=48))
FOURIER_FEATURES = 200


@dataclass(frozen=True, slots=True)
class InferOptions:
    """Options of the inference.

    `paper`: the paper's statistics, commands as input, one round; `simulations`: over all rounds, None for 3000 (paper:
    1000).

    `random_features` and `cross_correlation` are BayesSim's other density and statistics, for `paper` alone: a mixture
    on random Fourier features (MDRFF) in place of the network, and steps of the state against actions.
    """

    paper: bool = False
    simulations: int | None = None
    seed: int = 1
    random_features: bool = False
    cross_correlation: bool = False


@dataclass(frozen=True)
class Inference:
    """Result of the inference: posterior `draws` (D, 3) in the order of `NAMES`, the same as a belief, and its origin.

    `observed` (S,) are the log's statistics; `outside_region` is the share of the network's posterior that fell outside
    the region it was trained on; `effective_simulations` is how many the posterior rests on.
    """

    drive: Excitation
    noise: Noise
    simulator: Simulator
    summary: Summary
    observed: Array
    fitted: Fitted
    draws: Array
    outside_region: float
    belief: Mixture
    options: InferOptions
    predictive: Predictive
    calibration: Calibration
    effective_simulations: float
    undetermined: tuple[str, ...]

    def model(self, nominal: Model) -> Model:
        """Return the nominal model with the posterior's mean and the posterior as belief."""
        mean = dict(zip(NAMES, self.belief.mean().tolist(), strict=True))
        return replace(nominal.with_point(mean), belief=self.belief)


def infer(
    log: DriveLog,
    robot: RobotConfig,
    options: InferOptions | None = None,
    report_progress: ReportProgress = lambda *_: None,
    workers: Workers | None = None,
) -> Inference:
    """Infer x_icr, wheel radius and axial distance from a drive; pure for a given seed.

    `workers` run simulations and fits, by default on all cores; the result is the same. `report_progress` gets stage
    and share done. Raises InputError for a drive or options from which nothing can be inferred.
    """
    try:
        return _infer(log, robot, options or InferOptions(), report_progress, workers)
    except (EmptyRegionError, np.linalg.LinAlgError):
        raise InputError(
            f"{', '.join(log.sources)}: no parameters within the prior of robot.toml explain this log: poses, "
            "wheels and commands are not of one drive, or their units or robot.toml are wrong; check them, or "
            "widen the prior"
        ) from None


def _infer(
    log: DriveLog, robot: RobotConfig, options: InferOptions, report_progress: ReportProgress, workers: Workers | None
) -> Inference:
    simulations = options.simulations or (PAPER_SIMULATIONS if options.paper else DEFAULT_SIMULATIONS)
    if not options.paper and (options.random_features or options.cross_correlation):
        raise InputError("--random-features and --cross-correlation belong to the paper's method: give --paper too")
    if simulations < _FEWEST_SIMULATIONS:
        raise InputError(f"--simulations {simulations}: too few to train a network; give {_FEWEST_SIMULATIONS} or more")
    prior = prior_region(robot)
    drive = excitation(log, "commands" if options.paper else None)
    nominal = Model.nominal(robot.robot)
    measured = noise_of(drive)
    plain = estimates(drive, measured).theta(drive.pose[None])[0]
    known = noise_spread(Simulator(nominal, drive, measured), plain, options.seed + 4)
    noise = known.noise
    _check_inside(prior, plain, known.fit_std)
    summary: Summary = estimates(drive, noise)
    if options.paper:
        crossed = CrossCorrelation(drive.starts, drive.roll_rad)
        summary = crossed if options.cross_correlation else PaperStatistics(drive.starts)
    simulator = Simulator(nominal, drive, noise, known.factor)
    observed = summary(drive.pose[None])[0]
    widened = 0 if options.paper else WIDENING_SIMULATIONS
    tally = Tally(simulations + widened + PREDICTIVE_SIMULATIONS + CALIBRATION_SIMULATIONS, report_progress)

    def simulate(theta: Array, seeds: Seeds) -> Array:
        return simulator.summaries(theta, seeds, summary, workers, tally.add)

    settings = PAPER_ROUNDS if options.paper else DEFAULT_ROUNDS
    if options.random_features:
        settings = replace(settings, network=replace(settings.network, fourier=FOURIER_FEATURES))
    fitted = run_rounds(simulate, observed, prior, simulations, settings, options.seed, tally.stage, workers)
    rng = np.random.default_rng([options.seed, 1])
    if widened:
        tally.stage("width of the posterior")
        draws, _ = fitted.draw(observed[None], widened, rng)
        fitted = replace(fitted, widening=widening(fitted, simulate, draws[0], options.seed + 5))
    draws, outside = fitted.draw(observed[None], POSTERIOR_DRAWS, rng)
    belief = belief_of(fitted.posteriors(observed[None]), fitted.region, prior.low, prior.high, NAMES, rng)
    tally.stage("posterior predictive check")
    few = draws[0, :PREDICTIVE_SIMULATIONS]
    check = predictive(
        drive, noise, simulator, few, prior.low, prior.high, options.seed + 2, workers=workers, done=tally.add
    )
    tally.stage("calibration")
    calibration = calibrate(fitted, simulate, CALIBRATION_SIMULATIONS, options.seed + 3)
    return Inference(
        drive,
        noise,
        simulator,
        summary,
        observed,
        fitted,
        draws[0],
        float(outside[0]),
        belief,
        options,
        check,
        calibration,
        effective_simulations(fitted, observed),
        tuple(undetermined(draws[0], prior.low, prior.high, drive, options.paper)),
    )


def prior_region(robot: RobotConfig) -> Region:
    """Return the prior of robot.toml as far as it is physically possible; raises InputError if nothing of it is."""
    possible = np.column_stack(physical_range())
    ranges = np.array([getattr(robot.prior, name) for name in NAMES])
    low, high = np.maximum(possible[:, 0], ranges[:, 0]), np.minimum(possible[:, 1], ranges[:, 1])
    for name, lowest, highest, given, within in zip(NAMES, low, high, ranges.tolist(), possible, strict=True):
        if lowest >= highest:
            raise InputError(
                f"robot.toml: prior.{name}: {given} is physically impossible; write a range within "
                f"[{within[0]:g}, {within[1]:g}]"
            )
    return Region.box(low, high)


def _check_inside(prior: Region, estimate: Array, std: Array) -> None:
    """Raise InputError where the prior excludes what the log shows; `estimate` (3,) is a plain fit, `std` (3,) its own.

    Simulations from such a prior are all alike in being far from the log, and what a network makes of that is chance.
    """
    span = prior.high - prior.low
    off = np.maximum(prior.low - estimate, estimate - prior.high)
    excluded = np.where((off > _EXCLUDED_DEVIATIONS * std) & (off > _EXCLUDED_SHARE * span), off / span, 0.0)
    worst = int(np.argmax(excluded))
    if excluded[worst] > 0.0:
        raise InputError(
            f"robot.toml: prior.{NAMES[worst]}: the log points to {estimate[worst]:.3g}, outside "
            f"[{prior.low[worst]:g}, {prior.high[worst]:g}]; widen it"
        )


def noise_of(drive: Excitation) -> Noise:
    """Return the noise of a log: estimate the geometry, take what it leaves unexplained, and again with that."""
    noise = USUAL
    for _ in range(_NOISE_PASSES):
        theta = estimates(drive, noise).theta(drive.pose[None])[0]
        noise = measured_noise(drive, theta)
    return noise


# Chosen: the spread of so many is known to a tenth.
_REPEATS = 48
# What vanishes in a simulation counts as a third, what explodes as three times.
_LARGEST_RATIO = 3.0
_SMALLEST_VARIANCE = 1e-8
_SMALLEST_SCALE = 1e-4


@dataclass(frozen=True, slots=True)
class NoiseSpread:
    """Noise without the bias of its measurement, and its uncertainty.

    `factor` (7, 7), lower triangular, is of the covariance of its logarithms, and of its lever, in the order of
    `Noise.scales`; `fit_std` (3,) is the scatter of the plain estimates of the parameters.
    """

    noise: Noise
    factor: Array
    fit_std: Array


def noise_spread(simulator: Simulator, theta: Array, seed: int, repeats: int = _REPEATS) -> NoiseSpread:
    """Measure the noise of `repeats` simulations at `theta` (3,), which all have the simulator's own.

    The logarithm of what is measured scatters about that of the truth as it does here (parametric bootstrap); of the
    lever, what is measured itself.
    """
    drive, noise = simulator.drive, simulator.noise
    poses = simulator.poses(np.tile(theta, (repeats, 1)), draw_seeds(repeats, np.random.default_rng(seed)))
    fits = estimates(drive, noise).theta(poses)
    found = [measured_noise(replace(drive, pose=pose), fit) for pose, fit in zip(poses, fits, strict=True)]
    measured, truth = np.array([one.scales() for one in found]), noise.scales()
    ratio = np.maximum(measured[:, :-1], _SMALLEST_SCALE) / np.maximum(truth[:-1], _SMALLEST_SCALE)
    log_ratio = np.log(np.clip(ratio, 1.0 / _LARGEST_RATIO, _LARGEST_RATIO))
    off = np.column_stack([log_ratio, measured[:, -1] - truth[-1]])
    covariance = np.cov(off.T) + _SMALLEST_VARIANCE * np.eye(off.shape[1])
    mean = np.append(truth[:-1] * np.exp(-log_ratio.mean(axis=0)), truth[-1] - off[:, -1].mean()).tolist()
    factor = np.asarray(np.linalg.cholesky(covariance))
    return NoiseSpread(replace(Noise(*mean), speed_share=noise.speed_share), factor, fits.std(axis=0))


Component = tuple[float, Array, Array]

# Chosen: draws of each component, of which fewer inside say nothing of its shape.
_DRAWS = 4000
_FEWEST_INSIDE = 20
# Chosen: lighter components are left out, and nearly equal ones merged, as each costs the planner points.
_LEAST_WEIGHT = 1e-4
_MERGE_COST = 0.1
_MOST_COMPONENTS = 4


def belief_of(
    mixtures: Mixtures, region: Region, low: Array, high: Array, names: tuple[str, ...], rng: np.random.Generator
) -> Mixture:
    """Belief from the first of `mixtures`, which is over a region's coordinates.

    Components that reach outside [low, high] (P,) are replaced by the moments of their part inside; a component that is
    all outside goes. Components that one Gaussian describes as well are merged. Raises ValueError if nothing is inside.
    """
    weights = np.exp(mixtures.log_weight[0])
    inverse = np.linalg.inv(mixtures.factor[0])
    covariances = inverse @ inverse.transpose(0, 2, 1)
    kept: list[Component] = []
    for weight, mean, covariance in zip(weights, mixtures.mean[0], covariances, strict=True):
        here = region.points(mean)
        spread = region.factor @ covariance @ region.factor.T
        draws = rng.multivariate_normal(here, spread, size=_DRAWS, method="cholesky")
        inside = draws[((draws >= low) & (draws <= high)).all(axis=1)]
        if inside.shape[0] < _FEWEST_INSIDE:
            continue
        share = inside.shape[0] / _DRAWS
        if share < 1.0:
            here, spread = inside.mean(axis=0), np.cov(inside.T)
        kept.append((float(weight) * share, here, spread))
    total = sum(weight for weight, _, _ in kept)
    if total < _LEAST_WEIGHT:
        raise ValueError("the posterior lies outside the prior's range")
    merged = _merged([part for part in kept if part[0] > _LEAST_WEIGHT * total], total)
    return Mixture(
        np.array([weight for weight, _, _ in merged]),
        tuple(Gaussian(names, mean, 0.5 * (spread + spread.T)) for _, mean, spread in merged),
    )


def _merged(parts: list[Component], total: float) -> list[Component]:
    """Merge the pair that costs least, until that cost is not small or few enough are left (Runnalls, 2007, eq. 21)."""
    parts = list(parts)
    while len(parts) > 1:
        pairs = [(i, j) for i in range(len(parts)) for j in range(i)]
        costs = [_cost(parts[i], parts[j]) for i, j in pairs]
        cheapest = int(np.argmin(costs))
        if costs[cheapest] > _MERGE_COST * total and len(parts) <= _MOST_COMPONENTS:
            break
        i, j = pairs[cheapest]
        joined = _together(parts[i], parts[j])
        parts = [part for index, part in enumerate(parts) if index not in (i, j)] + [joined]
    return sorted(parts, key=lambda part: -part[0])


def _together(one: Component, other: Component) -> Component:
    weight = one[0] + other[0]
    share, rest = one[0] / weight, other[0] / weight
    offset = one[1] - other[1]
    spread = share * one[2] + rest * other[2] + share * rest * np.outer(offset, offset)
    return weight, share * one[1] + rest * other[1], spread


def _cost(one: Component, other: Component) -> float:
    """Upper bound of the Kullback-Leibler divergence that merging two components costs."""
    weight, _, spread = _together(one, other)
    parts = ((weight, spread), (-one[0], one[2]), (-other[0], other[2]))
    return float(0.5 * sum(share * np.linalg.slogdet(covariance)[1] for share, covariance in parts))
