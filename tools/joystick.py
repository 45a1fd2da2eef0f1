"""Drives by hand of a robot that is tried out, with a joystick's stick or a keyboard's keys, and the log of one."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from disco_hw.log.drive import Commands, DriveLog, Poses, Wheels, differentiate_angle

Array = NDArray[np.float64]

# Commands come every so many steps of the physics that they drive.
STEPS_PER_S, STEPS_PER_COMMAND = 480, 12
COMMANDS_PER_S = STEPS_PER_S // STEPS_PER_COMMAND
TOP_RAD_S = 5.3


def joystick(seed: int, duration_s: float, top_rad_s: float = TOP_RAD_S) -> Array:
    """Wheel-speed commands (N, 2) of a person who tries a robot out: straights, turns, arcs, weaving, pauses, stops.

    A wish is held for some seconds and reached as fast as a thumb moves; the stick is never quite still.
    """
    rng = np.random.default_rng([seed, 4711])
    wishes: list[tuple[float, float, float]] = []
    rows = np.zeros((0, 2))
    while rows.shape[0] < duration_s * COMMANDS_PER_S:
        if not wishes:
            wishes = _round(rng)
        seconds, forward, turn = wishes.pop()
        rows = np.concatenate([rows, np.tile([forward, turn], (round(seconds * COMMANDS_PER_S), 1))])
    rows = rows[: round(duration_s * COMMANDS_PER_S)]
    shaken = rows * (1.0 + 0.021 * _slow(rng, rows.shape, COMMANDS_PER_S / 3))
    stick, thumb, now = np.empty_like(shaken), rng.uniform(2.1, 4.3) / COMMANDS_PER_S, np.zeros(2)
    for k, wish in enumerate(shaken):
        now = now + np.clip(wish - now, -thumb, thumb)
        stick[k] = now
    sides = np.column_stack([stick[:, 0] - stick[:, 1], stick[:, 0] + stick[:, 1]])
    return top_rad_s * np.clip(sides, -1.0, 1.0)


def keyboard(seed: int, duration_s: float, top_rad_s: float) -> Array:
    """Wheel-speed commands (N, 2) of a person with the keys of a keyboard: all or nothing, for some seconds."""
    rng = np.random.default_rng([seed, 5557])
    forward, turn = rng.uniform(0.34, 0.59), rng.uniform(0.13, 0.29)
    keys = [(1.0, 0.0), (1.0, 0.0), (1.0, 0.61), (1.0, -0.61), (0.0, 1.0), (0.0, -1.0), (-1.0, 0.0), (0.0, 0.0)]
    rows = np.zeros((0, 2))
    while rows.shape[0] < duration_s * COMMANDS_PER_S:
        key = keys[rng.integers(len(keys))]
        constant_commands = np.tile(
            [forward * key[0], turn * key[1]], (round(rng.uniform(0.71, 4.1) * COMMANDS_PER_S), 1)
        )
        rows = np.concatenate([rows, constant_commands])
        if rng.random() < 0.17:
            # Faster or slower, by other keys.
            forward = float(np.clip(forward * rng.choice([0.91, 1.11, 1.21]), 0.19, 0.83))
    rows = rows[: round(duration_s * COMMANDS_PER_S)]
    return top_rad_s * np.clip(np.column_stack([rows[:, 0] - rows[:, 1], rows[:, 0] + rows[:, 1]]), -1.0, 1.0)


def _round(rng: np.random.Generator) -> list[tuple[float, float, float]]:
    """Half a minute or so of wishes in some order: seconds, and stick forward and to the left as shares."""
    either = rng.choice([-1.0, 1.0], size=9)
    wishes = [
        (rng.uniform(2, 4), rng.uniform(0.37, 0.93), 0.0),
        (rng.uniform(2, 3), -rng.uniform(0.27, 0.67), 0.0),
        (rng.uniform(2, 4), 0.0, either[0] * rng.uniform(0.32, 0.57)),
        (rng.uniform(1, 3), 0.0, -either[0] * rng.uniform(0.19, 0.44)),
        *((rng.uniform(2, 5), rng.uniform(0.29, 0.66), side * rng.uniform(0.07, 0.29)) for side in either[1:5]),
        (rng.uniform(2, 4), -rng.uniform(0.22, 0.43), either[5] * rng.uniform(0.07, 0.19)),
        (rng.uniform(1, 2), rng.uniform(0.11, 0.27), either[6] * rng.uniform(0.09, 0.23)),
    ]
    wishes = [wishes[place] for place in rng.permutation(len(wishes))]
    # A thumb lets go now and then, for a moment or longer.
    rests = rng.random(len(wishes)) < 0.47
    pauses = [[(rng.uniform(0.61, 1.9), 0.0, 0.0)] if rest else [] for rest in rests]
    return [each for wish, pause in zip(wishes, pauses, strict=True) for each in (wish, *pause)]


def _slow(rng: np.random.Generator, shape: tuple[int, ...], samples: float) -> Array:
    """Noise of unit variance that stays the same for about so many samples."""
    white = rng.standard_normal(shape)
    keep = 1.0 - 1.0 / samples
    for k in range(1, shape[0]):
        white[k] = keep * white[k - 1] + math.sqrt(1.0 - keep * keep) * white[k]
    return white


def recorded_drive(
    source: str, command_s: Array, command: Array, wheel_s: Array, angle: Array, pose_s: Array, pose: Array
) -> DriveLog:
    """The log that a host would have: commands (N, 2) rad/s, wheel angles (M, 2) rad, poses (P, 3) m and rad, by times.

    Wheel speeds are derived from the angles, and nothing interrupts the drive.
    """
    unbroken = [np.zeros(times.size, dtype=np.int64) for times in (command_s, wheel_s, pose_s)]
    speed = [differentiate_angle(wheel_s, angle[:, side], unbroken[1]) for side in (0, 1)]
    return DriveLog(
        (source,),
        Commands(command_s, command[:, 0], command[:, 1], unbroken[0]),
        Wheels(wheel_s, angle[:, 0], angle[:, 1], speed[0], speed[1], unbroken[1], True, False),
        Poses(pose_s, pose[:, 0], pose[:, 1], pose[:, 2], unbroken[2]),
    )
