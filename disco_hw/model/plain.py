"""The model in numpy and double precision, written for reading: the oracle of the compiled step.

Everything broadcasts: a value of theta, a state or a command may be a number or an array. `theta` maps the full names
of parameters ("wheel_radius_m", then `effect.parameter`) to values; an effect acts if its parameters are there. What an
effect does is `plain` in its own file, what a term's feature is in `terms`; here is what all robots have in common, and
the order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from disco_hw.effects import Array, Effect, Stage, Value, Values, arguments_of
from disco_hw.effects.registry import DELAY, in_stages
from disco_hw.model.terms import (
    BODY_FEATURES,
    BODY_MEMORIES,
    BODY_TARGETS,
    COMMAND,
    COMMAND_FEATURES,
    COMMAND_MEMORIES,
    Remembered,
)

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


def _over(memory: Remembered, before: Value, value: Value, step_s: float) -> Value:
    """Return the mean of a memory over a step, at whose start it was `before`, under a constant input."""
    if memory.slews:
        most = memory.most * step_s
        way: Value = np.clip(value - before, -most, most)
        # On its way, and there for the rest.
        return before + way * (1.0 - 0.5 * np.abs(way) / most)
    _, over_step = memory.follows(step_s)
    return before + over_step * (value - before)


def _after(memory: Remembered, before: Value, value: Value, step_s: float) -> Value:
    """Return a memory at the end of a step at whose start it was `before`, under a constant input."""
    if memory.slews:
        slewed: Value = np.clip(value, before - memory.most * step_s, before + memory.most * step_s)
        return slewed
    by_end, _ = memory.follows(step_s)
    return before + by_end * (value - before)


def _terms(theta: Theta, target: str) -> list[tuple[str, Value, Value]]:
    """Features, coefficients and reach of the terms that act on `target`; they are named `target += k feature`."""
    names = [name.removesuffix(".k") for name in theta if name.startswith(f"{target} += k ") and name.endswith(".k")]
    return [(name.partition(" += k ")[2], theta[f"{name}.k"], theta[f"{name}.reach"]) for name in names]


def _commands_remembered(theta: Theta, left: Value, right: Value) -> dict[str, tuple[Remembered, tuple[Value, ...]]]:
    """Return, by feature, the memories of commands that act, and what goes into each of their means."""
    acting = [(name, COMMAND_MEMORIES[name]) for name, *_ in _terms(theta, COMMAND) if name in COMMAND_MEMORIES]
    return {name: (memory, (memory.of(left, right), memory.of(right, left))) for name, memory in acting}


def _body_remembered(theta: Theta, v: Value, w: Value) -> dict[str, tuple[Remembered, tuple[Value, ...]]]:
    """Return the memories of the body's terms and their inputs, which are forward speed and yaw rate."""
    acting = {name for target in BODY_TARGETS for name, *_ in _terms(theta, target)}
    memories = {name: memory for of_target in BODY_MEMORIES.values() for name, memory in of_target.items()}
    return {name: (memory, (memory.of(v, w),)) for name, memory in memories.items() if name in acting}


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
    for feature, k, reach in _terms(theta, COMMAND):
        if feature in remembered:
            memory, values = remembered[feature]
            before = state.means.get(feature, (0.0, 0.0))
            of_left, of_right = (_over(memory, *pair, step_s) for pair in zip(before, values, strict=True))
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
                gained = memory.feature(*ideal[:2], _over(memory, before, value, step_s))
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
            _after(memory, before, value, step_s)
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
