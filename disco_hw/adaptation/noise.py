"""The noise that evidence is weighted with: learnt slowly from quiet stretches, from what is usual on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from disco_hw.inference.noise import USUAL, Noise

Array = NDArray[np.float64]

# A stretch is a few dozen independent errors of the slip: one alone is off by half.
_USUAL_COUNTS_FOR = 3.0
_LONGEST_MEMORY = 12.0


class RunningNoise:
    """A mean of variances over stretches of driving, which begins as `USUAL`."""

    def __init__(self) -> None:
        self._weight = _USUAL_COUNTS_FOR
        self._variance: Array = USUAL.vector() ** 2

    @property
    def noise(self) -> Noise:
        """The noise now."""
        return Noise(*np.sqrt(self._variance).tolist())

    def add(self, measured: Noise) -> None:
        """Take in the noise of one stretch."""
        self._weight = min(self._weight + 1.0, _LONGEST_MEMORY)
        self._variance += (measured.vector() ** 2 - self._variance) / self._weight
