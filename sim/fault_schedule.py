"""Schedules of faults as data: the kinds of faults, and a schedule in TOML."""

from __future__ import annotations

import enum
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

# Chosen: eleven days; larger is nanoseconds or milliseconds read as seconds.
MAX_TIME_S = 1e6


class FaultFileError(Exception):
    """A schedule that cannot be used; the message is one line that names file, field and remedy."""


class Site(enum.Enum):
    """Sites at which a fault strikes."""

    FRAMES = "frames"
    LINK = "link"
    SENSORS = "sensors"
    ROBOT = "robot"
    PROCESS = "process"


@dataclass(frozen=True, slots=True)
class FaultParameter:
    """One parameter of a kind: a number within bounds, an integer if `is_integer`, or one of `choices`."""

    name: str
    default: float | str
    least: float = 0.0
    most: float = 0.0
    choices: tuple[str, ...] = ()
    is_integer: bool = False


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of fault. `lasts`: it has a duration `for_s`; otherwise it happens at `at_s` and is over."""

    name: str
    site: Site
    summary: str
    parameters: tuple[FaultParameter, ...] = ()
    lasts: bool = True


def _number(name: str, default: float, least: float, most: float, *, is_integer: bool = False) -> FaultParameter:
    return FaultParameter(name, default, least, most, is_integer=is_integer)


_TO = FaultParameter("to", "both", choices=("robot", "host", "both"))
_ONE_SIDE = FaultParameter("to", "robot", choices=("robot", "host"))
_ID = _number("id", -1, -1, 0x7FF, is_integer=True)
_SOME = _number("probability", 0.3, 1e-6, 1.0)
_DELAY = _number("delay_s", 0.3, 1e-3, 10.0)
_CORES = _number("cores", 2, 1, 1024, is_integer=True)
_DROP = _number("drop_v", 6.0, 0.1, 100.0)
_WHEEL = FaultParameter("wheel", "left", choices=("left", "right"))
_PROCESS = FaultParameter("process", "daemon", choices=("daemon", "robot", "recorder", "viewer"))
_FRAMES = (_TO, _ID, _SOME)

KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        kind.name: kind
        for kind in (
            Kind("drop", Site.FRAMES, "frames are lost", _FRAMES),
            Kind("duplicate", Site.FRAMES, "frames come twice", _FRAMES),
            Kind(
                "delay", Site.FRAMES, "frames come late, by `growth` s more with each second that it lasts",
                (*_FRAMES, _number("delay_s", 0.05, 1e-4, 10.0), _number("growth", 0.0, 0.0, 10.0)),
            ),
            Kind("reorder", Site.FRAMES, "frames overtake", (*_FRAMES, _number("window_s", 0.03, 1e-4, 1.0))),
            Kind("flip_before_crc", Site.FRAMES, "a bit is wrong on the wire: the link's own check sees it", _FRAMES),
            Kind("flip_after_crc", Site.FRAMES, "a bit is wrong behind the link's check: only E2E can see it", _FRAMES),
            Kind("wrong_length", Site.FRAMES, "frames are cut short or padded behind the link's check", _FRAMES),
            Kind(
                "babble", Site.LINK, "another node sends zeros under an identifier",
                (_number("id", 0x100, 0, 0x7FF, is_integer=True), _number("rate_hz", 400.0, 0.1, 100_000.0)),
            ),
            Kind(
                "bus_off", Site.LINK, "a controller leaves the bus",
                (FaultParameter("who", "host", choices=("host", "robot")),), lasts=False,
            ),
            Kind("one_way", Site.LINK, "nothing arrives on one side", (_ONE_SIDE,)),
            Kind("unplug", Site.LINK, "the line is pulled out and put back in"),
            Kind("unplug_mid_frame", Site.LINK, "the same, in the middle of a frame"),
            Kind("encoder_stuck", Site.SENSORS, "an encoder does not count", (_WHEEL,)),
            Kind("encoder_disconnected", Site.SENSORS, "an encoder's lines hang in the air", (_WHEEL,)),
            Kind(
                "encoder_jump", Site.SENSORS, "an encoder's count jumps",
                (_WHEEL, _number("ticks", 5000, -(1 << 31), 1 << 31, is_integer=True)), lasts=False,
            ),
            Kind(
                "encoder_wrap", Site.SENSORS, "an encoder's count has so many bits only",
                (_WHEEL, _number("bits", 10, 4, 31, is_integer=True)),
            ),
            Kind("encoder_reversed", Site.SENSORS, "an encoder counts backwards", (_WHEEL,)),
            Kind("pose_frozen", Site.SENSORS, "the pose sensor repeats its last pose under new stamps"),
            Kind(
                "pose_jump", Site.SENSORS, "measured poses are elsewhere",
                (_number("dx_m", 2.0, -1e3, 1e3), _number("dy_m", 0.0, -1e3, 1e3), _number("dyaw_rad", 0.0, -3.2, 3.2)),
            ),
            Kind("pose_late", Site.SENSORS, "poses come later, with their true stamps", (_DELAY,)),
            Kind("pose_swapped", Site.SENSORS, "x and y of measured poses are exchanged"),
            Kind("pose_nan", Site.SENSORS, "measured poses are not numbers"),
            Kind("pose_silent", Site.SENSORS, "no poses are measured"),
            Kind(
                "clock_jump", Site.ROBOT, "the controller's clock jumps", (_number("step_s", 1.0, -3600.0, 3600.0),),
                lasts=False,
            ),
            Kind("brown_out", Site.ROBOT, "the controller loses power for a moment", lasts=False),
            Kind(
                "reboot", Site.ROBOT, "the controller restarts",
                (FaultParameter("cause", "power_on", choices=("power_on", "watchdog")),), lasts=False,
            ),
            Kind("motor_stall", Site.ROBOT, "a wheel is blocked and draws 18 A", (_WHEEL,)),
            Kind(
                "motor_runaway", Site.ROBOT, "a motor runs at a speed of its own while its controller drives it",
                (_WHEEL, _number("speed_rad_s", 15.0, -100.0, 100.0)),
            ),
            Kind("battery_sag", Site.ROBOT, "the battery's voltage falls", (_DROP,)),
            Kind("estop_button", Site.ROBOT, "the button on the robot is held down"),
            Kind("cpu_hog", Site.PROCESS, "busy processes on so many cores", (_CORES,)),
            Kind("disk_full", Site.PROCESS, "nothing more can be written to the log"),
            Kind("sigstop", Site.PROCESS, "a process is frozen (SIGSTOP, then SIGCONT)", (_PROCESS,)),
            Kind("sigkill", Site.PROCESS, "a process is killed (SIGKILL) and started again afterwards", (_PROCESS,)),
        )
    }
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ScheduledFault:
    """One fault of a schedule: from `begin_ns` to `end_ns` of the schedule's time, with its parameters by name."""

    number: int
    kind: Kind
    begin_ns: int
    end_ns: int
    values: Mapping[str, float | str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Any:
        return self.values[name]

    def __str__(self) -> str:
        values = "".join(f" {name}={_short(value)}" for name, value in self.values.items())
        return f"{self.kind.name}{values}"


@dataclass(frozen=True, slots=True)
class FaultSchedule:
    """Faults in the order in which they begin; `seed` decides whatever in them is left to chance."""

    seed: int
    faults: tuple[ScheduledFault, ...]


def parse_schedule(text: str, name: str = "schedule") -> FaultSchedule:
    """Return the schedule of a TOML text, see `schedule_of`."""
    try:
        return schedule_of(tomllib.loads(text), name)
    except (ValueError, RecursionError) as error:
        raise FaultFileError(f"{name}: not TOML ({' '.join(str(error).split())}); correct that line") from None


def schedule_of(table: Mapping[str, Any], name: str) -> FaultSchedule:
    """Return the schedule of a TOML table.

    It has `seed` (0 if absent) and a table `[[fault]]` for each fault with `kind`, `at_s`, `for_s` (only kinds that
    last) and the kind's parameters.
    """
    unknown = set(table) - {"seed", "fault"}
    if unknown:
        raise FaultFileError(f"{name}: {min(unknown)}: unknown; a schedule has seed and [[fault]] only")
    seed = table.get("seed", 0)
    if type(seed) is not int or not 0 <= seed < 1 << 63:
        raise FaultFileError(f"{name}: seed: {seed!r} is not a whole number from 0 up; correct it")
    entries = table.get("fault", [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise FaultFileError(f"{name}: fault: write each fault as a table [[fault]]")
    return FaultSchedule(seed, in_order([_fault(entry, f"{name}: fault {i}") for i, entry in enumerate(entries, 1)]))


def in_order(faults: Sequence[ScheduledFault]) -> tuple[ScheduledFault, ...]:
    """Return the faults by their beginnings, numbered from 1 in that order."""
    ordered = sorted(faults, key=lambda fault: (fault.begin_ns, fault.end_ns, fault.kind.name))
    return tuple(ScheduledFault(i, f.kind, f.begin_ns, f.end_ns, f.values) for i, f in enumerate(ordered, 1))


def kinds_table() -> str:
    """One line for each kind: its name, what happens, its parameters with their defaults."""
    width = max(map(len, KINDS))
    return "\n".join(
        f"{kind.name:{width}}  {kind.summary}" + "".join(f"; {p.name} = {_short(p.default)}" for p in kind.parameters)
        for kind in KINDS.values()
    )


def _fault(entry: dict[str, Any], where: str) -> ScheduledFault:
    kind = KINDS.get(entry.get("kind", "")) if isinstance(entry.get("kind"), str) else None
    if kind is None:
        raise FaultFileError(
            f"{where}: kind: {entry.get('kind')!r} is not a kind of fault; write one of {', '.join(KINDS)}"
        )
    where = f"{where}: {kind.name}"
    known = {parameter.name: parameter for parameter in kind.parameters}
    unknown = set(entry) - set(known) - {"kind", "at_s"} - ({"for_s"} if kind.lasts else set())
    if unknown:
        names = ", ".join(["at_s", *(["for_s"] if kind.lasts else []), *known])
        raise FaultFileError(f"{where}: {min(unknown)}: unknown; it has {names}")
    at_s = _bounded(entry.get("at_s"), f"{where}: at_s", 0.0, MAX_TIME_S)
    for_s = _bounded(entry.get("for_s"), f"{where}: for_s", 0.0, MAX_TIME_S) if kind.lasts else 0.0
    values = {name: _value(entry.get(name, p.default), p, f"{where}: {name}") for name, p in known.items()}
    begin_ns = round(at_s * 1e9)
    return ScheduledFault(0, kind, begin_ns, begin_ns + round(for_s * 1e9), values)


def _value(value: Any, parameter: FaultParameter, where: str) -> float | str:
    if parameter.choices:
        if value not in parameter.choices:
            raise FaultFileError(
                f"{where}: {value!r} is not possible here; write one of {', '.join(parameter.choices)}"
            )
        return str(value)
    number = _bounded(value, where, parameter.least, parameter.most)
    if parameter.is_integer and number != int(number):
        raise FaultFileError(f"{where}: {value!r} is not a whole number; round it")
    return int(number) if parameter.is_integer else number


def _bounded(value: Any, where: str, least: float, most: float) -> float:
    if value is None:
        raise FaultFileError(f"{where}: missing; give a number from {least:g} to {most:g}")
    if type(value) not in (int, float) or not least <= value <= most:
        raise FaultFileError(f"{where}: {value!r} is not within {least:g} to {most:g}; correct it")
    return float(value)


def _short(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"
