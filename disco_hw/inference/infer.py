"""BayesSim from a logged drive to a posterior over the robot's geometry."""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from disco_hw.config import RobotConfig
from disco_hw.errors import InputError
from disco_hw.inference.calibration import Calibration, calibrate, effective_simulations
from disco_hw.inference.density_network import NetworkSettings
from disco_hw.inference.estimates import estimates
from disco_hw.inference.excitation import Excitation, excitation
from disco_hw.inference.mixture_belief import belief_of
from disco_hw.inference.noise import USUAL, Noise, measured_noise
from disco_hw.inference.noise_spread import noise_spread
from disco_hw.inference.paper_statistics import paper_statistics
from disco_hw.inference.predictive import Predictive, predictive
from disco_hw.inference.progress import Tally, Tell
from disco_hw.inference.region import Region
from disco_hw.inference.rounds import Fitted, RoundSettings, run_rounds
from disco_hw.inference.simulate import NAMES, Seeds, Simulator, Summary, physical_range
from disco_hw.inference.undetermined import undetermined
from disco_hw.inference.workers import Workers
from disco_hw.log.drive import DriveLog
from disco_hw.model import Mixture, Model

Array = NDArray[np.float64]

POSTERIOR_DRAWS = 4000
PREDICTIVE_SIMULATIONS = 120
CALIBRATION_SIMULATIONS = 300
DEFAULT_SIMULATIONS = 3000
PAPER_SIMULATIONS = 1000
_FEWEST_SIMULATIONS = 200
_NOISE_PASSES = 3
# Further outside the prior than this is excluded by it; nearer, the posterior is pressed against the edge, and says so.
_EXCLUDED_DEVIATIONS = 8.0
_EXCLUDED_SHARE = 0.01

DEFAULT_ROUNDS = RoundSettings()
# One round over the whole prior, as the paper has it; five components, as its pendulum's posterior.
PAPER_ROUNDS = RoundSettings(shares=(1.0,), network=NetworkSettings(components=5, hidden=48))


@dataclass(frozen=True, slots=True)
class InferOptions:
    """`paper`: the paper's statistics, commands as input, one round; `simulations`: over all rounds, None for 3000
    (paper: 1000).
    """

    paper: bool = False
    simulations: int | None = None
    seed: int = 1


@dataclass(frozen=True)
class Inference:
    """What the log says: posterior `draws` (D, 3) in the order of `NAMES`, the same as a belief, and how it came about.

    `observed` (S,) are the log's statistics; `outside_region` is the share of the network's posterior that fell outside
    the region it was trained on; `effective_simulations` is how many the posterior rests on.
    """

    drive: Excitation
    noise: Noise
    simulator: Simulator
    summary: Summary
    prior: Region
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
    seconds: float

    def model(self, nominal: Model) -> Model:
        """The nominal model with the posterior's mean and the posterior as belief."""
        mean = dict(zip(NAMES, self.belief.mean().tolist(), strict=True))
        return replace(nominal.with_point(mean), belief=self.belief)


def infer(
    log: DriveLog,
    robot: RobotConfig,
    options: InferOptions | None = None,
    tell: Tell = lambda *_: None,
    workers: Workers | None = None,
) -> Inference:
    """Infer x_icr, wheel radius and axial distance from a drive; pure for a given seed, but for the time it takes.

    `workers` run simulations and fits, by default on all cores; the result is the same. `tell` hears how far it is.
    Raises InputError for a drive or options from which nothing can be inferred.
    """
    began = perf_counter()
    options = options or InferOptions()
    simulations = options.simulations or (PAPER_SIMULATIONS if options.paper else DEFAULT_SIMULATIONS)
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
    summary: Summary = paper_statistics(drive) if options.paper else estimates(drive, noise)
    simulator = Simulator(nominal, drive, noise, known.factor)
    observed = summary(drive.pose[None])[0]
    tally = Tally(simulations + PREDICTIVE_SIMULATIONS + CALIBRATION_SIMULATIONS, tell)

    def simulate(theta: Array, seeds: Seeds) -> Array:
        return simulator.summaries(theta, seeds, summary, workers, tally.add)

    settings = PAPER_ROUNDS if options.paper else DEFAULT_ROUNDS
    fitted = run_rounds(simulate, observed, prior, simulations, settings, options.seed, tally.stage, workers)
    rng = np.random.default_rng([options.seed, 1])
    draws, outside = fitted.draw(observed[None], POSTERIOR_DRAWS, rng)
    mixtures = fitted.network.mixtures(observed[None])
    belief = belief_of(mixtures, fitted.region, prior.low, prior.high, NAMES, rng)
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
        prior,
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
        perf_counter() - began,
    )


def prior_region(robot: RobotConfig) -> Region:
    """The prior of robot.toml as far as it is physically possible; raises InputError if nothing of it is."""
    low, high = physical_range()
    ranges = np.array([getattr(robot.prior, name) for name in NAMES])
    low, high = np.maximum(low, ranges[:, 0]), np.minimum(high, ranges[:, 1])
    for name, lowest, highest, given in zip(NAMES, low, high, ranges.tolist(), strict=True):
        if lowest >= highest:
            raise InputError(f"robot.toml: prior.{name}: {given} is physically impossible; write a possible range")
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
    """The noise of a log: estimate the geometry, take what it leaves unexplained, and again with that."""
    noise = USUAL
    for _ in range(_NOISE_PASSES):
        theta = estimates(drive, noise).theta(drive.pose[None])[0]
        noise = measured_noise(drive, theta)
    return noise
