"""Log scores of `infer`'s posterior and of sbi's NPE, trained on the same simulations, paired on the same fresh ones.

.venv-bench/bin/python -m tools.study.sharpness --drive circle --robots 8   (make .venv-bench/.installed installs sbi)
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from importlib import import_module

import numpy as np
import torch
from numpy.typing import NDArray

from disco_hw.inference.density_network import Region
from disco_hw.inference.infer import Inference, InferOptions, infer
from disco_hw.inference.simulate import draw_seeds
from tools.study.infer_study import config, logged, plant

Array = NDArray[np.float64]

TESTS = 4000
CENTRAL = 0.5
PEERS = ("nsf", "mdn")
_DRAWS = 400
_PIECE = 250


def scores(result: Inference, peers: tuple[str, ...] = PEERS, tests: int = TESTS) -> dict[str, Array]:
    """Log densities (tests,) at the truth of fresh simulations, in nats and the last region's coordinates.

    The truths are even in the last region, like the parameters of the training. `ours` and the `peers` are posteriors:
    nothing of them is outside the region, as `infer` draws from its own and sbi's posterior normalises itself; `*_raw`
    are the densities as they come out of the networks; `central` is 1 where the statistics, by least squares, point
    away from the region's edges, as the log's do. `peers` are sbi's names, set up as the package does.
    """
    fitted = result.fitted
    rng = np.random.default_rng(11)
    theta = fitted.region.draw(tests, rng)
    statistics = result.simulator.summaries(theta, draw_seeds(tests, rng), result.summary)
    unit = fitted.region.unit(theta)
    mixtures = fitted.network.mixtures

    def ours(piece: slice) -> Array:
        return mixtures(statistics[piece]).draw(_DRAWS, rng)

    trained_on = fitted.region.unit(fitted.theta), fitted.statistics
    pointed = _least_squares(*trained_on, statistics)
    found = {"central": (np.abs(pointed) < CENTRAL).all(axis=1).astype(np.float64)}
    found["ours_raw"] = mixtures(statistics).log_density(unit[:, None])[:, 0]
    found["ours"] = found["ours_raw"] - _log_inside(ours, fitted.region, tests)
    for peer in peers:
        torch.manual_seed(1)
        found[f"{peer}_raw"], draw = _peer(peer, trained_on, unit, statistics)
        found[peer] = found[f"{peer}_raw"] - _log_inside(draw, fitted.region, tests)
    return found


def _least_squares(unit: Array, statistics: Array, new: Array) -> Array:
    """Parameters that new statistics (n, S) point to, (n, P): chosen by these, a subset scores nobody's prior."""
    mean, spread = statistics.mean(axis=0), statistics.std(axis=0)

    def columns(some: Array) -> Array:
        return np.column_stack([(some - mean) / spread, np.ones(some.shape[0])])

    return np.asarray(columns(new) @ np.linalg.lstsq(columns(statistics), unit, rcond=None)[0])


def _log_inside(draw: Callable[[slice], Array], region: Region, count: int) -> Array:
    """Log of the share of draws (piece, draws, P) that fall inside a region, (count,); one at least is taken to."""
    shares = []
    for first in range(0, count, _PIECE):
        points = region.points(draw(slice(first, min(first + _PIECE, count))))
        shares.append(region.contains(points.reshape(-1, points.shape[2])).reshape(points.shape[:2]).mean(axis=1))
    return np.log(np.maximum(np.concatenate(shares), 1.0 / _DRAWS))


def _peer(
    kind: str, trained_on: tuple[Array, Array], unit: Array, statistics: Array
) -> tuple[Array, Callable[[slice], Array]]:
    """Log densities of an NPE as sbi sets it up, and draws from it."""
    npe = import_module("sbi.inference").NPE
    bounds = torch.ones(unit.shape[1])
    prior = torch.distributions.Independent(torch.distributions.Uniform(-bounds, bounds), 1)
    inference = npe(prior=prior, density_estimator=kind, show_progress_bars=False)
    parts = (torch.as_tensor(part, dtype=torch.float32) for part in trained_on)
    estimator = inference.append_simulations(*parts).train()
    given = torch.as_tensor(statistics, dtype=torch.float32)

    def draw(piece: slice) -> Array:
        with torch.no_grad():
            samples = estimator.sample((_DRAWS,), condition=given[piece])
        return np.asarray(samples.transpose(0, 1).double().numpy())

    with torch.no_grad():
        found = estimator.log_prob(torch.as_tensor(unit, dtype=torch.float32)[None], given)
    return found.double().numpy().ravel(), draw


def paired(one: Array, other: Array) -> tuple[float, float]:
    """Mean difference and its standard error."""
    difference = one - other
    return float(difference.mean()), float(difference.std(ddof=1) / np.sqrt(difference.size))


def compared(found: dict[str, Array], peer: str) -> dict[str, tuple[float, float]]:
    """Mean difference of the log scores, ours less a peer's, with its standard error: in the three ways of looking."""
    central = found["central"] > 0.0
    ours, theirs = found["ours_raw"], found[f"{peer}_raw"]
    return {
        f"as posteriors, {peer}": paired(found["ours"], found[peer]),
        f"as they come out, {peer}": paired(ours, theirs),
        f"the same, near the log, {peer}": paired(ours[central], theirs[central]),
    }


def summary(means: dict[str, list[float]]) -> list[str]:
    """A line for each comparison of several robots."""
    lines = []
    for name, values in means.items():
        error = np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float("nan")
        span = f"{min(values):+.4f} to {max(values):+.4f}"
        lines.append(f"{name:28} {np.mean(values):+.4f} +- {error:.4f} over {len(values)} robots, {span}")
    return lines


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--drive", default="circle")
    parser.add_argument("--robots", type=int, default=8)
    parser.add_argument("--first", type=int, default=1, help="seed of the first robot")
    options = parser.parse_args()
    means: dict[str, list[float]] = {}
    for seed in range(options.first, options.first + options.robots):
        found = scores(infer(logged(plant(seed), options.drive, seed), config(), InferOptions(seed=seed)))
        for peer in PEERS:
            for name, (mean, error) in compared(found, peer).items():
                means.setdefault(name, []).append(mean)
                print(f"robot {seed}: {name}: ours - sbi's {mean:+.4f} +- {error:.4f}", flush=True)
    print("\n".join(summary(means)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
