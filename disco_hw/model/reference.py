"""The transition function in numpy and double precision, written for reading: the oracle of the compiled one.

Everything broadcasts: a value of theta, a state or a command may be a number or an array. `theta` maps the full names
of parameters ("wheel_radius_m", "motor_lag.tau_s", ...) to values; an effect acts if its parameters are there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

Theta = Mapping[str, Any]


@dataclass(frozen=True)
class State:
    """Pose of the tracked point (m, rad) and wheel speeds (rad/s)."""

    x: Any
    y: Any
    yaw: Any
    wheel_left: Any
    wheel_right: Any


def theta_of(names: tuple[str, ...], values: np.ndarray) -> dict[str, Any]:
    """Parameters by name from a vector, or from points (L, P) as arrays (L,)."""
    return dict(zip(names, np.moveaxis(values, -1, 0), strict=True))


def delayed(commands: Any, history: int, theta: Theta, step_s: float) -> Any:
    """Commands in force over each step, from commands (history + T, ...) of which the first rows were sent before."""
    horizon = commands.shape[0] - history
    steps = theta.get("command_delay.delay_s", 0.0) / step_s
    whole = int(np.floor(steps))
    fraction = steps - whole
    rows = history - whole + np.arange(horizon)
    recent, older = np.maximum(rows, 0), np.maximum(rows - 1, 0)
    return (1.0 - fraction) * commands[recent] + fraction * commands[older]


def _sign(x: Any, rest: float) -> Any:
    """The sign of x, faded out below `rest`."""
    return np.sign(x) * x**2 / (x**2 + rest**2)


# The features of terms without a name, as `disco_hw.model.terms` has them.
COMMAND_FEATURES: Mapping[str, Callable[[Any, Any, Any], Any]] = {
    "u |u|": lambda u, other, t: np.sign(u) * u**2,
    "u^3": lambda u, other, t: u**3,
    "sign(u)": lambda u, other, t: _sign(u, 0.05),
    "|u|": lambda u, other, t: np.abs(u),
    "u^2": lambda u, other, t: u**2,
    "|u_other| sign(u)": lambda u, other, t: np.abs(other) * _sign(u, 0.05),
    "u_other": lambda u, other, t: other,
    "u_other |u|": lambda u, other, t: other * np.abs(u),
    "|u_other| u": lambda u, other, t: np.abs(other) * u,
    "u_other^2 sign(u)": lambda u, other, t: other**2 * _sign(u, 0.05),
    "|u - u_other| sign(u)": lambda u, other, t: np.abs(u - other) * _sign(u, 0.05),
    "u / (1 + |u|)": lambda u, other, t: u / (1.0 + np.abs(u)),
    "t/100 u": lambda u, other, t: t / 100.0 * u,
    "t/100 sign(u)": lambda u, other, t: t / 100.0 * _sign(u, 0.05),
}
BODY_FEATURES: Mapping[str, Callable[[Any, Any, Any, Any], Any]] = {
    "v": lambda v, w, a, t: v,
    "|v|": lambda v, w, a, t: np.abs(v),
    "v |v|": lambda v, w, a, t: np.sign(v) * v**2,
    "v^2": lambda v, w, a, t: v**2,
    "v^3": lambda v, w, a, t: v**3,
    "omega": lambda v, w, a, t: w,
    "|omega|": lambda v, w, a, t: np.abs(w),
    "omega |omega|": lambda v, w, a, t: np.sign(w) * w**2,
    "omega^2": lambda v, w, a, t: w**2,
    "omega^3": lambda v, w, a, t: w**3,
    "sign(omega)": lambda v, w, a, t: _sign(w, 0.05),
    "sign(v)": lambda v, w, a, t: _sign(v, 0.02),
    "omega / (2 + 5 |omega|)": lambda v, w, a, t: w / (2.0 + 5.0 * np.abs(w)),
    "v omega": lambda v, w, a, t: v * w,
    "v |omega|": lambda v, w, a, t: v * np.abs(w),
    "|v| omega": lambda v, w, a, t: np.abs(v) * w,
    "v^2 omega": lambda v, w, a, t: v**2 * w,
    "v omega^2": lambda v, w, a, t: v * w**2,
    "a": lambda v, w, a, t: a,
    "|v| a": lambda v, w, a, t: np.abs(v) * a,
    "v |a|": lambda v, w, a, t: v * np.abs(a),
    "omega a": lambda v, w, a, t: w * a,
    "t/100 v": lambda v, w, a, t: t / 100.0 * v,
    "t/100 omega": lambda v, w, a, t: t / 100.0 * w,
}


def _terms(theta: Theta, target: str) -> list[tuple[str, Any]]:
    """Features and coefficients of the terms that act on `target`; they are named `target += k feature`."""
    parted = [(name.removesuffix(".k").partition(" += k "), value) for name, value in theta.items()]
    return [(feature, value) for (acted_on, _, feature), value in parted if feature and acted_on == target]


def wheel_targets(theta: Theta, state: State, left: Any, right: Any, time_s: float) -> tuple[Any, Any]:
    """Wheel speeds that the drive aims for (rad/s), from commands and the wheel speeds of the state."""
    u_left, u_right = left, right
    for feature, k in _terms(theta, "command"):
        left = left + k * COMMAND_FEATURES[feature](u_left, u_right, time_s)
        right = right + k * COMMAND_FEATURES[feature](u_right, u_left, time_s)
    if "deadband.width_rad_s" in theta:
        width = theta["deadband.width_rad_s"]
        left, right = (np.sign(u) * np.maximum(np.abs(u) - width, 0.0) for u in (left, right))
    if "yaw_rate_limit.limit_rad_s" in theta:
        rate = theta["wheel_radius_m"] * (right - left) / theta["axial_distance_m"]
        limit = theta["yaw_rate_limit.limit_rad_s"]
        difference = np.clip(rate, -limit, limit) * theta["axial_distance_m"] / theta["wheel_radius_m"]
        mean = (left + right) / 2.0
        left, right = mean - difference / 2.0, mean + difference / 2.0
    if "speed_limit.limit_rad_s" in theta:
        limit = theta["speed_limit.limit_rad_s"]
        left, right = np.clip(left, -limit, limit), np.clip(right, -limit, limit)
    if "wheel_gain.left" in theta:
        left, right = left * (1.0 + theta["wheel_gain.left"]), right * (1.0 + theta["wheel_gain.right"])
    if "battery_sag.loss" in theta:
        kept = 1.0 - np.clip(theta["battery_sag.loss"] * time_s / 150.0, 0.0, 0.3)
        left, right = left * kept, right * kept
    if "stiction.threshold_rad_s" in theta:
        threshold = theta["stiction.threshold_rad_s"]

        def resting(speed: Any, command: Any) -> Any:
            return (np.abs(speed) < 0.02) | (speed * command < 0.0)

        left = np.where(resting(state.wheel_left, left) & (np.abs(left) <= threshold), 0.0, left)
        right = np.where(resting(state.wheel_right, right) & (np.abs(right) <= threshold), 0.0, right)
    return left, right


def lagged(theta: Theta, target: Any, speed: Any, step_s: float) -> tuple[Any, Any]:
    """Wheel speed at the end of a step and its mean over it: w' = (target - w) / tau, solved."""
    tau = np.maximum(theta.get("motor_lag.tau_s", 0.0), 1e-9)
    left_at_end = np.exp(-step_s / tau)
    left_in_mean = (1.0 - left_at_end) * tau / step_s
    return target + (speed - target) * left_at_end, target + (speed - target) * left_in_mean


