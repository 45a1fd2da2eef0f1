"""The transition function f_theta: one step of the skid-steer robot with the effects its model has.

Compiled scalar functions, generic in precision. An effect that is absent is None; the compiler sees that in the type of
its argument and leaves nothing of it in the machine code. The same in numpy, for reading: `disco_hw.model.reference`.

    v = r (w_R + w_L) / 2        omega = r (w_R - w_L) / a        v_lateral = -omega x_icr
    x' = v cos(yaw) - v_lateral sin(yaw)      y' = v sin(yaw) + v_lateral cos(yaw)      yaw' = omega
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np

from disco_hw.model.effects import (
    MOTION_EFFECTS,
    acceleration_slip,
    battery_sag,
    deadband,
    lateral_icr,
    motor_lag,
    side_slip,
    slope,
    speed_limit,
    stiction,
    surface_change,
    turn_slip,
    wheel_gain,
    wheel_radius_asymmetry,
    yaw_rate_limit,
)
from disco_hw.model.jit import cast_like, scalar_function

# A field for every effect that moves the robot: None where absent, else what the effect's `coefficients` returned.
effects_type: Any = namedtuple
Effects = effects_type("Effects", MOTION_EFFECTS)


class Base(NamedTuple):
    """Base coefficients of one parameter point, or arrays (L,) of many: r/2 (m), r/(2a) (1), x_icr (m)."""

    half_radius_m: Any
    half_turn_ratio: Any
    x_icr_m: Any


class Integration(NamedTuple):
    """Length of a step as its series need it (powers over factorials), and `wide`: 1/16 if a step may turn far.

    sin(z)/z and cos(z) of half a step's turn, z = rate * step, are polynomials in rate^2. `wide` is None if no step
    turns the robot by more than 0.4 rad.
    """

    step_s: Any
    sinc1: Any
    sinc2: Any
    sinc3: Any
    cos1: Any
    cos2: Any
    cos3: Any
    wide: Any


def integration_of(step_s: float, wide: bool, dtype: type = np.float64) -> Integration:
    """Series of the exact arc for steps of `step_s`: good to 1e-7 for turns of 0.4 rad a step, `wide` for 8 rad."""
    h = step_s / 16.0 if wide else step_s
    h2 = h * h
    return Integration(
        dtype(step_s),
        dtype(-h2 / 6),
        dtype(h2**2 / 120),
        dtype(-(h2**3) / 5040),
        dtype(-h2 / 2),
        dtype(h2**2 / 24),
        dtype(-(h2**3) / 720),
        dtype(h) if wide else None,
    )


@scalar_function
def follows_wheels(effects: Any) -> Any:
    """Whether the state must carry wheel speeds; a constant to the compiler."""
    return (effects.motor_lag is not None) or (effects.stiction is not None) or (effects.acceleration_slip is not None)


@scalar_function
def wheel_step(left: Any, right: Any, wheel_left: Any, wheel_right: Any, time_s: Any, effects: Any) -> Any:
    """Wheel speeds at the end of a step and their means over it, left and right (rad/s).

    From the commands (after the command delay), the wheel speeds at the start of the step and its time.
    """
    left = deadband.term(left, effects.deadband)
    right = deadband.term(right, effects.deadband)
    left, right = yaw_rate_limit.term(left, right, effects.yaw_rate_limit)
    left = speed_limit.term(left, effects.speed_limit)
    right = speed_limit.term(right, effects.speed_limit)
    left, right = wheel_gain.term(left, right, effects.wheel_gain)
    left, right = battery_sag.term(left, right, time_s, effects.battery_sag)
    left = stiction.term(left, wheel_left, effects.stiction)
    right = stiction.term(right, wheel_right, effects.stiction)
    end_left, mean_left = motor_lag.term(left, wheel_left, effects.motor_lag)
    end_right, mean_right = motor_lag.term(right, wheel_right, effects.motor_lag)
    return end_left, end_right, mean_left, mean_right


@scalar_function
def body_velocity(mean_left: Any, mean_right: Any, wheel_change: Any, time_s: Any, base: Any, effects: Any) -> Any:
    """Forward speed (m/s), lateral speed of the axle (m/s) or None, and half the yaw rate (rad/s).

    From the mean wheel speeds over a step, the change of their sum (rad/s), and the time at its start.
    """
    mean_left, mean_right = wheel_radius_asymmetry.term(mean_left, mean_right, effects.wheel_radius_asymmetry)
    forward = base.half_radius_m * (mean_left + mean_right)
    turn = base.half_turn_ratio * (mean_right - mean_left)
    forward, turn = surface_change.term(forward, turn, time_s, effects.surface_change)
    turn = turn_slip.term(turn, effects.turn_slip)
    forward = acceleration_slip.term(forward, wheel_change, effects.acceleration_slip)
    lateral = side_slip.term(forward, turn, effects.side_slip)
    forward = lateral_icr.term(forward, turn, effects.lateral_icr)
    return forward, lateral, turn


@scalar_function
def half_turn(turn: float, wide: Any, series: Any) -> Any:
    """Sine over angle, and cosine, of the turn in half a step; `turn` is half the yaw rate (rad/s)."""
    q = turn * turn
    one = cast_like(1.0, q)
    if wide is None:
        return one + q * (series.sinc1 + q * series.sinc2), one + q * (series.cos1 + q * series.cos2)
    sinc = one + q * (series.sinc1 + q * (series.sinc2 + q * series.sinc3))
    cosine = one + q * (series.cos1 + q * (series.cos2 + q * series.cos3))
    # Doubled four times, by way of sine and 1 - cosine, which lose no precision near zero.
    two = cast_like(2.0, q)
    sine = turn * wide * sinc
    for _ in range(4):
        sinc, sine, cosine = sinc * cosine, two * sine * cosine, one - two * sine * sine
    return sinc, cosine


@scalar_function
def sideways(lateral: Any, chord: float, x: float, y: float, cos_mid: float, sin_mid: float) -> Any:
    """Add the lateral part of a step to a position; nothing if there is none."""
    if lateral is None:
        return x, y
    across = lateral * chord
    return x - across * sin_mid, y + across * cos_mid


@scalar_function
def move(
    x: float, y: float, cos_yaw: float, sin_yaw: float, forward: float, lateral: Any, turn: float, integration: Any
) -> Any:
    """Move the axle's centre along the exact arc of a constant body velocity; returns x, y, cos(yaw), sin(yaw)."""
    sinc, cosine = half_turn(turn, integration.wide, integration)
    chord = integration.step_s * sinc
    sine = turn * chord
    cos_mid = cos_yaw * cosine - sin_yaw * sine
    sin_mid = sin_yaw * cosine + cos_yaw * sine
    along = forward * chord
    x, y = sideways(lateral, chord, x + along * cos_mid, y + along * sin_mid, cos_mid, sin_mid)
    return x, y, cos_mid * cosine - sin_mid * sine, sin_mid * cosine + cos_mid * sine


