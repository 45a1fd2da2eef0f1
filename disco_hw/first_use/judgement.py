"""Evaluation of the guided first drive: faults with the lines of robot.toml that mend them, and figures; pure.

A fault is judged against what robot.toml says already: what was mended once and is right now is no fault.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, product
from statistics import median
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw.config import Robot
from disco_hw.first_use.procedure import RUNAWAY_SHARE, SIDES, SLOWING, FloorSeen, SideSeen, Track, TurnsSeen
from drivers.motor import Wiring
from drivers.pose import PoseConvention
from drivers.types import PoseSample

Edits = Mapping[tuple[str, str], Any]

# Chosen: above the noise of a measured speed, below the slowest motion of the procedure.
STATIONARY_RAD_S = 0.05
COUNTS_RAD = 0.1
"""A wheel that was seen turning has moved its own encoder by more, another one by less."""
TURN_TOLERANCE = 0.15
"""What a person's eye and finger may miss of a turn."""
# Chosen: less may be skid-steering's own; more is a sensor beside the middle.
POSE_STD_LEFT_M = 0.1
# Chosen: allowance for the delay of the samples and for the wheel's own slowing down.
SETTLED_S = 0.5


@dataclass(frozen=True)
class Fault:
    """Fault with its remedy in words; `edits`: fields of robot.toml, by section and name, that correct it."""

    name: str
    text: str
    edits: Edits = field(default_factory=dict)


@dataclass(frozen=True)
class Findings:
    """Faults, and figures for the operator: what was measured, in words."""

    faults: tuple[Fault, ...] = ()
    figures: tuple[str, ...] = ()

    @property
    def edits(self) -> dict[tuple[str, str], Any]:
        """Edits of all faults together, by section and name of the field."""
        return {place: value for fault in self.faults for place, value in fault.edits.items()}


def evaluate_sides(seen: Sequence[SideSeen], wiring: Wiring, robot: Robot) -> Findings:
    """Find which motor and encoder is on which side, and which way round; `wiring`: that of robot.toml."""
    faults: list[Fault] = []
    figures = [_dead_band(side, one.track) for side, one in enumerate(seen)]
    for side, one in enumerate(seen):
        if one.ran_away:
            limit = RUNAWAY_SHARE * robot.max_wheel_speed_rad_s
            faults.append(
                Fault(
                    "runaway",
                    f"at a slow start of the {SIDES[side]} side a wheel reached more than {limit:.1f} rad/s: its "
                    "controller and its encoder disagree about forward; exchange the encoder's channels A and B, "
                    "or run the controller's own calibration",
                )
            )
        if not one.seen:
            faults.append(Fault(f"{SIDES[side]} still", _stationary_text(side, one.track)))
    turned = ["lr".index(one.seen[0]) for one in seen if one.seen]
    if len(turned) == 2 and turned[0] == turned[1]:
        both = f"both commands turned the {SIDES[turned[0]]} side; give each side its own node, or check the cables"
        faults.append(Fault("one side for both", both))
    if faults:
        return Findings(tuple(faults), tuple(figures))
    return Findings(tuple(_wiring_faults(seen, wiring)), tuple(figures))


def _stationary_text(side: int, track: Track) -> str:
    counted = [SIDES[k] for k, rad in enumerate(track.turned()) if abs(rad) > COUNTS_RAD]
    if counted:
        return f"you saw nothing turn, but the {' and '.join(counted)} encoder counts; look again"
    return (
        f"the {SIDES[side]} side does not turn at {max(map(abs, track.commands[-1][1:]), default=0.0):.1f} rad/s; "
        "check its motor's cable, the motor supply and the controller's limits of current and speed"
    )


