"""Mixture density network from statistics to a mixture of Gaussians over the parameters; and its rounds.

An ensemble of networks is trained side by side as one stack of matrices; the members differ in their start, their
split into training and validation, and the order of their batches. Each keeps the weights of its best validation.

Inference is sequential: every round draws parameters only from where the last one left them possible. Within a region
draws are uniform, so the prior over the proposal is one constant there and the network's density is the posterior as it
stands: no division of mixtures, which fails for components wider than the proposal.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch.optim.adamw import adamw

from disco_hw.inference.simulate import LocalWorkers, Seeds, Workers, draw_seeds

Array = NDArray[np.float64]

# Chosen: a statistic further out says no more than that it is out.
_LARGEST_FEATURE = 8.0
# Chosen, as usual for networks of this size: batch, held-out share, ridge of the linear start, and the clip of a
# gradient.
_BATCH = 256
_VALIDATION_SHARE = 0.15
_RIDGE = 1e-3
_CLIP_NORM = 5.0


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """Settings of a network's size and training.

    `patience`: epochs without a better validation before a member counts as done; `decay`: of the weights, per step and
    unit of the learning rate. Without it 90 % regions held 86 % of the truths, with it 89 to 90 %. `fourier`: so many
    random Fourier features, which are not trained, in place of the hidden layers (BayesSim's MDRFF); 0 for none.
    """

    members: int = 4
    components: int = 2
    hidden: int = 32
    epochs: int = 120
    patience: int = 15
    rate: float = 3e-3
    decay: float = 1.0
    fourier: int = 0


@dataclass(frozen=True, slots=True)
class Scaling:
    """Standardisation of statistics, (S,) each; features beyond 8 standard deviations are held there."""

    mean: Array
    scale: Array

    def __call__(self, statistics: Array) -> Array:
        """Features (n, S) of statistics (n, S)."""
        return np.clip((statistics - self.mean) / self.scale, -_LARGEST_FEATURE, _LARGEST_FEATURE)


@dataclass(frozen=True, slots=True)
class Mixtures:
    """n mixtures of C Gaussians in P dimensions: `log_weight` (n, C), `mean` (n, C, P), `factor` (n, C, P, P).

    `factor` is lower triangular and maps a deviation to a standard normal vector: covariance = (F' F)^-1.
    """

    log_weight: Array
    mean: Array
    factor: Array

    def log_density(self, points: Array) -> Array:
        """Log density (n, m) of points (n, m, P), mixture i at its own points."""
        deviation = points[:, :, None, :] - self.mean[:, None]
        normal = np.einsum("ncij,nmcj->nmci", self.factor, deviation)
        diagonal = np.log(np.diagonal(self.factor, axis1=2, axis2=3)).sum(axis=2)
        size = points.shape[2]
        parts = self.log_weight[:, None] + diagonal[:, None] - 0.5 * (normal**2).sum(axis=3)
        top = parts.max(axis=2)
        total: Array = top + np.log(np.exp(parts - top[..., None]).sum(axis=2)) - 0.5 * size * math.log(2.0 * math.pi)
        return total

    def moments(self) -> tuple[Array, Array]:
        """Means (n, P) and covariances (n, P, P)."""
        share = np.exp(self.log_weight)
        share = share / share.sum(axis=1, keepdims=True)
        mean = np.einsum("nc,nci->ni", share, self.mean)
        inverse, apart = np.linalg.inv(self.factor), self.mean - mean[:, None]
        within = np.einsum("nc,ncik,ncjk->nij", share, inverse, inverse)
        return mean, within + np.einsum("nc,nci,ncj->nij", share, apart, apart)

    def spread(self, by: Array) -> Mixtures:
        """Mixtures of the same means, in which deviations from these are `by` (P, P) times what they were."""
        middle = self.moments()[0][:, None]
        # A factor that is not triangular is so again after a rotation of the normal vector: QL, by way of QR.
        upper = np.linalg.qr((self.factor @ np.linalg.inv(by))[..., ::-1, ::-1]).R
        lower = upper[..., ::-1, ::-1]
        sign = np.sign(np.diagonal(lower, axis1=-2, axis2=-1))
        return Mixtures(self.log_weight, middle + (self.mean - middle) @ by.T, sign[..., None] * lower)

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Draws (n, count, P)."""
        n, components, size = self.mean.shape
        cumulative = np.cumsum(np.exp(self.log_weight), axis=1)
        uniform = rng.random((n, count)) * cumulative[:, -1:]
        which = np.minimum((uniform[:, :, None] > cumulative[:, None, :]).sum(axis=2), components - 1)
        rows = np.arange(n)[:, None]
        inverse = np.linalg.inv(self.factor)
        normal = rng.standard_normal((n, count, size))
        samples: Array = self.mean[rows, which] + np.einsum("nmij,nmj->nmi", inverse[rows, which], normal)
        return samples


class _Stack(torch.nn.Module):
    """E networks with two hidden layers, or random features, and a linear path from the statistics to the means."""

    frequencies: torch.Tensor
    phases: torch.Tensor

    def __init__(self, features: int, size: int, settings: NetworkSettings, skip: torch.Tensor, spread: torch.Tensor):
        super().__init__()
        members, components, hidden = settings.members, settings.components, settings.hidden
        self.size, self.components = size, components
        self.outputs = components * (1 + size + size * (size + 1) // 2)

        def layer(inputs: int, outputs: int, gain: float) -> torch.nn.Parameter:
            return torch.nn.Parameter(gain * torch.randn(members, inputs, outputs) / math.sqrt(inputs))

        def zeros(outputs: int) -> torch.nn.Parameter:
            return torch.nn.Parameter(torch.zeros(members, 1, outputs))

        self.fourier = settings.fourier
        if self.fourier:
            # Of a Gaussian kernel half as wide as standardised statistics are apart (Rahimi, Recht, NeurIPS 2007).
            frequencies = torch.randn(members, features, self.fourier) * math.sqrt(2.0 / features)
            self.register_buffer("frequencies", frequencies)
            self.register_buffer("phases", 2.0 * math.pi * torch.rand(members, 1, self.fourier))
        else:
            self.first, self.first_bias = layer(features, hidden, 1.0), zeros(hidden)
            self.second, self.second_bias = layer(hidden, hidden, 1.0), zeros(hidden)
        self.last, self.last_bias = layer(self.fourier or hidden, self.outputs, 0.05), zeros(self.outputs)
        # Least squares is a good network already where the posterior is narrow; training only has to improve on it.
        self.skip = torch.nn.Parameter(skip[None].repeat(members, 1, 1))
        with torch.no_grad():
            means = self.last_bias[:, 0, components : components * (1 + size)].view(members, components, size)
            means += 0.3 * spread * torch.randn(members, components, size)
            self.last_bias[:, 0, components * (1 + size) :].view(members, components, -1)[..., :size] -= spread.log()
        self.below = tuple(torch.tril_indices(size, size, -1))

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Log weights (E, n, C), means (E, n, C, P), factors (E, n, C, P, P) for features (E, n, S)."""
        out = torch.baddbmm(self.last_bias, self._hidden(x), self.last)
        members, n = x.shape[:2]
        size, components = self.size, self.components
        log_weight = torch.log_softmax(out[..., :components], dim=-1)
        mean = out[..., components : components * (1 + size)].reshape(members, n, components, size)
        mean = mean + torch.bmm(torch.cat([x, torch.ones_like(x[..., :1])], dim=-1), self.skip)[:, :, None, :]
        rest = out[..., components * (1 + size) :].reshape(members, n, components, -1)
        diagonal = rest[..., :size].clamp(-4.0, 9.0).exp()
        factor = torch.diag_embed(diagonal)
        rows, columns = self.below
        factor[..., rows, columns] = rest[..., size:] * diagonal[..., rows]
        return log_weight, mean, factor

    def _hidden(self, x: torch.Tensor) -> torch.Tensor:
        if self.fourier:
            return torch.cos(torch.baddbmm(self.phases, x, self.frequencies))
        hidden = torch.tanh(torch.baddbmm(self.first_bias, x, self.first))
        return torch.tanh(torch.baddbmm(self.second_bias, hidden, self.second))

    def log_density(self, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        """Log density (E, n) of targets (E, n, P)."""
        log_weight, mean, factor = self(x)
        normal = torch.matmul(factor, (y[:, :, None, :] - mean)[..., None])[..., 0]
        diagonal = factor.diagonal(dim1=-2, dim2=-1).log().sum(dim=-1)
        parts = log_weight + diagonal - 0.5 * normal.square().sum(dim=-1)
        return torch.logsumexp(parts, dim=-1) - 0.5 * self.size * math.log(2.0 * math.pi)


@dataclass(frozen=True)
class DensityNetwork:
    """Trained ensemble of networks; all members count alike."""

    scaling: Scaling
    stack: _Stack

    def mixtures(self, statistics: Array) -> Mixtures:
        """Mixtures of all members together for statistics (n, S)."""
        features = torch.as_tensor(self.scaling(statistics), dtype=torch.float32)
        members = self.stack.last.shape[0]
        with torch.no_grad():
            parts = self.stack(features[None].expand(members, -1, -1))
        log_weight, mean, factor = (part.transpose(0, 1).flatten(1, 2).double().numpy() for part in parts)
        return Mixtures(log_weight - math.log(members), mean, factor)


def train(statistics: Array, targets: Array, settings: NetworkSettings, seed: int) -> DensityNetwork:
    """Fit an ensemble to pairs of statistics (n, S) and targets (n, P), the targets of order one."""
    spread = statistics.std(axis=0)
    scaling = Scaling(statistics.mean(axis=0), np.where(spread > 1e-12, spread, 1.0))
    features = scaling(statistics)
    skip, residual = _least_squares(features, targets)
    # Matrices this small are slower on several threads than on one.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            x, y = torch.as_tensor(features, dtype=torch.float32), torch.as_tensor(targets, dtype=torch.float32)
            linear = (torch.as_tensor(each, dtype=torch.float32) for each in (skip, residual))
            stack = _Stack(x.shape[1], y.shape[1], settings, *linear)
            _fit(stack, x, y, settings)
    finally:
        torch.set_num_threads(threads)
    return DensityNetwork(scaling, stack)


def _least_squares(features: Array, targets: Array) -> tuple[Array, Array]:
    """Coefficients (S + 1, P), the last row constant, and standard deviations of what is left (P,)."""
    columns = np.column_stack([features, np.ones(features.shape[0])])
    gram = columns.T @ columns / features.shape[0] + _RIDGE * np.diag([1.0] * features.shape[1] + [0.0])
    skip = np.linalg.solve(gram, columns.T @ targets / features.shape[0])
    return skip, np.maximum((targets - columns @ skip).std(axis=0), 1e-3)


def _fit(stack: _Stack, x: torch.Tensor, y: torch.Tensor, settings: NetworkSettings) -> None:
    """Train an ensemble in place, with early stopping by the log density of held-out pairs."""
    members, count = settings.members, x.shape[0]
    validation_count = max(8, round(_VALIDATION_SHARE * count))
    order = torch.stack([torch.randperm(count) for _ in range(members)])
    validation, training = order[:, :validation_count], order[:, validation_count:]
    valid_x, valid_y = x[validation], y[validation]
    batches = max(1, training.shape[1] // _BATCH)
    parameters: list[torch.Tensor] = list(stack.parameters())
    rate = settings.rate
    moments, squares = ([torch.zeros_like(parameter) for parameter in parameters] for _ in range(2))
    steps = [torch.tensor(0.0) for _ in parameters]
    best = torch.full((members,), -math.inf)
    since = torch.zeros(members)
    kept = [parameter.detach().clone() for parameter in parameters]
    for epoch in range(settings.epochs):
        shuffled = torch.stack([row[torch.randperm(row.shape[0])] for row in training])
        for batch in shuffled.tensor_split(batches, dim=1):
            stack.zero_grad()
            loss = -stack.log_density(x[batch], y[batch]).mean(dim=1).sum()
            loss.backward()  # type: ignore[no-untyped-call]
            torch.nn.utils.clip_grad_norm_(parameters, _CLIP_NORM * math.sqrt(members))
            gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
            # As a function: torch's class for it loads torch's compiler, for which each process waits a second or more.
            with torch.no_grad():
                adamw(
                    parameters, gradients, moments, squares, [], steps, amsgrad=False, beta1=0.9, beta2=0.999, lr=rate,
                    weight_decay=settings.decay, eps=1e-8, maximize=False,
                )  # fmt: skip
        # Along a cosine to zero.
        before, after = (1.0 + math.cos(math.pi * (epoch + n) / settings.epochs) for n in range(2))
        rate *= after / before
        with torch.no_grad():
            score = stack.log_density(valid_x, valid_y).mean(dim=1)
        better = score > best
        best = torch.where(better, score, best)
        since = torch.where(better, torch.zeros_like(since), since + 1)
        for copy, parameter in zip(kept, parameters, strict=True):
            copy[better] = parameter.detach()[better]
        if bool((since >= settings.patience).all()):
            break
    with torch.no_grad():
        for copy, parameter in zip(kept, parameters, strict=True):
            parameter.copy_(copy)


Simulate = Callable[[Array, Seeds], Array]
Report = Callable[[str], None]

SCOUT = NetworkSettings(members=2, epochs=60, patience=8)

# Chosen: of a posterior, to shrink the region around; and how often draws outside the region are drawn again.
_DRAWS = 4000
_LARGEST_REJECTION = 30


@dataclass(frozen=True, slots=True)
class RoundSettings:
    """Settings of the rounds: shares of the simulations; `deviations` is the half width of the next round's region.

    The shares are of all simulations; with one share there is one round over the whole prior. `scout` is the network of
    all rounds but the last: it only has to find the region.
    """

    shares: tuple[float, ...] = (0.1, 0.1, 0.15, 0.15, 0.5)
    deviations: float = 4.5
    scout: NetworkSettings = SCOUT
    network: NetworkSettings = NetworkSettings()


@dataclass(frozen=True)
class Fitted:
    """Result of the last round: region, network in the region's coordinates, and the simulations it was trained on.

    `theta` (n, P), `statistics` (n, S); `simulations` counts those of all rounds. `widening` (P,): what the standard
    deviations that the network gives are multiplied by, or None (`checks.widening`).
    """

    region: Region
    network: DensityNetwork
    theta: Array
    statistics: Array
    simulations: int
    widening: Array | None = None

    def posteriors(self, statistics: Array) -> Mixtures:
        """Return the posteriors given statistics (n, S), in the region's coordinates and not cut to it."""
        found = self.network.mixtures(statistics)
        if self.widening is None:
            return found
        factor = self.region.factor
        return found.spread(np.asarray(np.linalg.solve(factor, self.widening[:, None] * factor), dtype=np.float64))

    def draw(self, statistics: Array, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Draw samples (n, count, P) given statistics (n, S); with the share (n,) drawn again for being outside."""
        return truncated_draws(self.region, self.posteriors(statistics), count, rng)


def truncated_draws(region: Region, mixtures: Mixtures, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draws (n, count, P) of mixtures over a region's coordinates, inside it, and the share (n,) first outside."""
    n, _, size = mixtures.mean.shape
    samples = np.empty((n, count, size))
    missing = np.ones((n, count), dtype=bool)
    outside = np.zeros(n)
    for attempt in range(_LARGEST_REJECTION):
        fresh = region.points(mixtures.draw(count, rng))
        good = np.zeros((n, count), dtype=bool)
        good[missing] = region.contains(fresh[missing])
        if attempt == 0:
            outside = 1.0 - good.mean(axis=1)
        accepted = missing & good
        samples[accepted] = fresh[accepted]
        missing &= ~good
        if not missing.any():
            return samples, outside
    # What never falls inside is put on the edge: the posterior is all but outside, and `outside` says so.
    edge = region.points(np.clip(region.unit(region.points(mixtures.draw(count, rng)).reshape(-1, size)), -1.0, 1.0))
    clipped = np.clip(edge, region.low, region.high).reshape(n, count, size)
    samples[missing] = clipped[missing]
    return samples, outside


def run_rounds(
    simulate: Simulate,
    observed: Array,
    prior: Region,
    simulations: int,
    settings: RoundSettings,
    seed: int,
    report: Report = lambda _: None,
    workers: Workers | None = None,
) -> Fitted:
    """Infer from observed statistics (S,); `simulate` gives statistics (n, S) of points (n, P) and seeds (n,).

    The networks are trained by `workers`, by default here.
    """
    workers = workers or LocalWorkers()
    rng = np.random.default_rng(seed)
    region = prior
    theta, statistics = np.empty((0, prior.centre.size)), np.empty((0, observed.size))
    fitted: Fitted | None = None
    for number, share in enumerate(settings.shares, start=1):
        count = max(64, round(share * simulations))
        report(f"round {number} of {len(settings.shares)}: {count} simulations")
        fresh = region.draw(count, rng)
        theta = np.concatenate([theta, fresh])
        statistics = np.concatenate([statistics, simulate(fresh, draw_seeds(count, rng))])
        report(f"round {number} of {len(settings.shares)}: density network")
        # Draws of earlier rounds that fall inside were uniform there too.
        used = region.contains(theta)
        size = settings.network if number == len(settings.shares) else settings.scout
        targets = region.unit(theta[used])
        network = workers.call(train, statistics[used], targets, size, int(rng.integers(2**31)))
        fitted = Fitted(region, network, theta[used], statistics[used], theta.shape[0])
        if number < len(settings.shares):
            draws, _ = fitted.draw(observed[None], _DRAWS, rng)
            region = region.shrunk(draws[0], settings.deviations)
    if fitted is None:
        raise ValueError("no round to run")
    return fitted


Mask = NDArray[np.bool_]

# Chosen: a region of which less lies in the prior is not worth the time.
_LARGEST_TRIES = 400
# Of the box: keeps a region open where all draws press against an edge.
_SMALLEST_DEVIATION = 1e-5


class EmptyRegionError(ValueError):
    """No parameters are left to draw: the posterior lies outside the prior, or far from all that was simulated."""


@dataclass(frozen=True, slots=True)
class Region:
    """All points `centre + factor @ z` with every |z| <= 1 that lie in the box from `low` to `high` and in `within`.

    `centre`, `low`, `high` (P,), `factor` (P, P). Coordinates z are of order one, which is what the network sees.
    """

    low: Array
    high: Array
    centre: Array
    factor: Array
    within: Region | None = None

    @classmethod
    def box(cls, low: Array, high: Array) -> Region:
        """Create a region that is a whole box."""
        return cls(low, high, 0.5 * (low + high), np.diag(0.5 * (high - low)))

    def unit(self, theta: Array) -> Array:
        """Coordinates z (n, P) of points (n, P)."""
        return np.asarray(np.linalg.solve(self.factor, (theta - self.centre).T).T)

    def points(self, unit: Array) -> Array:
        """Points (..., P) of coordinates (..., P)."""
        return np.asarray(self.centre + unit @ self.factor.T)

    def contains(self, theta: Array) -> Mask:
        """Return which points (n, P) are in the region."""
        inside: Mask = np.all((theta >= self.low) & (theta <= self.high) & (np.abs(self.unit(theta)) <= 1.0), axis=1)
        if self.within is not None:
            inside[inside] = self.within.contains(theta[inside])
        return inside

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Uniform draws (count, P); raises EmptyRegionError if the region is all but empty."""
        size = self.centre.size
        found: list[Array] = []
        missing = count
        for _ in range(_LARGEST_TRIES):
            trial = self.points(rng.uniform(-1.0, 1.0, (4 * count, size)))
            kept = trial[self.contains(trial)][:missing]
            found.append(kept)
            missing -= kept.shape[0]
            if missing == 0:
                return np.concatenate(found)
        raise EmptyRegionError("the region to draw parameters from is all but empty")

    def shrunk(self, draws: Array, deviations: float) -> Region:
        """Return the region's part within `deviations` standard deviations of draws (n, P), along their main axes."""
        scale = self.high - self.low
        covariance = np.cov((draws / scale).T) + _SMALLEST_DEVIATION**2 * np.eye(scale.size)
        variances, axes = np.linalg.eigh(covariance)
        factor = scale[:, None] * axes * (deviations * np.sqrt(variances))
        return Region(self.low, self.high, draws.mean(axis=0), factor, self)