@scalar_function
def axle_of(x: Any, y: Any, cos_yaw: Any, sin_yaw: Any, base: Any) -> Any:
    """Point of the axle, x_icr ahead of the tracked point, that rolls without sliding sideways.

    It moves as a unicycle whatever x_icr is, so the step is worked out for it.
    """
    return x + base.x_icr_m * cos_yaw, y + base.x_icr_m * sin_yaw


@scalar_function
def tracked_of(axle_x: Any, axle_y: Any, cos_yaw: Any, sin_yaw: Any, base: Any) -> Any:
    """The tracked point, from the axle's point."""
    return axle_x - base.x_icr_m * cos_yaw, axle_y - base.x_icr_m * sin_yaw


@scalar_function
def step(
    axle_x: Any, axle_y: Any, cos_yaw: Any, sin_yaw: Any, wheel_left: Any, wheel_right: Any, left: Any, right: Any,
    time_s: Any, base: Any, effects: Any, integration: Any,
) -> Any:  # fmt: skip
    """One step of f_theta.

    State: the axle's point (m), cosine and sine of yaw, wheel speeds (rad/s); controls: the commands in force over the
    step (rad/s), after the command delay; the time at its start (s). Returns the state after it, the forward speed over
    it (m/s) and half the yaw rate over it (rad/s).
    """
    end_left, end_right, mean_left, mean_right = wheel_step(left, right, wheel_left, wheel_right, time_s, effects)
    change = (end_left + end_right) - (wheel_left + wheel_right)
    forward, lateral, turn = body_velocity(mean_left, mean_right, change, time_s, base, effects)
    axle_x, axle_y, cos_yaw, sin_yaw = move(axle_x, axle_y, cos_yaw, sin_yaw, forward, lateral, turn, integration)
    axle_x, axle_y = slope.term(axle_x, axle_y, mean_left, mean_right, effects.slope)
    return axle_x, axle_y, cos_yaw, sin_yaw, end_left, end_right, forward, turn