def _wiring_faults(seen: Sequence[SideSeen], old: Wiring) -> list[Fault]:
    """Compare the wiring that was seen with the one that robot.toml says."""
    motors, encoders = [0, 0], [0, 0]
    dead: list[int] = []
    swapped = crossed = False
    for commanded, one in enumerate(seen):
        side, way = "lr".index(one.seen[0]), 1 if one.seen[1] == "f" else -1
        channel = commanded ^ old.sides_swapped
        motors[side] = way * old.motor_direction[commanded]
        swapped = bool(channel ^ side)
        counted = one.track.turned()
        reader = max((0, 1), key=lambda k: abs(counted[k]))
        if abs(counted[reader]) < COUNTS_RAD:
            dead.append(side)
            continue
        expected = reader ^ (old.sides_swapped != old.encoders_swapped)
        crossed = swapped != bool(expected ^ side)
        encoders[side] = way * (1 if counted[reader] > 0.0 else -1) * old.encoder_direction[reader]
    if dead:
        names = " and ".join(SIDES[side] for side in dead)
        return [Fault("encoder dead", f"the {names} wheel turned but its encoder did not count; check its cable")]
    found: list[tuple[str, str]] = []
    edits: dict[tuple[str, str], Any] = {}
    if swapped != old.sides_swapped:
        found.append(("sides swapped", "the controller's left side drives the right wheels"))
        edits["wheels", "sides_swapped"] = swapped
    if crossed != old.encoders_swapped:
        found.append(("encoders swapped", "the left and right encoders are exchanged"))
        edits["wheels", "encoders_swapped"] = crossed
    for one in sorted(seen, key=lambda one: one.seen[0]):
        side = "lr".index(one.seen[0])
        name = SIDES[side]
        if one.seen[1] == "b":
            found.append((f"{name} motor reversed", f"forward turns the {name} wheels backward"))
            edits["wheels", "motor_direction"] = motors
        elif encoders[side] != old.encoder_direction[side]:
            found.append((f"{name} encoder reversed", f"the {name} encoder counts down when its wheel turns forward"))
            edits["wheels", "encoder_direction"] = encoders
    if encoders != list(old.encoder_direction):
        edits["wheels", "encoder_direction"] = encoders
    if motors != list(old.motor_direction):
        edits["wheels", "motor_direction"] = motors
    # Each needs all the others: a wheel that is found under another name has that one's direction.
    return [Fault(name, text, edits) for name, text in found]


def _dead_band(side: int, track: Track) -> str:
    """Return the command at which a wheel began to turn."""
    begun = next(
        (s.t_ns for s in track.wheels if max(abs(s.left_speed_rad_s), abs(s.right_speed_rad_s)) > STATIONARY_RAD_S),
        None,
    )
    if begun is None:
        return f"{SIDES[side]}: never turned"
    command = max((max(abs(left), abs(right)) for t_ns, left, right in track.commands if t_ns <= begun), default=0.0)
    return f"{SIDES[side]}: begins to turn at a command of {command:.2f} rad/s"


def evaluate_turns(seen: TurnsSeen, wiring: Wiring, reaction_s: float, brakes: bool) -> Findings:
    """Ticks a turn, and whether the robot stopped by itself; `reaction_s`: how soon the driver's safety card says."""
    faults, figures = [], []
    shares = [abs(track.turned()[side]) / (2.0 * math.pi) for side, track in enumerate(seen.turns)]
    for side, share in enumerate(shares):
        figures.append(f"{SIDES[side]}: one turn counted as {share:.2f} turns")
    ratio = 1.0 / (0.5 * sum(shares)) if sum(shares) else math.inf
    if min(shares) <= 0.0 or max(shares) / min(shares) > 1.0 + 2.0 * TURN_TOLERANCE:
        faults.append(
            Fault(
                "turns differ", "the two sides count differently for one turn; compare their gears, encoders, settings"
            )
        )
    elif abs(ratio - 1.0) > TURN_TOLERANCE:
        faults.append(
            Fault(
                "wrong ticks",
                f"the wheels make {ratio:.2f} turns for each counted turn: ticks_per_rev, gear or pole_pairs is "
                "wrong; correct the wrong one, or write turn_ratio",
                {("wheels", "turn_ratio"): _simple(wiring.turn_ratio * ratio)},
            )
        )
    figures += [f"{name}: {text}" for name, text in _response(seen.watchdog)]
    stopped = _stop_after_silence(seen.watchdog)
    if stopped is None:
        faults.append(
            Fault(
                "watchdog off",
                "this computer stopped sending and the wheels kept turning: the controller's watchdog is off or "
                "far too long; set it as `disco-hw check` says, and do not put the robot on the floor before",
            )
        )
    else:
        begun_s, stationary_s = stopped
        how = "braking" if brakes else "coasting"
        figures.append(
            f"watchdog: slowing down {begun_s:.2f} s after the last command, {_standing(stationary_s)} ({how})"
        )
        if begun_s > reaction_s + SETTLED_S:
            delayed = (
                f"the robot began to stop {begun_s:.2f} s after the last command, but should within {reaction_s:.2f} s"
            )
            faults.append(Fault("watchdog late", f"{delayed}; set its time as `disco-hw check` says"))
    return Findings(tuple(faults), tuple(figures))


