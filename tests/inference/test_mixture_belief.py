import numpy as np
import pytest

from disco_hw.control.parameter_points import moments, moving_names
from disco_hw.inference.density_network import Mixtures, Region
from disco_hw.inference.infer import belief_of
from disco_hw.inference.simulate import NAMES

LOW, HIGH = np.array([0.0, 0.0, 0.1]), np.array([0.5, 0.5, 0.5])
REGION = Region.box(LOW, HIGH)


def mixtures(parts):
    """Parts (weight, mean in metres, standard deviation in metres) in the region's coordinates."""
    half = 0.5 * (HIGH - LOW)
    return Mixtures(
        np.log([[weight for weight, _, _ in parts]]),
        REGION.unit(np.array([mean for _, mean, _ in parts], dtype=float))[None],
        np.array([np.diag(half / sd) for _, _, sd in parts])[None],
    )


def belief(*parts):
    return belief_of(mixtures(parts), REGION, LOW, HIGH, NAMES, np.random.default_rng(0))


def handed_to_disco(found):
    """Mean and covariance as the controller takes them, in the order of `NAMES`."""
    mean, covariance = moments(found)
    order = [moving_names(found).index(name) for name in NAMES]
    return mean[order], covariance[np.ix_(order, order)]


def test_one_gaussian_comes_back_in_metres():
    found = belief((1.0, [0.2, 0.06, 0.4], 0.01))
    assert found.weights == pytest.approx([1.0])
    assert found.mean() == pytest.approx([0.2, 0.06, 0.4])
    assert found.covariance() == pytest.approx(1e-4 * np.eye(3), abs=1e-12)


def test_members_that_agree_become_one_component():
    found = belief(*((0.25, [0.2 + 0.001 * k, 0.06, 0.4], 0.01) for k in range(4)))
    assert found.weights.size == 1


def test_disco_takes_the_dominant_component_above_the_threshold_and_the_moments_of_the_whole_below_it():
    found = belief((0.95, [0.1, 0.06, 0.4], 0.005), (0.05, [0.4, 0.2, 0.2], 0.005))
    mean, covariance = handed_to_disco(found)
    assert mean == pytest.approx([0.1, 0.06, 0.4], abs=1e-6)
    assert covariance == pytest.approx(2.5e-5 * np.eye(3), abs=1e-9)
    found = belief((0.6, [0.1, 0.06, 0.4], 0.005), (0.4, [0.3, 0.06, 0.4], 0.005))
    mean, covariance = handed_to_disco(found)
    assert mean == pytest.approx([0.18, 0.06, 0.4], abs=1e-6)
    assert covariance[0, 0] == pytest.approx(2.5e-5 + 0.6 * 0.4 * 0.2**2, rel=1e-6)


def test_what_reaches_outside_the_range_is_cut_off():
    found = belief((1.0, [0.0, 0.06, 0.4], 0.01))
    # Half of a Gaussian: mean sd sqrt(2/pi), variance sd^2 (1 - 2/pi).
    assert found.mean()[0] == pytest.approx(0.01 * np.sqrt(2.0 / np.pi), rel=0.05)
    assert found.covariance()[0, 0] == pytest.approx(1e-4 * (1.0 - 2.0 / np.pi), rel=0.1)


def test_a_component_all_outside_goes_and_a_mixture_all_outside_is_refused():
    found = belief((0.5, [0.2, 0.06, 0.4], 0.01), (0.5, [0.9, 0.06, 0.4], 0.01))
    assert found.mean() == pytest.approx([0.2, 0.06, 0.4], abs=1e-3)
    with pytest.raises(ValueError, match="outside the prior"):
        belief((1.0, [0.9, 0.06, 0.4], 0.01))


def test_a_component_counts_by_what_of_it_is_inside():
    found = belief((0.5, [0.3, 0.06, 0.4], 0.005), (0.5, [0.0, 0.3, 0.2], 0.005))
    assert found.weights == pytest.approx([2.0 / 3.0, 1.0 / 3.0], abs=0.02)
