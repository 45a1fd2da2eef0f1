"""What is believed of the parameters: a joint Gaussian, a mixture of them, or a uniform box."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Belief(Protocol):
    """A joint distribution over the named parameters; P is their number."""

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters, in the order of all arrays."""

    def mean(self) -> Array:
        """Mean vector, shape (P,)."""

    def covariance(self) -> Array:
        """Covariance matrix, shape (P, P)."""

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Independent draws, shape (count, P)."""


def _checked_covariance(covariance: Array, size: int, what: str) -> Array:
    """Return a read-only copy; raises ValueError unless it is finite, symmetric and positive definite."""
    matrix = np.array(covariance, dtype=np.float64)
    if matrix.shape != (size, size):
        raise ValueError(f"{what} has shape {matrix.shape}, not ({size}, {size})")
    if not np.all(np.isfinite(matrix)):
        raise ValueError(f"{what} holds a value that is not finite")
    scale = np.sqrt(np.abs(np.diag(matrix)))
    if np.any(np.abs(matrix - matrix.T) > 1e-9 * np.outer(scale, scale) + 1e-300):
        raise ValueError(f"{what} is not symmetric")
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise ValueError(f"{what} is not positive definite") from None
    # Numbers that were rounded on their way are symmetric to the last bit from here on, as the estimator wants them.
    matrix = 0.5 * (matrix + matrix.T)
    matrix.setflags(write=False)
    return matrix


def _checked_vector(vector: Array, size: int, what: str) -> Array:
    values = np.array(vector, dtype=np.float64)
    if values.shape != (size,):
        raise ValueError(f"{what} has {values.size} entries, not {size}")
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{what} holds a value that is not finite")
    values.setflags(write=False)
    return values


@dataclass(frozen=True, eq=False)
class Gaussian:
    """A joint Gaussian; raises ValueError for shapes that disagree, non-finite values or a covariance that is none."""

    names: tuple[str, ...]
    means: Array
    covariances: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "means", _checked_vector(self.means, len(self.names), "mean"))
        object.__setattr__(self, "covariances", _checked_covariance(self.covariances, len(self.names), "covariance"))

    def mean(self) -> Array:
        """Mean vector, shape (P,)."""
        return self.means

    def covariance(self) -> Array:
        """Covariance matrix, shape (P, P)."""
        return self.covariances

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Independent draws, shape (count, P)."""
        factor = np.linalg.cholesky(self.covariances)
        return np.asarray(self.means + rng.standard_normal((count, len(self.names))) @ factor.T)


@dataclass(frozen=True, eq=False)
class Mixture:
    """A mixture of joint Gaussians over the same names; `weights` (C,) are positive and are normalised here.

    Raises ValueError for components that disagree or weights that are none.
    """

    weights: Array
    components: tuple[Gaussian, ...]

    def __post_init__(self) -> None:
        if not self.components:
            raise ValueError("a mixture needs at least one component")
        weights = _checked_vector(self.weights, len(self.components), "weights")
        if np.any(weights <= 0.0):
            raise ValueError("weights must all be positive")
        if any(component.names != self.components[0].names for component in self.components):
            raise ValueError("the components name different parameters")
        normalised = weights / weights.sum()
        normalised.setflags(write=False)
        object.__setattr__(self, "weights", normalised)

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters, in the order of all arrays."""
        return self.components[0].names

    def mean(self) -> Array:
        """Mean of the mixture, shape (P,)."""
        return np.asarray(sum(w * c.means for w, c in zip(self.weights, self.components, strict=True)))

    def covariance(self) -> Array:
        """Covariance of the mixture (within plus between components), shape (P, P)."""
        mean = self.mean()
        total = np.zeros((mean.size, mean.size))
        for weight, component in zip(self.weights, self.components, strict=True):
            offset = component.means - mean
            total += weight * (component.covariances + np.outer(offset, offset))
        return total

    def dominant(self) -> tuple[float, Gaussian]:
        """Weight and component of the largest weight."""
        index = int(np.argmax(self.weights))
        return float(self.weights[index]), self.components[index]

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Independent draws, shape (count, P)."""
        which = rng.choice(len(self.components), size=count, p=self.weights)
        draws = np.empty((count, len(self.names)))
        for index, component in enumerate(self.components):
            chosen = which == index
            draws[chosen] = component.draw(int(chosen.sum()), rng)
        return draws


@dataclass(frozen=True, eq=False)
class Uniform:
    """Independent uniform ranges, as a prior; raises ValueError unless low < high, all finite."""

    names: tuple[str, ...]
    low: Array
    high: Array

    def __post_init__(self) -> None:
        low = _checked_vector(self.low, len(self.names), "low")
        high = _checked_vector(self.high, len(self.names), "high")
        if np.any(low >= high):
            raise ValueError("low must be below high in every entry")
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    def mean(self) -> Array:
        """Mean vector, shape (P,)."""
        return np.asarray(0.5 * (self.low + self.high))

    def covariance(self) -> Array:
        """Diagonal covariance, shape (P, P)."""
        return np.diag((self.high - self.low) ** 2 / 12.0)

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Independent draws, shape (count, P)."""
        return np.asarray(rng.uniform(self.low, self.high, (count, len(self.names))))
