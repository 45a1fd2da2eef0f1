"""The life cycle of every controller that knows no session: one state machine, and the interface of what differs.

`VendorDriver` arms, ramps, brakes, latches, and notices silence and a second host, the same for all vendors. A vendor's
file gives it a `Port`: what its frames mean, which frames do what, and a `Table` of its figures. The machine owns the
permit to move and hands it to the port as a value; the port never changes it.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import msgspec
from msgspec.structs import replace

from drivers.motor import vendor_parts as parts
from drivers.motor.permit import ON_STANDBY, Controllers, Idle, MotionPermit, Stage
from drivers.types import (
    DriverState,
    DriverStats,
    Frame,
    Identity,
    Limits,
    OutgoingFrame,
    Readings,
    ReceivedFrame,
    Request,
    RobotStatus,
    WheelCommand,
    WheelSample,
)

# Chosen: longer than any controller should take to arm; then the operator is told why it did not.
ARMING_TIMEOUT_NS = 1_500_000_000
BRAKING_NS = 3_000_000_000
"""Wheels that do not say by then that they stand are taken to."""
# Chosen: a lost frame costs 0.1 s; more often would load the bus of a controller that does not answer.
REPEAT_NS = 100_000_000
# An hour, so above any time for which a driver counts a command as under way.
_LONG_AFTER_NS = 3_600_000_000_000


class Table(msgspec.Struct, frozen=True, kw_only=True):
    """The figures in which controllers differ.

    `watchdog_s`: after what silence of the host they have stopped by themselves, where they keep no state that shows
    it, so that a later command would move them again; None where they do. `zeros_to_arm`: zeros commanded before the
    first speed. `slowest_rad_s`: the slowest speed that they hold, at which the ramp of a stop ends. `idle`, in which
    they are met, and `after_loss`: see `MotionPermit`.
    """

    stop_deceleration_rad_s2: float
    watchdog_s: float | None = None
    zeros_to_arm: int = 0
    slowest_rad_s: float = 0.0
    idle: Idle = Stage.REST
    after_loss: Idle = Stage.REST


class Source(msgspec.Struct, frozen=True):
    """Source that must report again and again, by name: when it was received last, and how long it may be silent.

    After `silent_ns` a drive ends; after `gone_ns` at rest the controllers must be met anew (None: they need not).
    """

    name: str
    received_ns: int | None
    silent_ns: float
    gone_ns: float | None = None


class Objection(msgspec.Struct, frozen=True):
    """Reason why a drive must end, and whether that is a fault that stays until a reset."""

    why: str
    is_fault: bool = True


class FrameReport(msgspec.Struct, frozen=True, kw_only=True):
    """Meaning of one received frame.

    `counts`: counters of `DriverStats` that it adds to. `is_status`: it says how the controllers are. `is_stop` and
    `commanded`: another host's e-stop, and whom another host commands. `lost`: what ends a drive, and nothing else.
    `restarted`: why the controllers must be met anew. `message`: for the operator.
    """

    counts: tuple[str, ...] = ("frames_accepted",)
    wheels: WheelSample | None = None
    is_status: bool = False
    is_stop: bool = False
    commanded: str | None = None
    lost: str | None = None
    restarted: str | None = None
    message: str | None = None


UNKNOWN = FrameReport(counts=("unknown_id",))
REJECTED_LENGTH = FrameReport(counts=("rejected_length",))
IMPLAUSIBLE = ("frames_accepted", "implausible_ticks")


class Pending(msgspec.Struct, frozen=True, kw_only=True):
    """Precondition of arming that is not met yet: the frames that bring it about, and why arming fails without it.

    `is_final`: waiting does not help.
    """

    why: str
    frames: tuple[Frame, ...] = ()
    is_final: bool = False


class Port(ABC):
    """One vendor's protocol, as `VendorDriver` needs it. Pure: no clock, thread or I/O, and no frame makes it raise.

    `table`: the figures of these controllers, set when it is made.
    """

    table: Table
    _repeat_ns = 0

    @property
    @abstractmethod
    def seen(self) -> Controllers:
        """State of the controllers, as received last."""

    @property
    @abstractmethod
    def identity(self) -> Identity | None:
        """Identity of the controller; None before all of it is known."""

    @property
    @abstractmethod
    def limits(self) -> Limits:
        """Limits of the controllers, and who states them; requested only when `identity` is known."""

    @property
    @abstractmethod
    def is_stopped(self) -> bool:
        """Whether the controllers have confirmed, since they were met, that an e-stop holds."""

    @abstractmethod
    def reset_state(self, now_ns: int) -> None:
        """Forget what was received: the link or the controllers have restarted. What the wheels have turned stays."""

    def end_drive(self) -> None:
        """Prepare the end of the drive: what is repeated to stop the controllers (`_is_due`) is due at once."""
        self._repeat_ns = 0

    @abstractmethod
    def handle(self, received: ReceivedFrame, permit: MotionPermit) -> FrameReport:
        """Take in a frame and return what it meant."""

    @abstractmethod
    def sources(self) -> Sequence[Source]:
        """Return the sources that must report again and again."""

    @abstractmethod
    def objection(self, permit: MotionPermit) -> Objection | None:
        """Return why the controllers, as received last, may not be driven on; None if they may."""

    @abstractmethod
    def prepare(self, now_ns: int, permit: MotionPermit) -> Pending | None:
        """Return what lacks before zeros may be commanded; None when all proof is there.

        Called in each tick of an arming, in the first one with `permit.lasts_ns(now_ns)` 0: proof is given anew.
        """

    @abstractmethod
    def speeds(self, now_ns: int, left_rad_s: float, right_rad_s: float) -> Sequence[Frame]:
        """Return the frames that command these wheel speeds."""

    @abstractmethod
    def brake(self, now_ns: int, lasts_ns: int) -> tuple[Sequence[Frame], bool]:
        """Return the frames that hold the wheels, and whether they stand; `lasts_ns` since braking began."""

    def rest(self, now_ns: int, permit: MotionPermit) -> Sequence[Frame]:
        """Return the frames due at rest: what keeps the controllers there, resets them, asks for what is not known."""
        return ()

    def may_reset(self, now_ns: int) -> bool:
        """Whether the vendor's conditions that `seen` does not show allow what is latched here to be cleared."""
        return True

    def questions(self, now_ns: int, permit: MotionPermit) -> tuple[OutgoingFrame, ...]:
        """Return the questions due in this tick, after its other frames; none may feed a watchdog without a command."""
        return ()

    @abstractmethod
    def stop_frames(self) -> tuple[Frame, ...]:
        """Return the e-stop to all controllers."""

    def _is_due(self, now_ns: int, every_ns: int = REPEAT_NS) -> bool:
        """Whether what is repeated until a controller obeys is due; it then counts as sent."""
        is_due = now_ns - self._repeat_ns >= every_ns
        self._repeat_ns = now_ns if is_due else self._repeat_ns
        return is_due


