"""A robot with motors that lag, to which something happens once; it shares no constant with the search."""

import math

import numpy as np

from disco_hw.log.drive import Commands, DriveLog, Poses, Wheels, differentiate_angle
from tools.joystick import COMMANDS_PER_S, joystick

RADIUS_M, AXIAL_M, AHEAD_M = 0.0771, 0.541, 0.087
STEPS_PER_S, STEPS_A_READING, STEPS_A_POSE = 400, 8, 20
COUNTS_PER_TURN = 3071


def driven(seed, duration_s, blocked=(), slipping=(), late=(), turn_slip_s=0.0, lag_s=0.021, delay_s=0.0):
    """The log of a drive by joystick.

    `blocked`: (begin_s, duration_s, sides) in which wheels do not turn; `slipping`: (begin_s, duration_s, share) in
    which the body moves by this share of what its wheels say; `late`: (begin_s, duration_s), for which new commands
    wait.
    """
    rng = np.random.default_rng([seed, 6131])
    commands = joystick(seed, duration_s)
    dt, every = 1.0 / STEPS_PER_S, STEPS_PER_S // COMMANDS_PER_S
    requested = np.repeat(commands, every, axis=0)
    requested = requested[np.maximum(np.arange(requested.shape[0]) - round(delay_s * STEPS_PER_S), 0)]
    t_s = dt * np.arange(requested.shape[0])
    if late:
        waits = (t_s >= late[0]) & (t_s < late[0] + late[1])
        requested[waits] = 0.0
    held = np.zeros(requested.shape, dtype=bool)
    if blocked:
        held[np.ix_((t_s >= blocked[0]) & (t_s < blocked[0] + blocked[1]), blocked[2])] = True
    grip = np.ones(t_s.size)
    if slipping:
        grip[(t_s >= slipping[0]) & (t_s < slipping[0] + slipping[1])] = slipping[2]
    keep, mixed = math.exp(-dt / 0.11), -math.expm1(-dt / lag_s)
    ripples, shocks = (each.tolist() for each in rng.standard_normal((2, t_s.size, 2)) * math.sqrt(1.0 - keep**2))
    # Plain floats: arrays of two numbers would take ten times as long.
    speed, rough, slip = [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]
    wheel_rad, rolled_m = [0.0, 0.0], [0.0, 0.0]
    x_m = y_m = yaw_rad = 0.0
    angles, path = [], []
    for wanted, is_held, ripple, shock, share in zip(
        requested.tolist(), held.tolist(), ripples, shocks, grip.tolist(), strict=True
    ):
        for side in (0, 1):
            rough[side] = keep * rough[side] + 0.009 * ripple[side]
            slip[side] = keep * slip[side] + 0.008 * shock[side]
            speed[side] = 0.0 if is_held[side] else speed[side] + (wanted[side] - speed[side]) * mixed
            turned = speed[side] * (1.0 + rough[side]) * dt
            wheel_rad[side] += turned
            rolled_m[side] = RADIUS_M * turned * (1.0 + slip[side]) * share
        turn = (rolled_m[1] - rolled_m[0]) / AXIAL_M
        turn /= 1.0 + turn_slip_s * abs(turn) / dt
        ahead, middle = 0.5 * (rolled_m[0] + rolled_m[1]), yaw_rad + 0.5 * turn
        aside = -AHEAD_M * turn
        cosine, sine = math.cos(middle), math.sin(middle)
        x_m, y_m, yaw_rad = x_m + (cosine * ahead - sine * aside), y_m + (sine * ahead + cosine * aside), yaw_rad + turn
        angles.append(tuple(wheel_rad))
        path.append((x_m, y_m, yaw_rad))
    angles, path = np.array(angles), np.array(path)
    read, seen = np.arange(0, t_s.size, STEPS_A_READING), np.arange(0, t_s.size, STEPS_A_POSE)
    count = 2.0 * math.pi / COUNTS_PER_TURN
    counted = np.round(angles[read] / count) * count
    poses = path[seen] + rng.standard_normal((seen.size, 3)) * (0.0031, 0.0031, 0.0043)
    sent_s = np.arange(commands.shape[0]) / COMMANDS_PER_S
    none = [np.zeros(each.size, dtype=np.int64) for each in (sent_s, read, seen)]
    speeds = [differentiate_angle(t_s[read], counted[:, side], none[1]) for side in (0, 1)]
    return DriveLog(
        ("eventful",),
        Commands(sent_s, commands[:, 0], commands[:, 1], none[0]),
        Wheels(t_s[read], counted[:, 0], counted[:, 1], *speeds, none[1], True, False),
        Poses(t_s[seen], poses[:, 0], poses[:, 1], poses[:, 2], none[2]),
    )


def moments(seed, duration_s, lasting_s):
    """Times (s) at which a drive begins from standstill, and from which it goes on at some speed for `lasting_s`."""
    commands = joystick(seed, duration_s)
    size, span = np.abs(commands), round(lasting_s * COMMANDS_PER_S)
    rests = size.max(axis=1) == 0.0
    begins = np.flatnonzero(rests[:-1] & ~rests[1:])
    starts = [k for k in begins if k > 100 and rests[k - 20 : k].all() and size[k + 20 : k + 60].min() > 0.3]
    fast = size.min(axis=1) > 1.5
    even = [k for k in range(200, fast.size - 2 * span) if fast[k - 20 : k + span + 20].all()]
    return np.array(starts) / COMMANDS_PER_S, np.array(even) / COMMANDS_PER_S
