"""Checks before the first motion: each a pure judgement of figures that somebody else took; and the link's load."""

from __future__ import annotations

import enum
import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from disco_hw.config import Control, Link, Robot, RobotConfig
from disco_hw.errors import FieldFault
from disco_hw.fence import Fence
from disco_hw.tasks import RobotTask, straight_fastest_m_s
from drivers.motor import find_driver
from drivers.types import SOURCE_TEXTS, CyclicFrame, Limits, SafetyCard
from firmware_protocol.serial_framing import BITS_PER_BYTE

# Of firmware_protocol.serial_framing: kind 1, identifier 2, CRC 2, COBS 1, delimiter 1.
_SERIAL_OVERHEAD_BYTES = 7


def worst_case_bits(length: int) -> int:
    """Return the bit times of a classic CAN frame with 11-bit identifier and `length` bytes, interframe space included.

    With the most stuff bits that its content can need: 55 + 10 n, which is 135 for 8 bytes (ISO 11898-1: one after
    each four of the 34 + 8 n bits that are stuffed, the first excepted).
    """
    return 47 + 8 * length + (34 + 8 * length - 1) // 4


def can_load(frames: Iterable[CyclicFrame], bitrate: int) -> float:
    """Return the part of a CAN bus at `bitrate` (bit/s) that the frames take, every one with the most stuff bits."""
    return sum(worst_case_bits(frame.length) * frame.rate_hz for frame in frames) / bitrate


def serial_load(frames: Iterable[CyclicFrame], baud: int) -> float:
    """Return the part of a serial line at `baud` (bit/s) that the frames take in the busier of its two directions.

    A frame is tunnelled with 7 bytes of kind, identifier, CRC, stuffing and delimiter, unless it says otherwise; a byte
    is 10 bits on the line.
    """
    load: dict[str, float] = {}
    for frame in frames:
        count = frame.length + _SERIAL_OVERHEAD_BYTES if frame.line_bytes is None else frame.line_bytes
        busy_s = count * BITS_PER_BYTE / baud + frame.pause_s
        load[frame.sender] = load.get(frame.sender, 0.0) + busy_s * frame.rate_hz
    return max(load.values(), default=0.0)


# Steps of LIMITS in firmware_protocol/disco_robot.dbc: a limit that was rounded to one is still the same limit.
_SPEED_RESOLUTION_RAD_S = 0.002
_ACCELERATION_RESOLUTION_RAD_S2 = 0.01
# Chosen: the rest is room for retransmissions and other nodes; above the limit, frames of low priority may wait too
# long.
_LOAD_BUDGET = 0.4
_LOAD_LIMIT = 0.8
# Chosen: a disturbed frame and a late tick, one after the other, must not stop the robot.
_COMMANDS_TO_SPARE = 2


class Level(enum.Enum):
    """Levels of a check's result."""

    OK = "ok"
    WARNING = "warn"
    FAIL = "fail"


@dataclass(frozen=True, slots=True)
class Check:
    """Result of one check: `text` says what was found, and what to do if it is not ok."""

    name: str
    level: Level
    text: str


def check_link_load(link: Link, control: Control) -> Check:
    """Compare the load of the link by the driver's cyclic frames with a budget of 40 %."""
    frames = find_driver(link.driver).cyclic_frames(link.settings(), control.rate_hz, link.key_file is not None)
    if link.kind == "can":
        load = can_load(frames, link.bitrate)
        found = f"{load:.1%} of the bus at {link.bitrate / 1e3:g} kbit/s with the largest number of stuff bits"
        hint = "raise link.bitrate on both ends, or lower control.rate_hz"
    else:
        load = serial_load(frames, link.baud)
        shared = any(frame.line_bytes is not None for frame in frames)
        found = f"{load:.1%} of the {'line' if shared else 'busier direction'} at {link.baud} baud"
        hint = "raise link.baud on both ends, or lower control.rate_hz"
    if load > _LOAD_LIMIT:
        return Check("link load", Level.FAIL, f"{found} is too much; {hint}")
    if load > _LOAD_BUDGET:
        return Check("link load", Level.WARNING, f"{found} is above {_LOAD_BUDGET:.0%}; {hint}")
    return Check("link load", Level.OK, found)


