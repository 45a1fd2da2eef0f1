"""The sampling optimiser behind DISCO, which knows nothing of its system, and the splines that smooth its noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.kernel import BLOCK, STATE_ROWS, Floats, System, aligned_zeros, block_count
from disco_hw.control.kernel.sequences import Basis, Limits
from disco_hw.control.kernel.step import ESS, INVALID, LEAST, SAMPLING, TEMPERATURE, Workspace, disco_step
from disco_hw.control.plan import Sampler
from disco_hw.jit import compiled_for
from disco_hw.tasks import single

# Cubic: the lowest degree whose second derivative has no jumps.
DEGREE = 3


def spline_basis(knots: int, horizon: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Clamped uniform cubic B-spline basis at the middle of each of `horizon` steps.

    Returns the first of the four control points that act at each step (T,) and their weights (T, 4), which sum to one.
    """
    inner = np.linspace(0.0, 1.0, knots - DEGREE + 1)
    vector = np.concatenate([np.zeros(DEGREE), inner, np.ones(DEGREE)])
    middles = (np.arange(horizon) + 0.5) / horizon
    first = np.clip(np.searchsorted(inner, middles, side="right") - 1, 0, knots - DEGREE - 1)
    weights = np.ones((horizon, 1))
    # The recursion of de Boor (A Practical Guide to Splines, chapter X) from one degree to the next.
    for degree in range(1, DEGREE + 1):
        number = first[:, None] + DEGREE + np.arange(1, degree + 1)
        upper, lower = vector[number], vector[number - degree]
        share = weights / (upper - lower)
        weights = np.zeros((horizon, degree + 1))
        weights[:, :-1] = share * (upper - middles[:, None])
        weights[:, 1:] += share * (middles[:, None] - lower)
    return first.astype(np.int64), weights


Array = NDArray[np.float64]
# Chosen: where the search for the temperature of a first plan begins.
FIRST_TEMPERATURE = 0.1


