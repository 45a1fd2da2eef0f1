"""The transition function f_theta: one step of the skid-steer robot with the terms of its effects put in line.

And the free run: the model from a known state through given commands, in double precision.

Compiled scalar functions, generic in precision. An effect that is absent is None; the compiler sees that in the type of
its argument and leaves nothing of it in the machine code. The same in numpy, for reading: `disco_hw.model.plain`.

    v = r (w_R + w_L) / 2        omega = r (w_R - w_L) / a        v_lateral = -omega x_icr
    x' = v cos(yaw) - v_lateral sin(yaw)      y' = v sin(yaw) + v_lateral cos(yaw)      yaw' = omega

A step hands its numbers from stage to stage; what is in brackets is there only if the model has an effect for it:

    commands ─[command_delay]─▶ in force ─[command terms, COMMAND, RESPONSE]─▶ w_L, w_R at the end and in the mean
    means ─[ROLLING]─▶ sum, difference ─▶ v, v_lateral, omega ─[VELOCITY to LATERAL, body terms]─▶ arc ─[WORLD]─▶ pose

Layout of what a free run works on; each row of commands is held for a step:

    commands (history + N, 2)   | -history | ... | -1 | 0 | 1 | ... | N - 1 |         left, right (rad/s)
    states (N + 1, 5)                                 | 0 | 1 | ... | N - 1 | N |     x, y, yaw, w_L, w_R
    means (n,)                  | command term 0: left, right | term 1 ... | body term 0 | term 1 ... |
    Base, Coefficients          a field for each parameter or effect: columns (L,) of points, numbers of one, or None

In step t the command of row `history + t - delay_steps` is in force, mixed with the one before it (`in_force`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects import Effect, Stage, arguments_of
from disco_hw.effects.registry import DELAY, REGISTRY, in_stages
from disco_hw.jit import cast_like, compiled_for, kernel_function, scalar_function
from disco_hw.model.added_terms import (
    Means,
    add_to_commands,
    add_to_velocity,
    count_means,
    new_means,
    terms_need_change,
    written_out,
)
from disco_hw.model.coefficients import Base, Coefficients, Integration, base_point, effect_point
from disco_hw.model.drift import MOVES_RAD_S, NO_DRIFT_M_S
from disco_hw.model.model import Model, coefficient_tables

Pose: TypeAlias = tuple[float, float, float, float]
"""x, y (m), cosine and sine of yaw."""


def integration_series(step_s: float, wide: bool, dtype: type = np.float64) -> NDArray[np.floating]:
    """Series of the exact arc for steps of `step_s`, (8,): to 1e-7 for turns of 0.4 rad a step, `wide` for 8."""
    h = step_s / 16.0 if wide else step_s
    h2 = h * h
    chord = (step_s, -step_s * h2 / 6, step_s * h2**2 / 120, -step_s * h2**3 / 5040)
    return np.array([step_s, *chord, -h2 / 2, h2**2 / 24, -(h2**3) / 720], dtype=dtype)


@scalar_function
def integration_from(series: NDArray[np.floating], wide: object, euler: object) -> Integration:
    """Build the numbers of a step from `integration_series`; `wide` and `euler` are None or anything else."""
    return Integration(
        series[0], series[1], series[2], series[3], series[4], series[5], series[6], series[7], wide, euler
    )


@scalar_function
def wheel_step(
    left: float, right: float, wheel_left: float, wheel_right: float, time_s: float, effects: Coefficients,
    means: Means, at: Any, apart: Any,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Wheel speeds at the end of a step and their means over it, left and right (rad/s).

    From the commands (after the command delay), the wheel speeds at the start of the step and its time. What terms
    remember of commands, number n at `means[at + n * apart]`, goes on by the step.
    """
    left, right = add_to_commands(left, right, time_s, effects.command_terms, means, at, apart)
    turned: tuple[float, float, float, float] = wheel_terms(left, right, wheel_left, wheel_right, time_s, effects)
    return turned


@scalar_function
def body_velocity(
    wheel_sum: float, difference: float, change: float, time_s: float, base: Base, effects: Coefficients,
    means: Means, at: Any, apart: Any,
) -> tuple[float, float | None, float]:  # fmt: skip
    """Forward speed (m/s), lateral speed of the axle (m/s) or None, and half the yaw rate (rad/s).

    From the mean wheel speeds over a step, left plus right and right minus left, the change of their sum over it
    (rad/s), and the time at its start (s). What terms remember of wheel speeds goes on as in `wheel_step`.
    """
    forward, lateral, turn = body_terms(wheel_sum, difference, change, time_s, base, effects)
    return add_to_velocity(
        forward, lateral, turn, wheel_sum, difference, change, time_s, base, effects.body_terms, means, at,
        apart,
    )  # fmt: skip


