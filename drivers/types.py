"""Interfaces of drivers and pose sources, and the identity, limits and safety card that a driver reports.

Frames and transports are in `drivers/link_types.py`, samples and commands in `drivers/samples.py`; both can be imported
from here. SI units; left before right; positive wheel speed drives forward; x forward, y left, yaw counter-clockwise.
Time stamps are nanoseconds of the host's monotonic clock unless the name says otherwise.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, Literal, Protocol, runtime_checkable

import msgspec

from drivers.link_types import (
    MAX_EXTENDED_ID,
    CyclicFrame,
    Exchange,
    Frame,
    LinkState,
    OutgoingFrame,
    ReceivedFrame,
    Transport,
    TransportStats,
    socketcan_id,
)
from drivers.samples import (
    MotorSample,
    PoseSample,
    PowerSample,
    Readings,
    RobotLinkHealth,
    RobotStatus,
    WheelCommand,
    WheelSample,
)

SaidBy = Literal["device", "fixed", "robot.toml"]
"""Who says something of a controller: itself, its documents of what cannot be set otherwise, or robot.toml alone."""
SOURCE_TEXTS: Mapping[SaidBy, str] = MappingProxyType(
    {
        "device": "reported by the controller",
        "fixed": "which cannot be set otherwise",
        "robot.toml": "declared in robot.toml, not reported by the controller",
    }
)


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity of a controller: its kind, its firmware's version where it is known, and what else it reports of itself.

    `said_by` is of kind and version: where the controller reports neither, they are what robot.toml says.
    """

    controller: str
    firmware: str
    said_by: SaidBy
    details: str = ""

    def describe(self) -> str:
        """Return the whole identity as text, with who states it."""
        version = self.firmware and f"firmware {self.firmware}"
        known = ", ".join(text for text in (self.controller, version, self.details) if text)
        return f"{known} ({SOURCE_TEXTS.get(self.said_by, self.said_by)})"


@dataclass(frozen=True, slots=True)
class Limit:
    """One figure that a controller keeps to, and who says so."""

    value: float
    said_by: SaidBy


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits that a controller enforces; a figure that nobody states is None.

    `command_timeout_s`: how long it waits for a command before it stops the motors. `drive_off_timeout_s`: how long
    until it takes the current off them then.
    """

    max_wheel_speed_rad_s: Limit
    command_timeout_s: Limit
    stop_deceleration_rad_s2: Limit
    max_wheel_acceleration_rad_s2: Limit | None = None
    ticks_per_rev: Limit | None = None
    drive_off_timeout_s: Limit | None = None

    def known(self) -> dict[str, Limit]:
        """Return the figures that somebody says, by name."""
        each = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: limit for name, limit in each.items() if limit is not None}


class DriverState(enum.Enum):
    """States of a driver with its robot."""

    DISCONNECTED = "disconnected"
    HANDSHAKE = "handshake"
    REFUSED = "refused"
    STANDBY = "standby"
    READY = "ready"
    ARMING = "arming"
    ARMED = "armed"
    STOPPING = "stopping"
    FAULT = "fault"
    ESTOP = "estop"


class Request(enum.Enum):
    """Requests of the host to a driver: stay still, open a session, allow motion, clear a latched fault or e-stop."""

    STANDBY = "standby"
    READY = "ready"
    ARM = "arm"
    RESET = "reset"


@dataclass(frozen=True, slots=True)
class DriverStats:
    """Counters of one driver since it was made."""

    frames_accepted: int = 0
    rejected_crc: int = 0
    rejected_sequence: int = 0
    rejected_length: int = 0
    unknown_id: int = 0
    lost_frames: int = 0
    implausible_ticks: int = 0
    implausible_values: int = 0
    commands_sent: int = 0
    sessions: int = 0
    robot_clock_errors: int = 0
    late_commands: int = 0
    silent_states: int = 0


class Driver(Protocol):
    """One motor controller's protocol as a pure state machine; no thread, clock or I/O.

    Malformed input never raises.
    """

    @property
    def state(self) -> DriverState:
        """State of the driver with its robot."""

    @property
    def detail(self) -> str:
        """One sentence for the operator: why the state is what it is and what to do about it."""

    @property
    def identity(self) -> Identity | None:
        """Identity of the controller; None before the handshake is complete."""

    @property
    def limits(self) -> Limits | None:
        """Limits of the controller, and who states them; None before the handshake is complete."""

    @property
    def stats(self) -> DriverStats:
        """A snapshot of the counters."""

    @property
    def clock_offset_ns(self) -> int | None:
        """Host time minus device time, as estimated now; None before the first estimate."""

    @property
    def is_stop_over(self) -> bool:
        """Whether no further frame would bring the wheels to a stand: they stand, or the robot cannot be reached."""

    def link_up(self, now_ns: int) -> None:
        """Start the handshake, because the medium has come up (again); any session is void."""

    def link_down(self, now_ns: int) -> None:
        """Drop any session, because the medium is gone."""

    def receive(self, now_ns: int, frames: Sequence[ReceivedFrame]) -> Readings:
        """Take in received frames and return what they meant."""

    def request(self, request: Request) -> None:
        """Set what the host wants; held until changed. ARM is consumed: it never re-arms by itself after a stop."""

    def release(self, why: str) -> None:
        """Take the torque off every motor from now on, without a ramp, which would need the encoders.

        `why`, in words, is a fault until a reset.
        """

    def transmit(self, now_ns: int, command: WheelCommand | None) -> tuple[OutgoingFrame, ...]:
        """Return the frames due now: the command (only while armed; zeros while arming) and house-keeping."""

    def estop(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Frames that stop the robot in any state."""


