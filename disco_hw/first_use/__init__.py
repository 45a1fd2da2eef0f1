"""The first hour with a robot: what its robot.toml must say, and whether it does what it is told.

Here the first step, `disco-hw init`: a robot.toml from what is heard on the link, or answers there, and what its owner
says.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import serial

from disco_hw.config import link_fields, load_robot_config, names_address
from disco_hw.errors import InputError
from disco_hw.files import parse_toml
from disco_hw.reports import refuse_file
from drivers.motor import DEFAULT, UnknownDriverError, find_driver, motor_drivers
from drivers.pose import DEFAULT as POSE_SOURCE
from drivers.transport import SerialMedium, TransportSettingsError, create_transport
from drivers.transport.reconnecting import TransportCounters
from drivers.transport.serial import EXCHANGE_READ_S, ExchangeConnection, open_port
from drivers.types import Frame, LinkState, MotorDriver


def in_toml(value: Any) -> str:
    """Return a number, text, truth or list of them as TOML writes it."""
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
        case list() | tuple():
            return f"[{', '.join(map(in_toml, value))}]"
        case _:
            return repr(value)


def with_fields(text: str, fields: Mapping[tuple[str, str], Any]) -> str:
    """Return the text with these fields, by section and name, set; what is not there yet is added to its section.

    A field whose old value goes over several lines is not understood: look at the result before it is written.
    """
    lines = text.splitlines()
    for (section, name), value in fields.items():
        _set(lines, section, name, in_toml(value))
    return "\n".join(lines) + "\n"


def _set(lines: list[str], section: str, name: str, value: str) -> None:
    tables = {k: table for k in range(len(lines)) if (table := _table_begun(lines, k)) is not None}
    begin = next((k for k, table in tables.items() if table == {section: {}}), None)
    if begin is None:
        lines += [*([""] if lines and lines[-1] else []), f"[{section}]", f"{name} = {value}"]
        return
    end = next((k for k in tables if k > begin), len(lines))
    field = re.compile(rf"^(\s*{re.escape(name)}\s*=\s*)([^#]*?)(\s*#.*)?$")
    for k in range(begin + 1, end):
        found = field.match(lines[k])
        if found is not None and _parsed(lines[:k]) is not None:
            lines[k] = f"{found[1]}{value}{found[3] or ''}"
            return
    lines.insert(begin + 1, f"{name} = {value}")


def _table_begun(lines: Sequence[str], k: int) -> dict[str, Any] | None:
    """Return the empty table, or the list with one, that this line is the header of; None for any other line.

    A line of a value over several lines may look like a header: what is above it is then no TOML by itself.
    """
    if not lines[k].lstrip().startswith("[") or (table := _parsed(lines[k : k + 1])) is None:
        return None
    return None if _parsed(lines[:k]) is None else table


def _parsed(lines: Sequence[str]) -> dict[str, Any] | None:
    try:
        return parse_toml("\n".join(lines).encode(), "")
    except InputError:
        return None


# Chosen: short beside the seconds of listening.
_POLL_S = 0.01
# Chosen: longer than a link takes to open; then it is reported as one that does not.
_OPEN_S = 2.0
# Chosen: longer than the pause of any device that sends by itself, which a question would disturb.
_SILENT_S = 0.3
# Chosen: longer than a busy computer keeps a process waiting; there are few questions.
_PATIENT_S = 0.25
# Chosen: some seconds of a full bus at 500 kbit/s; a kind of controller shows within far fewer.
_MOST_FRAMES = 20_000


@dataclass(frozen=True, slots=True)
class FieldPrompt:
    """A field of [robot]: what is asked of a person, the comment that is written beside it, and what is usual."""

    name: str
    prompt: str
    comment: str
    usual: float


QUESTIONS = (
    FieldPrompt("wheel_radius_m", "radius of a wheel, m", "nominal; `infer` learns what it really is", 0.06),
    FieldPrompt("axial_distance_m", "from left to right wheels, m", "nominal; a skid-steer seems wider", 0.31),
    FieldPrompt("ticks_per_rev", "encoder ticks a turn of a wheel", "what the controller counts in one turn", 2048.0),
    FieldPrompt("max_wheel_speed_rad_s", "fastest speed of a wheel, rad/s", "no command is ever faster than this", 8.0),
)


@dataclass(frozen=True, slots=True)
class InitOptions:
    """Options of `disco-hw init`; a field that is None is asked for, or has the usual value if nobody is to be asked.

    `is_interactive`: whether a serial line may be asked for controllers that only reply; None asks the operator.
    """

    out: Path
    link: str | None = None
    driver: str | None = None
    name: str | None = None
    measures: tuple[tuple[str, float], ...] = ()
    listen_s: float = 3.0
    pose_source: str | None = None
    overwrite: bool = False
    is_interactive: bool | None = None


@dataclass(frozen=True, slots=True)
class FoundController:
    """Result of listening on a link: the driver, the fields in [link] that its frames show, a serial line's speed."""

    driver: str
    fields: dict[str, Any]
    baud: int | None = None


