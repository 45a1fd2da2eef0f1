"""The model in numpy and double precision, written for reading: the oracle of the compiled step.

Everything broadcasts: a value of theta, a state or a command may be a number or an array. `theta` maps the full names
of parameters ("wheel_radius_m", then `effect.parameter`) to values; an effect acts if its parameters are there. What an
effect does is `plain` in its own file; here is what all robots have in common, and the order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from disco_hw.effects import Array, Effect, Stage, Value, Values, arguments_of
from disco_hw.effects.registry import DELAY, in_stages

Theta = Mapping[str, Value]
Means = Mapping[str, tuple[Value, ...]]
"""By name the mean that a term remembers: of both wheels for one of commands, one of the body's."""


@dataclass(frozen=True)
class RobotState:
    """Pose of the tracked point (m, rad), wheel speeds (rad/s) and what terms remember, 0 where that is not named."""

    x: Value
    y: Value
    yaw: Value
    wheel_left: Value
    wheel_right: Value
    means: Means = field(default_factory=dict)


def theta_of(names: tuple[str, ...], values: Array) -> dict[str, Value]:
    """Parameters by name from a vector, or from points (L, P) as arrays (L,)."""
    return dict(zip(names, np.moveaxis(values, -1, 0), strict=True))


def delayed(commands: Array, history: int, theta: Theta, step_s: float) -> Array:
    """Commands in force over each step, from commands (history + T, ...) of which the first rows were sent before."""
    horizon = commands.shape[0] - history
    delay_s = float(_called(DELAY, theta, {}, step_s)) if _acts(DELAY, theta) else 0.0
    steps = delay_s / step_s
    cells = int(np.floor(steps))
    fraction = steps - cells
    rows = history - cells + np.arange(horizon)
    recent, older = np.maximum(rows, 0), np.maximum(rows - 1, 0)
    return np.asarray((1.0 - fraction) * commands[recent] + fraction * commands[older])


def _sign(x: Value, rest: float) -> Value:
    """Return the sign of x, faded out below `rest`."""
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


@dataclass(frozen=True)
class _Memory:
    """A lag (s), what goes into it, and the feature of the motion and what comes out, in the mean over a step."""

    time_s: float
    goes_in: Callable[..., Value]
    feature: Callable[..., Value]

    def over(self, before: Value, value: Value, step_s: float) -> Value:
        """Mean of what comes out over a step, at whose start it was `before`, while `value` goes in."""
        lag = self.time_s / step_s
        return value + (before - value) * lag * (1.0 - math.exp(-1.0 / lag))

    def after(self, before: Value, value: Value, step_s: float) -> Value:
        """Return the memory at the end of a step at whose start it was `before`, under a constant input."""
        return value + (before - value) * math.exp(-step_s / self.time_s)


@dataclass(frozen=True)
class _Slewed:
    """Memory that follows its input by at most `most` a second (m/s^2), with the feature that uses it."""

    most: float
    goes_in: Callable[..., Value]
    feature: Callable[..., Value]

    def over(self, before: Value, value: Value, step_s: float) -> Value:
        """Mean of what comes out over a step, at whose start it was `before`: on its way, and there for the rest."""
        way = value - before
        arrives = np.minimum(np.abs(way) / (self.most * step_s), 1.0)
        end = self.after(before, value, step_s)
        return 0.5 * (before + end) * arrives + end * (1.0 - arrives)

    def after(self, before: Value, value: Value, step_s: float) -> Value:
        """Return the memory at the end of a step at whose start it was `before`, under a constant input."""
        return np.clip(value, before - self.most * step_s, before + self.most * step_s)


_Remembering = _Memory | _Slewed

