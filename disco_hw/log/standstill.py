"""Detection of signals that stand still in a log while the rest moves: a pose, a heading, an encoder, or a clock."""

from __future__ import annotations

import numpy as np

from disco_hw.log.contradictions import SIDES, Contradiction
from disco_hw.log.drive import DriveLog
from disco_hw.log.motion_fits import FEWEST_WINDOWS, MOVING_RAD, TURNING_RAD
from disco_hw.log.motion_windows import STEP_S, MotionWindows

_STILL = 0.02
_EXACTLY = 1e-9
_STANDING_SHARE = 0.05
_DEAD_SHARE = 0.2
_MOSTLY = 0.5
_FEWEST_COMMON_S = 2.0
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
            f"the poses stand still while the wheels turn by {STEP_S * rolled[moving].sum():.3g} rad: the wheels are "
            "off the ground or the pose sensor is dead; leave its columns empty to compare commands and wheels alone",
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
        f"pose_yaw_rad stands still in {share:.0%} of the turns that the wheels make: it is no measured heading; "
        "record a source that measures the heading, or leave the pose columns empty",
        ("body",) if share > _MOSTLY else (),
    )


def _wheels_standing(rolled_rad: np.ndarray, way_m: np.ndarray, radius_m: float) -> Contradiction | None:
    travels = way_m > radius_m
    if np.count_nonzero(travels) < FEWEST_WINDOWS or np.median(rolled_rad[travels]) > _STILL:
        return None
    return Contradiction(
        "wheels_still",
        f"the poses move by {STEP_S * way_m[travels].sum():.3g} m while both wheels stand still: the encoders are not "
        "read, or the poses are of another drive; check the encoders' cables and columns",
    )


def dead_encoders(windows: MotionWindows) -> tuple[Contradiction, ...]:
    """Return the encoders that count nothing while their wheel is told to turn and the other one does."""
    known = np.isfinite(windows.rolled_rad).all(axis=1) & np.isfinite(windows.commanded_rad).all(axis=1)
    rolled, told = np.abs(windows.rolled_rad[known]), np.abs(windows.commanded_rad[known])
    found = []
    for side, name in enumerate(SIDES):
        could = (told[:, side] > MOVING_RAD) & (rolled[:, 1 - side] > MOVING_RAD)
        share = float(np.mean(rolled[could, side] < _STILL)) if np.count_nonzero(could) >= FEWEST_WINDOWS else 0.0
        if share > _DEAD_SHARE:
            message = (
                f"the {name} encoder stands still in {share:.0%} of the time in which its wheel is told to turn and "
                "the other one turns: check its cable and its channel, or the motor"
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
        f"the {SIDES[side]} encoder stands still throughout, and the poses are not those of a robot that turns about "
        "that wheel: check its cable and its channel",
    )
