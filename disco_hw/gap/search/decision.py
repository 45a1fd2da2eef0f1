"""One rule decides between models that were predicted with: the simplest one that is as good as the best.

1. The score of a stretch of held-out time is half the log of its squared errors plus the sensors' noise, in position
   and in heading, added: a millimetre counts by what the noise of that log is.
2. The best model has the lowest mean score over the stretches.
3. Each other model's excess over it is taken stretch by stretch. Its standard error is that on another drive as long:
   s^2 (2 / n + 1 / (F - 1)) of n stretches in F folds that scatter by s, and wider after Student where n is small.
4. A model is as good as the best if its excess is no more than one standard error (Breiman et al., 1984, ch. 3).
5. Of those the first is chosen of: an amended model that adds nothing to a delay and a lag, `timed`, `refitted`, and
   the amended model with the fewest effects.

Of the variance in 3, 1 / n is of the mean over the stretches at hand, 1 / n of that over those of the other drive, and
1 / (F - 1) of models that learn from data which they share (Nadeau and Bengio, Machine Learning 52, 2003): it is the
share of what is predicted in what is learnt from.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from disco_hw.gap.search.cross_validation import PredictionErrors

Array = NDArray[np.float64]
T = TypeVar("T")

# Of a normal distribution the share below one standard deviation.
_ONE_SIGMA = 0.8413447460685429
# Keeps the log of an error of none finite, far below what any sensor resolves (1e-9 m or rad).
_NO_ERROR = 1e-18


def score(errors: PredictionErrors, floor: PredictionErrors | None) -> Array:
    """Return the score of each stretch of time (B,), lower is better; without a `floor` the sensors have no noise."""
    noise = np.zeros((1, 2)) if floor is None else floor.by_stretch
    return np.asarray(0.5 * np.log(errors.by_stretch + noise + _NO_ERROR).sum(axis=1))


def excess(best: PredictionErrors, other: PredictionErrors, floor: PredictionErrors | None) -> tuple[float, float]:
    """Mean over stretches by which the other's score exceeds the best one's, and its standard error on another drive.

    Of a single stretch the error is not known, and 0.
    """
    growth = score(other, floor) - score(best, floor)
    if growth.size < 2:
        return float(growth.mean()), 0.0
    # Stretches of a single fold were predicted by one model: it is taken for one of two.
    share = 2.0 / growth.size + 1.0 / max(best.folds - 1, 1)
    error = float(growth.std(ddof=1)) * math.sqrt(share)
    return float(growth.mean()), float(stdtrit(growth.size - 1, _ONE_SIGMA)) * error


def is_as_good(best: PredictionErrors, other: PredictionErrors, floor: PredictionErrors | None) -> bool:
    """Whether other errors exceed the best ones by no more than one standard error."""
    mean, error = excess(best, other, floor)
    return mean <= error


def best_of(options: Sequence[T], errors: Callable[[T], PredictionErrors], floor: PredictionErrors | None) -> T:
    """Return the option with the lowest mean score, the first of equals."""
    return min(options, key=lambda option: float(score(errors(option), floor).mean()))


def first_as_good(options: Sequence[T], errors: Callable[[T], PredictionErrors], floor: PredictionErrors | None) -> T:
    """Return the first of the options, which begin with the simplest, that is as good as the best of them."""
    best = errors(best_of(options, errors, floor))
    return next(option for option in options if is_as_good(best, errors(option), floor))
