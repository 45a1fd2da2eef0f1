"""Reference in time on the task's line: where the tracked point should be at the end of each step.

It starts at the place on the line beside the robot and moves on at the task's speed, or as fast as the wheels allow:
where a robot that stays on the line would turn a wheel faster than its limit, the reference takes longer. So a robot
whose wheels cannot do what the task requests stays on the line and goes slower.
"""

from __future__ import annotations

import math

from disco_hw.control.kernel import (
    START_COS,
    START_MEMORY,
    START_SIN,
    START_X,
    START_Y,
    Floats,
    Terms,
    line_at,
    place_of,
)
from disco_hw.control.kernel.guide import SteeredChassis
from disco_hw.jit import kernel_function

# The line is sampled so many times a step, as its direction may change within one.
PARTS = 4
# The reference uses this part of the wheels' speed, so that some is left to return to the line.
USED_SPEED = 0.94


@kernel_function
def timed_reference(
    reference: Floats, terms: Terms, start: Floats, chassis: SteeredChassis, largest_rad_s: float, step_s: float,
    found: Floats,
) -> None:  # fmt: skip
    """Fill `reference` (T, 2) with points (m), relative to the task's origin.

    `start` (11,) is the state of `SkidSteer`. Sets `found` (6,): distance to the line (m), cosine of the angle between
    the robot and the heading in which it would stay on the line, the part of the task's speed that the wheels can do,
    at most 1, that heading at the end (cosine, sine), and the length of the way from the first point to the last (m).
    """
    x, y, cos_yaw, sin_yaw = start[START_X], start[START_Y], start[START_COS], start[START_SIN]
    place = place_of(terms, start[START_MEMORY], x, y)
    at_x, at_y, head_x, head_y, _, _ = line_at(terms, place, 0.0)
    found[0] = math.hypot(x - at_x, y - at_y)
    found[1] = cos_yaw * head_x + sin_yaw * head_y
    fastest = USED_SPEED * max(largest_rad_s - chassis.dead_rad_s, 0.0) * chassis.wheel_radius_m
    half_axle, part_s = 0.5 * chassis.axial_distance_m, step_s / PARTS
    ahead, requested, way_m = 0.0, 0.0, 0.0
    for t in range(reference.shape[0]):
        for _ in range(PARTS):
            _, _, from_x, from_y, along, speed = line_at(terms, place, ahead)
            way = speed * part_s
            _, _, to_x, to_y, _, _ = line_at(terms, place, ahead + way)
            turn = math.atan2(from_x * to_y - from_y * to_x, from_x * to_x + from_y * to_y)
            # How far the faster wheel rolls, and how far it can.
            rolls = abs(way * along) + half_axle * abs(turn)
            ahead += way * min(1.0, fastest * part_s / max(rolls, 1e-9))
            requested += way
        at_x, at_y, head_x, head_y, _, _ = line_at(terms, place, ahead)
        reference[t, 0], reference[t, 1] = at_x, at_y
        if t > 0:
            way_m += math.hypot(at_x - reference[t - 1, 0], at_y - reference[t - 1, 1])
    found[2] = ahead / requested if requested > 0.0 else 1.0
    found[3], found[4], found[5] = head_x, head_y, way_m
