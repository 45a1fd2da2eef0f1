"""What the drivers of vendors' controllers share: odometers, frames and ids as written, and the permit to move.

These controllers know no session, latch little and report to no host that another one drives them. What the reference
protocol proves in the controller is kept in `MotionPermit`, one value: arming only when asked and only from rest, the
ramp of a stop, a fault and an e-stop that stay until a reset, and that nothing re-arms by itself. A driver says what
its controllers are like (`Controllers`) and what happened; which frames that makes is the driver's own. Stopping is
taken in every stage; what does not belong to a stage leaves the permit as it is.
"""

from __future__ import annotations

import dataclasses
import enum
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import msgspec
from msgspec.structs import replace

from drivers.types import (
    DriverState,
    DriverStats,
    Frame,
    OutgoingFrame,
    Request,
    RobotStatus,
    WheelCommand,
    WheelSample,
)

_FRAME_LIFE_NS = 50_000_000
_ESTOP_LIFE_NS = 1_000_000_000
_ESTOP_REPEATS = 3
_ESTOP_RANK, _RANK = 0, 1
Nodes = int | tuple[int, ...]
"""Ids on CAN of one side's controllers, as robot.toml names them."""
Sign = Literal[-1, 1]


@dataclass(slots=True)
class Odometer:
    """What one motor has turned since the driver began, in the controller's counts.

    `total` goes on over a restart of the controller; `speed` in counts/s carries it on from `t_ns`, when the last count
    was received; it is not older than `looked_ns`, when the host had looked before.
    """

    total: float = 0.0
    speed: float = 0.0
    t_ns: int = 0
    looked_ns: int = 0
    last: float | None = None
    is_new: bool = False

    def take(self, count: float, t_ns: int, looked_ns: int, fastest: float, slack: float) -> bool:
        """Whether the motor can have turned so far since the count before; if not, it goes on from this one.

        `fastest` in counts/s, and `slack` counts more. A pause of the host brings the stamps of two counts together,
        but not before the host had looked last (`looked_ns`, now).
        """
        longest_s = (t_ns - min(self.t_ns, self.looked_ns)) * 1e-9
        moved = 0.0 if self.last is None else count - self.last
        plausible = abs(moved) <= fastest * longest_s + slack
        self.total += moved if plausible else 0.0
        self.last, self.t_ns, self.looked_ns, self.is_new = count, t_ns, looked_ns, True
        return plausible

    def take_wrapping(self, count: int, t_ns: int, looked_ns: int, fastest: float, slack: float) -> bool:
        """As `take`, of a count of 32 bits."""
        last = count if self.last is None else int(self.last)
        moved = (count - last + 2**31) % 2**32 - 2**31
        self.last = None if self.last is None else count - moved
        return self.take(count, t_ns, looked_ns, fastest, slack)

    def begin_anew(self) -> None:
        """The controller may have restarted: the next count is compared with none before."""
        self.last, self.is_new = None, False


def wheel_sample(
    t_ns: int, sides: Sequence[Sequence[Odometer]], direction: tuple[int, int], rad_per_count: float
) -> WheelSample:
    """The wheels of both sides, each the mean of its motors; what was counted earlier is carried on to `t_ns`."""
    angles, speeds = [], []
    for side, sign in zip(sides, direction, strict=True):
        turned = [each.total + each.speed * (t_ns - each.t_ns) * 1e-9 for each in side]
        angles.append(sign * rad_per_count * sum(turned) / len(side))
        speeds.append(sign * rad_per_count * sum(each.speed for each in side) / len(side))
        for each in side:
            each.is_new = False
    return WheelSample(t_ns, t_ns, angles[0], angles[1], speeds[0], speeds[1])


@dataclass(frozen=True, slots=True)
class Layout:
    """A message: its number, its bytes by `struct` without the byte order, and the names of the fields."""

    command: int
    order: str
    body: str
    fields: tuple[str, ...] = ()

    @property
    def length(self) -> int:
        """Of the fields in bytes."""
        return struct.calcsize(self.order + self.body)

    def pack(self, *values: float) -> bytes:
        """The bytes of the fields."""
        return struct.pack(self.order + self.body, *values)

    def unpack(self, data: bytes) -> dict[str, Any]:
        """The fields by name, of bytes that begin with them."""
        return dict(zip(self.fields, struct.unpack_from(self.order + self.body, data), strict=True))


def layouts(order: str, *rows: tuple[str, int, str, str]) -> Mapping[str, Layout]:
    """By name: each row has name, number, body and the fields' names."""
    return MappingProxyType(
        {name: Layout(command, order, body, tuple(names.split())) for name, command, body, names in rows}
    )


