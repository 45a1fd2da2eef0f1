"""DISCO over any simulator: a user's transition function on batched torch tensors, on CPU or GPU.

The same sampling, risk, weighting and update as the compiled planner, from the same settings (`Sampler`).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from disco_hw.control.optimiser import spline_basis
from disco_hw.control.plan import NoValidControl, Sampler

Transition = Callable[[Tensor, Tensor, Tensor], Tensor]
StageCost = Callable[[Tensor, int], Tensor]
TerminalCost = Callable[[Tensor], Tensor]

WEIGHTS_SUM_TO = 1e-4
"""By how much the weights of the points may miss a sum of one."""
# Of a range of e^28 to far below the precision of float32.
_BISECTIONS = 40
# A prime: no two seeds share a step's noise within so many steps.
_SEEDS_APART = 1_000_003


def _shaped(name: str, result: Tensor, shape: torch.Size) -> Tensor:
    """Return the result of a user's function; raise ValueError unless it has this shape."""
    found = tuple(result.shape) if isinstance(result, Tensor) else type(result).__name__
    if found != tuple(shape):
        raise ValueError(f"{name} returned {found}; must return a tensor of shape {tuple(shape)}")
    return result


class BlackBoxDisco:
    """Plans controls (T, m) for a system of which only a transition function is known.

    `transition(state, control, theta)` returns the next state, `stage_cost(state, t)` the cost (L, K) of the state
    after step t, `terminal_cost(state)` that of the last one, with states (L, K, n), controls (K, m) and parameters
    (L, 1, p) or, for samples with draws of their own, (L, K, p). All are called on `device` in `dtype`.
    `theta`, `weights`: L parameter points as above and their weights (L,), as from `sigma_points`.
    `largest` bounds each control, `change` its change from one step to the next. All randomness comes from `seed` and
    the number of the step, so a run can be repeated. Raises ValueError for points, weights, states and settings that
    have no meaning, and for costs and states of another shape than the above.
    """

    def __init__(
        self, transition: Transition, stage_cost: StageCost, theta: NDArray[np.float64], weights: NDArray[np.float64],
        controls: int, sampler: Sampler, largest: float = math.inf, change: float = math.inf,
        terminal_cost: TerminalCost | None = None, device: str = "cpu", dtype: torch.dtype = torch.float32,
        seed: int = 1,
    ) -> None:  # fmt: skip
        for name, value in (("controls", controls), ("largest", largest), ("change", change)):
            if not value > 0:
                raise ValueError(f"{name}: {value}; must be above 0")
        self._transition, self._stage_cost, self._terminal_cost = transition, stage_cost, terminal_cost
        self._sampler, self._largest, self._change = sampler, largest, change
        self._device, self._dtype, self._seed = torch.device(device), dtype, seed
        self._basis: Tensor | None = None
        if sampler.knots is not None:
            first, taps = spline_basis(sampler.knots, sampler.horizon)
            dense = np.zeros((sampler.horizon, sampler.knots))
            np.put_along_axis(dense, first[:, None] + np.arange(taps.shape[1]), taps, axis=1)
            self._basis = self._tensor(dense)
        self._nominal = torch.zeros(sampler.horizon, controls, device=self._device, dtype=dtype)
        self.step_number = 0
        self.ess = math.nan
        self.set_points(theta, weights)

    def _tensor(self, values: NDArray[np.float64]) -> Tensor:
        return torch.as_tensor(np.asarray(values), device=self._device, dtype=self._dtype)

    def set_points(self, theta: NDArray[np.float64], weights: NDArray[np.float64]) -> None:
        """Plan under these parameter points from now on: (L, p) or (L, K, p), and weights (L,)."""
        points, shares = np.asarray(theta), np.asarray(weights)
        samples = self._sampler.samples
        if points.ndim not in (2, 3) or not points.size or (points.ndim == 3 and points.shape[1] not in (1, samples)):
            raise ValueError(f"theta: shape {points.shape}; must be (L, p), or (L, {samples}, p), for each sample")
        if shares.shape != points.shape[:1]:
            raise ValueError(f"weights: shape {shares.shape}; must be {points.shape[:1]}, one for each point of theta")
        if not (np.isfinite(points).all() and np.isfinite(shares).all()):
            raise ValueError("theta, weights: must be finite")
        if not math.isclose(shares.sum(), 1.0, rel_tol=0.0, abs_tol=WEIGHTS_SUM_TO):
            raise ValueError(f"weights: sum to {shares.sum():g}; must sum to 1")
        if self._sampler.risk != "mean" and shares.min() < 0.0:
            raise ValueError(
                f"weights: {shares.min():g} is negative, and risk {self._sampler.risk!r} has no meaning then; take "
                "sigma points with alpha = 1, or risk 'mean'"
            )
        self._theta = self._tensor(points[:, None] if points.ndim == 2 else points)
        self._weights = self._tensor(shares)

    def reset(self) -> None:
        """Clear the plan but continue the sequence of random numbers."""
        self._nominal.zero_()

    @torch.no_grad()
    def plan(self, state: NDArray[np.float64], shift_steps: int = 1) -> NDArray[np.float64]:
        """Plan controls (T, m) from a state (n,) on, the last plan moved on by whole steps.

        Raises NoValidControl, and keeps the last plan, if no sample has a finite cost.
        """
        if np.ndim(state) != 1:
            raise ValueError(f"state: shape {np.shape(state)}; must be (n,)")
        if shift_steps < 0:
            raise ValueError(f"shift_steps: {shift_steps}; must be 0 or more")
        sampler = self._sampler
        nominal = self._shifted(shift_steps if self.step_number else 0)
        sampled = self._noise()
        applied = self._limited(nominal + sampled)
        costs = self._combined(self._rolled(self._tensor(state), applied))
        if sampler.control_cost_weight > 0.0:
            noise = sampled if sampler.update_from == "drawn" else applied - nominal
            term = torch.einsum("tm,ktm->k", nominal, noise) / sampler.noise_std**2
            costs = costs + sampler.control_cost_weight * term
        weights = self._sample_weights(costs)
        self.step_number += 1
        if not bool(torch.isfinite(weights).all()):
            raise NoValidControl("no control sequence has a finite cost; check the state and the transition function")
        base = nominal + sampled if sampler.update_from == "drawn" else applied
        self._nominal = torch.einsum("k,ktm->tm", weights, base).clamp(-self._largest, self._largest)
        self.ess = float(1.0 / (weights**2).sum())
        return self._nominal.cpu().numpy().astype(np.float64)

    def _shifted(self, steps: int) -> Tensor:
        if steps == 0:
            return self._nominal
        kept = self._nominal[steps:]
        last = self._nominal[-1:] if self._sampler.beyond_end == "hold" else torch.zeros_like(self._nominal[-1:])
        return torch.cat([kept, last.expand(self._nominal.shape[0] - kept.shape[0], -1)])

    def _noise(self) -> Tensor:
        sampler = self._sampler
        generator = torch.Generator(self._device).manual_seed(self._seed * _SEEDS_APART + self.step_number)
        knots = sampler.horizon if sampler.knots is None else sampler.knots
        noise = sampler.noise_std * torch.randn(
            sampler.samples, knots, self._nominal.shape[1], generator=generator, device=self._device, dtype=self._dtype
        )
        if sampler.with_nominal:
            noise[0] = 0.0
        return noise if self._basis is None else torch.einsum("tj,kjm->ktm", self._basis, noise)

    def _limited(self, commands: Tensor) -> Tensor:
        commands = commands.clamp(-self._largest, self._largest)
        if math.isinf(self._change):
            return commands
        for t in range(1, commands.shape[1]):
            before = commands[:, t - 1]
            commands[:, t] = commands[:, t].clamp(before - self._change, before + self._change)
        return commands

    def _rolled(self, start: Tensor, commands: Tensor) -> Tensor:
        """Costs (L, K) of command sequences (K, T, m)."""
        points, samples = self._theta.shape[0], commands.shape[0]
        state = start.expand(points, samples, -1)
        costs = torch.zeros(points, samples, device=self._device, dtype=self._dtype)
        for t in range(commands.shape[1]):
            state = _shaped("transition", self._transition(state, commands[:, t], self._theta), state.shape)
            costs = costs + _shaped("stage_cost", self._stage_cost(state, t), costs.shape)
        if self._terminal_cost is None:
            return costs
        return costs + _shaped("terminal_cost", self._terminal_cost(state), costs.shape)

    def _combined(self, costs: Tensor) -> Tensor:
        """Costs (K,) of the samples from those under each point (L, K)."""
        sampler, weights = self._sampler, self._weights
        if sampler.risk == "mean":
            return weights @ costs
        if sampler.risk == "worst":
            return costs.max(dim=0).values
        ordered, order = costs.sort(dim=0, descending=True)
        shares = weights[order]
        used = (sampler.worst_part - (shares.cumsum(0) - shares)).clamp(min=0.0).minimum(shares)
        return (used * ordered).sum(0) / used.sum(0)

    def _sample_weights(self, costs: Tensor) -> Tensor:
        """Weights (K,) that sum to one; NaN throughout if no cost is finite."""
        costs = torch.where(torch.isfinite(costs), costs, torch.inf)
        above = costs - costs.min()
        if self._sampler.temperature is not None:
            return torch.softmax(-above / self._sampler.temperature, dim=0)
        # Bisection of the logarithm of the temperature, on the device: no waiting for it in between.
        low = torch.full((), math.log(1e-6), device=self._device, dtype=self._dtype)
        high = torch.full((), math.log(1e6), device=self._device, dtype=self._dtype)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            weights = torch.softmax(-above / middle.exp(), dim=0)
            too_many = 1.0 / (weights**2).sum() > self._sampler.target_ess
            low, high = torch.where(too_many, low, middle), torch.where(too_many, middle, high)
        return torch.softmax(-above / (0.5 * (low + high)).exp(), dim=0)
