"""Driving along the task's line: the commands of a steering law.

One more sample, the guide, is the commands of a steering law that follows the line from where the robot is. Samples
lie around the last plan and cut the corners that it cuts. Turning before a corner comes first, then a worse cost, then
a better one: no small change of a plan finds it. The law does at once, as it acts on the centre of rotation along the
stable inverse (tasks/line/course.py) of the line. The guide is costed as every sample is; how the planner goes over to
it is written in `Disco`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from disco_hw.control.kernel import (
    CARRIED_X,
    CARRIED_Y,
    START_COS,
    START_LEFT,
    START_MEMORY,
    START_RIGHT,
    START_SIN,
    START_X,
    START_Y,
    Floats,
    Terms,
    line_at,
    place_of,
)
from disco_hw.control.kernel.sequences import Limits, clip
from disco_hw.jit import kernel_function, scalar_function
from disco_hw.model.drift import MOVES_RAD_S

# The law's gains (1/m): of the heading, and of the distance, which the robot comes back from at this angle a metre.
YAW_PER_M, ANGLE_PER_M = 9.0, 3.3
# Over so much of the way is the line's turning taken; a corner is turned about within it.
TURN_M = 0.04
# Between two points so far apart the line is straight.
NEARBY_M = 1e-3
# Below this a command is lifted over the dead band in part, so that a wheel at rest does not chatter (rad/s).
LIFTED_RAD_S = 0.05
# A robot that faces elsewhere goes on at this part of its speed: turning on the spot by the middle of a bend, it could
# turn for ever with the place that it is to go to.
SLOWEST = 0.2
# Between two corners nearer to one another than the centre of rotation is to the tracked point, the line asks the point
# to go aside faster than the robot turns. It goes on at this part of its speed, and cuts the line: the law would else
# hold it still there for ever.
LEAST_FORWARD = 0.3


class SteeredChassis(NamedTuple):
    """Parameters of the steered chassis: geometry (m), response time of the wheels (s), their dead band (rad/s)."""

    wheel_radius_m: float
    axial_distance_m: float
    x_icr_m: float
    response_s: float
    dead_rad_s: float


@kernel_function
def guide(
    commands: Floats, terms: Terms, start: Floats, chassis: SteeredChassis, before_left: float, before_right: float,
    limits: Limits, step_s: float,
) -> None:  # fmt: skip
    """Fill `commands` (T, 2) with the wheel speeds (rad/s) of the steering law.

    They start from the state `start` (10,) of `SkidSteer` and the commands before, and stay within the limits.
    """
    x, y = float(start[START_X]), float(start[START_Y])
    cos_yaw, sin_yaw = float(start[START_COS]), float(start[START_SIN])
    wheel_left, wheel_right = float(start[START_LEFT]), float(start[START_RIGHT])
    place = float(start[START_MEMORY])
    half_axle, x_icr_m, lead_s = 0.5 * chassis.axial_distance_m, chassis.x_icr_m, chassis.response_s
    turn_rad_s2 = limits.change * chassis.wheel_radius_m / (half_axle * step_s)
    keep = math.exp(-step_s / lead_s) if lead_s > 0.0 else 0.0
    settled = (1.0 - keep) * lead_s / step_s
    for t in range(commands.shape[0]):
        place = place_of(terms, place, x, y)
        at_x, at_y, head_x, head_y, _, speed = _ahead_at(terms, place, 0.0)
        away_x, away_y = x - at_x + x_icr_m * (cos_yaw - head_x), y - at_y + x_icr_m * (sin_yaw - head_y)
        back = math.atan(ANGLE_PER_M * (away_y * head_x - away_x * head_y))
        off_rad = math.atan2(sin_yaw * head_x - cos_yaw * head_y, cos_yaw * head_x + sin_yaw * head_y) + back
        returning = math.sin(back) * math.sin(back)
        # What the wheels are to do when the command acts.
        _, _, from_x, from_y, along, _ = _ahead_at(terms, place, speed * lead_s)
        _, _, to_x, to_y, _, _ = _ahead_at(terms, place, speed * lead_s + TURN_M)
        bend = math.atan2(from_x * to_y - from_y * to_x, from_x * to_x + from_y * to_y) / TURN_M
        off_rad = math.atan2(math.sin(off_rad), math.cos(off_rad))
        turn = speed * (bend - YAW_PER_M * off_rad)
        # No faster than the turn can end by the time the robot faces right: it would turn past, to and fro.
        fastest = math.sqrt(2.0 * turn_rad_s2 * abs(off_rad))
        if speed * YAW_PER_M * abs(off_rad) > fastest:
            turn = -math.copysign(fastest, off_rad)
        # On a line that can be followed, along^2 + (x_icr * bend)^2 = 1.
        along = max(along, LEAST_FORWARD * (1.0 - min(abs(x_icr_m * bend), 1.0)))
        forward = speed * (along + (1.0 - along) * returning) * max(math.cos(off_rad), SLOWEST)
        left, right = _within(
            (forward - half_axle * turn) / chassis.wheel_radius_m,
            (forward + half_axle * turn) / chassis.wheel_radius_m,
            chassis.dead_rad_s,
            limits.largest,
        )
        before_left = clip(left, before_left - limits.change, before_left + limits.change)
        before_right = clip(right, before_right - limits.change, before_right + limits.change)
        commands[t, 0], commands[t, 1] = before_left, before_right
        left, right = _beyond(before_left, chassis.dead_rad_s), _beyond(before_right, chassis.dead_rad_s)
        mean_left, mean_right = left + settled * (wheel_left - left), right + settled * (wheel_right - right)
        wheel_left, wheel_right = left + keep * (wheel_left - left), right + keep * (wheel_right - right)
        moved = 0.5 * chassis.wheel_radius_m * step_s * (mean_left + mean_right)
        turned = chassis.wheel_radius_m * step_s * (mean_right - mean_left) / chassis.axial_distance_m
        cos_half, sin_half = math.cos(0.5 * turned), math.sin(0.5 * turned)
        cos_yaw, sin_yaw = cos_yaw * cos_half - sin_yaw * sin_half, sin_yaw * cos_half + cos_yaw * sin_half
        aside = turned * x_icr_m
        carried = min((abs(mean_left) + abs(mean_right)) / MOVES_RAD_S, 1.0)
        x += moved * cos_yaw + aside * sin_yaw + carried * start[CARRIED_X]
        y += moved * sin_yaw - aside * cos_yaw + carried * start[CARRIED_Y]
        cos_yaw, sin_yaw = cos_yaw * cos_half - sin_yaw * sin_half, sin_yaw * cos_half + cos_yaw * sin_half


@kernel_function
def _ahead_at(terms: Terms, place: float, ahead_m: float) -> tuple[float, float, float, float, float, float]:
    """`line_at`, but with a heading across the line where a robot that stays on it would drive backwards."""
    x, y, head_x, head_y, along, speed = line_at(terms, place, ahead_m)
    if along < 0.0:
        next_x, next_y, _, _, _, _ = line_at(terms, place, ahead_m + NEARBY_M)
        length = max(math.hypot(next_x - x, next_y - y), 1e-9)
        way_x, way_y = (next_x - x) / length, (next_y - y) / length
        side = math.copysign(1.0, way_x * head_y - way_y * head_x)
        head_x, head_y, along = -side * way_y, side * way_x, 0.0
    return x, y, head_x, head_y, along, speed


@scalar_function
def _within(left: float, right: float, dead: float, largest: float) -> tuple[float, float]:
    """Commands for these wheel speeds: lifted over the dead band; if one is too fast, both slower on the same curve."""
    left, right = _lifted(left, dead), _lifted(right, dead)
    scale = min(1.0, largest / max(abs(left), abs(right), 1e-6))
    return left * scale, right * scale


@scalar_function
def _lifted(speed: float, dead: float) -> float:
    return speed + math.copysign(dead, speed) * min(abs(speed) / LIFTED_RAD_S, 1.0)


@scalar_function
def _beyond(command: float, dead: float) -> float:
    return math.copysign(max(abs(command) - dead, 0.0), command)
