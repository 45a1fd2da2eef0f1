"""Currents, battery and heat."""

import pytest

from sim.effects import hidden_effects
from sim.electrics import Electrics
from sim.plant_parameters import PlantParameters

PARAMETERS = PlantParameters()


def run(torques, speeds, seconds=1.0, **effects):
    electrics = Electrics(PARAMETERS, hidden_effects(effects))
    for k in range(round(seconds * 10)):
        electrics.advance((k + 1) * 0.1, 0.1, torques, speeds)
    return electrics


def test_current_is_torque_over_the_motor_constant_with_its_sign():
    assert run((0.5, -0.25), (1.0, 1.0)).motor_currents_a == pytest.approx((2.0, -1.0))


def test_the_battery_gives_mechanical_power_losses_and_idle_current():
    power_w = 0.5 * 4.0 + 0.25 * 2.0 + 0.3 * (2.0**2 + 1.0**2)
    battery = run((0.5, 0.25), (4.0, 2.0), 0.1).battery
    assert battery.current_a == pytest.approx(0.5 + power_w / 25.2)
    assert battery.voltage_v == pytest.approx(25.2 - 0.08 * battery.current_a, abs=1e-4)


def test_voltage_falls_with_load_and_with_charge():
    resting, working = run((0.0, 0.0), (0.0, 0.0)), run((3.0, 3.0), (5.0, 5.0))
    assert working.battery.voltage_v < resting.battery.voltage_v - 0.1
    assert run((3.0, 3.0), (5.0, 5.0), 600.0).battery.voltage_v < working.battery.voltage_v - 0.1


def test_battery_sag_shows_in_the_voltage():
    fresh, sagging = run((0.0, 0.0), (0.0, 0.0), 10.0), run((0.0, 0.0), (0.0, 0.0), 10.0, battery_sag=(0.1, 10.0))
    assert fresh.battery.voltage_v - sagging.battery.voltage_v == pytest.approx(2.52)


def test_motors_warm_up_towards_heat_times_thermal_resistance():
    current_a = 1.0 / 0.25
    final_c = 22.0 + 3.0 * 0.3 * current_a**2
    left, right = run((1.0, 0.0), (0.0, 0.0), 180.0).motor_temperatures_c
    assert left == pytest.approx(22.0 + (final_c - 22.0) * (1 - 2.718281828**-1), rel=0.01)
    assert right == 22.0
