"""Reads and checks robot.toml; every error is one line that names the file, the field and the remedy."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import msgspec

from disco_hw.config.robot import LONGEST_HORIZON, Control, Link, PoseInput, Prior, Robot, RobotConfig
from disco_hw.errors import FieldFault, InputError
from disco_hw.fence import fence_fault
from disco_hw.files import ROBOT_TOML, control_character_in, describe, field_of_others, read_toml
from drivers.motor import UnknownDriverError, find_driver, motor_drivers
from drivers.pose import DEFAULT, PoseSourceError, fields_of, find_pose_source, pose_sources
from drivers.pose.senders import parse_allowed

if TYPE_CHECKING:
    # Tasks bring numpy with them, which no command needs to say what its options are.
    from disco_hw.tasks import RobotTask


# Of all samples together. Chosen: some hundred times more than the planner rolls out, a tenth of a second and more.
MOST_STEPS = 20_000_000


def load_robot_config(path: Path | str) -> RobotConfig:
    """Read and validate robot.toml, and none of the files that it names.

    Raises InputError with one line naming file, field and remedy.
    """
    path = Path(path)
    raw = read_toml(path, ROBOT_TOML)
    config = _without_task(path, raw)
    config = msgspec.structs.replace(config, task=_task_of(path, raw.get("task", {})))
    _check_task(path, config)
    if "task" in raw and config.task.file is None:
        refuse_outside_task(path, config)
    return config


def refuse_outside_task(path: Path, config: RobotConfig) -> None:
    """Raise InputError, naming the place, for a task on whose line or start the footprint is not within the fence."""
    from disco_hw.fence.clearance import task_breach  # noqa: PLC0415

    fault = task_breach(config.fence, config.footprint_along_line, config.task.course())
    if fault is not None:
        _refuse(path, "fence", fault, "move the task or the fence")


def load_daemon_address(path: Path) -> tuple[str, str | None]:
    """Return the robot's name and the control socket that robot.toml sets: what a request to the running daemon needs.

    [task] and [fence] are not looked at: a daemon can be asked and stopped whatever has been written there since it
    was started. Raises InputError with one line naming file, field and remedy for any other section that is wrong.
    """
    raw = read_toml(path, ROBOT_TOML)
    config = _without_task(path, {name: raw[name] for name in raw if name != "fence"})
    return config.robot.name, config.daemon.control_socket


def _without_task(path: Path, raw: dict[str, Any]) -> RobotConfig:
    """Return all of robot.toml but [task], validated; `task` is None."""
    _check_names(path, raw)
    _check_pose_fields(path, raw.get("pose"))
    common, of_driver = _split_link(path, raw.get("link", {}))
    try:
        config = msgspec.convert({**raw, "link": common, "task": None}, RobotConfig)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {describe(error, RobotConfig, 'docs/robot.md')}") from None
    config = msgspec.structs.replace(config, link=msgspec.structs.replace(config.link, of_driver=of_driver))
    given = {name: getattr(config.prior, name) for name in raw.get("prior", {})}
    config = msgspec.structs.replace(config, prior=msgspec.structs.replace(prior_around(config.robot), **given))
    _check(path, config)
    return config


def _split_link(path: Path, section: Any) -> tuple[Any, Any]:
    """Return the fields of [link] that every driver has, and the settings of the driver that it names."""
    if not isinstance(section, dict):
        return section, None
    if "of_driver" in section:
        raise InputError(f"{path}: link.of_driver: no such field; remove it")
    driver = find_driver(section.get("driver"))
    kind = driver.settings
    fields = {name: value for name, value in section.items() if name in kind.__struct_fields__}
    if unknown := section.keys() - {*fields, *Link.__struct_fields__}:
        drivers = {name: one.settings.__struct_fields__ for name, one in motor_drivers().items()}
        _refuse_fields_of_others(path, "link", "driver", driver.name, unknown, drivers)
    try:
        settings = msgspec.convert(fields, kind)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {describe(error, kind, 'docs/robot.md', 'link')}") from None
    fault = settings.fault()
    if fault is not None:
        raise InputError(f"{path}: link.{fault.field}: {fault.fault}; {fault.hint}")
    return {field: value for field, value in section.items() if field not in fields}, settings


def link_of(path: Path, section: dict[str, Any]) -> Link:
    """[link] alone, of a robot.toml whose other sections may be broken; fields that are not its driver's are left out.

    Raises InputError.
    """
    _check_names(path, {"link": section})
    fields = find_driver(section.get("driver")).settings.__struct_fields__
    _, of_driver = _split_link(path, {name: section[name] for name in section if name in (*fields, "driver")})
    common = {name: section[name] for name in section if name in Link.__struct_fields__ and name != "of_driver"}
    try:
        link = msgspec.convert(common, Link)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: [link]: {error}") from None
    return msgspec.structs.replace(link, of_driver=of_driver)


def prior_around(robot: Robot) -> Prior:
    """Ranges that hold the robots of this nominal geometry.

    A skid-steer's wheels slip sideways in turns, so that it turns as an ideal robot with a track 1.5 to 2.5 times its
    own would (Mandow et al., IROS 2007); a differential drive as one with its own track.
    """
    radius, axial = robot.wheel_radius_m, robot.axial_distance_m
    return Prior(
        x_icr_m=(robot.x_icr_m - axial, robot.x_icr_m + axial),
        wheel_radius_m=(0.5 * radius, 1.5 * radius),
        axial_distance_m=(0.5 * axial, 3.0 * axial),
    )


def _task_of(path: Path, section: object) -> RobotTask:
    """Return the task that [task] says; its kind knows which fields that has."""
    from disco_hw.tasks import ReadField, UnknownKind, kind_in, kinds, task_class, task_from  # noqa: PLC0415

    if not isinstance(section, dict):
        raise InputError(f"{path}: task: not a section; write [task] above its fields")
    try:
        kind = kind_in(section)
        task_type = task_class(kind)
    except UnknownKind as error:
        raise InputError(f"{path}: task.kind: {error}") from None
    if unknown := section.keys() - {"kind", *task_type.__struct_fields__}:
        types = {one: task_class(one) for one in kinds()}
        fields = {one: {*of.__struct_fields__} - {*of.read_fields} for one, of in types.items()}
        _refuse_fields_of_others(path, "task", "kind", kind, unknown, fields)
    try:
        return task_from(section)
    except ReadField as error:
        raise InputError(f"{path}: [task] {error}") from None
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {describe(error, task_type, 'docs/robot.md', 'task')}") from None


def _check_names(path: Path, raw: dict[str, Any]) -> None:
    """Refuse what is no name of a driver or pose source; the registries know the names, the fields' types do not."""
    link = raw.get("link")
    if isinstance(link, dict) and "driver" in link:
        try:
            find_driver(str(link["driver"]))
        except UnknownDriverError as error:
            raise InputError(f"{path}: link.driver: {error}") from None
    for where, section in _pose_sections(raw.get("pose")):
        try:
            find_pose_source(str(section.get("source", DEFAULT)))
        except PoseSourceError as error:
            raise InputError(f"{path}: {where}.source: {error}") from None


