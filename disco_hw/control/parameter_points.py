"""The parameter points that every command sequence is rolled out under, and their weights; sigma points among them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects import Channel
from disco_hw.effects.registry import DELAY
from disco_hw.model import Belief, Mixture, Model
from disco_hw.model.model import BASE_PARAMETERS, X_ICR
from disco_hw.model.terms import effect_of

Array = NDArray[np.float64]
# Chosen: with a lighter first component the whole mixture's mean and covariance are taken.
DOMINANT_WEIGHT = 0.9
SCALED = ("wheel_radius_m", "axial_distance_m")
# Rounding of equal numbers.
SAME_RATIO = 1e-9


def moving_names(belief: Belief) -> tuple[str, ...]:
    """Return the belief's parameters that change motion: of effects, wheel radius and axial distance, then x_icr."""
    base = {parameter.name for parameter in BASE_PARAMETERS}
    moving = [name for name in belief.names if name in base or effect_of(name.rpartition(".")[0]).moves]
    return tuple(sorted(moving, key=lambda name: (name in base) + (name == X_ICR.name)))


def shared_basis(names: tuple[str, ...], mean: Array) -> Array:
    """Coordinates (n, n) in which to take the square root, so that as many sigma points as can be share a rollout.

    The points along the last column then differ from the mean in x_icr alone, and those along the one before it, if
    wheel radius and axial distance are both believed in, in these in proportion and in x_icr: they turn alike.
    """
    basis = np.eye(len(names))
    if set(SCALED) <= set(names):
        rows = sorted(names.index(name) for name in SCALED)
        if mean[rows].min() > 0.0:
            basis[rows, rows[1]] = mean[rows] / mean[rows[1]]
    return basis


def moments(belief: Belief) -> tuple[Array, Array]:
    """Mean and covariance for the unscented transform, over `moving_names`.

    A mixture gives its dominant component above a weight of 0.9 (paper, section IV-C), else its overall moments.
    """
    mean, covariance = belief.mean(), belief.covariance()
    if isinstance(belief, Mixture):
        weight, component = belief.dominant()
        if weight >= DOMINANT_WEIGHT:
            mean, covariance = component.means, component.covariances
    kept = [belief.names.index(name) for name in moving_names(belief)]
    return mean[kept], covariance[np.ix_(kept, kept)]


def point_estimate(model: Model) -> tuple[Array, Array]:
    """Return the model's point values as the only point: (1, P), weight (1,)."""
    return model.point()[None], np.ones(1)


def unscented_points(model: Model, alpha: float) -> tuple[Array, Array]:
    """Sigma points over all parameters of the model, (L, P), within their physical ranges; weights (L,), sum one."""
    belief = model.belief
    if belief is None or not moving_names(belief):
        return point_estimate(model)
    names, (mean, covariance) = moving_names(belief), moments(belief)
    sigma = sigma_points(mean, covariance, alpha, basis=shared_basis(names, mean))
    return model.complete(sigma.points, names), sigma.mean_weights


def sampled_points(model: Model, count: int, seed: int, step: int) -> Array:
    """Draws of the belief over all parameters of the model, (count, P), within their physical ranges.

    A pure function of seed and step number. The command delay keeps its mean: it shifts whole rows of commands.
    """
    belief = model.belief
    if belief is None:
        return np.tile(model.point(), (count, 1))
    rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 0, step]))
    draws = belief.draw(count, rng)
    if DELAY.columns[0] in belief.names:
        column = belief.names.index(DELAY.columns[0])
        draws[:, column] = belief.mean()[column]
    return model.complete(draws, belief.names)


def mean_point(model: Model) -> Array:
    """Return the mean of the belief over all parameters of the model, (1, P), within their physical ranges."""
    if model.belief is None:
        return model.point()[None]
    return model.complete(model.belief.mean()[None], model.belief.names)


