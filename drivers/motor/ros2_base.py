"""The driver of bases that are reached over ROS 2 alone: speeds of the body out, joint states or odometry in.

It speaks to `disco-hw bridge ros2-base`, a process of its own, as nothing of ROS belongs into the control process. A
base tells nothing of its time-out, its limits or of who else commands it: the weakest safety of all drivers here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from drivers.motor import ros2_base_wire as wire
from drivers.motor import vendor_parts as parts
from drivers.motor.vendor_parts import Stage
from drivers.types import (
    DriverState,
    DriverStats,
    Frame,
    Identity,
    Limit,
    Limits,
    MotorDriver,
    OutgoingFrame,
    Readings,
    ReceivedFrame,
    Request,
    RobotStatus,
    WheelCommand,
    WheelSample,
)

ZEROS_TO_ARM = 5
SILENT_NS = 250_000_000
GONE_NS = 1_000_000_000
ARMING_TIMEOUT_NS = 1_500_000_000
STOPPING_NS = 3_000_000_000
_REPEAT_NS = 100_000_000


class Ros2BaseDriver:
    """Satisfies `drivers.types.Driver`: pure, and no frame makes it raise."""

    clock_offset_ns: int | None = None

    def __init__(self, settings: wire.Ros2BaseSettings) -> None:
        self._settings = settings
        self._check_sum = settings.check_sum()
        self.stats = DriverStats()
        self._attention = parts.Attention()
        self._link_is_up = False
        self._stage = Stage.REST
        self._stage_ns: int | None = None
        self._wanted, self._note = Request.STANDBY, "it stands by"
        self._fault: str | None = None
        self._estopped = self._foreign = False
        self._state_ns: int | None = None
        self._wheels_ns: int | None = None
        self._flags = self._refusal = self._bridge_sum = 0
        self._raw: tuple[int, int] | None = None
        self._newest: tuple[int, int] | None = None
        self._angles = (0.0, 0.0)
        self._wheel_speeds = (0.0, 0.0)
        self._zeros = 0
        self._speeds = (0.0, 0.0)
        self._last_sent_ns = self._repeat_ns = 0
        self._events: list[str] = []

    @property
    def state(self) -> DriverState:
        """Where the driver is with its base."""
        if not self._link_is_up:
            return DriverState.DISCONNECTED
        if self._estopped or self._flags & (wire.LATCHED | wire.BUTTON):
            return DriverState.ESTOP
        if self._state_ns is None or self._is_foreign_bridge or not self._is_alive:
            return DriverState.HANDSHAKE if self._fault is None else DriverState.FAULT
        if self._fault is not None:
            return DriverState.FAULT
        if self._stage is Stage.ARMED:
            return DriverState.ARMED
        if self._stage is Stage.STOPPING or (self._stage is Stage.REST and self._flags & wire.DRIVING):
            return DriverState.STOPPING
        rest = {Request.ARM: DriverState.ARMING, Request.READY: DriverState.READY}
        return rest.get(self._wanted, DriverState.STANDBY)

    @property
    def detail(self) -> str:
        """For a person: why the state is what it is, and what to do about it."""
        match self.state:
            case DriverState.DISCONNECTED:
                return "the link is down; start disco-hw bridge ros2-base ROBOT.toml"
            case DriverState.HANDSHAKE if self._state_ns is None:
                return "no answer from the bridge; start disco-hw bridge ros2-base ROBOT.toml"
            case DriverState.HANDSHAKE if self._is_foreign_bridge:
                return "the bridge was started with another [link] of robot.toml; start it again"
            case DriverState.HANDSHAKE if self._flags & wire.ODOMETRY:
                return self._unfit or "waiting for the first odometry"
            case DriverState.HANDSHAKE:
                return f"no odometry from {self._settings.wheels_from}: {wire.REFUSALS[self._refusal]}"
            case DriverState.ESTOP:
                if self._flags & wire.BUTTON:
                    return f"a button on the base is pressed{self._or_unheard}"
                return "emergency stop; remove its cause, then reset"
            case DriverState.FAULT:
                return f"{self._fault}; remove the cause, then reset"
            case DriverState.ARMED:
                return "armed"
        return self._note

    @property
    def identity(self) -> Identity | None:
        """What answers behind the bridge; a base tells nothing of itself on its topics."""
        if self._state_ns is None or self._is_foreign_bridge:
            return None
        return Identity("ROS 2 base", "", "robot.toml")

    @property
    def limits(self) -> Limits | None:
        """What robot.toml declares of the base; it tells nothing of that itself."""
        if self.identity is None:
            return None
        settings = self._settings
        return Limits(
            max_wheel_speed_rad_s=Limit(settings.fastest_rad_s, "robot.toml"),
            command_timeout_s=Limit(settings.watchdog_s, "robot.toml"),
            stop_deceleration_rad_s2=Limit(settings.stop_deceleration_rad_s2, "robot.toml"),
        )

    def link_up(self, now_ns: int) -> None:
        """The medium has come up (again): whatever was agreed is void."""
        self._restart("the link was lost")
        self._link_is_up = True

    def link_down(self, now_ns: int) -> None:
        """The medium is gone: whatever was agreed is void."""
        self._restart("the link was lost")
        self._link_is_up = False

    def request(self, request: Request) -> None:
        """Set what the host wants; ARM only from standing by, and consumed when the bridge drives no longer."""
        if request is self._wanted:
            return
        if request is Request.ARM:
            refusal = self.detail if self.state not in (DriverState.STANDBY, DriverState.READY) else self._unfit
            if refusal is not None:
                self._note = f"not arming: {refusal}"
                return
            self.stats = replace(self.stats, sessions=self.stats.sessions + 1)
            self._note, self._stage, self._stage_ns = "arming", Stage.ARMING, None
            self._zeros, self._speeds = 0, (0.0, 0.0)
        elif self._wanted is Request.ARM and self._stage in (Stage.ARMING, Stage.ARMED):
            self._note, self._stage, self._stage_ns = "stopping as asked", Stage.STOPPING, None
        self._wanted = request

    def receive(self, now_ns: int, frames: Sequence[ReceivedFrame]) -> Readings:
        """Take in received frames and return what they meant; frames that come while the link is down are ignored."""
        wheels: list[WheelSample] = []
        status: list[RobotStatus] = []
        for received in frames if self._link_is_up else ():
            frame, data = received.frame, received.frame.data
            if frame.extended or frame.can_id not in wire.LENGTHS:
                self._count("unknown_id")
            elif len(data) != wire.LENGTHS[frame.can_id]:
                self._count("rejected_length")
            elif frame.can_id in wire.HOST_FRAMES:
                self._take_foreign(frame)
            else:
                self._count("frames_accepted")
                if frame.can_id == wire.STATE:
                    self._take_state(data, received.t_ns)
                    status.append(self._status(received.t_ns))
                elif frame.can_id == wire.ANGLES:
                    self._newest = wire.unpack_angles(data)
                elif self._newest is not None:
                    wheels += self._take_wheels(data, received.t_ns)
        if self._link_is_up:
            self._check_silence(now_ns)
        events, self._events = tuple(self._events), []
        return Readings(wheels=tuple(wheels), status=tuple(status[-1:]), events=events)

    def transmit(self, now_ns: int, command: WheelCommand | None) -> tuple[OutgoingFrame, ...]:
        """Frames due now: the command, or what has the bridge stop and stand by.

        Raises ValueError for a command that is not finite or valid for no time.
        """
        parts.check_command(command)
        if not self._link_is_up:
            return ()
        late = now_ns - self._last_sent_ns > wire.DEADMAN_S * 1e9
        if late and (self._stage is Stage.ARMED or (self._stage is Stage.STOPPING and any(self._speeds))):
            self._lose("no command for longer than the bridge waits")
        match self._stage:
            case Stage.REST:
                return self._rest(now_ns)
            case Stage.ARMING:
                return self._arm(now_ns)
            case Stage.STOPPING:
                return self._ramp(now_ns)
        if command is None:
            return ()
        self._speeds, self._last_sent_ns = (command.left_rad_s, command.right_rad_s), now_ns
        self._count("commands_sent")
        # Half of its validity may pass on the way.
        return parts.outgoing(now_ns, self._motion(self._speeds), life_ns=round(0.5e9 * command.valid_for_s))

    def estop(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Stop in any state; whatever was wanted is dropped, and nothing is commanded again."""
        self._wanted, self._stage, self._estopped = Request.STANDBY, Stage.REST, True
        self._note, self._repeat_ns = "emergency stop sent", 0
        return parts.estop_frames(now_ns, wire.stop_frames(self._settings))

    @property
    def _is_foreign_bridge(self) -> bool:
        return self._bridge_sum != self._check_sum

    @property
    def _or_unheard(self) -> str:
        return f", or {self._settings.stop_topic} says nothing" if self._settings.stop_topic else ""

    @property
    def _is_alive(self) -> bool:
        """Whether it says its wheels, and hears speeds."""
        return bool(self._flags & wire.ODOMETRY and self._flags & wire.HEARD) and self._raw is not None

    @property
    def _unfit(self) -> str | None:
        """Why the base may not be driven, whatever is asked."""
        topic = self._settings.speed_topic
        if self._flags & wire.OTHERS:
            return f"another node speaks on {topic}; end it, or give it a topic of its own"
        if not self._flags & wire.HEARD:
            return f"nobody hears {topic}; is the base switched on, and in this domain?"
        return None

    def _rest(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Bring the bridge to standing by, or to a stop that it does not hold yet; reset it when asked."""
        if self._wanted is Request.RESET and self._state_ns is not None:
            if not self._flags & (wire.LATCHED | wire.BUTTON | wire.DRIVING) and self._is_alive:
                self._fault, self._estopped = None, False
                self._wanted, self._note = Request.STANDBY, "it stands by"
                return ()
            if self._flags & wire.LATCHED and self._is_due(now_ns):
                return parts.outgoing(now_ns, Frame(wire.RESET, b""))
        elif self._estopped and not self._flags & wire.LATCHED and self._is_due(now_ns):
            return parts.outgoing(now_ns, *wire.stop_frames(self._settings))
        if self._flags & wire.DRIVING and self._is_due(now_ns):
            return parts.outgoing(now_ns, wire.enable(False))
        return ()

    def _is_due(self, now_ns: int) -> bool:
        due = now_ns - self._repeat_ns >= _REPEAT_NS
        self._repeat_ns = now_ns if due else self._repeat_ns
        return due

    def _arm(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        self._stage_ns = now_ns if self._stage_ns is None else self._stage_ns
        if not self._settings.stands(*self._wheel_speeds):
            self._give_up("not armed: the base moves; wait until it stands")
            return self._rest(now_ns)
        if now_ns - self._stage_ns > ARMING_TIMEOUT_NS:
            self._give_up("not armed: the bridge did not begin to drive")
            return self._rest(now_ns)
        self._last_sent_ns = now_ns
        if not self._flags & wire.DRIVING:
            return parts.outgoing(now_ns, wire.enable(True))
        self._zeros += 1
        if self._zeros > ZEROS_TO_ARM:
            self._stage, self._note = Stage.ARMED, "armed"
        return parts.outgoing(now_ns, wire.speeds(0.0, 0.0))

    def _ramp(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Slow down with the declared deceleration, stand, then stand by."""
        self._stage_ns = now_ns if self._stage_ns is None else self._stage_ns
        elapsed_ns, self._last_sent_ns = now_ns - self._last_sent_ns, now_ns
        self._speeds = parts.slowed(self._speeds, self._settings.stop_deceleration_rad_s2, elapsed_ns)
        if any(self._speeds):
            return parts.outgoing(now_ns, self._motion(self._speeds))
        if self._settings.stands(*self._wheel_speeds) or now_ns - self._stage_ns > STOPPING_NS:
            self._stage, self._repeat_ns = Stage.REST, now_ns
            return parts.outgoing(now_ns, wire.enable(False))
        return parts.outgoing(now_ns, wire.speeds(0.0, 0.0))

    def _motion(self, speeds: tuple[float, float]) -> Frame:
        """Of wheel speeds, by the nominal geometry; both scaled down where the base can do less."""
        left, right = speeds
        settings = self._settings
        scale = settings.wheel_radius_m * min(1.0, settings.fastest_rad_s / max(abs(left), abs(right), 1e-9))
        return wire.speeds(0.5 * scale * (left + right), scale * (right - left) / settings.track_m)

    def _take_state(self, data: bytes, t_ns: int) -> None:
        before, self._state_ns = self._flags, t_ns
        self._flags, self._refusal, self._bridge_sum = wire.unpack_state(data)
        if self._stage in (Stage.REST, Stage.STOPPING):
            return
        if self._flags & wire.BUTTON:
            self._lose(f"a button on the base was pressed{self._or_unheard}")
        elif self._flags & wire.LATCHED:
            self._lose("stopped from outside, by `disco-hw estop` or another host")
        elif self._unfit is not None:
            self._lose(self._unfit)
        elif not self._flags & wire.ODOMETRY:
            self._lose(f"no odometry: {wire.REFUSALS[self._refusal]}")
        elif self._stage is Stage.ARMED and before & wire.DRIVING and not self._flags & wire.DRIVING:
            silent = self._flags & wire.FELL_SILENT
            self._lose("commands reached the bridge too late" if silent else "the bridge drives no longer")

    def _take_wheels(self, data: bytes, t_ns: int) -> list[WheelSample]:
        """A sample of ANGLES and WHEELS; none where the wheels could not have turned so far."""
        assert self._newest is not None
        self._wheel_speeds, age_s = wire.unpack_wheels(data)
        true_ns = t_ns - round(age_s * 1e9)
        if self._raw is not None and self._wheels_ns is not None:
            left, right = wire.turned_rad(self._newest, self._raw)
            most = 1.5 * self._settings.fastest_rad_s * (0.1 + (t_ns - self._wheels_ns) * 1e-9)
            if max(abs(left), abs(right)) <= most:
                self._angles = (self._angles[0] + left, self._angles[1] + right)
            else:
                self._count("implausible_ticks")
                if self._stage in (Stage.ARMING, Stage.ARMED):
                    self._lose("the base has restarted: its wheels' angles jumped")
        self._raw, self._newest, self._wheels_ns = self._newest, None, t_ns
        return [WheelSample(true_ns, t_ns, *self._angles, *self._wheel_speeds)]

    def _take_foreign(self, frame: Frame) -> None:
        self._count("unknown_id")
        if frame.can_id == wire.STOP:
            if self._stage is not Stage.REST:
                self._events.append("stopped from outside on the link, by `disco-hw estop` or another host")
            self._wanted, self._stage, self._estopped = Request.STANDBY, Stage.REST, True
            return
        if not self._foreign:
            self._foreign = True
            self._events.append("another host is on the link: it commands the base; disconnect it")
        if self._stage in (Stage.ARMING, Stage.ARMED):
            self._lose("another host commands the base; disconnect it")

    def _check_silence(self, now_ns: int) -> None:
        self._attention.look(now_ns)
        if self._state_ns is None:
            return
        silent_ns = self._attention.silent_ns(self._state_ns)
        silent = silent_ns > SILENT_NS
        silent = silent or (self._wheels_ns is not None and self._attention.silent_ns(self._wheels_ns) > SILENT_NS)
        if silent and self._stage is not Stage.REST:
            self._lose("bridge or base fell silent")
        elif self._stage is Stage.REST and silent_ns > GONE_NS:
            self._restart("the bridge fell silent")
            self._events.append("the bridge fell silent: waiting for it")

    def _status(self, t_ns: int) -> RobotStatus:
        at_rest = self._flags & wire.LATCHED and self._settings.stands(*self._wheel_speeds)
        return parts.status(t_ns, self.state, bool(at_rest or self._flags & wire.BUTTON))

    def _give_up(self, why: str) -> None:
        self._wanted, self._stage, self._stage_ns, self._note = Request.STANDBY, Stage.REST, None, why
        # Standing by is due at once where the bridge still listens.
        self._repeat_ns = 0

    def _lose(self, why: str) -> None:
        self._give_up(f"disarmed: {why}")
        self._fault = why
        self._events.append(f"disarmed: {why}")

    def _restart(self, why: str) -> None:
        if self._wanted is Request.ARM:
            self._note = f"disarmed: {why}"
        self._wanted, self._stage, self._stage_ns = Request.STANDBY, Stage.REST, None
        self._fault, self._foreign, self._repeat_ns = None, False, 0
        self._state_ns = self._wheels_ns = self._raw = self._newest = None
        self._flags, self._wheel_speeds = 0, (0.0, 0.0)

    def _count(self, name: str) -> None:
        self.stats = replace(self.stats, **{name: getattr(self.stats, name) + 1})


DRIVER = MotorDriver(
    "ros2_base",
    lambda settings, _key: Ros2BaseDriver(settings),
    settings=wire.Ros2BaseSettings,
    example=wire.EXAMPLE,
    stop_frames=wire.stop_frames,
    stop_confirmation=wire.stop_confirmation,
    cyclic_frames=wire.cyclic_frames,
    safety_card=wire.safety_card,
)