def check_firmware_limits(robot: Robot, limits: Limits) -> list[Check]:
    """Compare robot.toml's limits and encoder with the controller's; FAIL for each that does not fit, else one OK.

    A limit is to be refused at the start, not clipped in silence: a host that plans with more than the robot does
    plans wrongly. Equal within the resolution on the wire (0.002 rad/s, 0.01 rad/s^2) is within.
    """
    errors, found = [], []
    for name, unit, limit, resolution in (
        ("max_wheel_speed_rad_s", "rad/s", limits.max_wheel_speed_rad_s, _SPEED_RESOLUTION_RAD_S),
        (
            "max_wheel_acceleration_rad_s2",
            "rad/s^2",
            limits.max_wheel_acceleration_rad_s2,
            _ACCELERATION_RESOLUTION_RAD_S2,
        ),
    ):
        if limit is None:
            continue
        value, source = getattr(robot, name), SOURCE_TEXTS[limit.said_by]
        found.append(f"{value:g} {unit} of at most {limit.value:g}, {source}")
        if not value <= limit.value + resolution:
            errors.append(
                f"robot.{name}: {value:g} is above the controller's limit, {source}; write at most {limit.value:g}, "
                "or raise the controller's limit"
            )
    ticks = limits.ticks_per_rev
    if ticks is not None:
        found.append(f"{ticks.value:g} ticks a turn, {SOURCE_TEXTS[ticks.said_by]}")
        if robot.ticks_per_rev != ticks.value:
            errors.append(
                f"robot.ticks_per_rev: {robot.ticks_per_rev:g} differs from the firmware's {ticks.value:g}; "
                f"write {ticks.value:g}, or flash the firmware for this encoder"
            )
    if errors:
        return [Check("firmware limits", Level.FAIL, error) for error in errors]
    return [Check("firmware limits", Level.OK, "; ".join(found))]


def _fastest_m_s(config: RobotConfig, task: RobotTask) -> float:
    """Return the speed at which a wheel, or in the tightest bend the turning of the base, is at its limit."""
    robot, fastest_m_s = config.robot, task.fastest_m_s(config.robot)
    # Twice what the outer wheel of the tightest bend turns more than straight ahead: the difference of both wheels.
    difference_part = 2.0 * (straight_fastest_m_s(robot) / fastest_m_s - 1.0)
    if difference_part <= 0.0:
        return fastest_m_s
    return min(fastest_m_s, config.largest_wheel_difference_rad_s * robot.wheel_radius_m / difference_part)


def beyond_robot(config: RobotConfig, task: RobotTask) -> FieldFault | None:
    """Return what of the task the nominal robot and its base cannot do; None if they can."""
    fault, fastest_m_s = task.beyond_robot(config.robot), _fastest_m_s(config, task)
    if fault is not None or not task.reference_speed_m_s > fastest_m_s:
        return fault
    return FieldFault(
        "speed_m_s",
        f"{task.reference_speed_m_s:g} m/s turns the robot faster than its base can",
        f"write at most {math.floor(fastest_m_s * 1000.0) / 1000.0:g} m/s, or a larger figure",
    )


def check_task(config: RobotConfig) -> Check:
    """Compare the task with what the nominal robot can do; `config` is that of `config_for_tasks`."""
    task = config.task
    fault = beyond_robot(config, task)
    if fault is not None:
        return Check("task", Level.FAIL, f"task.{fault.field}: {fault.fault}; {fault.hint}")
    backwards = ", driven backwards" if config.turned_rad else ""
    return Check(
        "task", Level.OK, f"{task.describe()}{backwards}; the wheels can do {_fastest_m_s(config, task):.2f} m/s on it"
    )


def check_fence(robot: Robot, fence: Fence) -> list[Check]:
    """Report the footprint's size where a fence is set, and warn if it is estimated; an empty list without a fence."""
    if not fence.is_set:
        return []
    size = robot.footprint
    found = f"footprint {size.length:.2f} m x {size.width:.2f} m, {size.ahead:+.2f} m ahead of the tracked point"
    if robot.footprint_m is None:
        found += ", estimated from the wheels; measure the robot and write robot.footprint_m"
    return [Check("fence", Level.WARNING if robot.footprint_m is None else Level.OK, found)]


def check_command_timing(control: Control, limits: Limits) -> Check:
    """Count how many commands in a row may be lost before the firmware stops the robot."""
    timeout_s = min(control.command_valid_for_s, limits.command_timeout_s.value)
    # The last command received holds for the timeout; the next that arrives must do so within it.
    spare = math.ceil(round(timeout_s * control.rate_hz, 6)) - 2
    found = f"the firmware stops the robot {timeout_s * 1e3:g} ms after the last command; at {control.rate_hz:g} Hz "
    if spare < 0:
        return Check(
            "command timing", Level.FAIL, f"{found}the robot stops between two commands; raise control.rate_hz"
        )
    if spare < _COMMANDS_TO_SPARE:
        few = f"only {spare}" if spare else "not one"
        text = f"{found}{few} command may be lost; raise control.rate_hz or control.command_valid_for_s"
        return Check("command timing", Level.WARNING, text)
    return Check("command timing", Level.OK, f"{found}{spare} commands in a row may be lost")


