"""The transition function f_theta: one step of the skid-steer robot with the effects its model has.

Compiled scalar functions, generic in precision. An effect that is absent is None; the compiler sees that in the type of
its argument and leaves nothing of it in the machine code. The same in numpy, for reading: `disco_hw.model.plain`.

    v = r (w_R + w_L) / 2        omega = r (w_R - w_L) / a        v_lateral = -omega x_icr
    x' = v cos(yaw) - v_lateral sin(yaw)      y' = v sin(yaw) + v_lateral cos(yaw)      yaw' = omega
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from disco_hw.jit import cast_like, scalar_function
from disco_hw.model.coefficients import Base, Coefficients, Integration
from disco_hw.model.compose import body_terms, wheel_terms, world_terms
from disco_hw.model.terms import add_to_commands, add_to_velocity


def integration_series(step_s: float, wide: bool, dtype: type = np.float64) -> NDArray[np.floating]:
    """Series of the exact arc for steps of `step_s`, (8,): to 1e-7 for turns of 0.4 rad a step, `wide` for 8."""
    h = step_s / 16.0 if wide else step_s
    h2 = h * h
    chord = (step_s, -step_s * h2 / 6, step_s * h2**2 / 120, -step_s * h2**3 / 5040)
    return np.array([step_s, *chord, -h2 / 2, h2**2 / 24, -(h2**3) / 720], dtype=dtype)


@scalar_function
def integration_from(series: NDArray[np.floating], wide: object) -> Integration:
    """What a step needs, from `integration_series`; `wide` is None or anything else."""
    return Integration(series[0], series[1], series[2], series[3], series[4], series[5], series[6], series[7], wide)


@scalar_function
def wheel_step(
    left: float, right: float, wheel_left: float, wheel_right: float, time_s: float, effects: Coefficients
) -> tuple[float, float, float, float]:
    """Wheel speeds at the end of a step and their means over it, left and right (rad/s).

    From the commands (after the command delay), the wheel speeds at the start of the step and its time.
    """
    left, right = add_to_commands(left, right, time_s, effects.command_terms)
    turned: tuple[float, float, float, float] = wheel_terms(left, right, wheel_left, wheel_right, time_s, effects)
    return turned


@scalar_function
def body_velocity(
    wheel_sum: float, difference: float, change: float, time_s: float, base: Base, effects: Coefficients
) -> tuple[float, float | None, float]:
    """Forward speed (m/s), lateral speed of the axle (m/s) or None, and half the yaw rate (rad/s).

    From the mean wheel speeds over a step, left plus right and right minus left, the change of their sum over it
    (rad/s), and the time at its start (s).
    """
    forward, lateral, turn = body_terms(wheel_sum, difference, change, time_s, base, effects)
    return add_to_velocity(
        forward, lateral, turn, wheel_sum, difference, change, time_s, base, effects.body_terms
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
    """The tracked point, from the axle's point."""
    return axle_x - base.x_icr_m * cos_yaw, axle_y - base.x_icr_m * sin_yaw


@scalar_function
def body_step(
    axle_x: float, axle_y: float, cos_yaw: float, sin_yaw: float, wheel_sum: float, difference: float, change: float,
    time_s: float, base: Base, effects: Coefficients, integration: Integration,
) -> tuple[float, float, float, float, float, float]:  # fmt: skip
    """The body's half of a step: the axle's point (m), cosine and sine of yaw after it; forward speed (m/s) and half
    the yaw rate (rad/s) over it. Wheel speeds as for `body_velocity`.
    """
    forward, lateral, turn = body_velocity(wheel_sum, difference, change, time_s, base, effects)
    axle_x, axle_y, cos_yaw, sin_yaw = move(axle_x, axle_y, cos_yaw, sin_yaw, forward, lateral, turn, integration)
    axle_x, axle_y = world_terms(axle_x, axle_y, wheel_sum, difference, time_s, effects)
    return axle_x, axle_y, cos_yaw, sin_yaw, forward, turn


@scalar_function
def step(
    axle_x: float, axle_y: float, cos_yaw: float, sin_yaw: float, wheel_left: float, wheel_right: float, left: float,
    right: float, time_s: float, base: Base, effects: Coefficients, integration: Integration,
) -> tuple[float, float, float, float, float, float, float, float]:  # fmt: skip
    """One step of f_theta.

    State: the axle's point (m), cosine and sine of yaw, wheel speeds (rad/s); controls: the commands in force over the
    step (rad/s), after the command delay; the time at its start (s). Returns the state after it, the forward speed over
    it (m/s) and half the yaw rate over it (rad/s).
    """
    end_left, end_right, mean_left, mean_right = wheel_step(left, right, wheel_left, wheel_right, time_s, effects)
    change = (end_left + end_right) - (wheel_left + wheel_right)
    axle_x, axle_y, cos_yaw, sin_yaw, forward, turn = body_step(
        axle_x, axle_y, cos_yaw, sin_yaw, mean_left + mean_right, mean_right - mean_left, change, time_s,
        base, effects, integration,
    )  # fmt: skip
    return axle_x, axle_y, cos_yaw, sin_yaw, end_left, end_right, forward, turn
