"""The model in numpy and double precision, written for reading: the oracle of the compiled step.

Everything broadcasts: a value of theta, a state or a command may be a number or an array. `theta` maps the full names
of parameters ("wheel_radius_m", then `effect.parameter`) to values; an effect acts if its parameters are there. What an
effect does is `plain` in its own file; here is what all robots have in common, and the order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from disco_hw.effects import Array, Effect, Stage, Value, Values, asks_for
from disco_hw.effects.registry import DELAY, in_stages

Theta = Mapping[str, Value]


@dataclass(frozen=True)
class RobotState:
    """Pose of the tracked point (m, rad) and wheel speeds (rad/s)."""

    x: Value
    y: Value
    yaw: Value
    wheel_left: Value
    wheel_right: Value


def theta_of(names: tuple[str, ...], values: Array) -> dict[str, Value]:
    """Parameters by name from a vector, or from points (L, P) as arrays (L,)."""
    return dict(zip(names, np.moveaxis(values, -1, 0), strict=True))


def delayed(commands: Array, history: int, theta: Theta, step_s: float) -> Array:
    """Commands in force over each step, from commands (history + T, ...) of which the first rows were sent before."""
    horizon = commands.shape[0] - history
    late_s = float(_called(DELAY, theta, {}, step_s)) if _acts(DELAY, theta) else 0.0
    steps = late_s / step_s
    whole = int(np.floor(steps))
    fraction = steps - whole
    rows = history - whole + np.arange(horizon)
    recent, older = np.maximum(rows, 0), np.maximum(rows - 1, 0)
    return np.asarray((1.0 - fraction) * commands[recent] + fraction * commands[older])


def _sign(x: Value, rest: float) -> Value:
    """The sign of x, faded out below `rest`."""
    return np.sign(x) * x**2 / (x**2 + rest**2)


# The features of terms without a name, as `disco_hw.model.terms` has them.
COMMAND_FEATURES: Mapping[str, Callable[[Value, Value, float], Value]] = {
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
BODY_FEATURES: Mapping[str, Callable[[Value, Value, Value, float], Value]] = {
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


def _terms(theta: Theta, target: str) -> list[tuple[str, Value]]:
    """Features and coefficients of the terms that act on `target`; they are named `target += k feature`."""
    parted = [(name.removesuffix(".k").partition(" += k "), value) for name, value in theta.items()]
    return [(feature, value) for (acted_on, _, feature), value in parted if feature and acted_on == target]


def _acts(effect: Effect, theta: Theta) -> bool:
    return effect.columns[0] in theta


def _acting(theta: Theta, *stages: Stage) -> list[Effect]:
    return [effect for effect in in_stages(*stages) if _acts(effect, theta)]


def _called(effect: Effect, theta: Theta, motion: Mapping[str, Value], step_s: float) -> Any:
    """What an effect makes of the motion; it asks for what it needs by name."""
    geometry = theta["wheel_radius_m"], theta["axial_distance_m"], theta["x_icr_m"]
    values = tuple(theta[column] for column in effect.columns)
    known = {**motion, "values": values, "geometry": geometry, "step_s": step_s}
    return effect.plain(**{name: known[name] for name in asks_for(effect.plain)})


def wheel_targets(
    theta: Theta, state: RobotState, left: Value, right: Value, time_s: float, step_s: float
) -> tuple[Value, Value]:
    """Wheel speeds that the drive aims for (rad/s), from commands and the wheel speeds of the state."""
    u_left, u_right = left, right
    for feature, k in _terms(theta, "command"):
        left = left + k * COMMAND_FEATURES[feature](u_left, u_right, time_s)
        right = right + k * COMMAND_FEATURES[feature](u_right, u_left, time_s)
    for effect in _acting(theta, Stage.COMMAND):
        at_start = {"wheel_left": state.wheel_left, "wheel_right": state.wheel_right, "time_s": time_s}
        if "command" in asks_for(effect.plain):
            left = _called(effect, theta, {**at_start, "command": left, "speed": state.wheel_left}, step_s)
            right = _called(effect, theta, {**at_start, "command": right, "speed": state.wheel_right}, step_s)
        else:
            left, right = _called(effect, theta, {**at_start, "left": left, "right": right}, step_s)
    return left, right


def responded(theta: Theta, state: RobotState, left: Value, right: Value, time_s: float, step_s: float) -> Values:
    """Wheel speeds at the end of a step, left and right, and their means over it (rad/s), from what is aimed for."""
    end_left = mean_left = left
    end_right = mean_right = right
    for effect in _acting(theta, Stage.RESPONSE):
        if "end" in asks_for(effect.plain):
            of_left = {"end": end_left, "mean": mean_left, "speed": state.wheel_left, "time_s": time_s}
            of_right = {"end": end_right, "mean": mean_right, "speed": state.wheel_right, "time_s": time_s}
            end_left, mean_left = _called(effect, theta, of_left, step_s)
            end_right, mean_right = _called(effect, theta, of_right, step_s)
        else:
            both = {
                "left": left, "right": right, "end_left": end_left, "end_right": end_right,
                "mean_left": mean_left, "mean_right": mean_right,
                "wheel_left": state.wheel_left, "wheel_right": state.wheel_right, "time_s": time_s,
            }  # fmt: skip
            end_left, end_right, mean_left, mean_right = _called(effect, theta, both, step_s)
    return end_left, end_right, mean_left, mean_right


def body_velocity(
    theta: Theta, left: Value, right: Value, change: Value, step_s: float, time_s: float
) -> tuple[Value, Value, Value]:
    """Forward and lateral speed (m/s) of the tracked point and yaw rate (rad/s).

    From the mean wheel speeds over a step and the change of their sum over it (rad/s).
    """
    radius, axial = theta["wheel_radius_m"], theta["axial_distance_m"]
    ideal = (radius * (right + left) / 2.0, radius * (right - left) / axial, radius * change / 2.0 / step_s, time_s)
    motion: dict[str, Value] = {
        "wheel_sum": left + right, "difference": right - left, "change": change, "time_s": time_s
    }  # fmt: skip
    for effect in _acting(theta, Stage.ROLLING):
        motion["wheel_sum"], motion["difference"] = _called(effect, theta, motion, step_s)
    motion["forward"] = radius * motion["wheel_sum"] / 2.0
    motion["turn"] = radius * motion["difference"] / axial / 2.0
    across: Value = 0.0
    for effect in _acting(theta, Stage.VELOCITY, Stage.FORWARD, Stage.TURN, Stage.LATERAL):
        found = _called(effect, theta, motion, step_s)
        match effect.stage:
            case Stage.VELOCITY:
                motion["forward"], motion["turn"] = found
            case Stage.FORWARD:
                motion["forward"] = found
            case Stage.TURN:
                motion["turn"] = found
            case _:
                across = across + found
    v, omega = motion["forward"], 2.0 * motion["turn"]
    v = v + sum(k * BODY_FEATURES[feature](*ideal) for feature, k in _terms(theta, "v_x"))
    across = across + sum(k * BODY_FEATURES[feature](*ideal) for feature, k in _terms(theta, "v_y"))
    omega = omega + sum(k * BODY_FEATURES[feature](*ideal) for feature, k in _terms(theta, "omega"))
    return v, across - omega * theta["x_icr_m"], omega


def step(
    theta: Theta, state: RobotState, left: Value, right: Value, step_s: float, time_s: float = 0.0, euler: bool = False
) -> tuple[RobotState, Value, Value]:
    """One step of f_theta under the commands in force; also the forward speed over it (m/s) and the yaw rate (rad/s).

    The body keeps its velocity over the step, so the tracked point moves along an arc, which is exact: its chord lies
    at half the turn and is shorter than the arc by sin(z) / z, z = omega step / 2. With `euler` it moves straight,
    along the heading that the step begins with. What acts in the world comes on top.
    """
    left, right = wheel_targets(theta, state, left, right, time_s, step_s)
    end_left, end_right, mean_left, mean_right = responded(theta, state, left, right, time_s, step_s)
    change = (end_left + end_right) - (state.wheel_left + state.wheel_right)
    v, v_lateral, omega = body_velocity(theta, mean_left, mean_right, change, step_s, time_s)

    middle = state.yaw + omega * step_s / 2.0
    chord = step_s * np.sinc(omega * step_s / 2.0 / np.pi)
    if euler:
        middle, chord = state.yaw, step_s
    x = state.x + chord * (v * np.cos(middle) - v_lateral * np.sin(middle))
    y = state.y + chord * (v * np.sin(middle) + v_lateral * np.cos(middle))
    for effect in _acting(theta, Stage.WORLD):
        rolling = {"wheel_sum": mean_left + mean_right, "difference": mean_right - mean_left, "time_s": time_s}
        x, y = _called(effect, theta, {"x": x, "y": y, **rolling}, step_s)
    return RobotState(x, y, state.yaw + omega * step_s, end_left, end_right), v, omega
