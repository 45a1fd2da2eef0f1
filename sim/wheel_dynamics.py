"""Dynamics of the wheels, from speed setpoints to angles: command handling, speed profile, PI loop, friction, brake.

Each motor follows a speed profile w* (first-order lag of the command with limited acceleration, or what a hidden
effect makes of it). The tracking error e = w - w* obeys J e' = (torque limited - torque asked) - k e + z - load - b e,
z' = -k_i e: exactly zero while nothing unforeseen loads the wheel and the torque suffices, so that the unloaded
response is the profile itself. The motors are regulated by sensors of their own, not by the encoders that are read out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.kernel_cache import compiled
from sim.effects import HiddenEffects
from sim.plant_parameters import PlantParameters

# Chosen: a long run must not turn the supply round.
LARGEST_SAG = 0.9
# Chosen: slower counts as at rest, for stiction; smooth onset of the load that turning makes.
REST_RAD_S = 0.02
LOAD_ONSET_RAD_S = 0.5

Floats = npt.NDArray[np.float64]

_WHEEL = np.dtype(
    [(name, "f8") for name in ("setpoint", "profile", "profile_rate", "error", "integral", "torque", "angle", "speed")]
    + [("stuck", "i8")],
    align=True,
)


@dataclass(frozen=True, slots=True)
class WheelPieces:
    """Result of `WheelMotors.advance`: the ends of its integration pieces (us) and the wheel angles there (rad).

    times_us: shape (capacity,); angles: shape (capacity, 2), left and right.
    """

    times_us: npt.NDArray[np.int64]
    angles: Floats


def parameter_record(values: Mapping[str, float]) -> npt.NDArray[np.void]:
    """Return the values by name as a record for compiled functions, shape (1,)."""
    return np.array([tuple(values.values())], np.dtype([(name, "f8") for name in values], align=True))


class WheelMotors:
    """Motors of both wheels with their command handling."""

    def __init__(self, parameters: PlantParameters, effects: HiddenEffects, capacity: int) -> None:
        self.pieces = WheelPieces(np.zeros(capacity, dtype=np.int64), np.zeros((capacity, 2)))
        self._parameters = _parameter_record(parameters, effects)
        self._step_us = parameters.integration_step_us
        self._state = np.zeros(2, dtype=_WHEEL)
        self._state["stuck"] = 1

    @property
    def speeds_rad_s(self) -> tuple[float, float]:
        """True wheel speeds now, left and right."""
        left, right = self._state["speed"].tolist()
        return left, right

    @property
    def torques_nm(self) -> tuple[float, float]:
        """Motor torques at the wheels now, left and right."""
        left, right = self._state["torque"].tolist()
        return left, right

    def advance(
        self,
        now_us: int,
        until_us: int,
        left_rad_s: float,
        right_rad_s: float,
        enabled: bool,
        brake: bool,
        disturbance: Floats,
        first_cell: int,
    ) -> int:
        """Integrate to `until_us` with these setpoints in force; return how many pieces were filled.

        Disabled wheels coast; a brake shorts the windings whether enabled or not. `disturbance`: relative speed errors,
        shape (cells, 2), row 0 for grid cell `first_cell`.
        """
        return _advance(
            self._parameters,
            self._state,
            self.pieces.times_us,
            self.pieces.angles,
            now_us,
            until_us,
            left_rad_s,
            right_rad_s,
            enabled,
            brake,
            disturbance,
            first_cell,
            self._step_us,
        )


def _parameter_record(p: PlantParameters, effects: HiddenEffects) -> npt.NDArray[np.void]:
    (lag_s,) = effects.values("motor_lag")
    frequency, damping = effects.values("x_second_order_motor")
    slew_limit, more_to_stop = effects.values("acceleration_limit")
    sag, sag_duration_s = effects.values("battery_sag")
    left_gain, right_gain = effects.values("wheel_gain")
    return parameter_record(
        {
            "tau": lag_s if "motor_lag" in effects else p.speed_loop_time_constant_s,
            "second_order_frequency": frequency,
            "second_order_damping": damping,
            "acceleration_limit": min(p.max_motor_acceleration_rad_s2, slew_limit),
            "stop_limit": min(p.max_motor_acceleration_rad_s2, slew_limit * (1.0 + more_to_stop)),
            "inertia": p.wheel_inertia_kg_m2,
            "viscous": p.viscous_friction_nm_s,
            "dry": p.dry_friction_nm,
            "turning_load": p.turning_load_nm,
            "torque_limit": p.max_motor_torque_nm,
            "gain": p.tracking_gain_nm_s,
            "integral_gain": p.tracking_integral_gain_nm,
            "brake_rate": 1.0 / p.brake_time_constant_s,
            "hold": p.standstill_hold_rad_s,
            "deadband": effects.values("deadband")[0],
            "smooth_deadband": effects.values("x_smooth_deadband")[0],
            "mean_to_yaw_rate": p.wheel_radius_m / p.axial_distance_m,
            "yaw_rate_limit": effects.values("yaw_rate_limit")[0],
            "yaw_acceleration_limit": effects.values("yaw_acceleration_limit")[0],
            "speed_limit": effects.values("speed_limit")[0],
            "droop": effects.values("x_motor_droop")[0],
            "shared_supply": effects.values("x_shared_supply")[0],
            "left_factor": 1.0 + left_gain,
            "right_factor": 1.0 + right_gain,
            "sag_per_s": sag / sag_duration_s,
            "stiction": effects.values("stiction")[0],
        }
    )


@compiled
def _handled(p: Any, left: float, right: float, now_s: float) -> tuple[float, float]:
    """Commands after dead band, limits and gain, left and right."""
    width = p["deadband"]
    left = math.copysign(max(abs(left) - width, 0.0), left)
    right = math.copysign(max(abs(right) - width, 0.0), right)
    if p["smooth_deadband"] > 0.0:
        width = p["smooth_deadband"]
        left -= width * math.tanh(left / width)
        right -= width * math.tanh(right / width)
    yaw_rate = (right - left) * p["mean_to_yaw_rate"]
    if abs(yaw_rate) > p["yaw_rate_limit"]:
        mean = 0.5 * (left + right)
        half = 0.5 * math.copysign(p["yaw_rate_limit"], yaw_rate) / p["mean_to_yaw_rate"]
        left = mean - half
        right = mean + half
    limit = p["speed_limit"]
    left = min(max(left, -limit), limit)
    right = min(max(right, -limit), limit)
    if p["droop"] != 0.0:
        left -= p["droop"] * left * abs(left)
        right -= p["droop"] * right * abs(right)
    if p["shared_supply"] != 0.0:
        loss = p["shared_supply"]
        loss_left, loss_right = loss * abs(right), loss * abs(left)
        left = math.copysign(max(abs(left) - loss_left, 0.0), left)
        right = math.copysign(max(abs(right) - loss_right, 0.0), right)
    supply = 1.0 - min(p["sag_per_s"] * now_s, LARGEST_SAG)
    return left * p["left_factor"] * supply, right * p["right_factor"] * supply


@compiled
def _setpoints(p: Any, wheels: Any, left: float, right: float, now_s: float, dt: float) -> tuple[float, float]:
    """Setpoints of the motors from the commands, left and right: of the handled ones the turn follows as it may."""
    left, right = _handled(p, left, right, now_s)
    if not math.isinf(p["yaw_acceleration_limit"]):
        most = 0.5 * p["yaw_acceleration_limit"] * dt / p["mean_to_yaw_rate"]
        before = 0.5 * (wheels[1]["setpoint"] - wheels[0]["setpoint"])
        mean = 0.5 * (left + right)
        turn = before + min(max(0.5 * (right - left) - before, -most), most)
        left, right = mean - turn, mean + turn
    wheels[0]["setpoint"] = left
    wheels[1]["setpoint"] = right
    return left, right


@compiled
def _profile(p: Any, wheel: Any, reference: float, dt: float) -> float:
    """Move the speed profile on by one piece; return the profile speed at the piece's start for the angle's mean."""
    before: float = wheel["profile"]
    most = (p["acceleration_limit"] if reference != 0.0 else p["stop_limit"]) * dt
    frequency = p["second_order_frequency"]
    if frequency > 0.0:
        damping = 2.0 * p["second_order_damping"] * frequency
        stiffness = frequency * frequency
        rate = wheel["profile_rate"]
        half_speed = before + 0.5 * dt * rate
        half_rate = rate + 0.5 * dt * (stiffness * (reference - before) - damping * rate)
        change = min(max(dt * half_rate, -most), most)
        wheel["profile_rate"] = rate + dt * (stiffness * (reference - half_speed) - damping * half_rate)
        wheel["profile"] = before + change
        return before
    wheel["profile_rate"] = 0.0
    if p["tau"] > 0.0:
        change = (reference - before) * -math.expm1(-dt / p["tau"])
    elif math.isinf(most):
        wheel["profile"] = reference
        return reference
    else:
        change = reference - before
    wheel["profile"] = before + min(max(change, -most), most)
    return before


@compiled
def _track(p: Any, wheel: Any, acceleration: float, load: float, dt: float) -> None:
    """Move tracking error, integral and torque on by one piece."""
    speed = wheel["profile"] + wheel["error"]
    torque = p["inertia"] * acceleration + p["viscous"] * wheel["profile"]
    if speed != 0.0:
        torque += math.copysign(p["dry"], speed)
    demand = torque - p["gain"] * wheel["error"] + wheel["integral"]
    limit = p["torque_limit"]
    if abs(demand) <= limit:
        wheel["torque"] = demand
        stiffness = p["gain"] + p["viscous"]
        left_over = math.exp(-dt * stiffness / p["inertia"])
        rest = (wheel["integral"] - load) / stiffness
        error = rest + (wheel["error"] - rest) * left_over
        wheel["integral"] -= 0.5 * dt * p["integral_gain"] * (wheel["error"] + error)
        wheel["error"] = error
        return
    wheel["torque"] = math.copysign(limit, demand)
    missing = wheel["torque"] - torque - load - p["viscous"] * wheel["error"]
    wheel["error"] += dt * missing / p["inertia"]


@compiled
def _run_free(p: Any, wheel: Any, brake: bool, load: float, dt: float) -> None:
    """Move a wheel without drive on by one piece: friction, load and, if asked, the shorted motor."""
    speed = wheel["profile"] + wheel["error"]
    rate = p["viscous"] / p["inertia"]
    wheel["torque"] = 0.0
    if brake:
        rate += p["brake_rate"]
        wheel["torque"] = -p["inertia"] * p["brake_rate"] * speed
    speed *= math.exp(-rate * dt)
    against = p["dry"] + (load if speed > 0.0 else -load)
    lost = max(against, 0.0) * dt / p["inertia"]
    wheel["profile"] = math.copysign(max(abs(speed) - lost, 0.0), speed)
    wheel["setpoint"] = wheel["profile"]
    wheel["profile_rate"] = 0.0
    wheel["error"] = 0.0
    wheel["integral"] = 0.0


@compiled
def _advance(
    parameters: Any,
    wheels: Any,
    times_us: npt.NDArray[np.int64],
    angles: Floats,
    now_us: int,
    until_us: int,
    left: float,
    right: float,
    enabled: bool,
    brake: bool,
    disturbance: Floats,
    first_cell: int,
    step_us: int,
) -> int:
    p = parameters[0]
    pieces = 0
    while now_us < until_us:
        cell = now_us // step_us
        end_us = min((cell + 1) * step_us, until_us)
        dt = (end_us - now_us) * 1e-6
        references = _setpoints(p, wheels, left, right, now_us * 1e-6, dt)
        scrub = 0.0
        if p["turning_load"] > 0.0:
            difference = wheels[1]["profile"] + wheels[1]["error"] - wheels[0]["profile"] - wheels[0]["error"]
            scrub = p["turning_load"] * math.tanh(0.5 * difference / LOAD_ONSET_RAD_S)
        for side in range(2):
            wheel = wheels[side]
            load = -scrub if side == 0 else scrub
            error_before = wheel["error"]
            if enabled and not brake:
                reference = references[side]
                if p["stiction"] > 0.0:
                    if wheel["stuck"] == 1 and abs(reference) <= p["stiction"]:
                        reference = 0.0
                    else:
                        wheel["stuck"] = 0
                profile_before = wheel["profile"]
                start = _profile(p, wheel, reference, dt)
                is_immediate = start != profile_before
                acceleration = 0.0 if is_immediate else (wheel["profile"] - profile_before) / dt
                _track(p, wheel, acceleration, load, dt)
                crossed = profile_before * wheel["profile"] <= 0.0 and profile_before != 0.0
                resting = crossed or abs(wheel["profile"]) < REST_RAD_S
                if resting and p["stiction"] > 0.0 and abs(references[side]) <= p["stiction"]:
                    wheel["stuck"] = 1
                    wheel["profile"] = 0.0
                    wheel["profile_rate"] = 0.0
                if reference == 0.0 and abs(wheel["profile"]) < p["hold"] and abs(wheel["error"]) < 2.0 * p["hold"]:
                    wheel["profile"] = 0.0
                    wheel["error"] = 0.0
                    wheel["integral"] = 0.0
            else:
                start = wheel["profile"]
                _run_free(p, wheel, brake, load, dt)
                if wheel["profile"] == 0.0:
                    wheel["stuck"] = 1
            disturbed = 1.0 + disturbance[cell - first_cell, side]
            wheel["speed"] = (wheel["profile"] + wheel["error"]) * disturbed
            mean = 0.5 * (start + error_before + wheel["profile"] + wheel["error"])
            wheel["angle"] += mean * disturbed * dt
            angles[pieces, side] = wheel["angle"]
        times_us[pieces] = end_us
        pieces += 1
        now_us = end_us
    return pieces
