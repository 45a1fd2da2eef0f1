"""Statistics and seeding of the disturbances."""

from dataclasses import replace

import numpy as np
import pytest

from sim.disturbances import CELLS, Disturbances
from sim.plant_parameters import PlantParameters

PARAMETERS = PlantParameters(integration_step_us=10_000)


def _blocks(parameters, seed, count):
    source = Disturbances(parameters, np.random.SeedSequence(seed))
    wheel, slip = [], []
    for number in range(count):
        source.move_to(number * CELLS)
        assert source.first_cell == number * CELLS
        wheel.append(source.wheel)
        slip.append(source.slip)
    return np.concatenate(wheel), np.concatenate(slip)


def test_standard_deviations_and_means_are_the_parameters():
    wheel, slip = _blocks(PARAMETERS, 1, 100)
    np.testing.assert_allclose(wheel.std(axis=0), 0.015, rtol=0.05)
    np.testing.assert_allclose(slip.std(axis=0), [0.005, 0.004, 0.018], rtol=0.07)
    assert np.all(np.abs(wheel.mean(axis=0)) < 0.1 * 0.015)


def test_correlation_time_is_the_parameter():
    wheel, slip = _blocks(PARAMETERS, 2, 100)
    for values, lag in ((wheel[:, 0], 15), (slip[:, 2], 30)):
        assert np.corrcoef(values[:-lag], values[lag:])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.05)


def test_sides_and_axes_are_independent():
    wheel, slip = _blocks(PARAMETERS, 3, 100)
    together = np.corrcoef(np.hstack([wheel, slip]).T)
    assert np.all(np.abs(together - np.eye(5)) < 0.06)


def test_wander_adds_slow_variance():
    quick, _ = _blocks(PARAMETERS, 4, 200)
    slow, _ = _blocks(replace(PARAMETERS, wheel_wander_std=0.02, wheel_wander_correlation_s=2.0), 4, 200)
    wander = slow[:, 0] - quick[:, 0]
    assert wander.std() == pytest.approx(0.02, rel=0.1)
    assert np.corrcoef(wander[:-200], wander[200:])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.12)


def test_volatility_keeps_the_variance_and_fattens_the_tails():
    def kurtosis(values):
        return np.mean(values**4) / np.mean(values**2) ** 2

    calm, _ = _blocks(PARAMETERS, 5, 300)
    wild, _ = _blocks(replace(PARAMETERS, volatility=0.5), 5, 300)
    assert wild.std() == pytest.approx(calm.std(), rel=0.1)
    assert kurtosis(calm[:, 0]) == pytest.approx(3.0, abs=0.4)
    assert kurtosis(wild[:, 0]) > 5.0


def test_the_seed_decides_everything():
    first, again, other = (_blocks(PARAMETERS, seed, 2) for seed in (1, 1, 2))
    assert np.array_equal(first[0], again[0])
    assert np.array_equal(first[1], again[1])
    assert not np.array_equal(first[0], other[0])


def test_wheel_disturbances_do_not_depend_on_the_options_of_the_slip():
    plain, _ = _blocks(PARAMETERS, 1, 2)
    without_slip, _ = _blocks(replace(PARAMETERS, slip_std_yaw_rad_s=0.0), 1, 2)
    assert np.array_equal(plain, without_slip)
