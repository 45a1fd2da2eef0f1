"""Plants without noise, and plants drawn from a posterior."""

import dataclasses

import numpy as np
import pytest

from sim.plant_parameters import DrawError, PlantParameters, draw_plant_parameters

MEAN = (0.238, 0.061, 0.415)
COVARIANCE = np.array([[0.13, -0.03, -0.04], [-0.03, 0.15, 0.03], [-0.04, 0.03, 0.09]]) * 1e-3


def test_noiseless_silences_every_random_source_and_touches_no_geometry():
    quiet = PlantParameters(pose_outlier_probability=0.1, wheel_drift_std=0.1, pose_gap_interval_s=3.0).noiseless()
    random_fields = [f.name for f in dataclasses.fields(quiet) if "_std" in f.name or "probability" in f.name]
    assert len(random_fields) >= 9
    assert all(getattr(quiet, name) == 0.0 for name in random_fields)
    assert quiet.pose_gap_interval_s == quiet.pose_sample_jitter_s == quiet.pose_delay_jitter_s == 0.0
    assert (quiet.wheel_radius_m, quiet.axial_distance_m, quiet.x_icr_m) == (0.061, 0.415, 0.238)


def test_draws_have_the_posteriors_mean_and_covariance():
    samples = [draw_plant_parameters(MEAN, COVARIANCE, seed) for seed in range(1500)]
    values = np.array([(p.x_icr_m, p.wheel_radius_m, p.axial_distance_m) for p in samples])
    np.testing.assert_allclose(values.mean(axis=0), MEAN, atol=4 * np.sqrt(np.diag(COVARIANCE) / 3000).max())
    np.testing.assert_allclose(np.cov(values.T), COVARIANCE, atol=0.1 * COVARIANCE.max())


def test_a_draw_is_decided_by_its_seed_and_keeps_the_rest_of_the_base():
    base = PlantParameters(ticks_per_rev=512)
    first, again = (draw_plant_parameters(MEAN, COVARIANCE, 7, base) for _ in range(2))
    assert first == again
    assert first != draw_plant_parameters(MEAN, COVARIANCE, 8, base)
    assert first.ticks_per_rev == 512


def test_draws_stay_in_the_physical_range():
    wide = np.diag([0.5, 0.1, 0.5])
    for seed in range(200):
        sample = draw_plant_parameters(MEAN, wide, seed)
        assert sample.wheel_radius_m >= 0.01
        assert 0.05 <= sample.axial_distance_m <= 2.0
        assert abs(sample.x_icr_m) <= 1.0


def test_a_posterior_without_physical_plants_is_an_error():
    with pytest.raises(DrawError, match="physical"):
        draw_plant_parameters((0.2, -5.0, 0.4), COVARIANCE, 1)