def _standing(stationary_s: float | None) -> str:
    return "still rolling at the end" if stationary_s is None else f"at rest after {stationary_s:.2f} s"


def _simple(ratio: float) -> float:
    """Return a ratio of small numbers where one is as near as a person can tell, else two digits."""
    near = [a / b for b in range(1, 9) for a in range(1, 9) if abs(a / b / ratio - 1.0) < 0.3 * TURN_TOLERANCE]
    integers = [
        float(n) for n in range(2, 65) if min(abs(n / ratio - 1.0), abs(n * ratio - 1.0)) < 0.3 * TURN_TOLERANCE
    ]
    if integers:
        return integers[0] if ratio > 1.0 else 1.0 / integers[0]
    return min(near, key=lambda value: abs(value - ratio)) if near else float(f"{ratio:.2g}")


def _stop_after_silence(track: Track) -> tuple[float, float | None] | None:
    """Return when the wheels began to slow down and when they stood, since the last command (s), or None."""
    silent_ns = track.silent_ns or 0
    # What the robot said to be its own stop may show late; what began after the person had let go was not its own.
    let_go_s = (track.ended_ns - silent_ns) * 1e-9 if track.let_go and track.ended_ns is not None else math.inf
    before = [_faster(s.left_speed_rad_s, s.right_speed_rad_s) for s in track.wheels if s.t_ns <= silent_ns]
    after = [
        ((s.t_ns - silent_ns) * 1e-9, _faster(s.left_speed_rad_s, s.right_speed_rad_s))
        for s in track.wheels
        if s.t_ns > silent_ns
    ]
    steady = median(before[-20:]) if before else 0.0
    slow = next((t_s for t_s, speed in after if speed < SLOWING * steady), None)
    if slow is None or slow > let_go_s + 0.05 or after[-1][1] > 0.5 * steady:
        return None
    return slow, next((t_s for t_s, speed in after if speed < STATIONARY_RAD_S), None)


def _faster(left: float, right: float) -> float:
    return max(abs(left), abs(right))


def _response(track: Track) -> list[tuple[str, str]]:
    """Return the figure of the wheels' delay after a command, between the halves of both rises."""
    if not track.commands:
        return []
    top = max(_faster(left, right) for _, left, right in track.commands)
    commanded_s = next((t for t, left, right in track.commands if _faster(left, right) >= 0.5 * top), None)
    came = next((s.t_ns for s in track.wheels if _faster(s.left_speed_rad_s, s.right_speed_rad_s) >= 0.5 * top), None)
    if commanded_s is None or came is None:
        return [("command to wheel", "no response seen")]
    return [("command to wheel", f"{max(0.0, (came - commanded_s) * 1e-6):.0f} ms")]


def evaluate_floor(seen: FloorSeen, configured: PoseConvention, robot: Robot) -> Findings:
    """Find the units and axes of the poses, the sensor's place, and its delay.

    The poses are as the source sent them; `configured` is what robot.toml says of them. Its `origin` and `offset` are
    believed, as no drive of this kind shows them.
    """
    legs = (seen.straight, seen.left, seen.right, seen.straight_again)
    if any(len(leg.poses) < 5 for leg in legs):
        where = "no pose received" if not any(leg.poses for leg in legs) else "poses received only now and then"
        return Findings((Fault("no poses", f"{where} while driving; check [pose] and the sender of the poses"),))
    choices = (msgspec.structs.replace(configured, **units) for units in _CHOICES)
    fits = [fit for choice in choices if (fit := _fit(seen, choice, robot)) is not None]
    if not fits:
        text = (
            "the poses do not follow the robot in any units or axes; check that the sensor tracks this robot, that "
            "its frame is fixed to the floor, and that the wheels did not slip"
        )
        return Findings((Fault("poses do not follow", text),))
    # What robot.toml says is believed where it explains the drive.
    best = min(
        fits,
        key=lambda fit: (fit.mismatch_rad > _SAME_RAD, not _same_units(fit.convention, configured), fit.mismatch_rad),
    )
    faults = list(_pose_faults(best, configured))
    figures = [
        f"straight ahead: {best.wheels_m:.3f} m by the wheels, {best.poses_m:.3f} m by the poses",
        f"half a turn with the nominal axial distance was {math.degrees(best.turned_rad):.0f} degrees",
    ]
    if not 0.75 < best.poses_m / best.wheels_m < 1.33:
        faults.append(
            Fault(
                "wrong distance",
                f"the wheels measure {best.wheels_m:.2f} m where the poses measure {best.poses_m:.2f} m: "
                "wheel_radius_m or the ticks are wrong; measure the wheel, and count its turns again with the "
                "wheels off the ground",
            )
        )
    figures += _places(seen, best)
    return Findings(tuple(faults), tuple(figures))


