"""Where a robot that stays on the task's line is in the next steps: the reference of the refinement.

It starts at the place on the line beside the robot, at the robot's own speed along it, and goes on at the task's speed,
or as fast as the wheels allow. Where a robot that stays on the line would turn a wheel faster than its limit, or would
have to change a wheel's speed faster, as at a corner, the reference is slower, and slows down in time. So a robot whose
wheels cannot do what the task requests stays on the line and goes slower.
"""

from __future__ import annotations

import math

from disco_hw.control.kernel import (
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
from disco_hw.control.kernel.guide import TURN_M, SteeredChassis
from disco_hw.jit import kernel_function

# The line is sampled so many times a step, as its direction may change within one.
PARTS = 4
# The reference uses this part of the wheels' speed and acceleration, so that some is left to return to the line.
# Chosen: with more of the acceleration corners are overshot, with less they take longer.
USED_SPEED, USED_ACCELERATION = 0.94, 0.7
# Where a task's speed goes to zero, speeds are looked up at least so far apart.
LEAST_PART_M = 1e-3
# What differs at one place of the line, as behind a corner, the wheels may take so many steps for: by then a robot is
# hardly off the line. With one, robots of the shipped one's size took 8 % longer for squares at 0.3 m/s, and were 1 mm
# nearer to them. Without an x_icr, where a corner is turned about at one place, they take 14 % longer with eight, too.
CHANGE_STEPS = 8
# Columns of the table of speeds: how far the left and the right wheel roll for each metre of the line, and the highest
# speed along it (m/s).
LEFT_ROLLS, RIGHT_ROLLS, SPEED = range(3)
SPEED_COLUMNS = 3


@kernel_function
def timed_reference(
    reference: Floats, terms: Terms, start: Floats, chassis: SteeredChassis, largest_rad_s: float,
    change_rad_s2: float, step_s: float, turn_ahead_m: float, speeds: Floats, found: Floats, beyond: Floats,
    beyond_m: float,
) -> None:  # fmt: skip
    """Fill `reference` (T, 2) with points (m), relative to the task's origin.

    `start` (10,) is the state of `SkidSteer`; `largest_rad_s` and `change_rad_s2` limit the wheels; `speeds`
    (PARTS T, 3) is scratch. Sets `found` (6,): distance to the line (m), cosine of the angle between the robot and the
    nearer of the headings in which it would stay on the line there and `turn_ahead_m` further, the part of the task's
    speed that the wheels can do, at most 1, the heading at the end (cosine, sine), and the length of the way from the
    first point to the last (m).
    And `beyond` (N, 2): that last point, and those behind it along the line, `beyond_m` apart.
    """
    x, y, cos_yaw, sin_yaw = start[START_X], start[START_Y], start[START_COS], start[START_SIN]
    place = place_of(terms, start[START_MEMORY], x, y)
    at_x, at_y, head_x, head_y, _, speed = line_at(terms, place, 0.0)
    found[0] = math.hypot(x - at_x, y - at_y)
    _, _, next_x, next_y, _, _ = line_at(terms, place, turn_ahead_m)
    found[1] = max(cos_yaw * head_x + sin_yaw * head_y, cos_yaw * next_x + sin_yaw * next_y)
    part_s = step_s / PARTS
    part_m = max(speed * part_s, LEAST_PART_M)
    fastest = USED_SPEED * max(largest_rad_s - chassis.dead_rad_s, 0.0) * chassis.wheel_radius_m
    change = USED_ACCELERATION * change_rad_s2 * chassis.wheel_radius_m
    _fill_speeds(speeds, terms, place, part_m, 0.5 * chassis.axial_distance_m, fastest, change, CHANGE_STEPS * step_s)
    found[2] = _part_of_speed(speeds, terms, place, part_m)

    # From the robot's own speed along the line on, the reference gets faster as the wheels do.
    left, right = chassis.wheel_radius_m * start[START_LEFT], chassis.wheel_radius_m * start[START_RIGHT]
    ahead, aside = 0.5 * (left + right), chassis.x_icr_m * (right - left) / chassis.axial_distance_m
    moves_x, moves_y = ahead * cos_yaw + aside * sin_yaw, ahead * sin_yaw - aside * cos_yaw
    next_x, next_y, _, _, _, _ = line_at(terms, place, part_m)
    before = max((moves_x * (next_x - at_x) + moves_y * (next_y - at_y)) / part_m, 0.0)
    for n in range(speeds.shape[0]):
        before = min(speeds[n, SPEED], math.sqrt(before * before + 2.0 * change * part_m))
        speeds[n, SPEED] = before

    gone_m, way_m, last = 0.0, 0.0, speeds.shape[0] - 1
    for t in range(reference.shape[0]):
        for _ in range(PARTS):
            _, _, _, _, _, speed = line_at(terms, place, gone_m)
            gone_m += min(speed, speeds[min(int(gone_m / part_m), last), SPEED]) * part_s
        at_x, at_y, head_x, head_y, _, _ = line_at(terms, place, gone_m)
        reference[t, 0], reference[t, 1] = at_x, at_y
        if t > 0:
            way_m += math.hypot(at_x - reference[t - 1, 0], at_y - reference[t - 1, 1])
    found[3], found[4], found[5] = head_x, head_y, way_m
    for n in range(beyond.shape[0]):
        beyond[n, 0], beyond[n, 1], _, _, _, _ = line_at(terms, place, gone_m + n * beyond_m)


@kernel_function
def _fill_speeds(
    speeds: Floats, terms: Terms, place: float, part_m: float, half_axle_m: float, fastest: float, change: float,
    change_s: float,
) -> None:  # fmt: skip
    """Fill `speeds` (N, 3), a row for each `part_m` of the line ahead, within the wheels' limits (m/s and m/s^2)."""
    count, turn_m = speeds.shape[0], max(part_m, TURN_M)
    for n in range(count):
        _, _, from_x, from_y, along, _ = line_at(terms, place, n * part_m)
        _, _, to_x, to_y, _, _ = line_at(terms, place, n * part_m + turn_m)
        aside = half_axle_m * math.atan2(from_x * to_y - from_y * to_x, from_x * to_x + from_y * to_y) / turn_m
        speeds[n, LEFT_ROLLS], speeds[n, RIGHT_ROLLS] = along - aside, along + aside
    for n in range(count):
        left, right = speeds[n, LEFT_ROLLS], speeds[n, RIGHT_ROLLS]
        # The faster the robot, the more of the line is in the time that a change may take.
        differs, highest = 1e-6, 0.0
        for ahead in range(1, CHANGE_STEPS * PARTS + 1):
            there = min(n + ahead, count - 1)
            differs = max(differs, abs(speeds[there, LEFT_ROLLS] - left), abs(speeds[there, RIGHT_ROLLS] - right))
            highest = max(highest, min(ahead * part_m / change_s, change * change_s / differs))
        highest = max(highest, change * change_s / differs)
        speeds[n, SPEED] = min(highest, fastest / max(abs(left), abs(right), 1e-6))
    # Slow down in time.
    for n in range(count - 2, -1, -1):
        after = speeds[n + 1, SPEED]
        speeds[n, SPEED] = min(speeds[n, SPEED], math.sqrt(after * after + 2.0 * change * part_m))


@kernel_function
def _part_of_speed(speeds: Floats, terms: Terms, place: float, part_m: float) -> float:
    """Return which part of the task's speed the wheels can do, in the mean over the time that the way takes."""
    requested, taken = 0.0, 0.0
    for n in range(speeds.shape[0]):
        _, _, _, _, _, speed = line_at(terms, place, n * part_m)
        if speed > 0.0:
            requested += 1.0 / speed
            taken += 1.0 / min(speed, speeds[n, SPEED])
    return requested / taken if taken > 0.0 else 1.0