@scalar_function
def half_turn(turn: float, wide: object, series: Integration) -> tuple[float, float]:
    """Chord of a step over its speed (s), and cosine of the turn in half a step; `turn` is half the yaw rate (rad/s).

    The sine of the turn in half a step is `turn` times the chord.
    """
    q = turn * turn
    one = cast_like(1.0, q)
    if wide is None:
        chord = series.chord0 + q * (series.chord1 + q * series.chord2)
        return chord, one + q * (series.cos1 + q * series.cos2)
    chord = series.chord0 + q * (series.chord1 + q * (series.chord2 + q * series.chord3))
    cosine = one + q * (series.cos1 + q * (series.cos2 + q * series.cos3))
    # Doubled four times, by way of sine and 1 - cosine, which lose no precision near zero.
    two = cast_like(2.0, q)
    sine = turn * chord * cast_like(1 / 16, q)
    for _ in range(4):
        chord, sine, cosine = chord * cosine, two * sine * cosine, one - two * sine * sine
    return chord, cosine


@scalar_function
def sideways(
    lateral: float | None, chord: float, x: float, y: float, cos_mid: float, sin_mid: float
) -> tuple[float, float]:
    """Add the lateral part of a step to a position; nothing if there is none."""
    if lateral is None:
        return x, y
    across = lateral * chord
    return x - across * sin_mid, y + across * cos_mid


@scalar_function
def move(
    x: float,
    y: float,
    cos_yaw: float,
    sin_yaw: float,
    forward: float,
    lateral: float | None,
    turn: float,
    integration: Integration,
) -> tuple[float, float, float, float]:
    """Move the axle's centre along the exact arc of a constant body velocity; returns x, y, cos(yaw), sin(yaw)."""
    chord, cosine = half_turn(turn, integration.wide, integration)
    sine = turn * chord
    cos_mid = cos_yaw * cosine - sin_yaw * sine
    sin_mid = sin_yaw * cosine + cos_yaw * sine
    along = forward * chord
    x, y = sideways(lateral, chord, x + along * cos_mid, y + along * sin_mid, cos_mid, sin_mid)
    # exp(2iz) = 2 cos(z) exp(iz) - 1
    twice = cosine + cosine
    return x, y, twice * cos_mid - cos_yaw, twice * sin_mid - sin_yaw


@scalar_function
def axle_of(x: float, y: float, cos_yaw: float, sin_yaw: float, base: Base) -> tuple[float, float]:
    """Point of the axle, x_icr ahead of the tracked point, that rolls without sliding sideways.

    It moves as a unicycle whatever x_icr is, so the step is worked out for it.
    """
    return x + base.x_icr_m * cos_yaw, y + base.x_icr_m * sin_yaw


@scalar_function
def tracked_of(axle_x: float, axle_y: float, cos_yaw: float, sin_yaw: float, base: Base) -> tuple[float, float]:
    """Return the tracked point, from the axle's point."""
    return axle_x - base.x_icr_m * cos_yaw, axle_y - base.x_icr_m * sin_yaw


@scalar_function
def straight(
    euler: object, arc: Pose, axle_x: float, axle_y: float, cos_yaw: float, sin_yaw: float, forward: float,
    lateral: float | None, turn: float, base: Base, step_s: float,
) -> Pose:  # fmt: skip
    """Return the axle point after an explicit Euler step of the tracked point, with the heading after the `arc`.

    The arc itself if `euler` is None. The tracked point moves along the heading that the step begins with, and with it
    by -omega x_icr to the left of that; it takes the axle's point along, and this depends on x_icr then.
    """
    if euler is None:
        return arc
    _, _, cos_after, sin_after = arc
    x, y = tracked_of(axle_x, axle_y, cos_yaw, sin_yaw, base)
    along, across = forward * step_s, -(turn + turn) * step_s * base.x_icr_m
    x, y = x + (along * cos_yaw - across * sin_yaw), y + (along * sin_yaw + across * cos_yaw)
    x, y = sideways(lateral, step_s, x, y, cos_yaw, sin_yaw)
    axle_x, axle_y = axle_of(x, y, cos_after, sin_after, base)
    return axle_x, axle_y, cos_after, sin_after


