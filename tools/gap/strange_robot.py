"""A robot with imperfections that neither the model's effects nor the search's unnamed terms have the form of.

It shares no constant and no equation with the virtual robot or with the model (`tests/tools/test_strange_robot.py`
holds it to that), is driven as a person does with a joystick, and hides one of eleven FORMS at a time. Its motors are
as they are: a lag and a delay of their own, which a search may name. Poses carry white noise of POSITION_STD_M on each
axis and YAW_STD_RAD, encoders count in steps of 2 pi / COUNTS_PER_TURN. Stamps are exact.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from disco_hw.log.drive import DriveLog
from tools.joystick import STEPS_PER_COMMAND, STEPS_PER_S, joystick, recorded_drive

Array = NDArray[np.float64]

COMMANDS_PER_S = STEPS_PER_S // STEPS_PER_COMMAND
STEPS_A_COMMAND = 9
STEPS_A_READING, STEPS_A_POSE = 6, 11
COUNTS_PER_TURN = 3170
POSITION_STD_M, YAW_STD_RAD = 0.0027, 0.0034
NOMINAL = (0.0783, 0.527, 0.163)
"""Wheel radius, effective axial distance and the distance of the centre of turning of the drawing, m."""
DURATION_S = 147.0
SLIP_SHARE, SLIP_MEMORY_S = 0.0073, 0.092

FORMS: Mapping[str, Mapping[str, tuple[float, float]]] = MappingProxyType(
    {
        "hysteresis": {"half_width_rad_s": (0.17, 0.43)},
        "stribeck_friction": {
            "sliding_rad_s": (0.11, 0.19), "breakaway_rad_s": (0.47, 0.83), "fading_rad_s": (0.57, 0.93),
        },
        "tyre_relaxation": {"length_m": (0.053, 0.127)},
        "backlash": {"play_rad": (0.072, 0.137)},
        "com_shift": {"compliance_s2": (0.031, 0.067), "memory_s": (0.28, 0.49)},
        "time_varying_friction": {"share": (0.083, 0.163), "period_s": (38.0, 71.0)},
        "cross_coupled_supply": {"share_s_rad": (0.0089, 0.0173), "memory_s": (0.43, 1.27)},
        "gear_eccentricity": {"error_rad": (0.029, 0.057), "ratio": (2.63, 4.37)},
        "thermal_fade": {"most_share": (0.093, 0.173), "memory_s": (33.0, 57.0)},
        "rate_dependent_latency": {"most_s": (0.131, 0.237), "half_rad_s": (0.073, 0.139)},
        "speed_loop": {"damping": (0.37, 0.53), "frequency_rad_s": (7.3, 11.9)},
    }
)  # fmt: skip
"""Every form's parameters with the ranges that they are drawn from."""

KIN = {
    "stribeck_friction": ("deadband", "stiction"),
    "backlash": ("stiction",),
    "cross_coupled_supply": ("battery_sag",),
    "thermal_fade": ("battery_sag",),
    "rate_dependent_latency": ("command_delay",),
}
"""Names that are of a form's physical family, though not of its equation."""
MOTORS = ("motor_lag", "command_delay")
"""What the motors really have, whatever is hidden."""


@dataclass
class _Wheel:
    """State of one side: what is requested of the motor, its speed, heat and angle, and the angle beyond the gear."""

    hysteresis_rad_s: float = 0.0
    regulated_rad_s: float = 0.0
    growth_rad_s2: float = 0.0
    speed: float = 0.0
    heat: float = 0.0
    angle: float = 0.0
    rolled: float = 0.0
    caught: float = 0.0