def check_watchdog(limits: Limits) -> Check:
    """Warn if the command timeout is declared in robot.toml and not read from the controller."""
    timeout = limits.command_timeout_s
    described = f"{timeout.value:g} s, {SOURCE_TEXTS[timeout.said_by]}"
    if timeout.said_by == "robot.toml":
        return Check("watchdog", Level.WARNING, f"{described}; it could not be read back from the controller")
    return Check("watchdog", Level.OK, described)


def check_safety(robot: Robot, card: SafetyCard) -> list[Check]:
    """Check the safety card: what stops the robot when, how far it goes at full speed, what could not be verified."""
    speed_m_s = robot.max_wheel_speed_rad_s * robot.wheel_radius_m
    driven_m = speed_m_s * card.reaction_s
    if card.brakes:
        braking_m = speed_m_s**2 / (2.0 * robot.max_wheel_acceleration_rad_s2 * robot.wheel_radius_m)
        stop_time_s = card.reaction_s + speed_m_s / (robot.max_wheel_acceleration_rad_s2 * robot.wheel_radius_m)
        far = f"about {driven_m + braking_m:.2f} m and {stop_time_s:.2f} s at {speed_m_s:.2f} m/s"
    else:
        far = f"{driven_m:.2f} m, {card.reaction_s:.2f} s, at {speed_m_s:.2f} m/s, and then as far as the robot rolls"
    checks = [
        Check("stops when the host is silent", Level.OK, card.host_silent),
        Check("stops by", Level.OK if card.brakes else Level.WARNING, f"{card.stops_by}; {far}"),
        Check("e-stop", Level.OK, card.estop),
        Check("a wheel does not obey", Level.OK, card.wheel_fault),
    ]
    checks += [Check("not verified", Level.WARNING, text) for text in card.unverified]
    return checks + [Check("to be set in the controller", Level.OK, text) for text in card.setup]


def check_realtime(priority: int, fifo_allowed: bool, memory_lock_allowed: bool, cpu_count: int) -> list[Check]:
    """Say which real-time measures this process may take; none is required, each makes the loop more punctual."""
    checks = []
    if priority == 0:
        checks.append(
            Check("scheduler", Level.WARNING, "real-time scheduling is off: daemon.realtime_priority is 0; write 80")
        )
    elif fifo_allowed:
        checks.append(Check("scheduler", Level.OK, f"SCHED_FIFO {priority} is allowed"))
    else:
        hint = "set LimitRTPRIO=99 in the service, or an rtprio line in /etc/security/limits.conf"
        checks.append(Check("scheduler", Level.WARNING, f"SCHED_FIFO is not allowed; {hint}"))
    if memory_lock_allowed:
        checks.append(Check("memory", Level.OK, "may be locked"))
    else:
        hint = "set LimitMEMLOCK=infinity in the service, or a memlock line in /etc/security/limits.conf"
        checks.append(Check("memory", Level.WARNING, f"may not be locked; {hint}"))
    if cpu_count < 2:
        checks.append(
            Check(
                "CPUs",
                Level.WARNING,
                "the loop shares the only CPU with everything else; use a computer with more CPUs",
            )
        )
    return checks


def check_round_trip(round_trips_s: Sequence[float], period_s: float) -> Check:
    """Compare measured round trips to the robot and back (s) with the control period (s).

    Refused if a quarter of them or more take a period: the link is slow then, and each sample comes a tick late. A
    single one was held up by this computer or the bus; from such ones the robot's own watchdog protects.
    """
    name = "round trip"
    if not round_trips_s:
        return Check(name, Level.FAIL, "the robot did not answer; check its power, the cable and the link's settings")
    count, worst_s = len(round_trips_s), max(round_trips_s)
    found = f"median {statistics.median(round_trips_s) * 1e3:.2f} ms, worst {worst_s * 1e3:.2f} ms of {count}"
    period = f"a control period of {period_s * 1e3:g} ms"
    hint = "check the USB adapter's low-latency mode and the load of the bus"
    too_slow = sum(round_trip_s >= period_s for round_trip_s in round_trips_s)
    if 4 * too_slow >= count:
        return Check(name, Level.FAIL, f"{found}; {too_slow} are longer than {period}; {hint}")
    if too_slow:
        text = f"{found}; {too_slow} longer than {period}; stop other programs on this computer, and check again"
        return Check(name, Level.WARNING, text)
    if worst_s >= period_s / 2:
        return Check(name, Level.WARNING, f"{found}; the worst is longer than half of {period}; {hint}")
    return Check(name, Level.OK, found)