@scalar_function
def body_step(
    axle_x: float, axle_y: float, cos_yaw: float, sin_yaw: float, wheel_sum: float, difference: float, change: float,
    time_s: float, base: Base, effects: Coefficients, integration: Integration,
    means: Means, at: Any, apart: Any,
) -> tuple[float, float, float, float, float, float]:  # fmt: skip
    """Compute the body's half of a step.

    Return the axle's point (m), cosine and sine of yaw after it; forward speed (m/s) and half the yaw rate (rad/s) over
    it. Wheel speeds and means as for `body_velocity`.
    """
    forward, lateral, turn = body_velocity(wheel_sum, difference, change, time_s, base, effects, means, at, apart)
    arc = move(axle_x, axle_y, cos_yaw, sin_yaw, forward, lateral, turn, integration)
    axle_x, axle_y, cos_yaw, sin_yaw = straight(
        integration.euler, arc, axle_x, axle_y, cos_yaw, sin_yaw, forward, lateral, turn, base, integration.step_s
    )
    axle_x, axle_y = world_terms(axle_x, axle_y, wheel_sum, difference, time_s, effects)
    return axle_x, axle_y, cos_yaw, sin_yaw, forward, turn


@scalar_function
def step(
    axle_x: float, axle_y: float, cos_yaw: float, sin_yaw: float, wheel_left: float, wheel_right: float, left: float,
    right: float, time_s: float, base: Base, effects: Coefficients, integration: Integration, means: Means,
) -> tuple[float, float, float, float, float, float, float, float]:  # fmt: skip
    """One step of f_theta.

    State: the axle's point (m), cosine and sine of yaw, wheel speeds (rad/s); controls: the commands in force over the
    step (rad/s), after the command delay; the time at its start (s). Returns the state after it, the forward speed over
    it (m/s) and half the yaw rate over it (rad/s). `means`: what terms remember, of commands first, set to what they
    remember at its end; None without such.
    """
    first, next_one = np.uintp(0), np.uintp(1)
    end_left, end_right, mean_left, mean_right = wheel_step(
        left, right, wheel_left, wheel_right, time_s, effects, means, first, next_one
    )
    change = (end_left + end_right) - (wheel_left + wheel_right)
    axle_x, axle_y, cos_yaw, sin_yaw, forward, turn = body_step(
        axle_x, axle_y, cos_yaw, sin_yaw, mean_left + mean_right, mean_right - mean_left, change, time_s,
        base, effects, integration, means, np.uintp(count_means(effects.command_terms)), next_one,
    )  # fmt: skip
    return axle_x, axle_y, cos_yaw, sin_yaw, end_left, end_right, forward, turn


_WHEELS = (Stage.COMMAND, Stage.RESPONSE)
_BODY = (Stage.ROLLING, Stage.VELOCITY, Stage.FORWARD, Stage.TURN, Stage.LATERAL)
_RETURNS = {
    Stage.ROLLING: "wheel_sum, difference",
    Stage.VELOCITY: "forward, turn",
    Stage.FORWARD: "forward",
    Stage.TURN: "turn",
    Stage.WORLD: "x, y",
}
_BOTH_RESPOND = "end_left, end_right, mean_left, mean_right"
_BEGIN_RESPONSE = "end_left, mean_left, end_right, mean_right = left, left, right, right"
_ROLL = ("forward = base.half_radius_m * wheel_sum", "turn = base.half_turn_ratio * difference")


def _arguments_of(effect: Effect) -> tuple[str, ...]:
    assert effect.term is not None
    return arguments_of(effect.term)


def _call(effect: Effect, **instead: str) -> str:
    arguments = (f"effects.{effect.name}" if a == "coefficients" else instead.get(a, a) for a in _arguments_of(effect))
    return f"term_{effect.name}({', '.join(arguments)})"


def _wheel_lines() -> list[str]:
    lines: list[str] = []
    for effect in in_stages(Stage.COMMAND):
        if "command" not in _arguments_of(effect):
            lines.append(f"left, right = {_call(effect)}")
            continue
        lines += [f"{side} = {_call(effect, command=side, speed=f'wheel_{side}')}" for side in ("left", "right")]
    lines.append(_BEGIN_RESPONSE)
    for effect in in_stages(Stage.RESPONSE):
        if "end" not in _arguments_of(effect):
            lines.append(f"{_BOTH_RESPOND} = {_call(effect)}")
            continue
        for side in ("left", "right"):
            call = _call(effect, end=f"end_{side}", mean=f"mean_{side}", speed=f"wheel_{side}")
            lines.append(f"end_{side}, mean_{side} = {call}")
    return [*lines, "return end_left, end_right, mean_left, mean_right"]