@dataclass
class _Body:
    """The body's pose and what of its motion it remembers; `axial`, `ahead`: turning resistance and centre, m."""

    axial: float
    ahead: float
    phase: float
    t: float = 0.0
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    forward: float = 0.0
    turning: float = 0.0
    sideways: float = 0.0
    slid: float = 0.0

    def move(self, form: str | None, values: Mapping[str, float], rim: Array, dt: float) -> None:
        """Move on by `dt` with these speeds of the rims, m/s."""
        forward, turning, centre = float(rim.mean()), float(rim[1] - rim[0]) / self.axial, self.ahead
        if form == "time_varying_friction":
            wave = math.sin(2.0 * math.pi * self.t / values["period_s"] + self.phase)
            turning /= 1.0 + values["share"] * wave
        if form == "tyre_relaxation":
            # Rubber has to roll for a length before it carries what it is steered to.
            carried = -math.expm1(-float(np.abs(rim).mean()) * dt / values["length_m"])
            turning = self.turning + (turning - self.turning) * carried
        if form == "com_shift":
            compliance, share = values["compliance_s2"], dt / values["memory_s"]
            self.slid += (-compliance * (forward - self.forward) / dt - self.slid) * share
            self.sideways += (compliance * forward * turning - self.sideways) * share
            centre += self.slid
        middle = self.yaw + 0.5 * turning * dt
        along, across = (forward + self.sideways * turning) * dt, -centre * turning * dt
        self.x += math.cos(middle) * along - math.sin(middle) * across
        self.y += math.sin(middle) * along + math.cos(middle) * across
        self.yaw += turning * dt
        self.forward, self.turning, self.t = forward, turning, self.t + dt


@dataclass(frozen=True)
class Recording:
    """Recording of a drive: what is logged, and the true poses (N, 3) at the times of the measured ones."""

    log: DriveLog
    truth: Array
    values: Mapping[str, float] = field(default_factory=dict)


def sampled_parameters(form: str, seed: int) -> dict[str, float]:
    """A form's parameters for a seed; raises KeyError for a form that does not exist."""
    rng = np.random.default_rng([seed, 8311, list(FORMS).index(form)])
    return {name: float(rng.uniform(*ends)) for name, ends in FORMS[form].items()}


def record(form: str | None, seed: int, command: Array | None = None, share: float = 1.0) -> Recording:
    """Drive a robot off its drawing with a form hidden in it, or none; `command`: (N, 2), in place of the joystick's.

    `share` scales the first parameter of the form.
    """
    values = {} if form is None else sampled_parameters(form, seed)
    if values:
        values[next(iter(values))] *= share
    rng = np.random.default_rng([seed, 9173])
    radius, axial, ahead = (each * (1.0 + rng.uniform(-0.047, 0.047)) for each in NOMINAL)
    lag_s, delay_s = rng.uniform(0.033, 0.062), rng.uniform(0.021, 0.039)
    commands = joystick(seed, DURATION_S) if command is None else command
    steps_per_s = COMMANDS_PER_S * STEPS_A_COMMAND
    dt, steps = 1.0 / steps_per_s, commands.shape[0] * STEPS_A_COMMAND
    arrival = _arrivals(commands, delay_s, values if form == "rate_dependent_latency" else None)
    wheels, in_force, following = (_Wheel(), _Wheel()), (0.0, 0.0), 0
    body = _Body(axial, ahead, float(rng.uniform(-math.pi, math.pi)))
    phases, drained = rng.uniform(-math.pi, math.pi, 2), 0.0
    noise, keep = np.zeros(2), math.exp(-dt / SLIP_MEMORY_S)
    shocks = rng.standard_normal((steps, 2)) * SLIP_SHARE * math.sqrt(1.0 - keep**2)
    angles, path = np.empty((steps, 2)), np.empty((steps, 3))
    for k in range(steps):
        while following < len(arrival) and arrival[following] <= k * dt:
            in_force, following = tuple(commands[following]), following + 1
        if form == "cross_coupled_supply":
            drain = values["share_s_rad"] * (abs(wheels[0].speed) + abs(wheels[1].speed))
            drained += (drain - drained) * dt / values["memory_s"]
        rim = np.empty(2)
        for side, wheel in enumerate(wheels):
            target = _target_speed(form, values, wheel, in_force[side], dt) * (1.0 - drained)
            wheel.speed += (target - wheel.speed) * -math.expm1(-dt / lag_s)
            wheel.angle += wheel.speed * dt
            if form == "thermal_fade":
                load = min(abs(wheel.speed) / 3.7, 1.0)
                wheel.heat += (load - wheel.heat) * dt / values["memory_s"]
            rolled = _beyond_gear(form, values, wheel, float(phases[side]))
            rim[side], wheel.rolled = (rolled - wheel.rolled) / dt * radius, rolled
        noise = keep * noise + shocks[k]
        body.move(form, values, rim * (1.0 + noise), dt)
        angles[k], path[k] = (wheels[0].angle, wheels[1].angle), (body.x, body.y, body.yaw)
    return _measured(commands, angles, path, rng, values)


