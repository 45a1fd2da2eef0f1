import numpy as np
import pytest

from disco_hw.adaptation.recursive import evidence, from_linear
from disco_hw.inference.excitation import Noise
from tools.adaptation_drives import TRUTH, excited

NOISE = Noise(0.005, 0.01, 0.004, 0.004, 0.012)


def estimate(part):
    covariance = np.linalg.inv(part.information.sum(axis=0))
    return from_linear(covariance @ part.score.sum(axis=0), covariance)


def test_estimates_are_right_and_as_wide_as_they_say():
    """Over 40 drives the errors have the stated standard deviation: the mean square of 120 is within 0.7 and 1.4."""
    errors = []
    for seed in range(40):
        mean, covariance = estimate(evidence(excited(8.0, seed=seed), NOISE))
        errors.append((mean - TRUTH) / np.sqrt(np.diag(covariance)))
    assert 0.7 < np.mean(np.square(errors)) < 1.4
    assert np.abs(np.mean(errors, axis=0)).max() < 0.5


def test_what_is_left_over_is_noise():
    part = evidence(excited(20.0), NOISE)
    mean = np.linalg.solve(part.information.sum(axis=0), part.score.sum(axis=0))
    left = part.square.sum() - mean @ part.score.sum(axis=0)
    assert left / part.values.sum() == pytest.approx(1.0, abs=0.12)


def test_parts_add_up():
    whole = evidence(excited(8.0), NOISE)
    early = whole.t_s < 4.0
    both = whole.part(early).information.sum(axis=0) + whole.part(~early).information.sum(axis=0)
    assert both == pytest.approx(whole.information.sum(axis=0), rel=1e-12)


def test_turning_on_the_spot_and_straights_say_what_they_can():
    straight = evidence(excited(6.0, wheels=lambda t: (4.0, 4.0)), NOISE).information.sum(axis=0)
    spin = evidence(excited(6.0, wheels=lambda t: (-2.0, 2.0)), NOISE).information.sum(axis=0)
    assert straight[2, 2] < 1e-9 * spin[2, 2]
    assert spin[0, 0] < 1e-9 * straight[0, 0]