# Chosen: an angle that matches the drive to this is explained; conventions differ by far more.
_SAME_RAD = 0.35
# Chosen: sensors are mounted in quarter turns, and half a metre of driving shows an angle no better.
_OFFSET_RAD = 0.2
# The nearest multiple of it is what the mounting was meant to be.
_QUARTER = 0.5 * math.pi
_UNITS = ("position_unit", "yaw_unit", "clockwise", "mirrored")
_METRES: tuple[Literal["m", "cm", "mm"], ...] = ("m", "cm", "mm")
_RADIANS: tuple[Literal["rad", "deg"], ...] = ("rad", "deg")
_CHOICES: tuple[dict[str, Any], ...] = tuple(
    dict(zip(_UNITS, units, strict=True)) for units in product(_METRES, _RADIANS, (False, True), (False, True))
)


@dataclass(frozen=True)
class _Fit:
    """Fit of one pose convention to the drive; `mismatch_rad`: of the sensor's heading in the two straights."""

    convention: PoseConvention
    mismatch_rad: float
    wheels_m: float
    poses_m: float
    turned_rad: float


def _same_units(found: PoseConvention, configured: PoseConvention) -> bool:
    return all(getattr(found, name) == getattr(configured, name) for name in _UNITS)


def _fit(seen: FloorSeen, choice: PoseConvention, robot: Robot) -> _Fit | None:
    """Return the drive in this convention, with the yaw offset that it shows if that is another than the choice's own.

    None where distance or turn cannot be so.
    """
    wheels_m = _travel(seen.straight, robot)
    turns = [[choice.converted(pose) for pose in track.poses] for track in (seen.left, seen.right)]
    left, right = map(_turn, turns)
    if wheels_m <= 0.0 or not (0.2 < left / math.pi < 2.0 and 0.2 < -right / math.pi < 2.0):
        return None
    arm = _arm(turns)
    straights = [[choice.converted(pose) for pose in track.poses] for track in (seen.straight, seen.straight_again)]
    (poses_m, first), (_, second) = (_displacement(poses, arm) for poses in straights)
    if not 0.3 < poses_m / wheels_m < 3.0:
        return None
    aside = math.atan2(math.sin(first) + math.sin(second), math.cos(first) + math.cos(second))
    found = choice
    if abs(aside) > _OFFSET_RAD:
        offset = choice.yaw_offset_rad + aside
        near = _QUARTER * round(offset / _QUARTER)
        offset = math.remainder(near if abs(offset - near) < _OFFSET_RAD else offset, 2.0 * math.pi)
        found = msgspec.structs.replace(choice, yaw_offset_rad=offset)
    mismatch_rad = abs(math.remainder(first - second, 2.0 * math.pi))
    return _Fit(found, mismatch_rad, wheels_m, poses_m, 0.5 * (left - right))


def _travel(track: Track, robot: Robot) -> float:
    left, right = track.turned()
    return 0.5 * (left + right) * robot.wheel_radius_m