def recognised(frames: Sequence[Frame]) -> tuple[FoundController, ...]:
    """Return the controllers whose frames these are, by the drivers' own judgement."""
    found = ((driver.name, driver.recognise(frames)) for driver in motor_drivers().values())
    return tuple(FoundController(name, fields) for name, fields in found if fields is not None)


def listen(link: dict[str, Any], seconds: float) -> list[Frame]:
    """Return the frames that come over a link by themselves; nothing is sent.

    Raises InputError for what cannot be opened.
    """
    try:
        transport = create_transport(**link)
    except TransportSettingsError as error:
        raise InputError(f"--link: {error}") from None
    frames: list[Frame] = []
    transport.open()
    try:
        deadline_s = time.monotonic() + _OPEN_S
        while transport.state is not LinkState.UP:
            if time.monotonic() > deadline_s:
                raise InputError(f"--link: {transport.name} cannot be opened: {transport.last_error or 'no answer'}")
            time.sleep(_POLL_S)
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s and len(frames) < _MOST_FRAMES:
            frames += [received.frame for received in transport.receive()]
            time.sleep(_POLL_S)
    finally:
        transport.close()
    return frames


def query_line(port: str, driver: MotorDriver) -> FoundController | None:
    """Put a driver's questions, which move and write nothing, on a serial line; what the replies show.

    Nothing is asked of a line on which anything speaks by itself. Raises InputError for a port that cannot be used.
    """
    assert driver.questions is not None
    assert driver.exchange is not None
    exchange = driver.exchange(driver_settings(driver, parse_toml(driver.example.encode(), driver.name)))
    for baud in driver.questions.bauds:
        medium = SerialMedium(port, baud)
        try:
            with open_port(medium, timeout_s=EXCHANGE_READ_S, write_timeout_s=_OPEN_S, exclusive=True) as line:
                time.sleep(_SILENT_S)
                if line.in_waiting:
                    return None
                connection = ExchangeConnection(line, TransportCounters(), exchange)
                replies = [connection.exchange(frame) for frame in driver.questions.frames]
                # A computer that was busy just then has missed a reply: who was silent is asked again, and waited for.
                silent = [frame for frame, reply in zip(driver.questions.frames, replies, strict=True) if reply is None]
                replies += [connection.exchange(frame, _PATIENT_S) for frame in silent]
        except (serial.SerialException, OSError) as error:
            raise InputError(f"--link: {medium.explain(error)}") from None
        fields = driver.recognise([frame for frame in replies if frame is not None])
        if fields is not None:
            return FoundController(driver.name, fields, baud)
    return None


def run_init(options: InitOptions, ask: Callable[[str], str] | None, show: Callable[[str], None]) -> Path:
    """Listen, ask, and write a robot.toml that `check` reads; the file written.

    `ask` puts a question to a person, None where there is none. Raises InputError for wrong options, for a file that is
    there already or cannot be written, and where it is not known which controller the robot has.
    """
    refuse_file(options.out)
    if os.path.lexists(options.out) and not options.overwrite:
        raise InputError(f"{options.out}: is there already; name another file, or give --overwrite")
    link = link_fields(options.link)
    controller = _controller(options, link, ask, show)
    given = dict(options.measures)
    measures = {one.name: given[one.name] if one.name in given else _prompt_for(one, ask) for one in QUESTIONS}
    text = robot_text(options, link, controller, measures)
    trial = options.out.with_name(f".{options.out.name}.new")
    try:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        trial.write_text(text, encoding="utf-8")
        load_robot_config(trial)
        trial.replace(options.out)
    except InputError as error:
        trial.unlink()
        raise InputError(str(error).replace(str(trial), str(options.out))) from None
    except OSError as error:
        raise InputError(f"{options.out}: cannot be written ({error.strerror}); give another path") from None
    return options.out


def _controller(
    options: InitOptions, link: dict[str, Any], ask: Callable[[str], str] | None, show: Callable[[str], None]
) -> FoundController:
    """Return the driver that was named, or whose frames came, or that replies on a silent line."""
    found: tuple[FoundController, ...] = ()
    if options.driver is not None:
        try:
            find_driver(options.driver)
        except UnknownDriverError as error:
            raise InputError(f"--driver: {error}") from None
    if names_address(link) and options.listen_s > 0.0:
        show(f"listening for {options.listen_s:g} s; nothing is sent")
        frames = listen(link, options.listen_s)
        found = recognised(frames)
        controllers = ", ".join(f"{one.driver} {one.fields or ''}".strip() for one in found)
        show(f"{len(frames)} frames received: {controllers or 'no controller that is known by its own frames'}")
        if not frames and "port" in link:
            found = _answering(options, str(link["port"]), ask, show)
    if options.driver is not None:
        return next((one for one in found if one.driver == options.driver), FoundController(options.driver, {}))
    if len(found) == 1:
        return found[0]
    why = "several controllers answered" if found else "no controller was recognised"
    known = ", ".join(motor_drivers())
    raise InputError(
        f"init: {why}; name it: --driver with one of {known}"
        + (
            ("; or give --ask, which sends a question on the line, for a controller that only answers")
            if "port" in link
            else ""
        )
    )