class Optimiser:
    """Improves a command sequence (T, C) by sampling around it; all randomness is in `seed` and the step number.

    `points`: parameter points that every sample is costed under. `history`: steps of commands from before the plan that
    the system looks back on. `largest`, `change`: bound of a command and of its change in a step, kept in `limits`.
    `work`: the buffers, as the last step left them.
    """

    def __init__(
        self, sampler: Sampler, channels: int, points: int, history: int, largest: float, change: float, seed: int
    ) -> None:
        horizon, f32 = sampler.horizon, np.float32
        if sampler.knots is None:
            knots, self._basis = horizon, Basis(np.arange(horizon), None)
        else:
            first, weights = spline_basis(sampler.knots, horizon)
            knots, self._basis = sampler.knots, Basis(first, weights.astype(f32))
        rows = -(-knots * channels // 4) * 4
        blocks = block_count(sampler.samples)
        padded = blocks * int(BLOCK)
        self.step_number = 0
        self._before = np.zeros(channels, f32)
        self.limits = Limits(single(largest), single(min(change, 4.0 * largest)), self._before)
        commands_size = (history + horizon) * channels * int(BLOCK)
        self._samplings = np.zeros(1, SAMPLING)
        self._samplings[0] = (
            seed,
            sampler.samples,
            blocks,
            rows,
            history,
            sampler.with_nominal,
            False,
            sampler.beyond_end == "hold",
            sampler.update_from == "drawn",
            sampler.noise_std,
            sampler.wide,
            sampler.temperature or 0.0,
            sampler.target_ess,
            sampler.control_cost_weight / sampler.noise_std**2,
            {"mean": 1.0, "cvar": sampler.worst_part, "worst": 1e-6}[sampler.risk],
        )
        self.work = Workspace(
            nominal=np.zeros((horizon, channels), f32),
            guide=np.zeros((horizon, channels), f32),
            updated=np.zeros((horizon, channels), f32),
            before_update=np.zeros((horizon, channels), f32),
            noise=aligned_zeros(blocks * rows * int(BLOCK)),
            commands=aligned_zeros(blocks * commands_size).reshape(blocks, commands_size),
            state=aligned_zeros(STATE_ROWS * int(BLOCK)),
            point_costs=aligned_zeros(points * padded),
            costs=aligned_zeros(padded),
            weights=aligned_zeros(padded),
            sums=aligned_zeros(max(horizon * channels, rows) * int(BLOCK)),
            pull=np.zeros(rows, f32),
            order=np.zeros(points, np.int64),
            report=np.zeros(6),
        )
        self._sampler = sampler
        self._valid = self._with_guide = False
        self._replan: Callable[..., bool] | None = None
        # What `disco_step` was last called with, for whoever wants to repeat a step.
        self.arguments: tuple[object, ...] = ()
        self.reset()

    def reset(self) -> None:
        """Clear the plan but continue the sequence of random numbers."""
        self.work.nominal[:] = 0.0
        self._valid = False
        self.work.report[TEMPERATURE] = FIRST_TEMPERATURE

    @property
    def padded_samples(self) -> int:
        """Samples with the idle ones of the last block: K'."""
        return int(self.work.costs.size)

    def nominal(self) -> Array:
        """Return a read-only copy of the plan, (T, C)."""
        copy: Array = self.work.nominal.astype(np.float64)
        copy.setflags(write=False)
        return copy

    def set_nominal(self, commands: Array) -> None:
        """Continue from this plan, (T, C)."""
        self.work.nominal[:] = commands

    def sample_guide(self, desired: bool) -> None:
        """Whether sample 1 is the commands that stand in `work.guide` at a step, from the next one on."""
        if desired != self._with_guide:
            self._with_guide = self._samplings["with_guide"] = desired

    def guide_is_better(self, below: float) -> bool:
        """Whether the guide costs less than this part of what the plan did, in the last step."""
        return bool(self.work.costs[1] < below * self.work.costs[0])

    @property
    def guide_cost(self) -> float:
        """Cost of the guide in the last step."""
        return float(self.work.costs[1])

    @property
    def guide_is_valid(self) -> bool:
        """Whether the guide had a cost in the last step."""
        return bool(self.work.costs[1] < INVALID)

    def use_guide(self) -> None:
        """Continue from the guide."""
        self.work.nominal[:] = self.work.guide

    def set_command_history(self, past: Array) -> None:
        """Set the commands before the plan, (history, C)."""
        blocks = self.work.commands
        blocks.reshape(len(blocks), -1, int(BLOCK))[:, : past.size] = past.reshape(-1, 1)

    def step(
        self, shift_steps: float, gain: float, before: tuple[float, ...], system: System, point_weights: Floats
    ) -> bool:
        """Shift the plan by `shift_steps` and improve it once; return False if no valid plan came out.

        `gain`: how far the plan moves towards the weighted mean of the samples, 0 to 1.

        `before`: the commands that limits of change start from. `point_weights` (L,) float32. `system` and its parts
        must be of the same types in every step.
        """
        self._before[:] = before
        number = self.step_number
        self.step_number += 1
        self.arguments = (
            self.work, self._samplings, number, shift_steps, gain, self._basis, self.limits, system, point_weights
        )  # fmt: skip
        if self._replan is None:
            self._replan = compiled_for(disco_step, *self.arguments)
        self._valid = self._replan(*self.arguments)
        return self._valid

    @property
    def ess(self) -> float:
        """Effective sample size of the last step."""
        return float(self.work.report[ESS])

    @property
    def least_cost(self) -> float:
        """Least cost of a sample in the last step; NaN where none was finite."""
        return float(self.work.report[LEAST])

    @property
    def nominal_cost(self) -> float:
        """Cost that the plan had before the last step improved it."""
        return float(self.work.costs[0])

    def sampled_commands(self, limit: int) -> tuple[Array, Array]:
        """Up to `limit` of the last step's samples of the largest weight: commands (n, T, C), weights (n,).

        Worked out again from the noise and the plan that it was added to; changes nothing. None, if the last step was
        not valid.
        """
        work, samples = self.work, self._sampler.samples
        if not self._valid:
            return np.empty((0, *work.nominal.shape)), np.empty(0)
        weights = np.asarray(work.weights[:samples], dtype=np.float64)
        chosen = np.argsort(-weights, kind="stable")[:limit]
        block, lane = np.divmod(chosen, int(BLOCK))
        noise = work.noise.reshape(work.weights.size // int(BLOCK), -1, int(BLOCK))[block, :, lane]
        commands = self._applied(noise.astype(np.float64))
        if self._with_guide:
            commands[chosen == 1] = work.guide
        return commands, weights[chosen] / weights.sum()

    def _applied(self, noise: Array) -> Array:
        """Commands (n, T, C) within the limits, from the noise (n, R) of n samples."""
        horizon, channels = self.work.nominal.shape
        first, weights = self._basis
        by_knot = noise[:, : noise.shape[1] // channels * channels].reshape(len(noise), -1, channels)
        if weights is None:
            over_time = by_knot[:, first]
        else:
            over_time = np.einsum("tj,ntjc->ntc", weights, by_knot[:, first[:, None] + np.arange(4)])
        commands = np.asarray(self.work.before_update + over_time)
        change, largest = float(self.limits.change), float(self.limits.largest)
        previous = np.broadcast_to(self._before.astype(np.float64), commands[:, 0].shape)
        for t in range(horizon):
            desired = np.minimum(np.maximum(commands[:, t], previous - change), previous + change)
            previous = np.minimum(np.maximum(desired, -largest), largest)
            commands[:, t] = previous
        return commands