def check_command(command: WheelCommand | None) -> None:
    """Raise ValueError for a command that is not finite or valid for no time."""
    if command is not None and not (
        math.isfinite(command.left_rad_s) and math.isfinite(command.right_rad_s) and command.valid_for_s > 0.0
    ):
        raise ValueError(f"not a wheel command: {command}")


def outgoing(now_ns: int, *frames: Frame, life_ns: int = _FRAME_LIFE_NS) -> tuple[OutgoingFrame, ...]:
    """Frames to be sent within `life_ns`, in this order, after any e-stop."""
    return tuple(OutgoingFrame(frame, now_ns + life_ns, _RANK) for frame in frames)


def commanding(now_ns: int, command: WheelCommand, *frames: Frame) -> tuple[OutgoingFrame, ...]:
    """The frames of a command: half of its validity may pass on the way."""
    return outgoing(now_ns, *frames, life_ns=round(0.5e9 * command.valid_for_s))


def estop_frames(now_ns: int, frames: tuple[Frame, ...]) -> tuple[OutgoingFrame, ...]:
    """The frames of an e-stop, three times over, before all others."""
    return tuple(OutgoingFrame(frame, now_ns + _ESTOP_LIFE_NS, _ESTOP_RANK) for frame in _ESTOP_REPEATS * frames)


def status(t_ns: int, state: DriverState, stop_confirmed: bool) -> RobotStatus:
    """A status of nothing but the state: these controllers know no sessions and count no refused frames.

    An e-stop that is not confirmed yet is a stop under way.
    """
    names = {DriverState.ARMED: "ARMED", DriverState.FAULT: "FAULT", DriverState.STOPPING: "STOPPING"}
    names[DriverState.ESTOP] = "ESTOP" if stop_confirmed else "STOPPING"
    return RobotStatus(
        t_ns=t_ns,
        state=names.get(state, "STANDBY"),
        fault_code=0,
        fault="NONE",
        estop_source="NONE",
        stop_cause="NONE",
        session=0,
        rejected_count=0,
        reject_reason="NONE",
    )


def counted(stats: DriverStats, name: str) -> DriverStats:
    """The counters, with one more of `name`."""
    return dataclasses.replace(stats, **{name: getattr(stats, name) + 1})