_SHORT_TO_LONG = {"0.3": 0.3, "1": 1.0, "3": 3.0}
COMMAND_MEMORIES: Mapping[str, _Remembering] = {
    **{
        f"u mean_{name}s(|u| + |u_other|)": _Memory(
            time_s, lambda u, other: np.abs(u) + np.abs(other), lambda u, other, mean: mean * u
        )
        for name, time_s in _SHORT_TO_LONG.items()
    },
    **{
        f"(u - mean_{name}s(u))": _Memory(time_s, lambda u, other: u, lambda u, other, mean: u - mean)
        for name, time_s in (("0.3", 0.3), ("1", 1.0))
    },
    "u mean_30s(u^2)": _Memory(30.0, lambda u, other: u**2, lambda u, other, mean: mean * u),
    **{
        f"sign(u - mean_{name}s(u))": _Memory(time_s, lambda u, other: u, lambda u, other, mean: _sign(u - mean, 0.1))
        for name, time_s in _SHORT_TO_LONG.items()
    },
}
BODY_MEMORIES: Mapping[str, _Remembering] = {
    **{
        f"(v - mean_{name}s(v))": _Memory(time_s, lambda v, w: v, lambda v, w, mean: v - mean)
        for name, time_s in _SHORT_TO_LONG.items()
    },
    **{
        f"(omega - mean_{name}s(omega))": _Memory(time_s, lambda v, w: w, lambda v, w, mean: w - mean)
        for name, time_s in _SHORT_TO_LONG.items()
    },
    **{
        f"(v - slewed_{most}(v))": _Slewed(float(most), lambda v, w: v, lambda v, w, slewed: v - slewed)
        for most in ("1", "1.25", "1.6", "2", "2.5", "3.2", "4", "5", "6.3", "8")
    },
}


def _terms(theta: Theta, target: str) -> list[tuple[str, Value, Value]]:
    """Features, coefficients and reach of the terms that act on `target`; they are named `target += k feature`."""
    names = [name.removesuffix(".k") for name in theta if name.startswith(f"{target} += k ") and name.endswith(".k")]
    return [(name.partition(" += k ")[2], theta[f"{name}.k"], theta[f"{name}.reach"]) for name in names]


def _commands_remembered(theta: Theta, left: Value, right: Value) -> dict[str, tuple[_Remembering, tuple[Value, ...]]]:
    """Return, by feature, the memories of commands that act, and what goes into each of their means."""
    acting = [(name, COMMAND_MEMORIES[name]) for name, *_ in _terms(theta, "command") if name in COMMAND_MEMORIES]
    return {name: (memory, (memory.goes_in(left, right), memory.goes_in(right, left))) for name, memory in acting}


def _body_remembered(theta: Theta, v: Value, w: Value) -> dict[str, tuple[_Remembering, tuple[Value, ...]]]:
    """Return the memories of the body's terms and their inputs, which are forward speed and yaw rate."""
    features = [name for target in ("v_x", "omega") for name, *_ in _terms(theta, target)]
    acting = [(name, BODY_MEMORIES[name]) for name in features if name in BODY_MEMORIES]
    return {name: (memory, (memory.goes_in(v, w),)) for name, memory in acting}


def _ideal(theta: Theta, left: Value, right: Value) -> tuple[Value, Value]:
    """Forward speed (m/s) and yaw rate (rad/s) that these wheel speeds make without slip."""
    radius = theta["wheel_radius_m"]
    return radius * (right + left) / 2.0, radius * (right - left) / theta["axial_distance_m"]


def settled_means(theta: Theta, left: Value, right: Value, wheel_left: Value, wheel_right: Value) -> Means:
    """Return the means once commands and wheel speeds (rad/s) have been constant for ever."""
    body = _body_remembered(theta, *_ideal(theta, wheel_left, wheel_right))
    remembered = _commands_remembered(theta, left, right) | body
    return {name: values for name, (_, values) in remembered.items()}


def _acts(effect: Effect, theta: Theta) -> bool:
    return effect.columns[0] in theta


def _acting(theta: Theta, *stages: Stage) -> list[Effect]:
    return [effect for effect in in_stages(*stages) if _acts(effect, theta)]


def _called(effect: Effect, theta: Theta, motion: Mapping[str, Value], step_s: float) -> Any:
    """Evaluate an effect on the motion, with the arguments that it asks for by name."""
    geometry = theta["wheel_radius_m"], theta["axial_distance_m"], theta["x_icr_m"]
    values = tuple(theta[column] for column in effect.columns)
    known = {**motion, "values": values, "geometry": geometry, "step_s": step_s}
    return effect.plain(**{name: known[name] for name in arguments_of(effect.plain)})


