"""Currents, battery voltage and temperatures that follow from what the motors do."""

from __future__ import annotations

import math

import msgspec

from sim.effects import HiddenEffects
from sim.plant_parameters import PlantParameters

VOLTAGE_LOST_WHEN_EMPTY = 0.2
SECONDS_PER_HOUR = 3600.0
BATTERY_HEATING = 0.02


class Battery(msgspec.Struct, frozen=True, gc=False):
    """Voltage (V), current drawn (A, positive out of the battery) and temperature (degC)."""

    voltage_v: float
    current_a: float
    temperature_c: float


class Electrics:
    """Battery with inner resistance and falling open-circuit voltage; motors that warm up with the current squared."""

    def __init__(self, parameters: PlantParameters, effects: HiddenEffects) -> None:
        self._parameters = parameters
        sag, duration_s = effects.values("battery_sag")
        self._sag_per_s = sag / duration_s
        self._charge_used_as = 0.0
        self.motor_currents_a = (0.0, 0.0)
        self.motor_temperatures_c = (parameters.ambient_temperature_c, parameters.ambient_temperature_c)
        self.battery = Battery(parameters.battery_voltage_v, 0.0, parameters.ambient_temperature_c)

    def advance(
        self,
        now_s: float,
        dt_s: float,
        torques_nm: tuple[float, float],
        speeds_rad_s: tuple[float, float],
    ) -> None:
        """Move on by `dt_s` to `now_s` with these motor torques and wheel speeds (left, right)."""
        p = self._parameters
        (left_nm, right_nm), (left_rad_s, right_rad_s) = torques_nm, speeds_rad_s
        left_a, right_a = left_nm / p.motor_torque_constant_nm_per_a, right_nm / p.motor_torque_constant_nm_per_a
        left_w, right_w = p.motor_resistance_ohm * left_a**2, p.motor_resistance_ohm * right_a**2
        mechanical_w = left_nm * left_rad_s + right_nm * right_rad_s
        drawn_a = p.idle_current_a + (mechanical_w + (left_w + right_w)) / p.battery_voltage_v
        self._charge_used_as += drawn_a * dt_s
        empty = self._charge_used_as / (p.battery_capacity_ah * SECONDS_PER_HOUR)
        open_v = p.battery_voltage_v * (1.0 - VOLTAGE_LOST_WHEN_EMPTY * empty - self._sag_per_s * now_s)
        self.motor_currents_a = (left_a, right_a)
        cooled = math.exp(-dt_s / (p.motor_thermal_resistance_k_per_w * p.motor_thermal_capacity_j_per_k))
        left_c, right_c = self.motor_temperatures_c
        self.motor_temperatures_c = (self._warmed(left_c, left_w, cooled), self._warmed(right_c, right_w, cooled))
        self.battery = Battery(
            voltage_v=max(open_v - p.battery_resistance_ohm * drawn_a, 0.0),
            current_a=drawn_a,
            temperature_c=p.ambient_temperature_c + BATTERY_HEATING * drawn_a**2,
        )

    def _warmed(self, now_c: float, heat_w: float, cooled: float) -> float:
        """A motor's temperature on its way to where this heat keeps it."""
        p = self._parameters
        rise_k = p.motor_thermal_resistance_k_per_w * heat_w
        return p.ambient_temperature_c + rise_k + (now_c - p.ambient_temperature_c - rise_k) * cooled