def sides_of(nodes: tuple[Nodes, Nodes]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The ids on the left and on the right."""
    left, right = ((side,) if isinstance(side, int) else side for side in nodes)
    return left, right


def all_of(nodes: tuple[Nodes, Nodes]) -> tuple[int, ...]:
    """Every id, left before right."""
    left, right = sides_of(nodes)
    return (*left, *right)


def in_sides(nodes: Sequence[int | str]) -> list[Any]:
    """What was heard of motors as left and right, the lower half first: two numbers, or two lists."""
    half = len(nodes) // 2
    left, right = list(nodes[:half]), list(nodes[half:])
    return [left[0], right[0]] if len(left) == len(right) == 1 else [left, right]


_LONGEST_STEP_S = 0.1
# Longer than a period at the slowest rate, 50 ms; with the 20 ms between two messages still shorter than the 100 ms
# after which the first driver calls its controllers silent.
_PAUSE_NS = 75_000_000
STOPPED_FROM_OUTSIDE = "stopped from outside on the link, by `disco-hw estop` or another host"


class Stage(enum.Enum):
    """Where a driver is between standing by and driving.

    STOPPING is the ramp down, BRAKING what follows it, or replaces it, until the wheels stand.
    """

    REST = "rest"
    ARMING = "arming"
    ARMED = "armed"
    STOPPING = "stopping"
    BRAKING = "braking"


Idle = Literal[Stage.REST, Stage.BRAKING]
_DRIVING = (Stage.ARMING, Stage.ARMED, Stage.STOPPING)


class Controllers(msgspec.Struct, frozen=True, kw_only=True):
    """What a driver has heard of its controllers, in its vendor's meaning of the words; None for what is well.

    For a person: what is `missing` that must be known of them, why they are `refused`, which e-stop of their own holds
    (`stopped`), what is `faulty`, and why they are `unfit` to be driven now although they are well. `energised`: they
    would obey a command. `offline`: what to do about a link that is down.
    """

    missing: str | None = None
    refused: str | None = None
    stopped: str | None = None
    faulty: str | None = None
    unfit: str | None = None
    energised: bool = False
    offline: str = "the link is down"


class MotionPermit(msgspec.Struct, frozen=True, kw_only=True):
    """The value; each transition returns the next one.

    `idle`: where a restart or an arming that fails leaves it, `after_loss` where a fault or an e-stop does: BRAKING for
    controllers that must be sent something until they stand. `since_ns`: the first tick of the stage, None before it.
    `speeds`, `fed_ns`: wheel speeds (rad/s) commanded last, and when. `zeros`: commands of zero since arming began.
    `events`: said since the driver passed them on.
    """

    idle: Idle = Stage.REST
    after_loss: Idle = Stage.REST
    link_is_up: bool = False
    stage: Stage = Stage.REST
    since_ns: int | None = None
    wanted: Request = Request.STANDBY
    note: str = "it stands by"
    fault: str | None = None
    estopped: bool = False
    shared: bool = False
    speeds: tuple[float, float] = (0.0, 0.0)
    fed_ns: int = 0
    zeros: int = 0
    looked_ns: int = 0
    attentive_ns: int = 0
    events: tuple[str, ...] = ()

    @property
    def is_driving(self) -> bool:
        """Whether controllers hold speeds by command, or did just now: whatever is wrong with one then stops all."""
        return self.stage in _DRIVING

    def state(self, seen: Controllers) -> DriverState:
        """Where the driver is with its controllers; what is latched comes before what is not known."""
        if not self.link_is_up:
            return DriverState.DISCONNECTED
        if self.estopped or seen.stopped is not None:
            return DriverState.ESTOP
        if seen.refused is not None:
            return DriverState.REFUSED
        if self.fault is not None:
            return DriverState.FAULT
        if seen.missing is not None:
            return DriverState.HANDSHAKE
        if seen.faulty is not None:
            return DriverState.FAULT
        if self.stage is Stage.ARMED:
            return DriverState.ARMED
        if self.stage in (Stage.STOPPING, Stage.BRAKING) or (self.stage is Stage.REST and seen.energised):
            return DriverState.STOPPING
        if self.stage is Stage.ARMING:
            return DriverState.ARMING
        return DriverState.READY if self.wanted is Request.READY else DriverState.STANDBY

    def detail(self, seen: Controllers) -> str:
        """For a person: why the state is what it is, and what to do about it."""
        match self.state(seen):
            case DriverState.DISCONNECTED:
                return seen.offline
            case DriverState.ESTOP:
                return seen.stopped or "emergency stop; remove its cause, then reset"
            case DriverState.REFUSED:
                return seen.refused or ""
            case DriverState.HANDSHAKE:
                return seen.missing or ""
            case DriverState.FAULT:
                return f"{self.fault or seen.faulty}; remove the cause, then reset"
            case DriverState.STANDBY | DriverState.READY:
                return seen.unfit or self.note
        return self.note

    def may_arm(self, seen: Controllers) -> bool:
        """Whether arming may be asked for."""
        return self.state(seen) in (DriverState.STANDBY, DriverState.READY) and seen.unfit is None

    def is_late(self, now_ns: int, timeout_s: float) -> bool:
        """Whether controllers that hold a speed must have stopped by themselves, as nothing was commanded for so long.

        Where they have no armed state to fall out of, the next command would move them again.
        """
        holds = self.stage is Stage.ARMED or (self.stage is Stage.STOPPING and any(self.speeds))
        return holds and now_ns - self.fed_ns > timeout_s * 1e9

    def silent_ns(self, heard_ns: int) -> int:
        """How long nothing has come since `heard_ns`, of the time in which the host looked without a pause.

        What was not heard in a pause is no silence of the controllers: the host was not there, or has not read yet.
        """
        return self.looked_ns - max(heard_ns, self.attentive_ns)

    def looked(self, now_ns: int) -> MotionPermit:
        """The host looks at its controllers, once in each tick."""
        paused = now_ns - self.looked_ns > _PAUSE_NS
        return replace(self, looked_ns=now_ns, attentive_ns=now_ns if paused else self.attentive_ns)

    def linked(self, is_up: bool) -> MotionPermit:
        """The medium has come up or is gone: all is void but what is latched."""
        return replace(self.restarted("the link was lost"), link_is_up=is_up)

    def restarted(self, why: str, event: str | None = None) -> MotionPermit:
        """The controllers must be met anew; what is latched stays."""
        note = f"disarmed: {why}" if self.wanted is Request.ARM else self.note
        met_anew = replace(self._idled(note), shared=False)
        return met_anew if event is None else met_anew.saying(event)

    def requested(self, request: Request, seen: Controllers) -> MotionPermit:
        """What the host wants; ARM only of controllers that stand by and are fit, and each time asked for anew."""
        if request is self.wanted:
            return self
        if request is Request.ARM:
            if not self.may_arm(seen):
                return replace(self, note=f"not arming: {self.detail(seen)}")
            return replace(
                self, wanted=request, stage=Stage.ARMING, since_ns=None, zeros=0, speeds=(0.0, 0.0), note="arming"
            )
        if self.stage in (Stage.ARMING, Stage.ARMED):
            return replace(self, wanted=request, stage=Stage.STOPPING, since_ns=None, note="stopping as asked")
        return replace(self, wanted=request)

    def begun(self, now_ns: int) -> MotionPermit:
        """The stage's time runs from its first tick."""
        return replace(self, since_ns=now_ns) if self.since_ns is None else self

    def lasts_ns(self, now_ns: int) -> int:
        """Time since the stage's first tick."""
        return 0 if self.since_ns is None else now_ns - self.since_ns

    def fed_zero(self, now_ns: int) -> MotionPermit:
        """Zero was commanded while arming."""
        return replace(self, fed_ns=now_ns, zeros=self.zeros + 1) if self.stage is Stage.ARMING else self

    def armed(self, now_ns: int) -> MotionPermit:
        """All proof is there: commands may move it from now on."""
        if self.stage is not Stage.ARMING:
            return self
        return replace(self, stage=Stage.ARMED, note="armed", fed_ns=now_ns, speeds=(0.0, 0.0))

    def commanded(self, now_ns: int, command: WheelCommand) -> MotionPermit:
        """A command is passed on."""
        if self.stage is not Stage.ARMED:
            return self
        return replace(self, fed_ns=now_ns, speeds=(command.left_rad_s, command.right_rad_s))

    def slowed(self, now_ns: int, deceleration_rad_s2: float) -> MotionPermit:
        """A step of the ramp: speeds nearer to zero; a pause counts for 0.1 s at most."""
        if self.stage is not Stage.STOPPING:
            return self
        step = deceleration_rad_s2 * min(max(now_ns - self.fed_ns, 0) * 1e-9, _LONGEST_STEP_S)
        left, right = (math.copysign(max(abs(speed) - step, 0.0), speed) for speed in self.speeds)
        return replace(self.begun(now_ns), fed_ns=now_ns, speeds=(left, right))

    def ramped(self) -> MotionPermit:
        """The ramp is through: brake until the wheels stand."""
        return replace(self, stage=Stage.BRAKING, since_ns=None) if self.stage is Stage.STOPPING else self

    def rested(self) -> MotionPermit:
        """The stop is through."""
        stopping = self.stage in (Stage.STOPPING, Stage.BRAKING)
        return replace(self, stage=Stage.REST, since_ns=None) if stopping else self

    def given_up(self, why: str) -> MotionPermit:
        """Not armed, or disarmed, without a fault."""
        return self._idled(why)

    def lost(self, why: str) -> MotionPermit:
        """One controller, or its host, is lost: all stop, and that stays a fault until a reset."""
        stopped = replace(self._idled(f"disarmed: {why}"), stage=self.after_loss, fault=why)
        return stopped.saying(f"disarmed: {why}")

    def stopped(self) -> MotionPermit:
        """An emergency stop was sent from here."""
        return replace(self._idled("emergency stop sent"), stage=self.after_loss, estopped=True)

    def stop_heard(self) -> MotionPermit:
        """An emergency stop was heard that somebody else sent; said once."""
        stopped = replace(self._idled(self.note), stage=self.after_loss, estopped=True)
        return stopped if self.estopped else stopped.saying(STOPPED_FROM_OUTSIDE)

    def command_heard(self, whom: str) -> MotionPermit:
        """Another host commands `whom`; said once, and a fault unless the controllers are at rest."""
        said = self if self.shared else self.saying(f"another host is on the link: it commands {whom}; disconnect it")
        said = replace(said, shared=True)
        return said if self.stage is Stage.REST else said.lost(f"another host commands {whom}; disconnect it")

    def reset(self, seen: Controllers) -> MotionPermit:
        """Clear what is latched, when that is wanted of controllers at rest that were heard and are well.

        Those that are refused may be reset: nothing arms them.
        """
        heard = seen.missing is None or seen.refused is not None
        well = heard and seen.stopped is None and seen.faulty is None and not seen.energised
        if self.stage is not Stage.REST or self.wanted is not Request.RESET or not well:
            return self
        return replace(self, fault=None, estopped=False, wanted=Request.STANDBY, note="it stands by")

    def saying(self, event: str) -> MotionPermit:
        """Something that a person should know."""
        return replace(self, events=(*self.events, event))

    def _idled(self, note: str) -> MotionPermit:
        return replace(self, wanted=Request.STANDBY, stage=self.idle, since_ns=None, note=note)
