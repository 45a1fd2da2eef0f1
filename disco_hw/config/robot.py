"""robot.toml -> frozen, validated structs; every error is one line that names the file, the field and the remedy."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import msgspec
from msgspec import Meta

from disco_hw.errors import InputError
from disco_hw.fence import Fence, Footprint, fence_fault, usual_footprint
from disco_hw.files import ROBOT_TOML, control_character_in, in_words, read_toml
from drivers.motor import AS_TOLD, DriverFieldError, UnknownDriverError, Wiring, find_driver, own_fields
from drivers.pose import DEFAULT, PoseConvention, PoseSourceError, find_pose_source, pose_sources
from drivers.pose import own_fields as own_pose_fields
from drivers.pose.senders import parse_allowed

if TYPE_CHECKING:
    from disco_hw.tasks import RobotTask
else:
    # Tasks bring numpy with them, which no command needs to say what its options are. `_task_of` checks the kind.
    RobotTask = Any

Positive = Annotated[float, Meta(gt=0.0)]
NonNegative = Annotated[float, Meta(ge=0.0)]
Probability = Annotated[float, Meta(gt=0.0, lt=1.0)]
Share = Annotated[float, Meta(gt=0.0, le=1.0)]
Range = tuple[float, float]
NatNetVersion = Literal["2.6", "2.7", "2.8", "2.9", "2.10", "2.11", "3.0", "3.1", "4.0", "4.1"]
Datum = tuple[Annotated[float, Meta(ge=-90.0, le=90.0)], Annotated[float, Meta(ge=-180.0, le=180.0)]]


class Robot(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Nominal geometry and encoder of the robot (metres, radians).

    `footprint_m`: the rectangle that the robot covers; None takes one guessed from the wheels.
    """

    name: Annotated[str, Meta(min_length=1, max_length=64)]
    wheel_radius_m: Annotated[float, Meta(gt=0.0, le=2.0)]
    axial_distance_m: Annotated[float, Meta(gt=0.0, le=5.0)]
    x_icr_m: Annotated[float, Meta(ge=-2.0, le=2.0)] = 0.0
    ticks_per_rev: Annotated[float, Meta(ge=1.0, le=65535.0)]
    max_wheel_speed_rad_s: Annotated[float, Meta(gt=0.0, le=65.5)]
    max_wheel_acceleration_rad_s2: Annotated[float, Meta(gt=0.0, le=655.0)] = 20.0
    footprint_m: Footprint | None = None

    @property
    def footprint(self) -> Footprint:
        """The rectangle that the robot covers, as robot.toml says or guessed from the wheels."""
        return usual_footprint(self) if self.footprint_m is None else self.footprint_m