def turning_within_limits(theta: Theta, state: State, left: Any, right: Any, within_s: float) -> tuple[Any, Any]:
    """Wheel speeds (rad/s) that the largest yaw acceleration reaches from the state's in this time."""
    if "yaw_acceleration_limit.limit_rad_s2" not in theta:
        return left, right
    to_rate = theta["wheel_radius_m"] / theta["axial_distance_m"]
    change = theta["yaw_acceleration_limit.limit_rad_s2"] * within_s
    before = to_rate * (state.wheel_right - state.wheel_left)
    rate = np.clip(to_rate * (right - left), before - change, before + change)
    mean = (left + right) / 2.0
    return mean - rate / to_rate / 2.0, mean + rate / to_rate / 2.0


def body_velocity(
    theta: Theta, left: Any, right: Any, change: Any, step_s: float, time_s: float
) -> tuple[Any, Any, Any]:
    """Forward and lateral speed (m/s) of the tracked point and yaw rate (rad/s).

    From the mean wheel speeds over a step and the change of their sum over it (rad/s).
    """
    radius, axial = theta["wheel_radius_m"], theta["axial_distance_m"]
    rolling = (radius * (right + left) / 2.0, radius * (right - left) / axial, radius * change / 2.0 / step_s, time_s)
    if "wheel_radius_asymmetry.ratio" in theta:
        ratio = theta["wheel_radius_asymmetry.ratio"]
        left, right = left * (1.0 - ratio), right * (1.0 + ratio)
    v = radius * (right + left) / 2.0
    omega = radius * (right - left) / axial
    if "surface_change.time_s" in theta:
        part = np.clip((time_s + step_s - theta["surface_change.time_s"]) / step_s, 0.0, 1.0)
        larger = 1.0 + theta["surface_change.radius"]
        v = v * (1.0 + part * (larger - 1.0))
        omega = omega * (1.0 + part * (larger / (1.0 + theta["surface_change.track"]) - 1.0))
    if "turn_slip.k_s" in theta:
        omega = omega * np.clip(1.0 - theta["turn_slip.k_s"] * np.abs(omega), 0.5, 2.0)
    if "acceleration_slip.k_s2_m" in theta:
        acceleration = theta["wheel_radius_m"] * change / 2.0 / step_s
        v = v - np.abs(v) * np.clip(theta["acceleration_slip.k_s2_m"] * acceleration, -0.6, 0.6)
    across = -theta.get("side_slip.k_s", 0.0) * v * omega
    v = v + theta.get("lateral_icr.offset_m", 0.0) * omega
    v = v + sum(k * BODY_FEATURES[feature](*rolling) for feature, k in _terms(theta, "v_x"))
    across = across + sum(k * BODY_FEATURES[feature](*rolling) for feature, k in _terms(theta, "v_y"))
    omega = omega + sum(k * BODY_FEATURES[feature](*rolling) for feature, k in _terms(theta, "omega"))
    return v, across - omega * theta["x_icr_m"], omega


