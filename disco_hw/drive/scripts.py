"""The scripts of `disco-hw drive`, as functions of the robot's limits; the same seed draws the same drive.

`circle` is the paper's drive. `steps` follows the protocol of norlab-ulaval's DRIVE: find the wheels' limits, then hold
wheel speeds drawn evenly within them, 6 s each. `excite` takes two minutes to show what inference and the search for
gaps need to distinguish parameters and effects. The others show in at most a minute
what another drive could not: each effect of the model names the one for it, and `separate` is all of them in one.
Their shares are of the largest wheel speed: (forward, turn to the left).
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

from disco_hw.config import Robot
from disco_hw.drive.script import Manoeuvre, Pieces, Script
from disco_hw.errors import InputError
from disco_hw.tasks import RobotTask
from disco_hw.tasks.circle import CircleTask, circle_task

_STRAIGHT = "wheel radius against gains, slope and unequal wheels: two speeds, both ways"
_SPIN = "axial distance against slip in turns, and where it turns about: two rates, both ways"
_CURVE = "side slip and heading bias, which need speed and turning at once: two speeds, both ways"
_START = "lag, delay, late poses and slip under acceleration"
_STEER = "separates delay from lag"
_RAMP = "separates deadband from stiction, slowly through zero"


def _slow_straights(pieces: Pieces, each_s: float) -> list[Manoeuvre]:
    return pieces.each(_STRAIGHT, ("slow straight", each_s, 0.4, 0.0), ("slow reverse", each_s, -0.4, 0.0))


def _fast_straights(pieces: Pieces, each_s: float) -> list[Manoeuvre]:
    return pieces.each(_STRAIGHT, ("full speed straight", each_s, 1.0, 0.0), ("full speed reverse", each_s, -1.0, 0.0))


def _slow_spins(pieces: Pieces, each_s: float) -> list[Manoeuvre]:
    return pieces.each(_SPIN, ("slow turn left", each_s, 0.0, 0.3), ("slow turn right", each_s, 0.0, -0.3))


def _fast_spins(pieces: Pieces, each_s: float) -> list[Manoeuvre]:
    return pieces.each(_SPIN, ("fast turn left", each_s, 0.0, 0.85), ("fast turn right", each_s, 0.0, -0.85))


def _curves(pieces: Pieces, long_s: float, short_s: float) -> list[Manoeuvre]:
    return pieces.each(
        _CURVE,
        ("slow curve left", long_s, 0.3, 0.14),
        ("slow curve right", long_s, 0.3, -0.14),
        ("fast curve left", short_s, 0.65, 0.3),
        ("fast curve right", short_s, 0.65, -0.3),
    )


def _starts(pieces: Pieces, count: int) -> list[Manoeuvre]:
    # Slip under acceleration grows with the square of the speed reached, being late in proportion to it: two speeds.
    found: list[Manoeuvre] = []
    for number in range(count):
        forward = (1.0, -1.0, 0.5, -0.5)[number % 4]
        found += [pieces.hold(f"start and stop {number + 1}", _START, 0.8, forward, 0.0), pieces.rest()]
    return found


def _steering(pieces: Pieces, duration_s: float) -> list[Manoeuvre]:
    steer = pieces.play("steering", _STEER, duration_s, lambda t_s: (0.4, 0.35 * math.cos(math.pi * t_s)))
    return [steer, pieces.rest()]


def _ramps(pieces: Pieces, duration_s: float) -> list[Manoeuvre]:
    def wave(t_s: float) -> float:
        """Return a triangle of height 0.25, which begins and ends at zero."""
        return 0.25 * (2.0 / math.pi * math.asin(math.sin(2.0 * math.pi * (t_s / duration_s))))

    return [
        pieces.play("ramp through zero", _RAMP, duration_s, lambda t_s: (wave(t_s), 0.0)),
        pieces.play("turning ramp through zero", _RAMP, duration_s, lambda t_s: (0.0, wave(t_s))),
    ]


def _built(pieces: Pieces) -> dict[str, list[Manoeuvre]]:
    return {
        "straights": 2 * (_slow_straights(pieces, 4.0) + _fast_straights(pieces, 3.0)),
        "spins": 2 * (_slow_spins(pieces, 4.0) + _fast_spins(pieces, 3.0)),
        "curves": 2 * _curves(pieces, 4.0, 3.0),
        "starts": _starts(pieces, 12) + _steering(pieces, 10.0),
        "ramps": 2 * [*_ramps(pieces, 8.0), pieces.rest()],
        # Turns and straights at either end, for what changes on the way.
        "separate": [
            *_slow_straights(pieces, 2.0),
            *_fast_spins(pieces, 1.5),
            *_curves(pieces, 2.0, 2.0),
            *_starts(pieces, 6),
            *_steering(pieces, 4.0),
            *_ramps(pieces, 5.0),
            pieces.rest(),
            *_slow_spins(pieces, 2.0),
            *_fast_spins(pieces, 1.5),
            *_fast_straights(pieces, 2.0),
        ],
    }


PURPOSES: Mapping[str, str] = MappingProxyType(
    {
        "straights": _STRAIGHT,
        "spins": _SPIN,
        "curves": _CURVE,
        "starts": _START,
        "ramps": _RAMP,
        "separate": "all of these in a minute",
    }
)
SEPARATING = tuple(PURPOSES)


def separating(name: str, top_rad_s: float, max_wheel_acceleration_rad_s2: float = math.inf) -> Script:
    """Return the script of that name with wheel speeds up to `top_rad_s`, from rest to rest; raises KeyError."""
    pieces = Pieces(top_rad_s, max_wheel_acceleration_rad_s2)
    return Script(name, (pieces.rest(1.0), *_built(pieces)[name], pieces.rest(1.0)))


SCRIPTS = ("circle", "steps", "excite", *SEPARATING)
# Chosen: long enough for poses to show the step's steady motion; more steps of it make a longer drive.
STEP_S = 6.0
# Chosen: holds the largest speed for this, beyond the time that the ramp to it takes.
FIND_S = 2.0
# Chosen: with STEP_S two minutes.
STEPS = 20
# Chosen: a second lap shows what repeats.
_LAPS = 2.0


def create_script(name: str, robot: Robot, task: RobotTask, speed_share: float, seed: int = 1) -> Script:
    """Return the script of that name with wheel speeds up to `speed_share` of the robot's limit.

    Raises InputError for an unknown name, and for `circle` if the task is none or too fast for the wheels.
    """
    pieces = Pieces(speed_share * robot.max_wheel_speed_rad_s, robot.max_wheel_acceleration_rad_s2)
    match name:
        case "circle":
            return circle(robot, circle_task(task, "--script circle"), pieces)
        case "steps":
            return steps(pieces, seed)
        case "excite":
            return excite(pieces)
        case _ if name in SEPARATING:
            return separating(name, pieces.top_rad_s, pieces.max_wheel_acceleration_rad_s2)
        case _:
            raise InputError(f"--script {name}: no such script; write one of {', '.join(SCRIPTS)}")


def circle(robot: Robot, task: CircleTask, pieces: Pieces) -> Script:
    """Two laps of the task's circle, counter-clockwise at constant wheel speeds, from rest to rest.

    Raises InputError if a wheel would need more than the largest speed of `pieces`.
    """
    yaw_rate_rad_s = task.speed_m_s / task.radius_m
    half_m = 0.5 * robot.axial_distance_m
    left = (task.speed_m_s - yaw_rate_rad_s * half_m) / robot.wheel_radius_m
    right = (task.speed_m_s + yaw_rate_rad_s * half_m) / robot.wheel_radius_m
    if max(abs(left), abs(right)) > pieces.top_rad_s:
        raise InputError(
            f"--script circle: the outer wheel would need {right:.2f} rad/s, and drive.speed_share of "
            f"robot.max_wheel_speed_rad_s is {pieces.top_rad_s:.4g}; lower task.speed_m_s, or raise task.radius_m or "
            "drive.speed_share"
        )
    laps_s = _LAPS * 2.0 * math.pi / yaw_rate_rad_s
    purpose = "the paper's drive; cannot distinguish the wheel radius from slip, nor left from right"
    laps = Manoeuvre("circle to the left", purpose, laps_s, _constant(left, right))
    return Script("circle", (pieces.rest(1.0), laps, pieces.rest()))


def steps(pieces: Pieces, seed: int) -> Script:
    """Wheel speeds drawn evenly within the limits that the wheels show first, 6 s each; at most those of `pieces`."""
    top_rad_s = pieces.top_rad_s
    search = "finds the largest wheel speed that is reached"
    hold_s = FIND_S + top_rad_s / pieces.max_wheel_acceleration_rad_s2
    found: list[Manoeuvre] = []
    for name, forward, turn in (
        ("as fast as it goes", 1.0, 0.0),
        ("as fast as it goes, back", -1.0, 0.0),
        ("as fast as it turns left", 0.0, 1.0),
        ("as fast as it turns right", 0.0, -1.0),
    ):
        held = pieces.hold(name, search, hold_s, forward, turn)
        found += [replace(held, duration_s=hold_s, finds_limits=True), pieces.rest()]
    draw = random.Random(seed)
    purpose = "steady motion anywhere within the limits, and the step to it"
    # A step may be from full speed to full speed the other way.
    step_s = STEP_S + 2.0 * pieces.extra_s(1.0)
    for number in range(1, STEPS + 1):
        left, right = draw.uniform(-1.0, 1.0), draw.uniform(-1.0, 1.0)
        wheels = _constant(left * top_rad_s, right * top_rad_s)
        name = f"step {number}: {left:+.0%} {right:+.0%} of the limits"
        found.append(Manoeuvre(name, purpose, step_s, wheels, within_limits=True))
    return Script("steps", (*found, pieces.rest()))


def excite(pieces: Pieces) -> Script:
    """Return a short drive after which nearly all parameters and effects can be distinguished; it ends near its start.

    Shares below are those of `pieces`: (forward, turn to the left).
    """
    found: list[Manoeuvre] = [pieces.rest(2.0, "noise of the poses at standstill")]
    found += pieces.each(
        "wheel radius, and what grows with speed: gain, slip, pose latency",
        ("slow straight", 4.0, 0.4, 0.0),
        ("slow reverse", 4.0, -0.4, 0.0),
        ("fast straight", 3.0, 0.95, 0.0),
        ("fast reverse", 3.0, -0.95, 0.0),
    )
    found += pieces.each(
        "axial distance; two rates separate it from slip in turns, both ways separate latency from a heading bias",
        ("slow turn left", 5.0, 0.0, 0.3),
        ("slow turn right", 5.0, 0.0, -0.3),
        ("fast turn left", 4.0, 0.0, 0.75),
        ("fast turn right", 4.0, 0.0, -0.75),
    )
    found += pieces.each(
        "x_icr and side slip, which need speed and turning at once; latency changes sign with the side",
        ("slow curve left", 6.0, 0.3, 0.14),
        ("slow curve right", 6.0, 0.3, -0.14),
        ("fast curve left", 5.0, 0.65, 0.3),
        ("fast curve right", 5.0, 0.65, -0.3),
        ("reverse curve left", 4.0, -0.45, 0.2),
        ("reverse curve right", 4.0, -0.45, -0.2),
    )
    lag = "lag and delay from command to wheel, slip under acceleration"
    for number in range(8):
        forward = 0.7 if number % 2 == 0 else -0.7
        found += [pieces.hold(f"start and stop {number + 1}", lag, 1.0, forward, 0.0), pieces.rest(0.8)]
    steering = "separates delay from lag, build-up of turning under load"
    found += [
        pieces.play("steering at 0.5 Hz", steering, 12.0, lambda t_s: (0.4, 0.35 * math.cos(math.pi * t_s))),
        pieces.rest(),
        *_ramps(pieces, 10.0),
        pieces.rest(2.0, "noise of the poses at standstill, elsewhere"),
    ]
    return Script("excite", tuple(found))


def _constant(left_rad_s: float, right_rad_s: float) -> Callable[[float], tuple[float, float]]:
    return lambda _t_s: (left_rad_s, right_rad_s)
