from dataclasses import replace

import numpy as np
import pytest

from disco_hw.inference.estimates import estimates
from disco_hw.inference.excitation import excitation
from disco_hw.inference.noise import USUAL, Noise, _two_terms, measured_noise, unexplained_share
from disco_hw.inference.simulate import Simulator
from disco_hw.model import Model
from tests.inference.drives import THETA, logged

TRUE = Noise(0.008, 0.004, 0.01, 0.006, 0.03)


def simulated(true=TRUE, count=6, name="rich"):
    """Simulated drives that have this noise."""
    drive = excitation(logged(name))
    seeds = np.arange(count, dtype=np.uint32)
    poses = Simulator(Model(0.06, 0.4), drive, true).poses(np.repeat(THETA[None], count, axis=0), seeds)
    return [replace(drive, pose=pose) for pose in poses]


def found_in_simulations(*of):
    """The noise found in each of some simulated drives."""
    return [measured_noise(drive, THETA) for drive in simulated(*of)]


def test_the_noise_of_a_simulated_log_is_found():
    found = [noise.scales()[:5] for noise in found_in_simulations(TRUE, 4)]
    assert np.mean(found, axis=0) == pytest.approx(TRUE.scales()[:5], rel=0.25)


def test_jumps_of_the_sensor_do_not_count():
    drive = simulated()[1]
    clean = measured_noise(drive, THETA).scales()[:5]
    jumpy = drive.pose.copy()
    jumpy[::97, 0] += 0.5
    assert measured_noise(replace(drive, pose=jumpy), THETA).scales()[:5] == pytest.approx(clean, rel=0.5)


def test_the_plants_noise_is_found_at_its_own_estimate():
    drive = excitation(logged("rich"))
    theta = estimates(drive, USUAL).theta(drive.pose[None])[0]
    noise = measured_noise(drive, theta)
    assert noise.position_m == pytest.approx(0.005, rel=0.15)
    assert noise.yaw_rad == pytest.approx(0.0087, rel=0.15)
    # Of an Ornstein-Uhlenbeck velocity of standard deviation s and correlation time tau: s sqrt(2 tau).
    assert noise.slip_yaw_rad_sqrt_s == pytest.approx(0.018 * np.sqrt(0.6), rel=0.35)


def test_slip_that_keeps_its_direction_for_a_while_is_rated_by_what_it_grows_to():
    tau_s, rate, sensor = 0.3, 1.5e-5, 2.5e-5
    time_s = np.array([0.04, 0.12, 0.2, 0.4, 0.8, 1.6, 3.0])
    weight = 2.0
    variance = weight * sensor + rate * (time_s - tau_s * (1.0 - np.exp(-time_s / tau_s)))
    sensors, rates, found_s = _two_terms(
        time_s, np.full((time_s.size, 2), weight), np.full(time_s.size, 50.0), np.outer(variance, [1.0, 4.0])
    )
    assert sensors == pytest.approx([sensor, 4.0 * sensor], rel=1e-3)
    assert rates == pytest.approx([rate, 4.0 * rate], rel=1e-3)
    assert found_s == tau_s


@pytest.mark.parametrize(("true_s", "low_s", "high_s"), [(0.0, 0.0, 0.06), (0.15, 0.08, 0.25), (0.5, 0.3, 0.8)])
def test_how_long_slip_keeps_its_direction_is_found(true_s, low_s, high_s):
    found = found_in_simulations(replace(TRUE, correlation_s=true_s))
    assert low_s <= np.median([one.correlation_s for one in found]) <= high_s
    # What it adds up to is the same, however long it lasts.
    rates = np.median([one.scales()[:5] for one in found], axis=0)[2:]
    assert rates == pytest.approx(TRUE.scales()[2:5], rel=0.3)


@pytest.mark.parametrize("true_m", [0.0, 0.2])
def test_about_which_point_slip_turns_the_body_is_found(true_m):
    found = found_in_simulations(replace(TRUE, lever_m=true_m))
    assert np.mean([one.lever_m for one in found]) == pytest.approx(true_m, abs=0.04)


def test_slip_about_the_centre_of_rotation_is_counted_neither_to_the_left_nor_forward():
    # To the left of the tracked point it makes three times what slips forward.
    true = replace(
        TRUE, slip_forward_m_sqrt_s=0.005, slip_left_m_sqrt_s=0.0, slip_yaw_rad_sqrt_s=0.06, lever_m=0.25,
        correlation_s=0.15,
    )  # fmt: skip
    forward, left = np.median([one.scales()[2:4] for one in found_in_simulations(true)], axis=0)
    assert forward == pytest.approx(0.005, rel=0.2)
    # No less than a quarter of the slip forward is ever counted.
    assert left < 0.3 * forward


@pytest.mark.parametrize("true_share", [0.0, 1.0])
def test_whether_slip_grows_with_speed_is_found(true_share):
    found = found_in_simulations(replace(TRUE, speed_share=true_share))
    assert np.mean([one.speed_share for one in found]) == pytest.approx(true_share, abs=0.3)


def test_one_minute_of_a_circle_tells_the_slip_without_bias():
    found = [noise.scales()[:5] for noise in found_in_simulations(TRUE, 24, "circle")]
    ratio = np.array(found) / TRUE.scales()[:5]
    assert np.median(ratio, axis=0) == pytest.approx(1.0, abs=0.15)
    assert np.quantile(ratio, 0.1, axis=0).min() > 0.6


def test_the_poses_of_another_drive_are_not_taken_for_slip():
    original, other = excitation(logged("rich")), excitation(logged("rich", 5))
    poses = min(original.pose.shape[0], other.pose.shape[0])
    assert poses > 0.9 * original.pose.shape[0]
    swapped = original.pose.copy()
    swapped[:poses] = other.pose[:poses]
    assert unexplained_share(original, THETA) < 0.15
    assert unexplained_share(replace(original, pose=swapped), THETA) > 0.8