def stop_confirmation(port: Port) -> Callable[[ReceivedFrame], bool]:
    """Return what says, frame by frame heard, whether the controllers have confirmed an e-stop that was sent to them.

    `port`: a fresh one, for a connection beside the driver's.
    """
    permit = MotionPermit(link_is_up=True, stage=Stage.BRAKING)

    def is_confirmation(received: ReceivedFrame) -> bool:
        # Long after any command: none of this connection's can be under way.
        port.handle(ReceivedFrame(_LONG_AFTER_NS + received.t_ns, received.frame), permit)
        return port.is_stopped

    return is_confirmation


class VendorDriver:
    """Satisfies `drivers.types.Driver` with a `Port`: pure, and no frame makes it raise."""

    clock_offset_ns: int | None = None

    def __init__(self, port: Port) -> None:
        table = port.table
        self._port = port
        self._table = table
        self._permit = MotionPermit(idle=table.idle, after_loss=table.after_loss, stage=table.idle)
        self._counts = {field.name: 0 for field in dataclasses.fields(DriverStats)}

    @property
    def stats(self) -> DriverStats:
        """A snapshot of the counters."""
        return DriverStats(**self._counts)

    @property
    def state(self) -> DriverState:
        """State of the driver with its controllers."""
        return self._permit.state(self._port.seen)

    @property
    def detail(self) -> str:
        """Text on why the state is what it is, and what to do about it."""
        return self._permit.detail(self._port.seen)

    @property
    def identity(self) -> Identity | None:
        """Identity of the controller; None before all of it is known."""
        return self._port.identity

    @property
    def limits(self) -> Limits | None:
        """Limits of the controllers, and who states them; None before they are known."""
        return None if self._port.identity is None else self._port.limits

    @property
    def is_stop_over(self) -> bool:
        """Whether nothing more is sent to stop: controllers are at rest and not energised, or the link is down."""
        permit = self._permit
        return not permit.link_is_up or (permit.stage is Stage.REST and not self._port.seen.energised)

    def link_up(self, now_ns: int) -> None:
        """Start again after the medium has come up: whatever was agreed is void."""
        self._restart_handshake(self._permit.linked(True), now_ns)

    def link_down(self, now_ns: int) -> None:
        """Drop whatever was agreed, because the medium is gone."""
        self._restart_handshake(self._permit.linked(False), now_ns)

    def request(self, request: Request) -> None:
        """Set what the host wants; ARM only from standing by, and consumed when the controllers stop."""
        before, self._permit = self._permit, self._permit.requested(request, self._port.seen)
        if self._permit.target is Request.ARM is not before.target:
            self._count("sessions")

    def receive(self, now_ns: int, frames: Sequence[ReceivedFrame]) -> Readings:
        """Take in received frames and return what they meant; frames that come while the link is down are ignored."""
        wheels: list[WheelSample] = []
        status: RobotStatus | None = None
        other_host: str | None = None
        for received in frames if self._permit.link_is_up else ():
            report = self._port.handle(received, self._permit)
            self._react(report)
            if report.commanded is not None:
                other_host = f"it commands {report.commanded}"
            if report.is_status:
                status = parts.status(received.t_ns, self.state, self._port.is_stopped)
            if report.wheels is not None:
                wheels.append(report.wheels)
        if self._permit.link_is_up:
            self._permit = self._permit.looked(now_ns)
            self._check_silence(now_ns)
            self._check_objection()
        events, self._permit = self._permit.events, replace(self._permit, events=())
        statuses = () if status is None else (status,)
        return Readings(wheels=tuple(wheels), status=statuses, events=events, other_host=other_host)

    def transmit(self, now_ns: int, command: WheelCommand | None) -> tuple[OutgoingFrame, ...]:
        """Return the frames due now: the command or a stop, and the questions.

        Raises ValueError for a command that is not finite or valid for no time.
        """
        parts.check_command(command, 0.0)
        if not self._permit.link_is_up:
            return ()
        if self._table.watchdog_s is not None and self._permit.is_late(now_ns, self._table.watchdog_s):
            why = "no command was sent for longer than the controllers' time-out; check the load of this computer"
            self._end(self._permit.lost(why))
        sent = self._step(now_ns, command)
        return (*sent, *self._port.questions(now_ns, self._permit))

    def release(self, why: str) -> None:
        """Stop without a ramp from now on, as the controllers can; `why` is a fault until a reset."""
        self._end(self._permit.lost(why))

    def estop(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Return frames that stop the wheels in any state; no motion is commanded afterwards until a reset.

        Earlier requests are dropped.
        """
        self._end(self._permit.stopped())
        return parts.estop_frames(now_ns, self._port.stop_frames())

    def _step(self, now_ns: int, command: WheelCommand | None) -> tuple[OutgoingFrame, ...]:
        """Return the frames of the stage, which may end in this tick."""
        match self._permit.stage:
            case Stage.ARMED:
                if command is None:
                    return ()
                self._permit = self._permit.commanded(now_ns, command)
                self._count("commands_sent")
                frames = self._port.speeds(now_ns, *self._permit.speeds)
                # Half of the command's validity may pass on the way.
                return parts.outgoing(now_ns, *frames, life_ns=round(0.5e9 * command.valid_for_s))
            case Stage.ARMING:
                frames = self._arm(now_ns)
            case Stage.STOPPING:
                frames = self._ramp(now_ns)
            case Stage.BRAKING:
                frames = self._brake(now_ns)
            case Stage.REST:
                frames = self._rest(now_ns)
        return parts.outgoing(now_ns, *frames)

    def _arm(self, now_ns: int) -> Sequence[Frame]:
        """Return the frames that arm: what lacks, then zeros until there were enough; give up after too long."""
        self._permit = self._permit.begun(now_ns)
        pending = self._port.prepare(now_ns, self._permit)
        if pending is None:
            self._permit = self._permit.fed_zero(now_ns)
            if self._permit.zeros > self._table.zeros_to_arm:
                self._permit = self._permit.armed(now_ns)
            return self._port.speeds(now_ns, 0.0, 0.0)
        if pending.is_final or self._permit.lasts_ns(now_ns) > ARMING_TIMEOUT_NS:
            self._end(self._permit.given_up(f"not armed: {pending.why}"))
            return self._rest(now_ns) if self._permit.stage is Stage.REST else self._brake(now_ns)
        return pending.frames

    def _ramp(self, now_ns: int) -> Sequence[Frame]:
        """Slow down with the declared deceleration, then brake until the wheels stand."""
        self._permit = self._permit.slowed(now_ns, self._table.stop_deceleration_rad_s2)
        if max(map(abs, self._permit.speeds)) > self._table.slowest_rad_s:
            return self._port.speeds(now_ns, *self._permit.speeds)
        self._end(self._permit.ramped())
        return self._brake(now_ns)

    def _brake(self, now_ns: int) -> Sequence[Frame]:
        self._permit = self._permit.begun(now_ns)
        frames, is_stationary = self._port.brake(now_ns, self._permit.lasts_ns(now_ns))
        if is_stationary:
            self._permit = self._permit.rested()
        return frames

    def _rest(self, now_ns: int) -> Sequence[Frame]:
        if self._permit.target is Request.RESET and self._port.may_reset(now_ns):
            self._permit = self._permit.reset(self._port.seen)
            if self._permit.target is not Request.RESET:
                return ()
        return self._port.rest(now_ns, self._permit)

    def _react(self, report: FrameReport) -> None:
        for name in report.counts:
            self._count(name)
        if report.restarted is not None:
            self._end(self._permit.restarted(report.restarted))
        if report.message is not None:
            self._permit = replace(self._permit, note=ON_STANDBY).with_event(report.message)
        if report.is_stop:
            self._end(self._permit.stop_received())
        elif report.commanded is not None:
            before, self._permit = self._permit, self._permit.command_received(report.commanded)
            if before.stage is not self._permit.stage:
                self._port.end_drive()
        if report.lost is not None and self._permit.is_driving:
            self._end(self._permit.lost(report.lost))
        self._check_objection()

    def _check_objection(self) -> None:
        if not self._may_lose:
            return
        objection = self._port.objection(self._permit)
        if objection is not None and objection.is_fault:
            self._end(self._permit.lost(objection.why))
        elif objection is not None:
            self._end(self._permit.given_up(objection.why).with_event(objection.why))

    def _check_silence(self, now_ns: int) -> None:
        is_idle = self._permit.stage in (Stage.REST, self._table.idle)
        for source in self._port.sources():
            silent_ns = 0 if source.received_ns is None else self._permit.silent_ns(source.received_ns)
            why = f"{source.name} stopped reporting"
            if self._may_lose:
                if silent_ns > source.silent_ns:
                    why = f"{why}: no frame for {source.silent_ns * 1e-9:g} s; check its power and the cable"
                    self._end(self._permit.lost(why))
                    return
            elif is_idle and source.gone_ns is not None and silent_ns > source.gone_ns:
                self._restart_handshake(self._permit.restarted(why, f"{why}: waiting for it"), now_ns)
                return

    @property
    def _may_lose(self) -> bool:
        """Whether something that is wrong has a drive to end, and has not ended it already."""
        return self._permit.stage not in (Stage.REST, self._table.after_loss)

    def _end(self, permit: MotionPermit) -> None:
        self._permit = permit
        self._port.end_drive()

    def _restart_handshake(self, permit: MotionPermit, now_ns: int) -> None:
        self._end(permit)
        self._port.reset_state(now_ns)

    def _count(self, name: str) -> None:
        self._counts[name] += 1