def _pose_sections(section: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """[pose] and each of [[pose.also]], where they are what they should be, with their names."""
    if isinstance(section, dict):
        yield "pose", section
        also = section.get("also")
        for number, one in enumerate(also if isinstance(also, list) else ()):
            if isinstance(one, dict):
                yield f"pose.also[{number}]", one


# Whatever the source is, they say how good its poses are.
_OF_EVERY_SOURCE = {"position_std_m", "yaw_std_rad"}


def _check_pose_fields(path: Path, section: Any) -> None:
    """Refuse fields of another pose source, and what no further source has."""
    owned = {source: fields_of(source) for source in pose_sources()}
    for where, one in _pose_sections(section):
        if one is not section and "source" not in one:
            _refuse(path, where, "does not say which source", f"add source, one of {', '.join(pose_sources())}")
        name = str(one.get("source", DEFAULT))
        _refuse_fields_of_others(path, where, "source", name, one.keys() - owned[name] - _OF_EVERY_SOURCE, owned)
        if one is not section and "also" in one:
            _refuse(path, f"{where}.also", "sources are not nested", "write another [[pose.also]]")
        if one is not section and "rate_hz" in one:
            _refuse(path, f"{where}.rate_hz", "decides nothing any more", "remove it")


def _refuse_fields_of_others(
    path: Path, where: str, choice: str, chosen: str, names: Iterable[str], fields: Mapping[str, Collection[str]]
) -> None:
    """Refuse the first of the names, none of the chosen kind, driver or source, that is a field of another one."""
    for name in sorted(names):
        if owners := [other for other, own in fields.items() if name in own]:
            _refuse(path, f"{where}.{name}", *field_of_others(choice, owners, f', but {where}.{choice} is "{chosen}"'))


def _refuse(path: Path, field: str, fault: str, hint: str) -> NoReturn:
    raise InputError(f"{path}: {field}: {fault}; {hint}")


def _check_values(path: Path, name: str, section: Any) -> None:  # Any: a section's struct, or a kind of task.
    for field in section.__struct_fields__:
        value = getattr(section, field)
        numbers = value if isinstance(value, tuple) else (value,)
        if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
            _refuse(path, f"{name}.{field}", "not a finite number", "write a finite value")
        if isinstance(value, str) and (fault := control_character_in(value)):
            _refuse(path, f"{name}.{field}", fault, "take it out")


def _check(path: Path, config: RobotConfig) -> None:
    """Refuse what no single field of the sections but [task] shows."""
    for name in config.__struct_fields__:
        if name != "task":
            _check_values(path, name, getattr(config, name))
    for number, one in enumerate(config.pose.also):
        _check_values(path, f"pose.also[{number}]", one)
    _check_pose(path, config.pose, config.estimation.history_s)
    for field in config.prior.__struct_fields__:
        low, high = getattr(config.prior, field)
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            _refuse(path, f"prior.{field}", f"[{low}, {high}] is not a range", "write [low, high] with low < high")
    fault = fence_fault(config.fence, config.robot.footprint)
    if fault is not None:
        _refuse(path, f"fence.{fault.field}", fault.fault, fault.hint)
    _check_control(path, config.control)
    driver = find_driver(config.link.driver)
    # Every other medium carries CAN frames, as the one of that name does (docs/add-a-transport.md).
    medium = "serial" if config.link.kind == "serial" else "can"
    if medium not in driver.kinds:
        known = " or ".join(f'"{kind}"' for kind in driver.kinds)
        _refuse(
            path, "link.kind", f'the driver {driver.name} does not speak over "{config.link.kind}"', f"write {known}"
        )
    field = driver.serial_field
    if field and (getattr(config.link.settings(), field) is None) is (config.link.kind == "serial"):
        hint = "remove it" if config.link.kind != "serial" else "add it (docs/robot.md says what it is)"
        _refuse(path, f"link.{field}", "belongs to a serial line, and to no other link", hint)
    if config.link.key_file is not None and not driver.authenticates:
        _refuse(path, "link.key_file", f"the driver {driver.name} has no authenticated mode", "remove it")


def _check_control(path: Path, control: Control) -> None:
    """Refuse plans that are too large or too short, and times that contradict each other."""
    if control.command_valid_for_s < 1.5 / control.rate_hz:
        _refuse(
            path,
            "control.command_valid_for_s",
            f"{control.command_valid_for_s} s is shorter than 1.5 control periods",
            f"write at least {1.5 / control.rate_hz:.3f} or raise rate_hz",
        )
    # Without a horizon the task's speed and the model's x_icr decide it, which may change; this is the most.
    horizon = control.horizon or LONGEST_HORIZON
    if control.samples * horizon > MOST_STEPS:
        _refuse(
            path, "control.samples",
            f"{control.samples * horizon} steps in all samples of a horizon of {horizon}, which take long to plan",
            f"write at most {MOST_STEPS // horizon}" + ("" if control.horizon else ", or set control.horizon"),
        )  # fmt: skip
    if control.step_s is not None and control.step_s < 1.0 / control.rate_hz:
        _refuse(
            path, "control.step_s",
            f"{control.step_s:g} s is shorter than a control period, and the plan too short to drive by",
            f"write at least {math.ceil(1e3 / control.rate_hz) / 1e3:g}, or remove it",
        )  # fmt: skip
    if control.telemetry_disarm_s <= control.telemetry_zero_s:
        _refuse(path, "control.telemetry_disarm_s", "not above telemetry_zero_s", "write a larger value")


def _check_pose(path: Path, pose: PoseInput, history_s: float) -> None:
    """Refuse an `allow` that is no list of addresses and networks, and poses that would always be too old."""
    for number, one in enumerate(pose.every()):
        where = "pose" if number == 0 else f"pose.also[{number - 1}]"
        try:
            parse_allowed(("127.0.0.1",) if one.allow is None else one.allow)
        except ValueError as error:
            hint = 'write addresses as "192.168.1.20" or networks as "192.168.1.0/24"'
            _refuse(path, f"{where}.allow", str(error), hint)
        if one.latency_s >= history_s:
            fault = f"poses that are {one.latency_s:g} s old are refused, as estimation.history_s is {history_s:g}"
            _refuse(path, f"{where}.latency_s", fault, "raise estimation.history_s above it")


def _check_task(path: Path, config: RobotConfig) -> None:
    """Refuse what no single field of [task] shows."""
    _check_values(path, "task", config.task)
    if config.control.fallback != "ramp" and math.isnan(config.task.reference_speed_m_s):
        _refuse(path, "control.fallback", "way-points with times have no single speed to follow", 'write "ramp"')
    if config.control.facing == "backwards":
        if config.control.mode == "paper":
            _refuse(path, "control.facing", "the paper's cost knows of no facing", 'write mode = "default"')
        if config.control.fallback != "ramp":
            _refuse(path, "control.facing", "the law of control.fallback drives forwards", 'write fallback = "ramp"')
    fault = task_fault(config, config.task)
    if fault is not None:
        _refuse(path, f"task.{fault.field}", fault.fault, fault.hint)


def task_fault(config: RobotConfig, task: RobotTask) -> FieldFault | None:
    """Return why this robot cannot be given a task, from robot.toml or while it runs; None if it can."""
    slowest_m_s = config.slowest_wheel_rad_s * config.robot.wheel_radius_m
    # NaN for way-points with times, which may ask the robot to rest: they are never too slow.
    if task.reference_speed_m_s < slowest_m_s:
        least_m_s = math.ceil(100.0 * slowest_m_s) / 100.0
        return FieldFault(
            "speed_m_s",
            f"{task.reference_speed_m_s} m/s is slower than the motor controller can hold",
            f"write at least {least_m_s:.2f}, or set the motor controller for lower speeds",
        )
    if task.speed_m_s > config.robot.max_wheel_speed_rad_s * config.robot.wheel_radius_m:
        return FieldFault(
            "speed_m_s",
            f"{task.speed_m_s} m/s is above what the wheels can do",
            "lower it, or raise robot.max_wheel_speed_rad_s within the firmware's limit",
        )
    return task.fault()
