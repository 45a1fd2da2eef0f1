"""Whether commands, wheels and poses of a drive can be those of one robot, and if not, the most likely cause.

First, signals that stand still while the rest moves: a pose, a heading, an encoder, or a clock. Then increments over a
second are fitted with a free geometry: of a sound log, whatever effects the robot has, that explains all but a part.
Where it does not, or where the geometry is none that a robot can have, each known cause (an encoder reversed, an axis
mirrored, another clock, ...) is put right in turn, and the one that explains the log is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from disco_hw.errors import LogError
from disco_hw.log.contradictions import (
    REVERSE_COUNT,
    SIDES,
    Contradiction,
    Link,
    of_axes,
    of_clock,
    of_counts,
    of_scale,
    of_units,
    of_unrelated,
)
from disco_hw.log.drive import Array, DriveLog, separate
from disco_hw.log.motion_fits import (
    FEWEST_WINDOWS,
    MOVING_RAD,
    STEP_S,
    TURNING_RAD,
    BodyFit,
    CommandFit,
    MotionWindows,
    fit_body,
    fit_commands,
    fit_pose_clock,
    motion_windows,
)

# Chosen: share of what the wheels show; less is no motion but noise.
_STILL = 0.02
# Below the last digit of any log: a value that was repeated, not measured.
_EXACTLY = 1e-9
# Chosen: a smaller share may be single repeats.
_STANDING_SHARE = 0.05
# Chosen: fewer are slip, starts and stops.
_DEAD_SHARE = 0.2
# Above half, the data are of no use for what depends on them; below, only a part is lost.
_MOSTLY = 0.5
# Chosen: shorter logs may have parts apart by chance.
_FEWEST_COMMON_S = 2.0
# Chosen: less in common, or one this many times longer, are recordings on two clocks or of two drives.
_COMMON_SHARE = 0.1
_LARGEST_SPAN_RATIO = 5.0


def no_common_time(log: DriveLog) -> Contradiction | None:
    """Wheels and poses that were hardly ever recorded at one time, as on two clocks."""
    spans, common_s = [0.0, 0.0], 0.0
    for segment in range(log.segments):
        times = [part.t_s[part.segment == segment] for part in (log.wheels, log.poses)]
        for place, t_s in enumerate(times):
            spans[place] += float(t_s[-1] - t_s[0]) if t_s.size else 0.0
        if all(t_s.size for t_s in times):
            common_s += max(min(float(t_s[-1]) for t_s in times) - max(float(t_s[0]) for t_s in times), 0.0)
    apart = common_s < _COMMON_SHARE * min(spans) or spans[1] > _LARGEST_SPAN_RATIO * spans[0]
    if min(spans) < _FEWEST_COMMON_S or not apart:
        return None
    return Contradiction(
        "time_base",
        f"t_s: poses span {spans[1]:.4g} s and wheels {spans[0]:.4g} s, {common_s:.3g} s of it together: they are on "
        "two time bases (another clock, or milliseconds); stamp both in seconds of one clock",
    )


def standing(windows: MotionWindows, radius_m: float, axial_m: float) -> Contradiction | None:
    """Return a pose, a heading or both wheels that stand still while the others move."""
    known = np.isfinite(windows.rolled_rad).all(axis=1) & np.isfinite(windows.turned_rad)
    wheels = windows.rolled_rad[known]
    rolled, way = np.abs(wheels).max(axis=1, initial=0.0), np.abs(windows.moved_m[known])
    moving = rolled > MOVING_RAD
    if np.count_nonzero(moving) < FEWEST_WINDOWS:
        return _wheels_standing(rolled, way, radius_m)
    way, turned = way[moving], np.abs(windows.turned_rad[known][moving])
    could_turn = radius_m / axial_m * np.abs(wheels[moving, 1] - wheels[moving, 0])
    most_way, most_turn, could = (float(np.quantile(values, 0.9)) for values in (way, turned, could_turn))
    if most_way < _STILL * radius_m and most_turn < max(_STILL * could, _EXACTLY):
        return Contradiction(
            "poses_still",
            f"the poses do not change while the wheels turn by {STEP_S * rolled[moving].sum():.3g} rad: the wheels "
            "are off the ground or the pose sensor is dead; leave its columns empty to compare commands and wheels "
            "alone",
        )
    turning = could_turn > TURNING_RAD
    if np.count_nonzero(turning) < FEWEST_WINDOWS:
        return None
    # Poses that stand still altogether for a while are another matter.
    share = float(np.mean((turned[turning] < _EXACTLY) & (way[turning] > _EXACTLY)))
    if share < _STANDING_SHARE:
        return None
    return Contradiction(
        "heading_still",
        f"pose_yaw_rad does not change in {share:.0%} of the turns that the wheels make: it is not a measured "
        "heading; record a source that measures the heading, or leave the pose columns empty",
        ("body",) if share > _MOSTLY else (),
    )


def _wheels_standing(rolled_rad: np.ndarray, way_m: np.ndarray, radius_m: float) -> Contradiction | None:
    travels = way_m > radius_m
    if np.count_nonzero(travels) < FEWEST_WINDOWS or np.median(rolled_rad[travels]) > _STILL:
        return None
    return Contradiction(
        "wheels_still",
        f"the poses move by {STEP_S * way_m[travels].sum():.3g} m while neither wheel counts: the encoders are not "
        "read, or the poses are of another drive; check the encoders' cables and columns",
    )


def dead_encoders(windows: MotionWindows) -> tuple[Contradiction, ...]:
    """Return the encoders that count nothing while their wheel is told to turn and the other one does."""
    known = np.isfinite(windows.rolled_rad).all(axis=1) & np.isfinite(windows.commanded_rad).all(axis=1)
    rolled, commanded = np.abs(windows.rolled_rad[known]), np.abs(windows.commanded_rad[known])
    found = []
    for side, name in enumerate(SIDES):
        could = (commanded[:, side] > MOVING_RAD) & (rolled[:, 1 - side] > MOVING_RAD)
        share = float(np.mean(rolled[could, side] < _STILL)) if np.count_nonzero(could) >= FEWEST_WINDOWS else 0.0
        if share > _DEAD_SHARE:
            message = (
                f"the {name} encoder does not count in {share:.0%} of the time in which its wheel is commanded to "
                "turn and the other one turns: check its cable and its channel, or the motor"
            )
            found.append(Contradiction("encoder_dead", message, ("body", "response") if share > _MOSTLY else ()))
    return tuple(found)


def never_counting(windows: MotionWindows) -> Contradiction | None:
    """Return an encoder that counts nothing in the whole of a log without commands while the other one does."""
    rolled = np.nansum(np.abs(windows.rolled_rad), axis=0)
    side = int(np.argmin(rolled))
    if rolled[side] > _STILL * rolled[1 - side]:
        return None
    return Contradiction(
        "encoder_dead",
        f"the {SIDES[side]} encoder never counts, and the poses are not those of a robot that turns about that "
        "wheel: check its cable and its channel",
    )


# Of real logs the worst is 0.37 (a Warthog on sand), of unrelated motion the best 0.7.
_UNEXPLAINED = 0.6
_EXPLAINED = 0.4
_WELL_EXPLAINED = 0.2
_AS_GOOD = 0.5
_LEAST_DELAY_S = 0.75
_USUAL_GAIN = (0.55, 1.5)
_UNEQUAL = 1.4
# In a second of a slow drive a wheel may lack so much of its command by its deadband alone.
_MOST_DEADBAND_RAD = 1.5
# Signs and shares with which the counts of the left and right encoder are put right in turn.
_ENCODER_FAULTS = {
    (-1.0, 1.0): ("encoder_reversed", "the left encoder counts backwards"),
    (1.0, -1.0): ("encoder_reversed", "the right encoder counts backwards"),
    (0.5, 1.0): ("encoder_count", "the left wheel counts 2.00 times the expected ticks, the right one does not"),
    (1.0, 0.5): ("encoder_count", "the right wheel counts 2.00 times the expected ticks, the left one does not"),
    (2.0, 1.0): ("encoder_count", "the left wheel counts 0.50 times the expected ticks, the right one does not"),
    (1.0, 2.0): ("encoder_count", "the right wheel counts 0.50 times the expected ticks, the left one does not"),
}


def find_contradictions(log: DriveLog, wheel_radius_m: float, axial_distance_m: float) -> tuple[Contradiction, ...]:
    """Find what contradicts itself in logs of a robot with this nominal geometry; empty for sound ones.

    Several logs are judged one by one: a sound one must not hide what is wrong with another.
    """
    return tuple(
        replace(each, message=f"{name}: {each.message}")
        for name, part in separate(log)
        for each in _of_one(part, wheel_radius_m, axial_distance_m)
    )


def refuse_contradictions(found: Sequence[Contradiction], needs: Sequence[Link]) -> tuple[str, ...]:
    """Raise LogError for the first that spoils what is needed; return the messages of all others as warnings."""
    for each in found:
        if set(each.spoils) & set(needs):
            raise LogError(each.message)
    return tuple(each.message for each in found)


def _of_one(log: DriveLog, radius_m: float, axial_m: float) -> tuple[Contradiction, ...]:
    if not log.wheels.t_s.size:
        return ()
    windows = motion_windows(log)
    commands = fit_commands(windows)
    dead = dead_encoders(windows)
    if dead:
        return dead
    compared_with_commands = _of_commands(windows, commands)
    if compared_with_commands is None:
        return _of_poses(log, windows, radius_m, axial_m, has_commands=commands is not None)
    of_wheels, of_commands, as_commanded = compared_with_commands
    if _is_explained(fit_body(as_commanded, radius_m, axial_m)):
        return (replace(of_wheels, message=f"{of_wheels.message} (the poses show it too)"),)
    if _is_explained(fit_body(windows, radius_m, axial_m)):
        return (of_commands,)
    return (*_of_poses(log, windows, radius_m, axial_m, has_commands=True), of_wheels)


def _is_explained(fit: BodyFit | None) -> bool:
    """Whether the wheels explain the poses with a geometry that the robot can have."""
    return fit is not None and fit.worst < _UNEXPLAINED and fit.is_usual


def _of_commands(
    windows: MotionWindows, fit: CommandFit | None
) -> tuple[Contradiction, Contradiction, MotionWindows] | None:
    """Return the contradiction between commands and wheels, or None.

    Returns it as a fault of the wheels, as one of the commands, and the windows with the wheels put right.
    """
    if fit is None:
        return None
    gains = np.array(fit.gains)
    swapped = fit_commands(windows, swapped=True)
    if swapped is not None and swapped.worst < _EXPLAINED:
        far_better = swapped.worst < _AS_GOOD * min(fit.unexplained)
        if far_better or (_are_usual(swapped.gains) and not _are_usual(fit.gains)):
            explanation = "each wheel follows the command of the other side: the left and right"
            return (
                Contradiction("sides_swapped", f"{explanation} encoders are swapped", ("body", "response")),
                Contradiction("sides_swapped", f"{explanation} commands are swapped", ("response",)),
                _with_wheels(windows, np.sign(swapped.gains)[::-1], swap=True),
            )
    if fit.worst > _UNEXPLAINED:
        return None
    if (gains < 0.0).any():
        side = "both" if (gains < 0.0).all() else f"the {SIDES[int(np.argmin(gains))]}"
        encoder, command = ("encoders count", "commands have") if side == "both" else ("encoder counts", "command has")
        return (
            Contradiction(
                "encoder_reversed",
                f"{side} {encoder} against the commands: {REVERSE_COUNT}",
                ("body", "response"),
            ),
            Contradiction(
                "command_reversed",
                f"{side} {command} the other sign than wheels and poses: change it in the log",
                ("response",),
            ),
            _with_wheels(windows, np.sign(gains)),
        )
    if fit.worst > _EXPLAINED:
        return None
    ratio = float(gains[0] / gains[1])
    if not 1.0 / _UNEQUAL < ratio < _UNEQUAL and not _are_usual(fit.gains):
        more, times = (0, ratio) if ratio > 1.0 else (1, 1.0 / ratio)
        explanation = (
            f"the {SIDES[more]} wheel counts {times:.2f} times what the {SIDES[1 - more]} one does for a command "
            f"({gains[more]:.2f} and {gains[1 - more]:.2f} times the command)"
        )
        return (
            Contradiction("encoder_count", f"{explanation}: check ticks_per_rev and gear", ("body", "response")),
            Contradiction(
                "command_scale", f"{explanation}, and the poses confirm the wheels: check commands", ("response",)
            ),
            _with_wheels(windows, 1.0 / gains),
        )
    gain = float(np.sqrt(gains[0] * gains[1]))
    if _are_usual((gain,)) or (gain < 1.0 and (1.0 - gain) * fit.commanded_rad < _MOST_DEADBAND_RAD):
        return None
    return (
        of_counts(gain, " by the commands", ("response",)),
        Contradiction(
            "command_scale",
            f"commands are {1.0 / gain:.3g} times what the wheels do, and the poses confirm the wheels: write "
            "cmd_left_rad_s and cmd_right_rad_s in rad/s of the wheel (behind the gear)",
            ("response",),
        ),
        _with_wheels(windows, np.full(2, 1.0 / gain)),
    )


def _are_usual(gains: Sequence[float]) -> bool:
    low, high = _USUAL_GAIN
    return all(low < abs(gain) < high for gain in gains)


def _with_wheels(windows: MotionWindows, factors: Array, swap: bool = False) -> MotionWindows:
    rolled = windows.rolled_rad[:, ::-1] if swap else windows.rolled_rad
    return replace(windows, rolled_rad=rolled * factors)


def _of_poses(
    log: DriveLog, windows: MotionWindows, radius_m: float, axial_m: float, has_commands: bool
) -> tuple[Contradiction, ...]:
    """Return the contradictions between wheels and poses, the most likely cause first."""
    if log.poses.t_s.size < 2:
        return ()
    apart = no_common_time(log) or standing(windows, radius_m, axial_m)
    if apart is not None:
        return (apart,)
    fit = fit_body(windows, radius_m, axial_m)
    if fit is None or (fit.worst < _WELL_EXPLAINED and fit.is_usual):
        return ()
    dead = None if has_commands else never_counting(windows)
    cause = dead or of_units(fit) or _correction(log, windows, fit, radius_m, axial_m)
    if cause is not None:
        return (cause,)
    if fit.worst > _UNEXPLAINED:
        return (of_unrelated(fit),)
    found = [of_axes(fit), of_scale(fit, radius_m)]
    if fit.worst > _EXPLAINED and any(found):
        return (of_unrelated(fit),)
    return tuple(each for each in found if each is not None)


def _correction(
    log: DriveLog, windows: MotionWindows, fit: BodyFit, radius_m: float, axial_m: float
) -> Contradiction | None:
    """Return the one thing that, put right, lets the wheels explain the poses; None if there is none."""
    good = min(_EXPLAINED, _AS_GOOD * fit.worst)
    for factors, (cause, what) in _ENCODER_FAULTS.items():
        other = fit_body(windows, radius_m, axial_m, factors)
        is_reversed = min(factors) < 0.0
        # On a steady circle a reversed encoder explains no better than a geometry that no robot has.
        limit = _EXPLAINED if is_reversed and not fit.has_clear_axes else good
        if other is not None and other.is_usual and other.worst < limit:
            hint = REVERSE_COUNT if is_reversed else "check ticks_per_rev and gear there"
            return Contradiction(cause, f"{what}, by the poses: {hint}", ("body", "response"))
    mirrored = fit_body(windows, radius_m, axial_m, mirrored=True)
    if mirrored is not None and mirrored.worst < good:
        return _mirrored(mirrored)
    clock = fit_pose_clock(log, radius_m, axial_m, only_offset=fit.worst < _UNEXPLAINED)
    if clock is None or clock.fit.worst > good or not clock.fit.is_usual:
        return None
    return of_clock(clock) if clock.rate != 1.0 or abs(clock.later_s) > _LEAST_DELAY_S else None


def _mirrored(fit: BodyFit) -> Contradiction:
    """Positions and heading that turn in opposite ways; `fit` is that with the positions mirrored."""
    if fit.turn_unexplained is not None and fit.turn_ratio < 0.0:
        return Contradiction(
            "heading_mirrored",
            "pose_yaw_rad turns the other way than the wheels, and x, y do not: it is counted clockwise, as by a "
            "compass; write yaw counter-clockwise from x",
        )
    return Contradiction(
        "axis_mirrored",
        "the positions are mirrored: pose_yaw_rad turns with the wheels and x, y turn the other way; change the sign "
        "of pose_y_m (or exchange x and y)",
    )
