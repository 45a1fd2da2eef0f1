"""The sections of robot.toml as frozen structs, each with the range of its fields. `robot_file.py` reads them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from msgspec import Meta

from disco_hw.fence import Fence, Footprint, usual_footprint
from drivers.motor import AS_CONFIGURED, Wiring, find_driver
from drivers.pose import DEFAULT, PoseConvention

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
    """Uniform ranges of the model's base parameters; the class's defaults are the paper's (appendix, skid-steer table).

    Loading a robot.toml replaces what it leaves out by ranges around its own robot, see `prior_around`.
    """

    x_icr_m: Range = (0.0, 0.5)
    wheel_radius_m: Range = (0.0, 0.5)
    axial_distance_m: Range = (0.1, 0.5)


_OF_THE_PROTOCOL = ("driver", "key_file", "of_driver")


class Link(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Section [link] of robot.toml, how the robot is reached; `options` go to the python-can interface as they are.

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
        """Return keyword arguments for `create_transport`: the medium, its settings, and a serial line's exchange."""
        fields = {name: value for name, value in msgspec.structs.asdict(self).items() if name not in _OF_THE_PROTOCOL}
        exchange = find_driver(self.driver).exchange
        return fields if exchange is None else {**fields, "exchange": exchange(self.settings())}

    def settings(self) -> Any:
        """Return the driver's own settings. Raises msgspec.ValidationError where it needs some that are not there."""
        if self.of_driver is not None:
            return self.of_driver
        return msgspec.convert({}, find_driver(self.driver).settings)


class PoseInput(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Section [pose] of robot.toml: `source` is of `drivers.pose`; None leaves what that source takes by itself.

    `datum`: latitude and longitude (degrees) of the world frame's origin. For `disco-hw bridge ros2`: the topic, the
    frame that its poses must be in, and the standard deviations of poses that come without. `rate_hz` is read from old
    files and decides nothing. `also`: further sources, whose poses are fused with these. `allow`: addresses and
    networks that may send to the port; `key_file`: the key that each datagram must be proven with.
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
        """Return this source and the further ones, in the order of their numbers."""
        return (self, *self.also)

    def labels(self) -> tuple[str, ...]:
        """Return the names of the sources; those of one kind are numbered."""
        names = [one.source for one in self.every()]
        return tuple(
            name if names.count(name) == 1 else f"{name} {names[: number + 1].count(name)}"
            for number, name in enumerate(names)
        )

    def of(self, source: str) -> PoseInput | None:
        """Return the first source of this kind; None where there is none."""
        return next((one for one in self.every() if one.source == source), None)

    def convention(self) -> PoseConvention:
        """Return the units and axes in which the source reports poses."""
        return msgspec.convert(self, PoseConvention, from_attributes=True)

    def in_source_units(self) -> PoseInput:
        """Return the settings as the source takes them: their standard deviations join its poses, in its units."""
        position_std, yaw_std = self.convention().to_source_units(self.position_std_m, self.yaw_std_rad)
        return msgspec.structs.replace(self, position_std_m=position_std, yaw_std_rad=yaw_std)


LONGEST_HORIZON = 500
"""Steps of the longest plan: that robot.toml may ask for, and that slow tasks and a large x_icr lead to."""


class Control(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The loop and the planner."""

    rate_hz: Annotated[float, Meta(ge=20.0, le=100.0)] = 50.0
    mode: Literal["default", "sampled", "paper"] = "default"
    uncertainty: Literal["ut", "mc", "joint", "point"] = "ut"
    facing: Literal["forwards", "backwards"] = "forwards"
    adaptation: Literal["auto", "off", "fast", "audited"] = "auto"
    disturbance: bool = False
    fallback: Literal["ramp", "pure_pursuit", "kanayama", "lqr"] = "ramp"
    samples: Annotated[int, Meta(ge=8, le=1_000_000)] = 400
    horizon: Annotated[int, Meta(ge=2, le=LONGEST_HORIZON)] | None = None
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
    """File of the model with its posterior; without a file the nominal geometry and the prior are used."""

    file: str | None = None


class LogSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the directory in which runs are recorded."""

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
    """Section [ros2] of robot.toml: what of a bag is read; what is left out is guessed.

    `pose_topic` "tf" is the chain from map to base frame.

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
    wheels: Wiring = AS_CONFIGURED
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

    @property
    def turned_rad(self) -> float:
        """Angle between the robot's heading and the direction it follows its task in: 0, or pi backwards."""
        return math.pi if self.control.facing == "backwards" else 0.0

    @property
    def task_start(self) -> tuple[float, float, float]:
        """Pose of the robot at the start of its task: x, y (m), yaw (rad)."""
        x_m, y_m, yaw_rad = self.task.course().start
        return x_m, y_m, yaw_rad + self.turned_rad

    @property
    def footprint_along_line(self) -> Footprint:
        """The footprint as seen along the task's line: of a robot that drives backwards what is behind lies ahead."""
        return self.robot.footprint.turned if self.turned_rad else self.robot.footprint

    @property
    def slowest_wheel_rad_s(self) -> float:
        """Slowest true speed of a wheel that the motor controller holds, rad/s."""
        return find_driver(self.link.driver).slowest_rad_s(self.link.settings()) * self.wheels.turn_ratio

    @property
    def largest_wheel_difference_rad_s(self) -> float:
        """Largest difference of the true wheel speeds that the motor controller allows, rad/s; infinite without one."""
        return find_driver(self.link.driver).largest_difference_rad_s(self.link.settings()) * self.wheels.turn_ratio
