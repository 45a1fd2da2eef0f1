"""Currents, battery voltage and temperatures that follow from what the motors do."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sim.effects import HiddenEffects
from sim.plant_parameters import PlantParameters

VOLTAGE_LOST_WHEN_EMPTY = 0.2
SECONDS_PER_HOUR = 3600.0
BATTERY_HEATING = 0.02


@dataclass(frozen=True, slots=True)
class Battery:
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
        left_a, right_a = (torque / p.motor_torque_constant_nm_per_a for torque in torques_nm)
        heat_w = (p.motor_resistance_ohm * left_a**2, p.motor_resistance_ohm * right_a**2)
        mechanical_w = sum(torque * speed for torque, speed in zip(torques_nm, speeds_rad_s, strict=True))
        drawn_a = p.idle_current_a + (mechanical_w + sum(heat_w)) / p.battery_voltage_v
        self._charge_used_as += drawn_a * dt_s
        empty = self._charge_used_as / (p.battery_capacity_ah * SECONDS_PER_HOUR)
        open_v = p.battery_voltage_v * (1.0 - VOLTAGE_LOST_WHEN_EMPTY * empty - self._sag_per_s * now_s)
        self.motor_currents_a = (left_a, right_a)
        cooled = math.exp(-dt_s / (p.motor_thermal_resistance_k_per_w * p.motor_thermal_capacity_j_per_k))
        left_c, right_c = (
            p.ambient_temperature_c
            + p.motor_thermal_resistance_k_per_w * watt
            + (now_c - p.ambient_temperature_c - p.motor_thermal_resistance_k_per_w * watt) * cooled
            for now_c, watt in zip(self.motor_temperatures_c, heat_w, strict=True)
        )
        self.motor_temperatures_c = (left_c, right_c)
        self.battery = Battery(
            voltage_v=max(open_v - p.battery_resistance_ohm * drawn_a, 0.0),
            current_a=drawn_a,
            temperature_c=p.ambient_temperature_c + BATTERY_HEATING * drawn_a**2,
        )