class PoseSource(Protocol):
    """Source of measured poses; called in each tick of the control loop, so that it must not wait."""

    def receive(self, now_ns: int, from_robot: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """Poses that came since the last call, oldest first; `from_robot` are those of the motor driver.

        Never raises: what makes no sense is dropped and counted, and without poses the robot stops by itself.
        """

    def close(self) -> None:
        """Release what it holds; safe to call twice."""


@runtime_checkable
class MessageSource(Protocol):
    """A pose source that knows why its poses come or fail to come."""

    def new_messages(self) -> Sequence[str]:
        """Sentences for the operator since the last call."""


@dataclass(frozen=True, slots=True)
class SafetyCard:
    """Summary, for the operator, of what stops the robot when.

    `reaction_s`: how long the wheels may still be driven after the host has fallen silent. `brakes`: whether they are
    braked then, or coast. `wheel_fault`: how this computer stops wheels of which one does not obey, without a ramp that
    would need its encoder; `stops_by_own_ramp`: the controller slows down by a ramp of its own then. `unverified`: what
    this computer could not find out. `setup`: what the controller must be set to.
    """

    host_silent: str
    stops_by: str
    reaction_s: float
    brakes: bool
    estop: str
    wheel_fault: str = "by the ramp of every stop"
    stops_by_own_ramp: bool = False
    unverified: tuple[str, ...] = ()
    setup: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SettingsFault:
    """Fault of a driver's settings that no single field shows: the field's name, what is wrong, what to write."""

    field: str
    fault: str
    hint: str


class NoSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of a driver that has no fields of its own in [link]."""

    def fault(self) -> SettingsFault | None:
        """Return None, because nothing can be wrong."""
        return None


@dataclass(frozen=True, slots=True)
class LineQuestions:
    """Questions that find a controller which only replies: harmless frames, and the speeds (bit/s) to try."""

    frames: tuple[Frame, ...]
    bauds: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class MotorDriver:
    """A motor controller that robot.toml can name: each file of `drivers.motor` that speaks to one holds a `DRIVER`.

    `settings`: a struct of its own fields in [link], with `fault()`; those of another driver are refused there. `make`
    returns a fresh driver of these and of the key of authenticated mode (16 bytes) or None. `stop_frames`: the e-stop
    for a connection beside the daemon's, which needs no answer; `stop_confirmation` makes what says, given each frame
    that is heard then, whether the robot has confirmed it. `slowest_rad_s`: the slowest wheel speed that it holds.
    `largest_difference_rad_s`: of the wheel speeds, where it limits how fast the robot turns.
    `cyclic_frames` (of settings, command rate in Hz, whether authenticated): what the link carries. `authenticates`:
    whether there is such a mode; without one `link.key_file` is refused. `kinds`: of links that it speaks over, the
    usual one first; "can" stands for every medium but "serial". `reports_reception`: whether the controller counts the
    frames that it rejects and answers for its clock, so that `check` can ask. `exchange` makes what a serial line is
    spoken with; None: the reference protocol's frames. `serial_field`: of the settings, one that belongs to a serial
    link, where it must be given, and to no other. `example`: its fields in [link] for a robot as the demonstration
    drives it; none where its controller is not simulated. `takes_body_speeds`: whether it is given speed and turn rate
    of the body, and makes wheel speeds of them by a track of its own. `recognise`: of frames that came, the fields in
    [link] that they show, None if they are not its controller's; where it says nothing by itself, of the replies to
    `questions` on a serial line. `latches_stop`: whether the controller itself keeps an e-stop until it is reset.
    """

    name: str
    make: Callable[[Any, bytes | None], Driver]
    stop_frames: Callable[[Any], tuple[Frame, ...]]
    stop_confirmation: Callable[[Any], Callable[[ReceivedFrame], bool]]
    cyclic_frames: Callable[[Any, float, bool], tuple[CyclicFrame, ...]]
    safety_card: Callable[[Any], SafetyCard]
    slowest_rad_s: Callable[[Any], float] = lambda _settings: 0.0
    largest_difference_rad_s: Callable[[Any], float] = lambda _settings: math.inf
    settings: type[Any] = NoSettings
    kinds: tuple[str, ...] = ("can",)
    exchange: Callable[[Any], Exchange] | None = None
    serial_field: str = ""
    example: str = ""
    recognise: Callable[[Sequence[Frame]], dict[str, Any] | None] = lambda _frames: None
    questions: LineQuestions | None = None
    latches_stop: bool = True
    takes_body_speeds: bool = False
    authenticates: bool = False
    reports_reception: bool = False
