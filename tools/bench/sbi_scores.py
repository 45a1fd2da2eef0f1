"""Log scores of `infer`'s posterior and of sbi's NPE, from the same simulations and paired on the same new ones."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

import numpy as np
import torch
from numpy.typing import NDArray

from disco_hw.inference.density_network import Region
from disco_hw.inference.infer import Inference
from disco_hw.inference.simulate import draw_seeds

Array = NDArray[np.float64]

TESTS = 4000
PEERS = ("nsf", "mdn")
_DRAWS = 400
_PIECE = 250


def scores(result: Inference, peers: tuple[str, ...] = PEERS, tests: int = TESTS) -> dict[str, Array]:
    """Log densities (tests,) at the truth of fresh simulations, in nats and the last region's coordinates.

    The truths are even in the last region, like the parameters of the training. `ours` and the `peers` are posteriors:
    nothing of them is outside the region, as `infer` draws from its own and sbi's posterior normalises itself; `*_raw`
    are the densities as they come out of the networks. `peers` are sbi's names, set up as the package does.
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
    found = {"ours_raw": mixtures(statistics).log_density(unit[:, None])[:, 0]}
    found["ours"] = found["ours_raw"] - _log_inside(ours, fitted.region, tests)
    for peer in peers:
        torch.manual_seed(1)
        found[f"{peer}_raw"], draw = _peer(peer, trained_on, unit, statistics)
        found[peer] = found[f"{peer}_raw"] - _log_inside(draw, fitted.region, tests)
    return found


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
