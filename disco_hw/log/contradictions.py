"""Contradictions of a log in words: what they are called, what they say and how they are put right."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from disco_hw.log.motion_fits import STRAIGHT_ON_RAD, USUAL_RADIUS, USUAL_TURN, BodyFit, ClockFit

Link = Literal["body", "response"]
SIDES = ("left", "right")
# A driver's own link.direction also turns the command round.
REVERSE_COUNT = (
    "change the sign of the count: in robot.toml (wheels.encoder_direction) before the next drive, or in the columns "
    "of a CSV"
)


@dataclass(frozen=True, slots=True)
class Contradiction:
    """Two quantities of a log that cannot both be right: `cause` for programs, `message` with the remedy for people.

    `spoils`: what cannot be concluded from the log: `body`, how wheels move the robot, or `response`, how wheels answer
    commands. Empty where the log is still of use.
    """

    cause: str
    message: str
    spoils: tuple[Link, ...] = ("body",)


def of_axes(fit: BodyFit) -> Contradiction | None:
    """Wheels that explain the poses with a sign or an angle that no robot has."""
    turns_against = fit.turn_unexplained is not None and fit.turn_ratio < 0.0
    course = fit.course_rad if fit.way_unexplained is not None else 0.0
    ahead, backwards = abs(course) < STRAIGHT_ON_RAD, abs(course) > math.pi - STRAIGHT_ON_RAD
    if turns_against and backwards:
        return Contradiction(
            "wheels_reversed",
            f"both encoders count backwards beside the poses: {REVERSE_COUNT}",
        )
    if turns_against:
        off = "" if ahead else f", and the heading is {math.degrees(course):.0f} deg off the course"
        return Contradiction(
            "mirrored",
            f"the poses turn the other way than the wheels{off}: an axis of the pose frame is mirrored (write x, y "
            "and yaw counter-clockwise from x), or the left and right encoders are swapped",
        )
    if backwards:
        return Contradiction(
            "heading_backwards",
            "the poses move backwards while the wheels turn forwards: the heading points backwards, or both encoders "
            "count backwards and are swapped; check the mounting of the pose sensor and the sign of ticks",
        )
    if not ahead:
        return Contradiction(
            "heading_offset",
            f"pose_yaw_rad is {math.degrees(-course):.0f} deg off the course that the wheels drive: yaw must be 0 "
            "along x and grow counter-clockwise; correct the sensor's mounting angle or the frame of x, y",
        )
    return None


# Chosen: between 1 and the 57 of degrees read as radians; below the other, the heading does not turn with the wheels.
_DEGREES_TURN = 5.0
_STATIONARY_TURN = 0.15


def of_units(fit: BodyFit) -> Contradiction | None:
    """Return a heading that turns far more, or far less, than the wheels can make it."""
    if fit.turn_unexplained is None:
        return None
    if fit.turn_size > _DEGREES_TURN * max(1.0, fit.radius_ratio):
        return Contradiction(
            "heading_units",
            f"pose_yaw_rad turns {fit.turn_size:.3g} times as much as the wheels can make it, like degrees: write "
            "radians",
        )
    if fit.turn_size < _STATIONARY_TURN * min(1.0, fit.radius_ratio):
        return Contradiction(
            "heading_still",
            f"pose_yaw_rad turns by {fit.turn_size:.0%} of what the wheels make: it hardly follows the robot; record a "
            "source that measures the heading, or leave the pose columns empty",
        )
    return None


_LENGTHS = {1000.0: "millimetres", 100.0: "centimetres", 0.001: "kilometres"}
_ANGLES = {57.296: "degrees", 9.549: "revolutions per minute", 0.15915: "revolutions"}
# Chosen: the factors of units are further apart, and a robot's geometry is nearer.
_NEAR = 0.06


def _is_near(value: float, expected: float) -> bool:
    return abs(value / expected - 1.0) < _NEAR


def of_scale(fit: BodyFit, radius_m: float) -> Contradiction | None:
    """Wheels that explain the poses with a radius that the robot cannot have."""
    low, high = USUAL_RADIUS
    if fit.way_unexplained is None or low < fit.radius_ratio < high:
        return None
    turns_as_usual = fit.turn_unexplained is None or USUAL_TURN[0] < abs(fit.turn_ratio) < USUAL_TURN[1]
    for factor, unit in _LENGTHS.items():
        if turns_as_usual and _is_near(fit.radius_ratio, factor):
            return Contradiction(
                "pose_units",
                f"pose_x_m, pose_y_m: the poses move {fit.radius_ratio:.4g} times as far as the wheels roll, as {unit} "
                "do: write metres",
            )
    otherwise = f" (or wheel_radius_m, which the poses say is {fit.radius_ratio * radius_m:.3g} m)"
    return of_counts(1.0 / fit.radius_ratio, " by the poses", (), otherwise)


def of_counts(times: float, by: str, spoils: tuple[Link, ...], otherwise: str = "") -> Contradiction:
    """Wheels that count so many `times` what they should `by` what else the log holds."""
    for factor, unit in _ANGLES.items():
        if _is_near(times, factor):
            return Contradiction(
                "wheel_units",
                f"the wheels count {times:.4g} times the expected roll{by}, as {unit} do: write rad and rad/s",
                ("body", "response"),
            )
    ratio = max(times, 1.0 / times)
    count = f"{times:.2f}" if _is_near(ratio, round(ratio)) and ratio < 20.0 else f"{times:.3g}"
    message = f"the wheels count {count} times the expected ticks{by}: check ticks_per_rev and gear{otherwise}"
    return Contradiction("encoder_count", message, spoils)


def of_clock(clock: ClockFit) -> Contradiction:
    """Poses that another clock stamps."""
    explanation = (
        f"run at {clock.rate:.3g} times the rate of the wheels' stamps"
        if clock.rate != 1.0
        else f"are stamped {abs(clock.later_s):.3g} s {'late' if clock.later_s > 0.0 else 'early'}"
    )
    return Contradiction(
        "time_base", f"t_s: the poses {explanation}: they are on two time bases; stamp poses and wheels with one clock"
    )


def of_unrelated(fit: BodyFit) -> Contradiction:
    """Poses whose turns or way nothing that is known explains."""
    share = min(fit.worst, 1.0)
    return Contradiction(
        "unrelated",
        f"{share:.0%} of the poses' motion within a second is not the wheels' in any geometry: poses and wheels are "
        "not of one drive, or not on one clock; give the poses of this drive in m and rad",
    )