def _displacement(poses: Sequence[PoseSample], arm: tuple[float, float]) -> tuple[float, float]:
    """Return the distance (m) by which the point about which the robot turns has moved, and its direction (rad).

    It moves from the first poses' mean, at rest, to the last ones'. The direction is relative to the mean heading: this
    point alone moves where the robot heads, also along a curve.
    """
    rest = max(1, min(10, len(poses) // 4))
    cosines, sines = [math.cos(p.yaw_rad) for p in poses], [math.sin(p.yaw_rad) for p in poses]
    x = [p.x_m - c * arm[0] + s * arm[1] for p, c, s in zip(poses, cosines, sines, strict=True)]
    y = [p.y_m - s * arm[0] - c * arm[1] for p, c, s in zip(poses, cosines, sines, strict=True)]
    dx, dy = (_mean(along[-rest:]) - _mean(along[:rest]) for along in (x, y))
    return math.hypot(dx, dy), math.atan2(dy, dx) - math.atan2(_mean(sines), _mean(cosines))


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values)


def _turn(poses: Sequence[PoseSample]) -> float:
    """Return by how much the yaw has changed (rad), over the steps from pose to pose."""
    return math.fsum(math.remainder(b.yaw_rad - a.yaw_rad, 2.0 * math.pi) for a, b in pairwise(poses))


def _pose_faults(found: _Fit, configured: PoseConvention) -> list[Fault]:
    way = "clockwise" if found.convention.clockwise else "counter-clockwise"
    names = {
        "position_unit": ("pose in other units", f"positions come in {found.convention.position_unit}"),
        "yaw_unit": ("yaw in other units", f"the yaw comes in {found.convention.yaw_unit}"),
        "clockwise": ("yaw the other way round", f"the yaw grows {way}"),
        "mirrored": ("axes mirrored", "left and right are exchanged in the frame of the poses"),
    }
    faults = [
        Fault(name, f"{text}, unlike robot.toml", {("pose", key): getattr(found.convention, key)})
        for key, (name, text) in names.items()
        if getattr(found.convention, key) != getattr(configured, key)
    ]
    offset = found.convention.yaw_offset_rad
    if offset != configured.yaw_offset_rad:
        faults.append(
            Fault(
                "sensor looks aside",
                "when the robot drives straight ahead, the yaw differs from its direction by "
                f"{math.degrees(-offset):.0f} degrees",
                {("pose", "yaw_offset_rad"): round(offset, 4)},
            )
        )
    return faults


def _places(seen: FloorSeen, best: _Fit) -> list[str]:
    """Return lines on where the sensor sits beside the centre of the turns, and its delay against the wheels."""
    convention = best.convention
    tracked = _arm([[convention.converted(pose) for pose in track.poses] for track in (seen.left, seen.right)])
    forward, left = (place + offset for place, offset in zip(tracked, convention.offset, strict=True))
    delays = [_delay_s(track, convention) for track in (seen.left, seen.right)]
    ahead = "ahead of" if forward > 0.0 else "behind"
    aside = "left" if left > 0.0 else "right"
    direction = "behind" if _mean(delays) > 0.0 else "ahead of"
    poses = [convention.converted(pose) for pose in seen.straight.poses]
    rate_hz = (len(poses) - 1) / max(1e-9, (poses[-1].t_ns - poses[0].t_ns) * 1e-9)
    age_ms = median((pose.received_ns - pose.t_ns) * 1e-6 for pose in poses)
    lines = [
        f"lever arm: the sensor is {abs(forward):.2f} m {ahead} and {abs(left):.2f} m to the {aside} of the point "
        f"about which the robot turns (x_icr_m = {-tracked[0]:.2f})",
        f"poses: {rate_hz:.0f} a second, {age_ms:.0f} ms old on arrival, their stamps "
        f"{abs(1e3 * _mean(delays)):.0f} ms {direction} the wheels'",
    ]
    if abs(tracked[1]) > POSE_STD_LEFT_M:
        lines.append(
            "the tracked point is far from the middle of the robot: the circle it drives differs from the robot's"
        )
    return lines


def _arm(turns: Sequence[Sequence[PoseSample]]) -> tuple[float, float]:
    """Return the arm l of p = c + R(yaw) l by least squares, the mean of these turns: forward and left (m)."""
    arms = []
    for poses in turns:
        rows, values = [], []
        for pose in poses:
            c, s = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
            rows += [[1.0, 0.0, c, -s], [0.0, 1.0, s, c]]
            values += [pose.x_m, pose.y_m]
        arms.append(np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0][2:])
    forward, left = np.mean(arms, axis=0)
    return float(forward), float(left)


def _delay_s(track: Track, convention: PoseConvention) -> float:
    """Return by how much the poses' yaw lags behind the wheels' (s): the shift that fits best, to 5 ms."""
    wheel_t = np.array([s.t_ns for s in track.wheels]) * 1e-9
    turn = np.array([s.right_angle_rad - s.left_angle_rad for s in track.wheels])
    poses = [convention.converted(pose) for pose in track.poses]
    pose_t = np.array([pose.t_ns for pose in poses]) * 1e-9
    yaw = np.unwrap([pose.yaw_rad for pose in poses])
    shifts = np.arange(-0.3, 0.6, 0.005)
    return float(min(shifts, key=lambda shift: _mismatch(pose_t - shift, yaw, wheel_t, turn)))


def _mismatch(
    at: NDArray[np.float64], yaw: NDArray[np.float64], t: NDArray[np.float64], turn: NDArray[np.float64]
) -> float:
    base = np.column_stack([np.ones_like(at), np.interp(at, t, turn)])
    left = yaw - base @ np.linalg.lstsq(base, yaw, rcond=None)[0]
    return float(left @ left)