def wheel_targets(
    theta: Theta, state: RobotState, left: Value, right: Value, time_s: float, step_s: float
) -> tuple[Value, Value]:
    """Wheel speeds that the drive aims for (rad/s), from commands and the wheel speeds of the state."""
    u_left, u_right = left, right
    remembered = _commands_remembered(theta, left, right)
    for feature, k, reach in _terms(theta, "command"):
        if feature in remembered:
            memory, values = remembered[feature]
            before = state.means.get(feature, (0.0, 0.0))
            of_left, of_right = (memory.over(*pair, step_s) for pair in zip(before, values, strict=True))
            left = left + k * np.clip(memory.feature(u_left, u_right, of_left), -reach, reach)
            right = right + k * np.clip(memory.feature(u_right, u_left, of_right), -reach, reach)
            continue
        left = left + k * np.clip(COMMAND_FEATURES[feature](u_left, u_right, time_s), -reach, reach)
        right = right + k * np.clip(COMMAND_FEATURES[feature](u_right, u_left, time_s), -reach, reach)
    for effect in _acting(theta, Stage.COMMAND):
        at_start = {"wheel_left": state.wheel_left, "wheel_right": state.wheel_right, "time_s": time_s}
        if "command" in arguments_of(effect.plain):
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
        if "end" in arguments_of(effect.plain):
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
    theta: Theta, left: Value, right: Value, change: Value, step_s: float, time_s: float, means: Means
) -> tuple[Value, Value, Value]:
    """Forward and lateral speed (m/s) of the tracked point and yaw rate (rad/s).

    From the mean wheel speeds over a step, the change of their sum over it (rad/s), and what was remembered before.
    """
    radius, axial = theta["wheel_radius_m"], theta["axial_distance_m"]
    ideal = (*_ideal(theta, left, right), radius * change / 2.0 / step_s, time_s)
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
    remembered = _body_remembered(theta, *ideal[:2])

    def added(target: str) -> Value:
        total: Value = 0.0
        for feature, k, reach in _terms(theta, target):
            if feature in remembered:
                memory, (value,) = remembered[feature]
                (before,) = means.get(feature, (0.0,))
                gained = memory.feature(*ideal[:2], memory.over(before, value, step_s))
            else:
                gained = BODY_FEATURES[feature](*ideal)
            total = total + k * np.clip(gained, -reach, reach)
        return total

    v, omega = motion["forward"] + added("v_x"), 2.0 * motion["turn"] + added("omega")
    return v, across + added("v_y") - omega * theta["x_icr_m"], omega


def step(
    theta: Theta, state: RobotState, left: Value, right: Value, step_s: float, time_s: float = 0.0, euler: bool = False
) -> tuple[RobotState, Value, Value]:
    """One step of f_theta under the commands in force; also the forward speed over it (m/s) and the yaw rate (rad/s).

    The body keeps its velocity over the step, so the tracked point moves along an arc, which is exact: its chord lies
    at half the turn and is shorter than the arc by sin(z) / z, z = omega step / 2. With `euler` it moves straight,
    along the heading that the step begins with. What acts in the world comes on top.
    """
    remembered = _commands_remembered(theta, left, right)
    left, right = wheel_targets(theta, state, left, right, time_s, step_s)
    end_left, end_right, mean_left, mean_right = responded(theta, state, left, right, time_s, step_s)
    change = (end_left + end_right) - (state.wheel_left + state.wheel_right)
    v, v_lateral, omega = body_velocity(theta, mean_left, mean_right, change, step_s, time_s, state.means)
    remembered |= _body_remembered(theta, *_ideal(theta, mean_left, mean_right))
    means = {
        name: tuple(
            memory.after(before, value, step_s)
            for before, value in zip(state.means.get(name, (0.0,) * len(values)), values, strict=True)
        )
        for name, (memory, values) in remembered.items()
    }

    middle = state.yaw + omega * step_s / 2.0
    chord = step_s * np.sinc(omega * step_s / 2.0 / np.pi)
    if euler:
        middle, chord = state.yaw, step_s
    x = state.x + chord * (v * np.cos(middle) - v_lateral * np.sin(middle))
    y = state.y + chord * (v * np.sin(middle) + v_lateral * np.cos(middle))
    for effect in _acting(theta, Stage.WORLD):
        rolling = {"wheel_sum": mean_left + mean_right, "difference": mean_right - mean_left, "time_s": time_s}
        x, y = _called(effect, theta, {"x": x, "y": y, **rolling}, step_s)
    return RobotState(x, y, state.yaw + omega * step_s, end_left, end_right, means), v, omega