def step(
    theta: Theta, state: State, left: Any, right: Any, step_s: float, time_s: float = 0.0
) -> tuple[State, Any, Any]:
    """One step of f_theta under the commands in force; also the forward speed over it (m/s) and the yaw rate (rad/s).

    The body keeps its velocity over the step, so the tracked point moves along an arc, which is exact: its chord lies
    at half the turn and is shorter than the arc by sin(z) / z, z = omega step / 2. The effect of a slope comes on top.
    """
    target_left, target_right = wheel_targets(theta, state, left, right, time_s)
    end_left, mean_left = lagged(theta, target_left, state.wheel_left, step_s)
    end_right, mean_right = lagged(theta, target_right, state.wheel_right, step_s)
    end_left, end_right = turning_within_limits(theta, state, end_left, end_right, step_s)
    mean_left, mean_right = turning_within_limits(theta, state, mean_left, mean_right, step_s / 2.0)
    change = (end_left + end_right) - (state.wheel_left + state.wheel_right)
    v, v_lateral, omega = body_velocity(theta, mean_left, mean_right, change, step_s, time_s)

    middle = state.yaw + omega * step_s / 2.0
    chord = step_s * np.sinc(omega * step_s / 2.0 / np.pi)
    x = state.x + chord * (v * np.cos(middle) - v_lateral * np.sin(middle))
    y = state.y + chord * (v * np.sin(middle) + v_lateral * np.cos(middle))
    if "slope.drift_x_m_s" in theta:
        rim_speed = theta["wheel_radius_m"] * (np.abs(mean_left) + np.abs(mean_right)) / 2.0
        part = np.minimum(rim_speed / 0.02, 1.0)
        x = x + part * theta["slope.drift_x_m_s"] * step_s
        y = y + part * theta["slope.drift_y_m_s"] * step_s
    return State(x, y, state.yaw + omega * step_s, end_left, end_right), v, omega
