"""Final fit of the whole chain, from commands to poses, to its own predictions some seconds ahead.

What is best for each channel alone need not be best for both in a row: if the true form is none of the known ones, each
channel's best fit errs in its own way. Output-error method (Ljung, System Identification, 1999, ch. 3 and 7).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from disco_hw.gap.data import BASE_COUNT, Layout
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.search.cross_validation import (
    Chain,
    Starts,
    chain_track,
    chain_wheels,
    find_starts,
    prediction_error,
    scored_horizon_s,
)
from disco_hw.gap.search.least_squares import inverse, within
from disco_hw.gap.settings import OF_MEDIAN

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_SCALE = 1e-5
# How surely entries of which nothing is known stay where they are: enough where predictions say nothing of them.
_NEGLIGIBLE = 1e-4
# A fit begins inside its bounds, by this many difference steps.
_INSIDE = 1e-6


@dataclass(frozen=True)
class Part:
    """Part of a channel's vector that a fit frees: the `active` places, with prior `information` (A, A) about them."""

    layout: Layout
    vector: Array
    active: tuple[int, ...]
    information: Array


@dataclass(frozen=True)
class Freed:
    """Entries of each channel that a fit of the chain frees; `chain` joins the channels' vectors."""

    parts: tuple[Part, ...]
    chain: Callable[[Sequence[Array]], Chain]

    def joined(self, of: Callable[[Part], Array]) -> Array:
        """Concatenate the freed entries of the vectors that `of` returns for the channels, (A,)."""
        return np.concatenate([of(part)[list(part.active)] for part in self.parts])

    def vectors(self, values: Array) -> list[Array]:
        """Return the channels' vectors with their freed entries set to `values` (A,)."""
        counts = np.cumsum([len(part.active) for part in self.parts])
        out = [part.vector.copy() for part in self.parts]
        for vector, part, values_of_part in zip(out, self.parts, np.split(values, counts[:-1]), strict=True):
            vector[list(part.active)] = values_of_part
        return out

    def at(self, vectors: Sequence[Array]) -> Freed:
        """Return the same freed entries around other vectors."""
        pairs = zip(self.parts, vectors, strict=True)
        return replace(self, parts=tuple(replace(part, vector=vector) for part, vector in pairs))

    @property
    def names(self) -> tuple[str, ...]:
        """Full names of the freed entries."""
        return tuple(part.layout.columns[place] for part in self.parts for place in part.active)


@dataclass(frozen=True)
class JointFit:
    """A chain's vectors after a fit of the whole, the cost, and by name the covariance (A, A) of what was freed."""

    vectors: tuple[Array, ...]
    cost: float
    names: tuple[str, ...]
    covariance: Array

    def value(self, name: str, of: Freed, own_channel: Part | None = None) -> float | None:
        """Return an entry by its full name, from `own_channel` if it has one; None if it is in no channel's vector.

        Both channels number their unnamed terms alike.
        """
        found = [
            (part is own_channel, float(vector[part.layout.place[name]]))
            for vector, part in zip(self.vectors, of.parts, strict=True)
            if name in part.layout.place
        ]
        return next((value for is_of_part, value in found if is_of_part), found[0][1] if found else None)