def _body_lines() -> list[str]:
    # A lateral speed that is None at first and a number later needs a name of its own every time.
    lines, lateral = ["lateral0 = None"], 0
    lines += [f"{_RETURNS[Stage.ROLLING]} = {_call(effect)}" for effect in in_stages(Stage.ROLLING)]
    lines += _ROLL
    for effect in in_stages(*_BODY[1:]):
        if effect.stage is Stage.LATERAL:
            lines.append(f"lateral{lateral + 1} = plus(lateral{lateral}, {_call(effect)})")
            lateral += 1
        else:
            lines.append(f"{_RETURNS[effect.stage]} = {_call(effect)}")
    return [*lines, f"return forward, lateral{lateral}, turn"]


def _world_lines() -> list[str]:
    return [*(f"{_RETURNS[Stage.WORLD]} = {_call(effect)}" for effect in in_stages(Stage.WORLD)), "return x, y"]


def _change_lines() -> list[str]:
    asking = [f"effects.{effect.name} is not None" for effect in in_stages(*_BODY) if "change" in _arguments_of(effect)]
    return [f"return {' or '.join([*asking, 'terms_need_change(effects.body_terms)'])}"]


def _follow_lines() -> list[str]:
    absent = [f"effects.{effect.name} is None" for effect in in_stages(Stage.DELAY, *_WHEELS)]
    return [f"return {' and '.join([*absent, 'effects.command_terms is None'])}"]


@scalar_function
def _plus(lateral: float | None, more: float | None) -> float | None:
    if lateral is None:
        return more
    if more is None:
        return lateral
    return lateral + more


@scalar_function
def _delay_cells(coefficients: tuple[float, ...] | None) -> int:
    if coefficients is None:
        return 0
    return int(coefficients[0])


def _made(name: str, arguments: str, lines: list[str], summary: str) -> Callable[..., Any]:
    scope: dict[str, Any] = {f"term_{effect.name}": effect.term for effect in REGISTRY.values() if effect.moves}
    scope |= {"plus": _plus, "whole": _delay_cells, "terms_need_change": terms_need_change}
    made = written_out(name, arguments, lines, scope)
    made.__doc__ = summary
    return scalar_function(made)


delay_steps = _made(
    "delay_steps",
    "effects",
    [f"return whole(effects.{DELAY.name})"],
    "Number of whole steps by which commands are held back.",
)
in_force = _made(
    "in_force",
    "recent, older, effects",
    [f"return {_call(DELAY)}"],
    "Mean command over a step, from the command after the whole steps of delay and the one before it.",
)
wheel_terms = _made(
    "wheel_terms",
    "left, right, wheel_left, wheel_right, time_s, effects",
    _wheel_lines(),
    "Wheel speeds at the end of a step, left and right, and their means over it (rad/s), from the commands in force.",
)
body_terms = _made(
    "body_terms",
    "wheel_sum, difference, change, time_s, base, effects",
    _body_lines(),
    "Forward speed (m/s), lateral speed of the axle (m/s) or None, half the yaw rate (rad/s), from the wheels' means.",
)
world_terms = _made(
    "world_terms", "x, y, wheel_sum, difference, time_s, effects", _world_lines(), "Position (m) at the end of a step."
)
needs_change = _made(
    "needs_change",
    "effects",
    _change_lines(),
    "Whether the body's motion depends on the change of the wheel speeds; a constant to the compiler.",
)
wheels_follow = _made(
    "wheels_follow",
    "effects",
    _follow_lines(),
    "Whether the wheels turn as commanded, with nothing in between; a constant to the compiler.",
)


Array = NDArray[np.float64]


