"""The parameter points that every command sequence is rolled out under, and their weights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.settings import DiscoSettings
from disco_hw.control.sigma_points import sigma_points
from disco_hw.model import Mixture, Model

Array = NDArray[np.float64]
DOMINANT_WEIGHT = 0.9


def parameter_points(model: Model, settings: DiscoSettings, seed: int) -> tuple[Array, Array]:
    """Points (L, P) over all parameters of the model, within their physical ranges, and weights (L,) that sum to one.

    A mixture gives its dominant component above a weight of 0.9 (paper, section IV-C), else its overall moments.
    """
    belief = model.belief
    if belief is None or settings.uncertainty == "point":
        return model.point()[None], np.ones(1)
    if settings.uncertainty == "mc":
        points = belief.draw(settings.draws, np.random.default_rng(seed))
        return model.complete(points, belief.names), np.full(settings.draws, 1.0 / settings.draws)
    mean, covariance = belief.mean(), belief.covariance()
    if isinstance(belief, Mixture):
        weight, component = belief.dominant()
        if weight >= DOMINANT_WEIGHT:
            mean, covariance = component.means, component.covariances
    sigma = sigma_points(mean, covariance, settings.ut_alpha)
    return model.complete(sigma.points, belief.names), sigma.mean_weights
