"""Inference on simulated drives of about two minutes: time, error, width, calibration, and sbi's NPE beside it."""

from __future__ import annotations

from importlib import import_module
from time import perf_counter

import numpy as np
import torch

from disco_hw.inference.estimates import estimates
from disco_hw.inference.excitation import excitation
from disco_hw.inference.infer import Inference, infer, noise_of
from disco_hw.inference.rounds import Fitted
from disco_hw.inference.simulate import NAMES, Simulator, draw_seeds
from disco_hw.log.drive import DriveLog
from disco_hw.model import Model
from tools.infer_study import config, logged, plant

SEED = 5
SIMULATIONS = 300
TEST_SIMULATIONS = 500


def run() -> dict[str, float]:
    """A rich drive (150 s) and a steady circle (60 s) of one robot; seconds are from log to posterior, all checks in.

    `width`: posterior sd over that of a local Gaussian reference, from the scatter of the estimates at the truth.
    """
    found: dict[str, float] = {}
    for drive in ("rich", "circle"):
        parameters = plant(SEED)
        log = logged(parameters, drive, SEED)
        truth = np.array([getattr(parameters, name) for name in NAMES])
        began = perf_counter()
        result = infer(log, config())
        key = f"inference.{drive}"
        found[f"{key}.seconds"] = perf_counter() - began
        found[f"{key}.effective_simulations"] = result.effective_simulations
        found[f"{key}.coverage90"] = float(result.calibration.coverage[2])
        reference = reference_sd(log, truth)
        for index, name in enumerate(NAMES):
            found[f"{key}.{name}.error"] = float(abs(result.draws[:, index].mean() - truth[index]))
            found[f"{key}.{name}.width"] = float(result.draws[:, index].std() / reference[index])
            found[f"{key}.{name}.sbc_p"] = float(result.calibration.p_values[index])
        found |= {f"{key}.{name}": score for name, score in log_scores(result).items()}
    return found


def log_scores(result: Inference) -> dict[str, float]:
    """Mean log density (nats, in the last region's coordinates) at the truth of fresh simulations from that region.

    Ours is the network as it stands; `sbi` is NPE-C as the package sets it up, mixture density and spline flow, trained
    on the same simulations and statistics under the uniform prior of the region's box. Without sbi only ours.
    """
    fitted, size = result.fitted, result.prior.centre.size
    rng = np.random.default_rng(11)
    theta = fitted.region.draw(TEST_SIMULATIONS, rng)
    statistics = result.simulator.summaries(theta, draw_seeds(TEST_SIMULATIONS, rng), result.summary)
    unit = fitted.region.unit(theta)
    ours = fitted.network.mixtures(statistics).log_density(unit[:, None])[:, 0]
    found = {"log_score": float(ours.mean())}
    try:
        npe = import_module("sbi.inference").NPE
    except ImportError:
        return found
    trained_on = [torch.as_tensor(part, dtype=torch.float32) for part in (unit_of(fitted), fitted.statistics)]
    bounds = torch.ones(size)
    for kind in ("mdn", "nsf"):
        torch.manual_seed(1)
        prior = torch.distributions.Independent(torch.distributions.Uniform(-bounds, bounds), 1)
        inference = npe(prior=prior, density_estimator=kind, show_progress_bars=False)
        estimator = inference.append_simulations(*trained_on).train()
        with torch.no_grad():
            score = estimator.log_prob(
                torch.as_tensor(unit, dtype=torch.float32)[None], torch.as_tensor(statistics, dtype=torch.float32)
            )
        found[f"sbi_{kind}.log_score"] = float(score.mean())
    return found


def unit_of(fitted: Fitted) -> np.ndarray:
    """The parameters that the last network was trained on, in its coordinates (n, 3)."""
    return np.asarray(fitted.region.unit(fitted.theta))


def reference_sd(log: DriveLog, truth: np.ndarray) -> np.ndarray:
    """Standard deviations (3,) of a synthetic likelihood around the truth: statistics linear in the parameters there,
    with the covariance that simulations at the truth have.
    """
    drive = excitation(log)
    noise = noise_of(drive)
    statistics = estimates(drive, noise)
    simulator = Simulator(Model(0.06, 0.4), drive, noise)
    rng = np.random.default_rng(0)
    seeds = draw_seeds(SIMULATIONS, rng)
    here = simulator.summaries(np.tile(truth, (SIMULATIONS, 1)), seeds, statistics.raw)
    slopes = []
    for index in range(truth.size):
        step = np.zeros(truth.size)
        step[index] = 0.01 * truth[index]
        there = simulator.summaries(np.tile(truth + step, (SIMULATIONS, 1)), seeds, statistics.raw)
        slopes.append((there - here).mean(axis=0) / step[index])
    jacobian = np.array(slopes).T
    precision = jacobian.T @ np.linalg.inv(np.cov(here.T)) @ jacobian
    return np.sqrt(np.diag(np.linalg.inv(precision)))


if __name__ == "__main__":
    for name, value in run().items():
        print(f"{name} {value:.4g}")