def equivalent_points(model: Model, points: Array, step_s: float, pairs: int) -> NDArray[np.int64]:
    """For points (L, P), those that share one's rollout: (L, 2 * pairs), -1 for none, -2 for being such a twin.

    The first pair differs from the point in x_icr alone. The second one differs from it in wheel radius and axial
    distance too, in proportion: the robot then turns alike and drives a path of the same shape at another scale, unless
    an effect between wheel and body interferes. A point has all pairs, as the unscented transform makes them, or none.
    """
    found = np.full((len(points), 2 * pairs), -1)
    columns = [model.parameter_names.index(name) for name in (*SCALED, X_ICR.name)]
    ratio = points[:, columns[0]] / points[:, columns[1]]
    others = np.delete(points, columns, axis=1)
    terms = _wheel_coefficients(model, points, step_s)
    for i in range(len(points) if pairs else 0):
        if found[i, 0] != -1:
            continue
        free = [j for j in range(i + 1, len(points)) if found[j, 0] == -1 and np.array_equal(others[j], others[i])]
        group = [j for j in free if np.array_equal(points[j, columns[:2]], points[i, columns[:2]])][:2]
        if terms is not None and pairs == 2:
            group += [
                j
                for j in free
                if j not in group
                and math.isclose(ratio[j], ratio[i], rel_tol=SAME_RATIO)
                and np.allclose(terms[j], terms[i], rtol=SAME_RATIO, atol=0.0)
            ][:2]
        if len(group) == 2 * pairs:
            found[i] = group
            found[group] = -2
    return found


def shared_pairs(model: Model, points: Array, step_s: float) -> int:
    """Pairs of `equivalent_points` that these points have: 0, 1 or 2."""
    return max((pairs for pairs in (1, 2) if np.any(equivalent_points(model, points, step_s, pairs) >= 0)), default=0)


def _wheel_coefficients(model: Model, points: Array, step_s: float) -> Array | None:
    """Return the effects' coefficients (L, N) for points (L, P); None if an effect acts after the wheels."""
    columns = [np.empty((len(points), 0))]
    at = len(BASE_PARAMETERS)
    for setting in model.effects:
        width = len(setting.effect.parameters)
        if setting.effect.moves and setting.effect.channel is not Channel.COMMAND_TO_WHEEL:
            return None
        values = setting.effect.coefficients(points[:, at : at + width], points[:, : len(BASE_PARAMETERS)], step_s)
        columns += [column[:, None] for column in values]
        at += width
    return np.hstack(columns)


@dataclass(frozen=True, eq=False)
class SigmaPoints:
    """Points (L, n) with L = 2n + 1, weights of the mean (L,) and of the covariance (L,); the first is the mean."""

    points: Array
    mean_weights: Array
    covariance_weights: Array


def sigma_points(
    mean: Array, covariance: Array, alpha: float, kappa: float = 0.0, xi: float = 2.0, basis: Array | None = None
) -> SigmaPoints:
    """Sigma points of a mean (n,) and a covariance (n, n).

    The points are mean +- columns of a square root C of (n + nu) covariance, C C' = (n + nu) covariance, so that
    sum w d d' is the covariance exactly, correlated or not. C is the lower Cholesky factor; in the coordinates of
    `basis` (n, n), if given, whose last column is then the direction of the last points. alpha = 1 gives non-negative
    weights. Raises ValueError unless alpha > 0 and the covariance is positive definite.
    """
    n = mean.size
    if not alpha > 0.0:
        raise ValueError(f"alpha must be positive, not {alpha}")
    spread = alpha**2 * (n + kappa)
    if spread <= 0.0:
        raise ValueError(f"n + kappa must be positive, not {n + kappa}")
    axes = np.eye(n) if basis is None else basis
    inverse = np.linalg.inv(axes)
    try:
        factor = axes @ np.linalg.cholesky(spread * (inverse @ covariance @ inverse.T))
    except np.linalg.LinAlgError:
        raise ValueError("the covariance is not positive definite") from None
    points = np.vstack([mean, mean + factor.T, mean - factor.T])
    mean_weights = np.full(2 * n + 1, 0.5 / spread)
    mean_weights[0] = 1.0 - n / spread
    covariance_weights = mean_weights.copy()
    covariance_weights[0] += 1.0 - alpha**2 + xi
    return SigmaPoints(points, mean_weights, covariance_weights)
