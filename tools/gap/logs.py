"""Simulated logs for judging the search for missing effects; what is true stays here, only the log is handed on."""

from __future__ import annotations

import math

import numpy as np

from disco_hw.drive.script import Script
from disco_hw.log.drive import DriveLog
from disco_hw.runtime.pipeline import Governor, WheelLimits
from sim.effects import EFFECTS, HiddenEffects, hidden_effects
from sim.plant_parameters import PlantParameters
from tools.joystick import recorded_drive
from tools.simulated_drives import ScriptedDrive, create_drive
from tools.simulated_log import LogOptions, dirty_log_options, dirty_parameters, simulated_log, varied_parameters

# What a robot.toml sets if it says nothing else.
LARGEST_RAD_S, LARGEST_RAD_S2 = 8.0, 20.0
NAMED = tuple(name for name in EFFECTS if not name.startswith("x_"))
# Sizes are drawn by an effect's place: new effects come last, so that the logs of before stay as they are.
_LATER = ("acceleration_limit",)
_PLACES = (*sorted(EFFECTS.keys() - _LATER), *_LATER)


def simulated_drive(
    hide: dict[str, float | tuple[float, ...]] | None = None,
    seed: int = 0,
    drive: str = "rich",
    dirty: bool = False,
    motors: str = "ideal",
    robot: int | None = None,
    script: Script | None = None,
) -> DriveLog:
    """A log of a robot off its drawing with these effects hidden in it.

    `seed` decides drive, noise and robot; `robot` is a seed for the robot's geometry alone. `script`: a script of
    `disco-hw drive` that is driven after the drive.
    """
    parameters = varied_parameters(PlantParameters(), seed if robot is None else robot)
    if motors == "ideal":
        parameters = parameters.with_ideal_motors()
    options = LogOptions()
    if dirty:
        parameters, options = dirty_parameters(parameters), dirty_log_options()
    effects: HiddenEffects = hidden_effects(hide or {})
    driven = create_drive(drive, seed)
    if script is not None:
        driven = then_scripted(driven, script)
    rows = simulated_log(driven, parameters, effects, seed, options)
    return as_drive(rows[:, 0] - rows[0, 0], rows[:, 1:], parameters.ticks_per_rev)


def then_scripted(drive: ScriptedDrive, script: Script) -> ScriptedDrive:
    """A drive, and then a script as the commands that `disco-hw drive` sends: held to the usual acceleration."""
    t_s = np.arange(0.0, script.duration_s, drive.period_s)
    governor = Governor(WheelLimits(LARGEST_RAD_S, LARGEST_RAD_S2, LARGEST_RAD_S2), drive.period_s)
    sent = [governor.step(*script.at(float(t)), drive.period_s) for t in t_s]
    wheels = np.array([(command.left_rad_s, command.right_rad_s) for command in sent])
    return ScriptedDrive(
        f"{drive.name} and {script.name}",
        drive.period_s,
        np.concatenate([drive.t_s, drive.duration_s + t_s]),
        np.concatenate([drive.left_rad_s, wheels[:, 0]]),
        np.concatenate([drive.right_rad_s, wheels[:, 1]]),
        (*drive.phase, *("scripted",) * t_s.size),
    )


def as_drive(t_s: np.ndarray, cells: np.ndarray, ticks_per_rev: int) -> DriveLog:
    """Rows of a log (N,), (N, 7) as a drive; the columns are those of `tools.simulated_log` after the time."""

    def group(first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
        there = np.isfinite(cells[:, first])
        times, index = np.unique(t_s[there], return_index=True)
        return times, cells[there][index, first:last]

    wheel_s, ticks = group(2, 4)
    angle = ticks * (2.0 * math.pi / ticks_per_rev)
    return recorded_drive("simulated", *group(0, 2), wheel_s, angle, *group(4, 7))


def realistic(name: str, seed: int, share: float = 1.0) -> dict[str, float | tuple[float, ...]]:
    """An effect of realistic size, either sign where it has one; `share` makes it smaller."""
    generator = np.random.default_rng([seed, _PLACES.index(name)])
    spec = EFFECTS[name]
    drawn = {value.name: float(generator.uniform(*value.realistic)) for value in spec.values}
    sign = float(generator.choice([-1.0, 1.0]))
    signed = name in {
        "wheel_gain",
        "encoder_scale",
        "wheel_radius_asymmetry",
        "lateral_icr",
        "pose_offset",
        "heading_bias",
        "surface_change",
    }
    if name == "surface_change":
        return {name: (share * sign * drawn["track"], drawn["time_s"], share * -drawn["radius"])}
    if name == "slope":
        return {name: (share * drawn["drift_m_s"], float(generator.uniform(-math.pi, math.pi)))}
    if name in {"speed_limit", "yaw_rate_limit"}:
        top = 7.6 if name == "speed_limit" else 1.5
        return {name: top - share * (top - drawn["limit_rad_s"])}
    if name in {"yaw_acceleration_limit", "acceleration_limit"}:
        return {name: drawn["limit_rad_s2"] / share}
    if name == "x_second_order_motor":
        return {name: (drawn["natural_frequency_rad_s"], drawn["damping"])}
    if name == "x_saturating_turn_slip":
        return {name: (drawn["k_s"], drawn["omega_0_rad_s"])}
    if name == "x_carpet_patch":
        return {name: (drawn["track"],)}
    value = drawn[spec.values[spec.lone[0]].name]
    return {name: share * value * (sign if signed else 1.0)}
