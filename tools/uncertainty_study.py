"""What sigma points and CVaR buy where overshooting costs much: a sled that has to stop short of a wall.

python -m tools.uncertainty_study --seeds 200

How hard the sled can brake is not known, and no feedback makes it brake harder: who counts on the mean brakes too late
half of the time. The wall is at x = 0; a step costs the distance to it, and 100 m/s beyond it. Each seed draws what the
sled can do from the belief, in the widths that are given; all controllers are `BlackBoxDisco` with the same sampler and
seeds, and know the belief's mean, its sigma points, or draws of it.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from disco_hw.control.black_box import BlackBoxDisco
from disco_hw.control.parameter_points import sigma_points
from disco_hw.control.plan import Sampler

Array = NDArray[np.float64]

STEP_S, STEPS = 0.1, 45
START_M, LARGEST_M_S = -3.0, 1.5
GRIP_M_S2, WIDTHS, LEAST_M_S2 = 1.0, (0.1, 0.3), 0.2
WALL_COST = 100.0
DRAWS = 16
SAMPLER = Sampler(samples=200, horizon=25, noise_std=0.6, knots=6, temperature=1.0, beyond_end="hold")
CONTROLLERS = {
    "mean alone": ("point", "mean"),
    "sigma points, mean cost": ("sigma", "mean"),
    "sigma points, CVaR of the worst fifth": ("sigma", "cvar"),
    "16 draws, mean cost": ("draws", "mean"),
    "what is true": ("truth", "mean"),
}


def transition(state: Tensor, control: Tensor, theta: Tensor) -> Tensor:
    """States (L, K, 2) x (m) and speed (m/s) a step later; `theta` (L, 1, 1) is the largest acceleration (m/s^2)."""
    x, speed = state.unbind(-1)
    faster = (speed + STEP_S * theta[..., 0] * control[..., 0]).clamp(0.0, LARGEST_M_S)
    return torch.stack([x + 0.5 * STEP_S * (speed + faster), faster], dim=-1)


def stage_cost(state: Tensor, t: int) -> Tensor:
    """Distance from the wall, and what hitting it costs, (L, K)."""
    x = state[..., 0]
    return x.abs() + WALL_COST * (x > 0.0)


def points(kind: str, width: float, truth: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Parameter points (L, 1) of a controller, and their weights (L,)."""
    match kind:
        case "sigma":
            found = sigma_points(np.array([GRIP_M_S2]), np.array([[(width * GRIP_M_S2) ** 2]]), 1.0)
            return np.maximum(found.points, LEAST_M_S2), found.mean_weights
        case "draws":
            drawn = GRIP_M_S2 * (1.0 + width * rng.standard_normal((DRAWS, 1)))
            return np.maximum(drawn, LEAST_M_S2), np.full(DRAWS, 1.0 / DRAWS)
        case _:
            return np.array([[truth if kind == "truth" else GRIP_M_S2]]), np.ones(1)


def run(name: str, width: float, seed: int) -> tuple[float, float]:
    """Mean stage cost of one drive, and how far beyond the wall it came (m; below 0: short of it)."""
    kind, risk = CONTROLLERS[name]
    rng = np.random.default_rng([seed, 3])
    truth = max(GRIP_M_S2 * (1.0 + width * float(rng.standard_normal())), LEAST_M_S2)
    sampler = replace(SAMPLER, risk=risk, worst_part=0.2)
    planner = BlackBoxDisco(
        transition, stage_cost, *points(kind, width, truth, rng), controls=1, sampler=sampler, largest=1.0, seed=seed
    )
    state, total, furthest = torch.tensor([[[START_M, 0.0]]]), 0.0, -math.inf
    theta = torch.tensor([[[truth]]])
    for step in range(STEPS):
        control = planner.plan(state[0, 0].numpy().astype(np.float64))[0]
        state = transition(state, torch.tensor(control, dtype=torch.float32)[None], theta)
        total += float(stage_cost(state, step)[0, 0])
        furthest = max(furthest, float(state[0, 0, 0]))
    return total / STEPS, furthest


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--seed-offset", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(
        "| standard deviation | knows | mean cost | standard error | hit the wall | stood short of it by, median mm |"
    )
    print("|---|---|---|---|---|---|")
    for width in WIDTHS:
        for name in CONTROLLERS:
            seeds = range(options.seed_offset, options.seed_offset + options.seeds)
            costs, furthest = np.array([run(name, width, seed) for seed in seeds]).T
            error = costs.std(ddof=1) / math.sqrt(costs.size)
            hits, short = np.count_nonzero(furthest > 0.0), -1e3 * np.median(furthest)
            row = f"{width:.0%} | {name} | {costs.mean():.3f} | {error:.3f} | {hits} of {costs.size} | {short:.0f}"
            print(f"| {row} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
