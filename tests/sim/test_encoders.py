"""Quantisation, start value and the observed speed."""

import math

import numpy as np
import pytest

from sim.effects import hidden_effects
from sim.encoders import Encoders
from sim.plant_parameters import PlantParameters
from sim.wheel_dynamics import WheelPieces

TICK_RAD = 2.0 * math.pi / 2048


def _turn(encoders, angle_of_time, milliseconds, from_ms=0):
    """Turn both wheels to angle_of_time(t); return ticks and observed speeds at each millisecond."""
    ticks, speeds = [], []
    for k in range(from_ms, from_ms + milliseconds):
        pieces = WheelPieces(np.array([(k + 1) * 1000]), np.array([angle_of_time((k + 1) * 1e-3)]))
        encoders.advance(k * 1000, pieces, 1)
        ticks.append(encoders.ticks)
        speeds.append(encoders.speeds_rad_s)
    return np.array(ticks), np.array(speeds)


def test_ticks_are_whole_and_never_more_than_one_behind_the_angle():
    angles = lambda t: (3.0 * t, -2.0 * t)  # noqa: E731
    ticks, _ = _turn(Encoders(PlantParameters(), hidden_effects({})), angles, 2000)
    t = np.arange(1, 2001) * 1e-3
    behind = np.stack([3.0 * t, -2.0 * t], axis=1) / TICK_RAD - ticks
    assert ticks.dtype.kind == "i"
    assert behind.min() >= 0.0
    assert behind.max() < 1.0


def test_the_count_starts_where_it_is_told_to():
    parameters = PlantParameters(encoder_start_left_ticks=2**24 - 3, encoder_start_right_ticks=-7)
    encoders = Encoders(parameters, hidden_effects({}))
    assert encoders.ticks == (2**24 - 3, -7)
    ticks, speeds = _turn(encoders, lambda t: (10.5 * TICK_RAD, -9.5 * TICK_RAD), 1)
    assert ticks[-1].tolist() == [2**24 + 7, -17]
    still = Encoders(parameters, hidden_effects({}))
    _, speeds = _turn(still, lambda t: (0.0, 0.0), 200)
    assert np.all(speeds == 0.0)


def test_encoder_scale_counts_more_or_less_than_the_angle():
    encoders = Encoders(PlantParameters(), hidden_effects({"encoder_scale": (-0.02, 0.03)}))
    ticks, _ = _turn(encoders, lambda t: (100.0, 100.0), 1)
    assert ticks[0].tolist() == [math.floor(98.0 / TICK_RAD), math.floor(103.0 / TICK_RAD)]


def test_observed_speed_settles_at_the_speed_with_a_ripple_below_that_of_bare_differences():
    _, speeds = _turn(Encoders(PlantParameters(), hidden_effects({})), lambda t: (3.0 * t, -0.5 * t), 2000)
    settled = speeds[500:]
    assert settled.mean(axis=0) == pytest.approx((3.0, -0.5), abs=0.01)
    one_tick_per_step = TICK_RAD / 1e-3
    assert settled.std(axis=0).max() < 0.05 * one_tick_per_step


def test_observed_speed_lags_a_ramp_by_two_over_the_bandwidth_at_most():
    fine = PlantParameters(ticks_per_rev=2_000_000)
    _, speeds = _turn(Encoders(fine, hidden_effects({})), lambda t: (5.0 * t * t, 0.0), 1000)
    assert 10.0 - speeds[-1, 0] == pytest.approx(10.0 * 2.0 / 100.0, rel=0.05)


def test_observed_speed_is_zero_at_rest_whatever_the_place_within_a_tick():
    for part in np.linspace(0.01, 0.99, 9):
        encoders = Encoders(PlantParameters(), hidden_effects({}))
        _turn(encoders, lambda t: (3.0 * t, 3.0 * t), 300)
        rest = (math.floor(0.9 / TICK_RAD) + part) * TICK_RAD
        _, speeds = _turn(encoders, lambda t, rest=rest: (rest, rest), 500, from_ms=300)
        assert np.all(speeds[-100:] == 0.0)
