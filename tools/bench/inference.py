"""Inference on simulated drives of about two minutes: time, error, width, calibration, and sbi's NPE beside it."""

from __future__ import annotations

from importlib.util import find_spec
from time import perf_counter

import numpy as np

from disco_hw.config import Robot, RobotConfig
from disco_hw.inference.estimates import estimates
from disco_hw.inference.excitation import excitation
from disco_hw.inference.infer import Inference, infer, noise_of
from disco_hw.inference.simulate import NAMES, Simulator, draw_seeds
from disco_hw.log.drive import DriveLog
from disco_hw.model import Model
from sim.plant_parameters import PlantParameters
from tools.bench.sbi_scores import PEERS, paired, scores
from tools.simulated_drives import create_drive
from tools.simulated_log import read_back, simulated_log

SEED = 5
SIMULATIONS = 300
PLAUSIBLE = {"x_icr_m": (0.0, 0.3), "wheel_radius_m": (0.04, 0.10), "axial_distance_m": (0.2, 0.5)}
CONFIG = RobotConfig(
    robot=Robot(name="bench", wheel_radius_m=0.06, axial_distance_m=0.4, ticks_per_rev=2048, max_wheel_speed_rad_s=8.0)
)


def plausible_plant(seed: int) -> PlantParameters:
    """Draw a robot with sensor noise, disturbances and quantised encoders."""
    rng = np.random.default_rng([seed, 77])
    geometry = {name: float(rng.uniform(*span)) for name, span in PLAUSIBLE.items()}
    return PlantParameters(**geometry).with_ideal_motors()


def run() -> dict[str, float]:
    """A rich drive (150 s) and a steady circle (60 s) of one robot; seconds are from log to posterior, all checks in.

    `width`: posterior sd over that of a local Gaussian reference, from the scatter of the estimates at the truth.
    """
    found: dict[str, float] = {}
    for drive in ("rich", "circle"):
        parameters = plausible_plant(SEED)
        written = simulated_log(create_drive(drive, SEED), parameters, None, SEED)
        log = read_back(written, parameters.ticks_per_rev)
        truth = np.array([getattr(parameters, name) for name in NAMES])
        began = perf_counter()
        result = infer(log, CONFIG)
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
    """Mean log scores of the posteriors on fresh simulations (`tools.bench.sbi_scores`): ours, and how far it is ahead.

    Ahead of sbi's, with the standard error, also before the posteriors are cut to their region. Without sbi only ours.
    """
    peers = PEERS if find_spec("sbi") else ()
    given = scores(result, peers)
    found = {"log_score": float(given["ours"].mean())}
    for peer in peers:
        for kind in ("", "_raw"):
            ahead, error = paired(given[f"ours{kind}"], given[f"{peer}{kind}"])
            found |= {f"ahead_of_sbi_{peer}{kind}": ahead, f"ahead_of_sbi_{peer}{kind}.error": error}
    return found


def reference_sd(log: DriveLog, truth: np.ndarray) -> np.ndarray:
    """Standard deviations (3,) of a synthetic likelihood around the truth.

    Its statistics are linear in the parameters there, with the covariance that simulations at the truth have.
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