def _arrivals(commands: Array, delay_s: float, values: Mapping[str, float] | None) -> Array:
    """When each command takes effect, s: later the more it differs from the one before, and never out of order."""
    sent = np.arange(commands.shape[0]) / COMMANDS_PER_S
    delays_s = np.full(sent.size, delay_s)
    if values is not None:
        change = np.abs(np.diff(commands, axis=0, prepend=commands[:1])).max(axis=1)
        delays_s += values["most_s"] * change / (change + values["half_rad_s"])
    return np.maximum.accumulate(sent + delays_s)


def _target_speed(form: str | None, values: Mapping[str, float], wheel: _Wheel, command: float, dt: float) -> float:
    """The speed that a motor is after under a command."""
    if form == "hysteresis":
        half = values["half_width_rad_s"]
        wheel.hysteresis_rad_s = min(max(wheel.hysteresis_rad_s, command - half), command + half)
        return wheel.hysteresis_rad_s
    if form == "stribeck_friction":
        sliding, breakaway = values["sliding_rad_s"], values["breakaway_rad_s"]
        fading = math.exp(-((wheel.speed / values["fading_rad_s"]) ** 2))
        return math.copysign(max(abs(command) - sliding - (breakaway - sliding) * fading, 0.0), command)
    if form == "thermal_fade":
        return command * (1.0 - values["most_share"] * wheel.heat)
    if form == "speed_loop":
        # A controller that is tuned too sharply overshoots, and swings.
        frequency, before = values["frequency_rad_s"], wheel.regulated_rad_s
        pulled = frequency**2 * (command - before) - 2.0 * values["damping"] * frequency * wheel.growth_rad_s2
        wheel.growth_rad_s2 += pulled * dt
        wheel.regulated_rad_s += wheel.growth_rad_s2 * dt
        return wheel.regulated_rad_s
    return command


def _beyond_gear(form: str | None, values: Mapping[str, float], wheel: _Wheel, phase: float) -> float:
    """The angle that a wheel has rolled, of the motor's, which is the one that is measured."""
    if form == "backlash":
        half = 0.5 * values["play_rad"]
        wheel.caught = min(max(wheel.caught, wheel.angle - half), wheel.angle + half)
        return wheel.caught
    if form == "gear_eccentricity":
        off = math.sin(values["ratio"] * wheel.angle + phase) - math.sin(phase)
        return wheel.angle + values["error_rad"] * off
    return wheel.angle


def _measured(
    commands: Array, angles: Array, path: Array, rng: np.random.Generator, values: Mapping[str, float]
) -> Recording:
    """Return the recording of a drive: commands as sent, counted angles, noisy poses."""
    steps_per_s = COMMANDS_PER_S * STEPS_A_COMMAND
    reading, posed = (np.arange(every - 1, angles.shape[0], every) for every in (STEPS_A_READING, STEPS_A_POSE))
    count = 2.0 * math.pi / COUNTS_PER_TURN
    seen = np.round(angles[reading] / count) * count
    reading_s, posed_s, sent_s = (reading + 1) / steps_per_s, (posed + 1) / steps_per_s, np.arange(len(commands))
    poses = path[posed] + rng.standard_normal((posed.size, 3)) * (POSITION_STD_M, POSITION_STD_M, YAW_STD_RAD)
    log = recorded_drive("strange", sent_s / COMMANDS_PER_S, commands, reading_s, seen, posed_s, poses)
    return Recording(log, path[posed], values)