@dataclass(frozen=True)
class Ahead:
    """Predictions that fits are judged by: both channels, and starts by horizon."""

    body: BodyChannel
    wheels: WheelChannel | None
    starts: tuple[tuple[float, Starts], ...]

    @classmethod
    def of(cls, body: BodyChannel, wheels: WheelChannel | None, poses: tuple[Array, Array]) -> Ahead:
        """Predictions from smoothed `poses` over half and all of the reported horizon, or shorter where runs are."""
        longest_s = scored_horizon_s(body, poses)
        usual_s = body.settings.prediction.reported_horizon_s
        horizons = sorted({min(ahead_s, longest_s) for ahead_s in (0.5 * usual_s, usual_s)})
        every = [(ahead_s, find_starts(body, poses, ahead_s)) for ahead_s in horizons]
        return cls(body, wheels, tuple((ahead_s, starts) for ahead_s, starts in every if starts.node.size))

    @property
    def folds(self) -> int:
        """Number of folds into which the drive is divided."""
        return self.body.drive.folds.count

    def errors(self, chain: Chain, turned: tuple[Array, Array] | None = None) -> list[Array]:
        """Measured minus predicted poses (K, 3) by horizon; `turned`: what the wheels do, if that is known."""
        track, _ = chain_track(self.body, self.wheels, chain, turned)
        return [prediction_error(self.body, starts, chain.body, track, ahead_s) for ahead_s, starts in self.starts]

    def usual_cost(self, chain: Chain, left_out: int | None = None) -> float:
        """Return the usual size of prediction errors, to compare chains: the sum of the logs of both errors' sizes.

        Those that start in the fold `left_out` do not count.
        """
        errors = zip(self.errors(chain), self._outside(left_out), strict=True)
        return sum(float(np.log(_usual(error[mask])[1:]).sum()) for error, mask in errors)

    def _outside(self, left_out: int | None) -> list[Mask]:
        """Return which starts lie outside a fold, by horizon."""
        return [starts.block % self.folds != left_out for _, starts in self.starts]

    def fit(self, of: Freed, left_out: int | None = None, begin: Sequence[Array] | None = None) -> JointFit:
        """Fit the freed entries so that they predict best, without the fold `left_out` if there is one.

        The fit begins at the vectors `begin`, or else at those on which the prior is centred.

        Errors of position and of heading are each measured in what they usually are at the start of a round; large ones
        count linearly (Huber, 1964). Neighbouring predictions overlap, so that each counts for the time it adds.
        """
        settings = self.body.settings
        chosen = self._outside(left_out)
        every_s = settings.grid.start_every_s
        shares = [min(every_s / ahead_s, 1.0) ** 0.5 for ahead_s, _ in self.starts]
        start, step = of.joined(lambda part: part.vector), of.joined(lambda part: part.layout.step)
        low, high = of.joined(lambda part: part.layout.low), of.joined(lambda part: part.layout.high)
        precision = block_diag(*(part.information for part in of.parts))
        # Effects of the body leave the wheels alone; its geometry may not.
        first = np.array(of.parts[0].active)
        of_body = np.concatenate([first >= BASE_COUNT, np.zeros(step.size - first.size, dtype=bool)])
        root = np.linalg.cholesky(precision + np.diag((_NEGLIGIBLE / step) ** 2)).T
        first_at = start if begin is None else of.at(begin).joined(lambda part: part.vector)
        values, cost, normal = np.clip(first_at, low + _INSIDE * step, high - _INSIDE * step), math.inf, root.T @ root
        for _ in range(settings.fit.rounds if any(mask.any() for mask in chosen) else 0):
            units = [
                _usual(error[mask]) / share
                for error, mask, share in zip(self.errors(of.chain(of.vectors(values))), chosen, shares, strict=True)
            ]

            def residual(at: Array, units: list[Array] = units, turned: tuple[Array, Array] | None = None) -> Array:
                errors = zip(self.errors(of.chain(of.vectors(at)), turned), chosen, units, strict=True)
                return np.asarray(
                    np.hstack([*((e[mask] / unit).ravel() for e, mask, unit in errors), root @ (at - start)])
                )

            def slope(at: Array, residual: Callable[..., Array] = residual) -> Array:
                turned = chain_wheels(self.body, self.wheels, of.chain(of.vectors(at)))
                base, columns = residual(at, turned=turned), []
                for place, size in enumerate(np.where(at + step <= high, step, -step)):
                    moved = at.copy()
                    moved[place] += size
                    columns.append((residual(moved, turned=turned if of_body[place] else None) - base) / size)
                return np.asarray(np.column_stack(columns))

            found = least_squares(
                residual, values, slope, bounds=(low, high), x_scale=10.0 * step, loss="huber",
                f_scale=settings.noise.huber * max(shares), max_nfev=settings.fit.iterations, ftol=1e-5, xtol=1e-8,
            )  # fmt: skip
            values, cost, normal = found.x, float(found.cost), np.asarray(found.jac.T @ found.jac)
        return JointFit(tuple(of.vectors(values)), cost, of.names, within(inverse(normal), low, high))


def _usual(error: Array) -> Array:
    """Usual size of errors (K, 3): of position, twice, and of heading; (3,), 1 of no errors."""
    if not error.size:
        return np.ones(3)
    position = OF_MEDIAN * float(np.median(np.abs(error[:, :2])))
    heading = OF_MEDIAN * float(np.median(np.abs(error[:, 2])))
    return np.asarray(np.maximum(np.array([position, position, heading]), _LEAST_SCALE))