class Prior(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Uniform ranges of the model's base parameters; the defaults are the paper's (appendix, skid-steer table).

    What a robot.toml leaves out is made from its own robot, see `prior_around`.
    """

    x_icr_m: Range = (0.0, 0.5)
    wheel_radius_m: Range = (0.0, 0.5)
    axial_distance_m: Range = (0.1, 0.5)


_OF_THE_PROTOCOL = ("driver", "key_file", "of_driver")


class Link(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the robot is reached; `options` go to the python-can interface as they are.

    `driver`: of `drivers.motor`; None is its default. `of_driver`: the fields that are this driver's own, which stand
    in [link] beside the others; None where it is not made by `link_of`.
    """

    driver: str | None = None
    of_driver: Any = None
    kind: Literal["can", "serial"] = "can"
    interface: str = "socketcan"
    channel: str = "can0"
    bitrate: Annotated[int, Meta(ge=10_000, le=1_000_000)] = 500_000
    port: str = "/dev/ttyUSB0"
    baud: Annotated[int, Meta(ge=9600, le=4_000_000)] = 921_600
    options: dict[str, Any] = {}
    dtr: bool = False
    rts: bool = False
    key_file: str | None = None

    def medium_fields(self) -> dict[str, Any]:
        """What `drivers.transport.make_transport` takes: kind and address, and how a serial line is spoken."""
        fields = {name: value for name, value in msgspec.structs.asdict(self).items() if name not in _OF_THE_PROTOCOL}
        exchange = find_driver(self.driver).exchange
        return fields if exchange is None else {**fields, "exchange": exchange(self.settings())}

    def settings(self) -> Any:
        """The driver's own settings. Raises msgspec.ValidationError where it needs some that are not there."""
        if self.of_driver is not None:
            return self.of_driver
        return msgspec.convert({}, find_driver(self.driver).settings)


class PoseInput(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where measured poses come from: `source` is of `drivers.pose`; None leaves what that source takes by itself.

    `datum`: latitude and longitude (degrees) of the world frame's origin. For `disco-hw bridge ros2`: the topic, the
    frame that its poses must be in, and the standard deviations of poses that come without. By these, `rate_hz` (how
    often poses come at least) and `latency_s` it is decided whether the geometry is learnt while driving. `also`:
    further sources, whose poses are fused with these. `allow`: addresses and networks that may send to the port;
    `key_file`: the key that each datagram must be proven with.
    """

    source: str = DEFAULT
    address: str = "127.0.0.1"
    port: Annotated[int, Meta(ge=1, le=65535)] = 5005
    allow: tuple[str, ...] | None = None
    key_file: str | None = None
    device: str | None = None
    baud: Annotated[int, Meta(ge=1200, le=4_000_000)] | None = None
    datum: Datum | None = None
    heading_std_rad: Annotated[float, Meta(gt=0.0, le=1.8)] | None = None
    data_port: Annotated[int, Meta(ge=1, le=65535)] | None = None
    group: str | None = None
    server: str | None = None
    natnet_version: NatNetVersion | None = None
    body: Annotated[int, Meta(ge=0, le=2**31 - 1)] | None = None
    up_axis: Literal["y", "z"] | None = None
    latency_s: Annotated[float, Meta(ge=0.0, le=5.0)] = 0.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset: tuple[float, float] = (0.0, 0.0)
    position_unit: Literal["m", "cm", "mm"] = "m"
    yaw_unit: Literal["rad", "deg"] = "rad"
    clockwise: bool = False
    mirrored: bool = False
    yaw_offset_rad: Annotated[float, Meta(ge=-7.0, le=7.0)] = 0.0
    topic: str = "/pose"
    frame: str = "map"
    position_std_m: Positive = 0.02
    yaw_std_rad: Positive = 0.02
    rate_hz: Positive | None = None
    also: Annotated[tuple[PoseInput, ...], Meta(max_length=3)] = ()

    def every(self) -> tuple[PoseInput, ...]:
        """This source and the further ones, in the order of their numbers."""
        return (self, *self.also)

    def labels(self) -> tuple[str, ...]:
        """What the sources are called; those of one kind are numbered."""
        names = [one.source for one in self.every()]
        return tuple(
            name if names.count(name) == 1 else f"{name} {names[: number + 1].count(name)}"
            for number, name in enumerate(names)
        )

    def of(self, source: str) -> PoseInput | None:
        """The first source of this kind; None where there is none."""
        return next((one for one in self.every() if one.source == source), None)

    def convention(self) -> PoseConvention:
        """In what units and about which axes the source speaks."""
        return PoseConvention(
            self.position_unit,
            self.yaw_unit,
            self.clockwise,
            self.mirrored,
            self.yaw_offset_rad,
            self.origin,
            self.offset,
            self.latency_s,
        )


class Control(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The loop and the planner."""

    rate_hz: Annotated[float, Meta(ge=20.0, le=100.0)] = 50.0
    mode: Literal["default", "paper"] = "default"
    uncertainty: Literal["ut", "mc", "joint", "point"] = "ut"
    adaptation: Literal["auto", "off", "fast", "audited"] = "auto"
    disturbance: bool = False
    fallback: Literal["ramp", "pure_pursuit", "kanayama", "lqr"] = "ramp"
    samples: Annotated[int, Meta(ge=8, le=1_000_000)] = 400
    horizon: Annotated[int, Meta(ge=2, le=500)] | None = None
    step_s: Annotated[float, Meta(gt=0.0, le=1.0)] | None = None
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 1
    command_valid_for_s: Annotated[float, Meta(ge=0.02, le=0.1)] = 0.1
    plan_tail_s: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.2
    telemetry_zero_s: Annotated[float, Meta(ge=0.01, le=0.5)] = 0.05
    telemetry_disarm_s: Annotated[float, Meta(ge=0.02, le=1.0)] = 0.15


class Estimation(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Fusion of wheel odometry and pose."""

    slip_std_m_per_sqrt_m: Positive = 0.02
    slip_std_rad_per_sqrt_m: Positive = 0.02
    slip_std_rad_per_sqrt_rad: Positive = 0.05
    gate_probability: Probability = 0.999
    gate_lockout_count: Annotated[int, Meta(ge=2, le=1000)] = 10
    heading_std_rad: Annotated[float, Meta(ge=0.005, le=0.3)] = 0.1
    pose_timeout_s: Positive = 1.0
    history_s: Annotated[float, Meta(gt=0.0, le=10.0)] = 1.0
    pose_required: bool = True


class ModelFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where the model with its posterior is; without a file the nominal geometry and the prior are used."""

    file: str | None = None


class LogSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where runs are recorded."""

    directory: str = "logs"
    enabled: bool = True


class DaemonSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The daemon's local side."""

    control_socket: str | None = None
    realtime_priority: Annotated[int, Meta(ge=0, le=98)] = 80


class Drive(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Driving by hand or script: speeds as shares of the robot's limits, and what the gamepad's axes and button do."""

    speed_share: Share = 0.8
    turn_share: Share = 0.6
    gamepad_device: str = ""
    gamepad_forward_axis: str = "-ABS_Y"
    gamepad_left_axis: str = "-ABS_X"
    gamepad_deadman: str = "BTN_TL"
    gamepad_dead_zone: Annotated[float, Meta(ge=0.0, le=0.5)] = 0.1
    gamepad_silence_s: NonNegative = 2.0


class Ros2(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What of a bag is read; what is left out is guessed. `pose_topic` "tf" is the chain from map to base frame.

    `command_joints`: whose the numbers of a Float64MultiArray are, in its order. The last five are the bridge's; a
    domain that is left out is $ROS_DOMAIN_ID, or 0. `may_move`: whether what lets the robot move is taken from ROS 2.
    """

    command_topic: str = ""
    wheel_topic: str = ""
    pose_topic: str = ""
    left_joints: list[str] = []
    right_joints: list[str] = []
    command_joints: list[str] = []
    map_frame: str = ""
    base_frame: str = ""
    domain: Annotated[int, Meta(ge=0, le=232)] | None = None
    namespace: Annotated[str, Meta(pattern="^(/?[A-Za-z][A-Za-z0-9_]*)*$")] = ""
    localhost_only: bool = True
    may_move: bool = False


def _default_task() -> RobotTask:
    from disco_hw.tasks import default_task  # noqa: PLC0415

    return default_task()


class RobotConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The whole of robot.toml."""

    robot: Robot
    prior: Prior = Prior()
    link: Link = Link()
    wheels: Wiring = AS_TOLD
    pose: PoseInput = PoseInput()
    control: Control = Control()
    estimation: Estimation = Estimation()
    task: RobotTask = msgspec.field(default_factory=_default_task)
    model: ModelFile = ModelFile()
    log: LogSettings = LogSettings()
    daemon: DaemonSettings = DaemonSettings()
    drive: Drive = Drive()
    ros2: Ros2 = Ros2()
    fence: Fence = Fence()


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
    from disco_hw.fence.task_line import task_breach  # noqa: PLC0415

    fault = task_breach(config.fence, config.robot.footprint, config.task.course())
    if fault is not None:
        _refuse(path, "fence", fault, "move the task or the fence")


def load_daemon_address(path: Path) -> tuple[str, str | None]:
    """The robot's name and the control socket that robot.toml sets: what a request to the running daemon needs.

    [task] and [fence] are not looked at: a daemon can be asked and stopped whatever has been written there since it
    was started. Raises InputError with one line naming file, field and remedy for any other section that is wrong.
    """
    raw = read_toml(path, ROBOT_TOML)
    config = _without_task(path, {name: raw[name] for name in raw if name != "fence"})
    return config.robot.name, config.daemon.control_socket


def _without_task(path: Path, raw: dict[str, Any]) -> RobotConfig:
    """All that robot.toml says but [task], validated; `task` is None."""
    _check_names(path, raw)
    _check_pose_fields(path, raw.get("pose"))
    common, of_driver = _split_link(path, raw.get("link", {}))
    try:
        config = msgspec.convert({**raw, "link": common, "task": None}, RobotConfig)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {in_words(error, [RobotConfig], 'docs/robot.md')}") from None
    config = msgspec.structs.replace(config, link=msgspec.structs.replace(config.link, of_driver=of_driver))
    given = {name: getattr(config.prior, name) for name in raw.get("prior", {})}
    config = msgspec.structs.replace(config, prior=msgspec.structs.replace(prior_around(config.robot), **given))
    _check(path, config)
    return config


def _split_link(path: Path, section: Any) -> tuple[Any, Any]:
    """The fields of [link] that every driver has, and the settings of the driver that it names."""
    if not isinstance(section, dict):
        return section, None
    if "of_driver" in section:
        raise InputError(f"{path}: link.of_driver: no such field; remove it")
    name = section.get("driver")
    try:
        own = own_fields(name, section)
    except DriverFieldError as error:
        raise InputError(f"{path}: link.{error}; remove it, or name that driver") from None
    kind = find_driver(name).settings
    try:
        settings = msgspec.convert(own, kind)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {in_words(error, [kind], 'docs/robot.md', 'link')}") from None
    fault = settings.fault()
    if fault is not None:
        raise InputError(f"{path}: link.{fault.field}: {fault.fault}; {fault.remedy}")
    return {field: value for field, value in section.items() if field not in own}, settings


def link_of(path: Path, section: dict[str, Any]) -> Link:
    """[link] alone, of a robot.toml whose other sections may be broken; fields that are not its driver's are left out.

    Raises InputError.
    """
    _check_names(path, {"link": section})
    own = find_driver(section.get("driver")).settings.__struct_fields__
    _, of_driver = _split_link(path, {name: section[name] for name in section if name in (*own, "driver")})
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
    """The task that [task] says; its kind knows which fields that has."""
    from disco_hw.tasks import ReadField, UnknownKind, kinds, task_class, task_from  # noqa: PLC0415

    if not isinstance(section, dict):
        raise InputError(f"{path}: task: not a section; write [task] above its fields")
    try:
        return task_from(section)
    except UnknownKind as error:
        raise InputError(f"{path}: task.kind: {error}") from None
    except ReadField as error:
        raise InputError(f"{path}: [task] {error}") from None
    except msgspec.ValidationError as error:
        words = in_words(error, [task_class(kind) for kind in kinds()], "docs/robot.md", "task")
        raise InputError(f"{path}: {words}") from None


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
    for where, one in _pose_sections(section):
        if one is not section and "source" not in one:
            _refuse(path, where, "does not say which source", f"add source, one of {', '.join(pose_sources())}")
        name = str(one.get("source", DEFAULT))
        own = own_pose_fields(name)
        for other in pose_sources():
            for field in sorted(own_pose_fields(other) - own - _OF_EVERY_SOURCE):
                if field in one:
                    fault = f'a field of the source "{other}", and {where}.source is "{name}"'
                    _refuse(path, f"{where}.{field}", fault, "remove it")
        if one is not section and "also" in one:
            _refuse(path, f"{where}.also", "sources are not nested", "write another [[pose.also]]")
        if one is not section and "rate_hz" in one:
            fault = "says whether the geometry is learnt, which it is from the poses of [pose] alone"
            _refuse(path, f"{where}.rate_hz", fault, "remove it")


def _refuse(path: Path, field: str, fault: str, remedy: str) -> NoReturn:
    raise InputError(f"{path}: {field}: {fault}; {remedy}")


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
    _check_allowed_senders(path, config.pose)
    for field in config.prior.__struct_fields__:
        low, high = getattr(config.prior, field)
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            _refuse(path, f"prior.{field}", f"[{low}, {high}] is not a range", "write [low, high] with low < high")
    fault = fence_fault(config.fence, config.robot.footprint)
    if fault is not None:
        _refuse(path, f"fence.{fault.field}", fault.fault, fault.remedy)
    control = config.control
    if control.command_valid_for_s < 1.5 / control.rate_hz:
        _refuse(
            path,
            "control.command_valid_for_s",
            f"{control.command_valid_for_s} s is shorter than 1.5 control periods",
            f"write at least {1.5 / control.rate_hz:.3f} or raise rate_hz",
        )
    if control.telemetry_disarm_s <= control.telemetry_zero_s:
        _refuse(path, "control.telemetry_disarm_s", "not above telemetry_zero_s", "write a larger value")
    driver = find_driver(config.link.driver)
    if config.link.kind not in driver.kinds:
        known = " or ".join(f'"{kind}"' for kind in driver.kinds)
        _refuse(
            path, "link.kind", f'the driver {driver.name} does not speak over "{config.link.kind}"', f"write {known}"
        )
    field = driver.serial_field
    if field and (getattr(config.link.settings(), field) is None) is (config.link.kind == "serial"):
        remedy = "remove it" if config.link.kind != "serial" else "add it (docs/robot.md says what it is)"
        _refuse(path, f"link.{field}", "belongs to a serial line, and to no other link", remedy)
    if config.link.key_file is not None and not driver.authenticates:
        _refuse(path, "link.key_file", f"the driver {driver.name} has no authenticated mode", "remove it")


def _check_allowed_senders(path: Path, pose: PoseInput) -> None:
    """Refuse an `allow` that is no list of addresses and networks."""
    for number, one in enumerate(pose.every()):
        try:
            parse_allowed(("127.0.0.1",) if one.allow is None else one.allow)
        except ValueError as error:
            field = "pose.allow" if number == 0 else f"pose.also[{number - 1}].allow"
            _refuse(path, field, str(error), 'write addresses as "192.168.1.20" or networks as "192.168.1.0/24"')


def _check_task(path: Path, config: RobotConfig) -> None:
    """Refuse what no single field of [task] shows."""
    _check_values(path, "task", config.task)
    slowest = find_driver(config.link.driver).slowest_rad_s(config.link.settings()) * config.robot.wheel_radius_m
    if config.task.speed_m_s < slowest:
        _refuse(
            path,
            "task.speed_m_s",
            f"{config.task.speed_m_s} m/s is slower than the controller holds",
            f"write at least {slowest:.2f}, or set the controller for less",
        )
    if config.control.fallback != "ramp" and math.isnan(config.task.reference_speed_m_s):
        _refuse(path, "control.fallback", "way-points by time have no speed to follow them at", 'write "ramp"')
    fault = config.task.fault()
    if fault is not None:
        _refuse(path, f"task.{fault.field}", fault.fault, fault.remedy)
    if config.task.speed_m_s > config.robot.max_wheel_speed_rad_s * config.robot.wheel_radius_m:
        _refuse(
            path,
            "task.speed_m_s",
            f"{config.task.speed_m_s} m/s is above what the wheels can do",
            "lower it, or raise robot.max_wheel_speed_rad_s within the firmware's limit",
        )
