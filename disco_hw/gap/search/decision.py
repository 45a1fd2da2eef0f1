"""One rule decides between models that were predicted with: the simplest one that is as good as the best.

1. The score of a stretch of held-out time is half the log of its squared errors plus the sensors' noise, in position
   and in heading, added: a millimetre counts by what the noise of that log is.
2. The best model has the lowest mean score over the stretches.
3. Each other model's excess over it is taken stretch by stretch. If the two were equally good, each excess could as
   well have the other sign.
4. A model is as good as the best if its mean excess is below what is worth a change, or may be chance: one or more in
   ten of all choices of signs give one as large (Fisher's randomisation test: The Design of Experiments, 1935, ch. 3).
   Of fewer than four stretches, where no choice is so rare, each must be worse.
5. Of those the first is chosen of: an amended model that adds nothing to a delay and a lag, `timed`, `refitted`, and
   the amended model with the fewest effects.

Before that an amended model loses, one after the other, the effects without which its mean score exceeds the best one's
by no more than is worth a change (`_needed` in this package). There "may be chance" is no reason: with it the models
that came of it predicted the other halves of two real logs worse.

No scatter is estimated in 4: an effect that shows in two stretches of eight and harms none scatters widely, and is
sure all the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.stats import permutation_test

from disco_hw.gap.search.cross_validation import PredictionErrors

Array = NDArray[np.float64]
T = TypeVar("T")

# Chosen: one in ten. One in six, as a standard error of a normal distribution, handed out a model that erred by half
# more than `timed` on the other half of a real log; one in twenty missed two that erred by a fifth less.
_BY_CHANCE = 0.1
# Keeps the log of an error of none finite, far below what any sensor resolves (1e-9 m or rad).
_NO_ERROR = 1e-18


def score(errors: PredictionErrors, floor: PredictionErrors | None) -> Array:
    """Return the score of each stretch of time (B,), lower is better; without a `floor` the sensors have no noise."""
    noise = np.zeros((1, 2)) if floor is None else floor.by_stretch
    return np.asarray(0.5 * np.log(errors.by_stretch + noise + _NO_ERROR).sum(axis=1))


def chance(best: PredictionErrors, other: PredictionErrors, floor: PredictionErrors | None) -> float:
    """Return how often chance alone would make the other's score exceed the best one's by as much, over all stretches.

    Exact up to 13 stretches; of more a sample of 9999 choices of signs, always the same.
    """
    growth = score(other, floor) - score(best, floor)
    if growth.size < 2:
        return 0.5
    tested = permutation_test(
        (growth,),
        np.mean,
        permutation_type="samples",
        alternative="greater",
        vectorized=True,
        rng=np.random.default_rng(0),
    )
    return float(tested.pvalue)


def excess(best: PredictionErrors, other: PredictionErrors, floor: PredictionErrors | None) -> float:
    """Return by how much the other's mean score exceeds the best one's."""
    return float((score(other, floor) - score(best, floor)).mean())


def is_as_good(
    best: PredictionErrors, other: PredictionErrors, floor: PredictionErrors | None, worth: float = 0.0
) -> bool:
    """Whether the other's mean score exceeds the best one's by `worth` at most, or by what may be chance."""
    rarest = 0.5 ** best.by_stretch.shape[0]
    return excess(best, other, floor) <= worth or chance(best, other, floor) > max(_BY_CHANCE, 1.01 * rarest)


def best_of(options: Sequence[T], errors: Callable[[T], PredictionErrors], floor: PredictionErrors | None) -> T:
    """Return the option with the lowest mean score, the first of equals."""
    return min(options, key=lambda option: float(score(errors(option), floor).mean()))


def first_as_good(
    options: Sequence[T], errors: Callable[[T], PredictionErrors], floor: PredictionErrors | None, worth: float = 0.0
) -> T:
    """Return the first of the options, which begin with the simplest, that is as good as the best of them.

    `worth`: what the mean score must gain, as a share of the errors of position and heading together.
    """
    best = errors(best_of(options, errors, floor))
    return next(option for option in options if is_as_good(best, errors(option), floor, worth))