class FreeRun:
    """The model at L parameter points `theta` (L, P), in steps of `step_s`, ready to run."""

    def __init__(self, model: Model, theta: Array, step_s: float) -> None:
        self._base, self._effects = coefficient_tables(model, theta, step_s)
        self._series = integration_series(step_s, wide=True)
        delay = getattr(self._effects, DELAY.name)
        self._run: Callable[..., None] | None = None
        self.past_rows = 0 if delay is None else int(delay[0].max()) + 1
        self._has_memory = new_means(self._effects) is not None

    def states(
        self, start: Array, commands: Array, history: int, time_s: float = 0.0, point: int = 0,
        drift: Array = NO_DRIFT_M_S, means: Array | None = None,
    ) -> Array:  # fmt: skip
        """States (N + 1, 5) from `start` (5,): x, y (m), yaw (rad, not wrapped), wheel speeds (rad/s).

        `commands` (history + N, 2) rad/s, each held for a step; the first `history` rows were sent before and must be
        at least `past_rows`. `time_s`: the time at the start, for effects that depend on it. `point`: which of theta.
        `drift` (2,): how fast the ground carries the moving robot along x and y (m/s). `means` (n,): what the model's
        terms remember of what acted up to the start, as `PastMotion` gives it, set to what they remember at the end;
        without them nothing was before.
        """
        states = np.empty((commands.shape[0] - history + 1, 5))
        states[0] = start
        # Fresh copies, as a read-only array or a strided one is another type and would be compiled anew, in mid-loop.
        copied, carried = np.array(commands, dtype=np.float64, order="C"), np.array(drift)
        kept = None if not self._has_memory else new_means(self._effects) if means is None else means
        coefficients = self._base, self._effects, self._series
        arguments = states, copied, history, float(time_s), point, carried, kept, *coefficients
        if self._run is None:
            self._run = compiled_for(run_states, *arguments)
        self._run(*arguments)
        return states


def simulate(model: Model, commands: Array, step_s: float = 0.02, start: Array | None = None) -> Array:
    """Simulate a model's point values: states (N + 1, 5) x, y (m), yaw (rad, not wrapped), wheel speeds (rad/s).

    `commands` (N, 2): wheel speeds wanted, left and right (rad/s), each held for `step_s`; before them the wheels were
    commanded to stand. `start` (5,): the first state, the origin at rest if None. Raises ValueError for other
    shapes and for what is not finite.
    """
    commanded = np.asarray(commands, dtype=np.float64)
    begin = np.zeros(5) if start is None else np.asarray(start, dtype=np.float64)
    if commanded.ndim != 2 or commanded.shape[1] != 2 or begin.shape != (5,):
        raise ValueError(
            f"commands of shape (N, 2) and a start of shape (5,) are needed, not {commanded.shape}, {begin.shape}"
        )
    if not (np.isfinite(commanded).all() and np.isfinite(begin).all()):
        raise ValueError("commands and start have to be finite numbers")
    run = FreeRun(model, model.point()[None], step_s)
    before = np.zeros((run.past_rows, 2))
    return run.states(begin, np.vstack([before, commanded]), run.past_rows)


@kernel_function
def run_states(
    states: Array, commands: Array, history: int, time_s: float, point: int, drift: Array, means: Array | None,
    base: Base, effects: Coefficients, series: NDArray[np.floating],
) -> None:  # fmt: skip
    """Fill `states[1:]` from `states[0]`; as `FreeRun.states`."""
    integration = integration_from(series, True, None)
    here, acting = base_point(base, point), effect_point(effects, point)
    x, y, yaw = states[0, 0], states[0, 1], states[0, 2]
    wheel_left, wheel_right = states[0, 3], states[0, 4]
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    axle_x, axle_y = axle_of(x, y, cos_yaw, sin_yaw, here)
    carried_s = 0.0
    first_row = history - delay_steps(acting)
    for t in range(states.shape[0] - 1):
        was_left, was_right = wheel_left, wheel_right
        recent, older = max(t + first_row, 0), max(t + first_row - 1, 0)
        left = in_force(commands[recent, 0], commands[older, 0], acting)
        right = in_force(commands[recent, 1], commands[older, 1], acting)
        axle_x, axle_y, cos_yaw, sin_yaw, wheel_left, wheel_right, _, turn = step(
            axle_x, axle_y, cos_yaw, sin_yaw, wheel_left, wheel_right, left, right,
            time_s + t * integration.step_s, here, acting, integration, means,
        )  # fmt: skip
        yaw = yaw + (turn + turn) * integration.step_s
        x, y = tracked_of(axle_x, axle_y, cos_yaw, sin_yaw, here)
        turning = 0.5 * (abs(wheel_left + was_left) + abs(wheel_right + was_right))
        carried_s += min(turning / MOVES_RAD_S, 1.0) * integration.step_s
        states[t + 1, 0] = x + carried_s * drift[0]
        states[t + 1, 1] = y + carried_s * drift[1]
        states[t + 1, 2] = yaw
        states[t + 1, 3] = wheel_left
        states[t + 1, 4] = wheel_right
