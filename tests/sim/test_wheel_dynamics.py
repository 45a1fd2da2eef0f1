"""Motors, command handling and brake, against closed-form answers."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sim.effects import hidden_effects
from sim.plant_parameters import PlantParameters
from sim.wheel_dynamics import WheelMotors

NOISELESS = PlantParameters().noiseless()
IDEAL = NOISELESS.with_ideal_motors()
UNLOADED = replace(NOISELESS, turning_load_nm=0.0, max_motor_acceleration_rad_s2=math.inf)

NO_DISTURBANCE = np.zeros((100_000, 2))


class Bench:
    """Wheels on a test bench: commanded, time advanced in steps, speeds and angles recorded."""

    def __init__(self, parameters, **effects):
        self.wheels = WheelMotors(parameters, hidden_effects(effects), capacity=10)
        self.now_us = 0
        self.angles = (0.0, 0.0)

    def run(self, seconds, left, right, enabled=True, brake=False):
        """Hold a command; return speeds at each millisecond, shape (milliseconds, 2)."""
        speeds = []
        for _ in range(round(seconds * 1000)):
            count = self.wheels.advance(self.now_us, self.now_us + 1000, left, right, enabled, brake, NO_DISTURBANCE, 0)
            self.now_us += 1000
            self.angles = tuple(self.wheels.pieces.angles[count - 1])
            speeds.append(self.wheels.speeds_rad_s)
        return np.array(speeds)


def test_ideal_wheels_turn_exactly_as_commanded():
    bench = Bench(IDEAL)
    assert np.all(bench.run(0.5, 3.0, -2.0) == (3.0, -2.0))
    assert bench.angles == pytest.approx((1.5, -1.0), abs=1e-12)


def test_the_unloaded_response_is_a_first_order_lag_with_the_stated_time_constant():
    speeds = Bench(UNLOADED).run(0.3, 3.0, 3.0)[:, 0]
    t = np.arange(1, 301) * 1e-3
    np.testing.assert_allclose(speeds, 3.0 * (1.0 - np.exp(-t / 0.06)), atol=1e-9)


@pytest.mark.parametrize("parameters", [IDEAL, UNLOADED], ids=["ideal motors", "unloaded"])
def test_motor_lag_takes_the_place_of_the_loops_own_time_constant_and_the_angle_is_the_integral_of_the_speed(
    parameters,
):
    bench = Bench(parameters, motor_lag=0.12)
    assert bench.run(0.12, 3.0, 3.0)[-1, 0] == pytest.approx(3.0 * (1.0 - math.exp(-1.0)), abs=1e-9)
    bench.run(0.88, 3.0, 3.0)
    assert bench.angles[0] == pytest.approx(3.0 * (1.0 - 0.12 * (1.0 - math.exp(-1.0 / 0.12))), abs=1e-5)


def test_acceleration_is_limited():
    bench = Bench(NOISELESS)
    speeds = bench.run(0.05, 8.0, 8.0)[:, 0]
    assert np.diff(speeds).max() == pytest.approx(0.06, abs=1e-9)


def test_too_little_torque_means_slower_acceleration():
    weak = replace(NOISELESS, max_motor_torque_nm=0.75, turning_load_nm=0.0)
    bench = Bench(weak)
    speeds = bench.run(0.1, 8.0, 8.0)[:, 0]
    assert speeds[50] == pytest.approx(0.051 * (0.75 - 0.15) / 0.03, rel=0.05)
    assert np.abs(bench.wheels.torques_nm).max() <= 0.75
    assert bench.run(2.0, 8.0, 8.0)[-1, 0] == pytest.approx(8.0, abs=0.01)


def test_steady_torque_is_friction_times_direction():
    bench = Bench(replace(NOISELESS, turning_load_nm=0.0))
    bench.run(1.0, 3.0, -3.0)
    assert bench.wheels.torques_nm == pytest.approx((0.15 + 3 * 0.02, -0.15 - 3 * 0.02), abs=1e-6)


def test_the_loop_works_off_the_load_of_turning():
    bench = Bench(NOISELESS)
    speeds = bench.run(1.0, -3.0, 3.0)
    unloaded = Bench(replace(NOISELESS, turning_load_nm=0.0)).run(1.0, -3.0, 3.0)
    dip = unloaded[:, 1] - speeds[:, 1]
    assert 0.02 < dip.max() < 0.3
    assert speeds[-1] == pytest.approx((-3.0, 3.0), abs=0.005)
    assert bench.wheels.torques_nm[1] == pytest.approx(0.15 + 3 * 0.02 + 0.25, abs=0.01)


def test_a_wheel_that_is_commanded_to_stop_stands_still_and_while_it_is_disabled_ignores_its_command():
    bench = Bench(NOISELESS)
    bench.run(0.5, -3.0, 5.0)
    assert np.all(bench.run(1.0, 0.0, 0.0)[-1] == 0.0)
    assert np.all(bench.run(0.5, 5.0, 5.0, enabled=False) == 0.0)


def test_a_wheel_without_drive_coasts_to_rest_on_friction():
    bench = Bench(replace(NOISELESS, viscous_friction_nm_s=0.0, turning_load_nm=0.0))
    bench.run(1.0, 5.0, -5.0)
    speeds = bench.run(2.0, 5.0, -5.0, enabled=False)
    seconds_to_rest = 5.0 * 0.03 / 0.15
    assert np.argmax(speeds[:, 0] == 0.0) == pytest.approx(1000 * seconds_to_rest, abs=3)
    assert np.all(speeds[-1] == 0.0)
    assert bench.wheels.torques_nm == (0.0, 0.0)


@pytest.mark.parametrize("enabled", [True, False])
def test_the_brake_stops_within_its_time_constant_and_wins_over_the_command(enabled):
    bench = Bench(NOISELESS)
    bench.run(1.0, 5.0, 5.0)
    speeds = bench.run(0.3, 5.0, 5.0, enabled=enabled, brake=True)
    assert speeds[40, 0] < 5.0 * math.exp(-1.0)
    assert np.all(speeds[-1] == 0.0)


def test_drive_taken_up_again_starts_from_the_coasting_speed():
    bench = Bench(NOISELESS)
    bench.run(1.0, 5.0, 5.0)
    coasting = bench.run(0.2, 0.0, 0.0, enabled=False)[-1, 0]
    assert bench.run(0.001, 5.0, 5.0)[-1, 0] == pytest.approx(coasting, abs=0.1)


def steady(left, right, parameters=IDEAL, seconds=0.5, **effects):
    """Speeds that are reached under a held command."""
    return tuple(Bench(parameters, **effects).run(seconds, left, right)[-1])


@pytest.mark.parametrize(
    ("effects", "command", "speeds"),
    [
        ({"deadband": 0.5}, (3.0, -2.0), (2.5, -1.5)),
        ({"deadband": 0.5}, (0.4, -0.4), (0.0, 0.0)),
        ({"x_smooth_deadband": 0.5}, (3.0, -3.0), (2.5, -2.5)),
        ({"speed_limit": 5.0}, (7.0, -6.0), (5.0, -5.0)),
        ({"speed_limit": 5.0}, (4.0, -4.5), (4.0, -4.5)),
        ({"wheel_gain": 0.05}, (4.0, -2.0), (4.2, -2.1)),
        ({"wheel_gain": (0.05, -0.05)}, (4.0, -2.0), (4.2, -1.9)),
        ({"x_motor_droop": 0.01}, (5.0, -4.0), (4.75, -3.84)),
        ({"x_shared_supply": 0.1}, (4.0, -2.0), (3.8, -1.6)),
        ({"x_shared_supply": 0.5}, (4.0, -1.0), (3.5, 0.0)),
        ({"stiction": 0.8}, (0.7, -0.7), (0.0, 0.0)),
        ({"stiction": 0.8}, (0.9, -0.9), (0.9, -0.9)),
    ],
)
def test_steady_speed_under_a_static_effect(effects, command, speeds):
    assert steady(*command, **effects) == pytest.approx(speeds, abs=1e-4)


def test_the_yaw_rate_limit_cuts_the_turn_and_keeps_the_mean():
    left, right = steady(-1.0, 7.0, yaw_rate_limit=1.0)
    assert (right - left) * 0.061 / 0.415 == pytest.approx(1.0)
    assert 0.5 * (left + right) == pytest.approx(3.0)
    assert steady(7.0, -1.0, yaw_rate_limit=1.0) == pytest.approx((right, left))
    assert steady(7.0, 7.0, yaw_rate_limit=1.0) == (7.0, 7.0)


def test_the_yaw_acceleration_limit_ramps_the_turn_and_keeps_the_mean():
    bench = Bench(IDEAL, yaw_acceleration_limit=2.0)
    speeds = np.concatenate([bench.run(0.4, -1.0, 7.0), bench.run(0.4, 7.0, -1.0)])
    yaw_rate = (speeds[:, 1] - speeds[:, 0]) * 0.061 / 0.415
    t = np.arange(1, 401) * 1e-3
    np.testing.assert_allclose(yaw_rate, np.concatenate([2.0 * t, 0.8 - 2.0 * t]), atol=1e-9)
    np.testing.assert_allclose(speeds.mean(axis=1), 3.0, atol=1e-9)
    assert steady(-1.0, 7.0, seconds=1.0, yaw_acceleration_limit=2.0) == pytest.approx((-1.0, 7.0))


def test_the_turn_is_ramped_from_where_coasting_has_left_the_wheels():
    bench = Bench(IDEAL, yaw_acceleration_limit=2.0)
    bench.run(1.0, -4.0, 4.0)
    left, right = bench.run(0.05, 0.0, 0.0, enabled=False)[-1]
    before = right - left
    left, right = bench.run(0.001, -4.0, 4.0)[-1]
    assert right - left == pytest.approx(min(before + 2.0e-3 * 0.415 / 0.061, 8.0))
    assert 1.0 < before < 8.0


def test_the_battery_sags_linearly_with_time():
    bench = Bench(IDEAL, battery_sag=(0.1, 10.0))
    assert bench.run(5.0, 4.0, 4.0)[-1, 0] == pytest.approx(4.0 * 0.95, rel=1e-4)
    assert bench.run(5.0, 4.0, 4.0)[-1, 0] == pytest.approx(4.0 * 0.90, rel=1e-4)


def test_stiction_holds_at_rest_only():
    bench = Bench(IDEAL, stiction=0.8)
    assert bench.run(0.01, 0.7, 0.7)[-1, 0] == 0.0
    assert bench.run(0.01, 1.0, 1.0)[-1, 0] == 1.0
    assert bench.run(0.01, 0.3, 0.3)[-1, 0] == 0.3
    assert bench.run(0.01, 0.0, 0.0)[-1, 0] == 0.0
    assert bench.run(0.01, 0.3, 0.3)[-1, 0] == 0.0


def test_stiction_catches_a_wheel_that_passes_zero_slowly_and_not_one_that_is_thrown_over():
    slow, thrown = Bench(IDEAL, stiction=0.8), Bench(IDEAL, stiction=0.8)
    for bench in (slow, thrown):
        bench.run(0.01, 1.0, 1.0)
    assert slow.run(0.01, -0.5, -0.5)[-1, 0] == 0.0
    assert thrown.run(0.01, -1.0, -1.0)[-1, 0] == -1.0


def test_the_second_order_motor_overshoots_as_its_damping_says():
    speeds = Bench(IDEAL, x_second_order_motor=(15.0, 0.5)).run(1.5, 2.0, 2.0)[:, 0]
    overshoot = math.exp(-math.pi * 0.5 / math.sqrt(1.0 - 0.25))
    assert speeds.max() == pytest.approx(2.0 * (1.0 + overshoot), rel=0.01)
    assert np.argmax(speeds) == pytest.approx(1000 * math.pi / (15.0 * math.sqrt(0.75)), abs=3)
    assert speeds[-1] == pytest.approx(2.0, abs=1e-3)


def test_a_motor_of_limited_acceleration_ramps_and_may_stop_at_another_rate():
    speeds = Bench(IDEAL, acceleration_limit=10.0).run(0.5, 3.0, -3.0)
    assert speeds[99] == pytest.approx((1.0, -1.0), abs=1e-9)
    assert speeds[-1] == pytest.approx((3.0, -3.0), abs=1e-12)
    bench = Bench(IDEAL, acceleration_limit=(10.0, 4.0))
    bench.run(0.3, 3.0, -3.0)
    assert bench.run(0.01, 0.0, 0.0)[-1] == pytest.approx((2.5, -2.5), abs=1e-9)
    assert bench.run(0.01, 1.0, -1.0)[-1] == pytest.approx((2.4, -2.4), abs=1e-9)


def test_disturbance_multiplies_the_true_speed_of_its_side():
    wheels = WheelMotors(IDEAL, hidden_effects({}), capacity=10)
    wheels.advance(5000, 6000, 2.0, 2.0, True, False, np.array([[0.1, -0.1]]), 5)
    assert wheels.speeds_rad_s == pytest.approx((2.2, 1.8))
    assert wheels.pieces.angles[0] == pytest.approx((2.2e-3, 1.8e-3))


def test_pieces_end_on_the_grid_and_at_the_asked_time():
    wheels = WheelMotors(IDEAL, hidden_effects({}), capacity=10)
    count = wheels.advance(300, 2700, 1.0, 1.0, True, False, NO_DISTURBANCE, 0)
    assert wheels.pieces.times_us[:count].tolist() == [1000, 2000, 2700]
    assert wheels.pieces.angles[count - 1] == pytest.approx((2.4e-3, 2.4e-3))