def _answering(
    options: InitOptions, port: str, ask: Callable[[str], str] | None, show: Callable[[str], None]
) -> tuple[FoundController, ...]:
    """Return the controllers that reply on a silent line: of the driver named, or of all once that was allowed."""
    drivers = [driver for driver in motor_drivers().values() if driver.questions is not None]
    if options.driver is not None:
        drivers = [driver for driver in drivers if driver.name == options.driver]
    if not drivers:
        return ()
    names = ", ".join(driver.name for driver in drivers)
    allowed = options.is_interactive if options.driver is None else options.is_interactive is not False
    if allowed is None and ask is not None:
        show(
            "a controller that takes single bytes as speeds could move: lift the wheels off the ground, or cut the "
            "motor power"
        )
        allowed = (
            ask(f"nothing is sent without your consent; request the version of {names}, and no more? [y/n] ").strip()
            == "y"
        )
    if not allowed:
        return ()
    found = [controller for driver in drivers if (controller := query_line(port, driver)) is not None]
    for controller in found:
        show(f"answers at {controller.baud} baud: {controller.driver} {controller.fields}")
    if not found:
        show(f"no answer from {names}; check that it is switched on and set to answer (packet serial)")
    return tuple(found)


def _prompt_for(prompt: FieldPrompt, ask: Callable[[str], str] | None) -> float:
    while ask is not None:
        reply = ask(f"{prompt.prompt} [{prompt.usual:g}]: ").strip()
        if not reply:
            break
        try:
            return float(reply)
        except ValueError:
            continue
    return prompt.usual


def robot_text(
    options: InitOptions, link: dict[str, Any], controller: FoundController, measures: dict[str, float]
) -> str:
    """Return the text of a robot.toml, with a comment where somebody must look."""
    driver = find_driver(controller.driver)
    lines = [
        "# Written by `disco-hw init`; docs/robot.md says what every field means and what else there is.",
        "# Next: `disco-hw check` on this file (nothing moves), then `disco-hw commission` (wheels off the ground).",
        "[robot]",
        f"name = {in_toml(options.name or 'robot')}",
    ]
    for prompt in QUESTIONS:
        value = measures[prompt.name]
        written = in_toml(int(value)) if prompt.name == "ticks_per_rev" and value == int(value) else in_toml(value)
        lines.append(f"{prompt.name} = {written:<12}  # {prompt.comment}")
    kind = link.get("kind", driver.kinds[0])
    lines += ["", "[link]", f"driver = {in_toml(controller.driver)}", f"kind = {in_toml(kind)}"]
    lines += [f"{name} = {in_toml(link[name])}" for name in ("interface", "channel", "port") if name in link]
    if kind == "can":
        lines.append(
            "# LOOK: what is not marked as found on the link is an example; write what your controller is set to."
        )
    elif driver.questions is not None:
        baud = controller.baud or driver.questions.bauds[0]
        lines.append(
            f"baud = {baud:<20}   # {'it answered at this' if controller.baud else 'as the controller is set'}"
        )
    fields = {**parse_toml(driver.example.encode(), driver.name), **controller.fields}
    if "wheel_radius_m" in fields:
        fields |= {"wheel_radius_m": measures["wheel_radius_m"], "track_m": measures["axial_distance_m"]}
    if fields:
        lines.append("# LOOK: what is not marked as heard is an example; write what your controller is set to.")
    for name, value in fields.items():
        note = "# found on the link: check that left stands before right" if name in controller.fields else ""
        lines.append(f"{name} = {in_toml(value)}{note}")
    source = options.pose_source or (POSE_SOURCE if driver.name == DEFAULT else "udp")
    lines += [
        "",
        "[pose]",
        f"source = {in_toml(source)}               # where measured poses come from (docs/robot.md)",
        "",
        "[task]",
        'kind = "circle"',
        "radius_m = 1.0",
        f"speed_m_s = {_task_speed(driver.slowest_rad_s(driver_settings(driver, fields)), measures):.3g}",
        "",
        "[log]",
        'directory = "logs"',
    ]
    return "\n".join(lines) + "\n"


def driver_settings(driver: Any, fields: dict[str, Any]) -> Any:
    """Return the driver's settings of these fields; raises InputError where they are none."""
    try:
        return msgspec.convert(fields, driver.settings)
    except msgspec.ValidationError as error:
        raise InputError(f"init: link: {error}; write the file by hand (docs/robot.md)") from None


def _task_speed(slowest_rad_s: float, measures: dict[str, float]) -> float:
    """Return a quarter of what the wheels can do, at most 0.2 m/s, and not below what the controller holds."""
    radius_m, top = measures["wheel_radius_m"], measures["max_wheel_speed_rad_s"]
    return min(0.8 * top * radius_m, max(1.5 * slowest_rad_s * radius_m, min(0.2, 0.25 * top * radius_m)))
