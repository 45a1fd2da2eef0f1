"""The driver of bases that are reached over ROS 2 alone: speeds of the body out, joint states or odometry in.

It speaks to `disco-hw bridge ros2-base`, a process of its own, as nothing of ROS belongs into the control process. A
base reports nothing of its time-out, its limits or of who else commands it: the weakest safety of all drivers here.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from drivers.motor import ros2_base_wire as wire
from drivers.motor import vendor_parts as parts
from drivers.motor.permit import Controllers, MotionPermit, Stage
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
        self._permit = MotionPermit()
        self._state_ns: int | None = None
        self._wheels_ns: int | None = None
        self._flags = self._refusal = self._bridge_sum = 0
        self._turned = (parts.Odometer(), parts.Odometer())
        self._newest: tuple[int, int] | None = None
        self._wheel_speeds = (0.0, 0.0)
        self._repeat_ns = 0

    @property
    def state(self) -> DriverState:
        """Where the driver is with its base."""
        return self._permit.state(self._seen)

    @property
    def detail(self) -> str:
        """For a person: why the state is what it is, and what to do about it."""
        return self._permit.detail(self._seen)

    @property
    def _seen(self) -> Controllers:
        stopped = f"a button on the base is pressed{self._or_unheard}" if self._flags & wire.BUTTON else None
        latched = "emergency stop; remove its cause, then reset" if self._flags & wire.LATCHED else None
        return Controllers(
            missing=self._missing,
            stopped=stopped or latched,
            unfit=self._unfit,
            energised=bool(self._flags & wire.DRIVING),
            offline="the link is down; start disco-hw bridge ros2-base ROBOT.toml",
        )

    @property
    def _missing(self) -> str | None:
        if self._state_ns is None:
            return "no answer from the bridge; start disco-hw bridge ros2-base ROBOT.toml"
        if self._is_foreign_bridge:
            return "the bridge was started with another [link] of robot.toml; start it again"
        if not self._flags & wire.ODOMETRY:
            return f"no odometry from {self._settings.wheels_from}: {wire.REFUSALS[self._refusal]}"
        is_alive = self._flags & wire.HEARD and self._turned[0].last is not None
        return None if is_alive else self._unfit or "waiting for the first odometry"

    @property
    def identity(self) -> Identity | None:
        """What answers behind the bridge; a base reports nothing of itself on its topics."""
        if self._state_ns is None or self._is_foreign_bridge:
            return None
        return Identity("ROS 2 base", "", "robot.toml")

    @property
    def limits(self) -> Limits | None:
        """What robot.toml declares of the base; it reports nothing of that itself."""
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
        self._meet_anew(self._permit.linked(True))

    def link_down(self, now_ns: int) -> None:
        """The medium is gone: whatever was agreed is void."""
        self._meet_anew(self._permit.linked(False))

    def request(self, request: Request) -> None:
        """Set what the host wants; ARM only from standing by, and consumed when the bridge drives no longer."""
        before, self._permit = self._permit, self._permit.requested(request, self._seen)
        if self._permit.wanted is Request.ARM is not before.wanted:
            self._count("sessions")

    def receive(self, now_ns: int, frames: Sequence[ReceivedFrame]) -> Readings:
        """Take in received frames and return what they meant; frames that come while the link is down are ignored."""
        wheels: list[WheelSample] = []
        status: list[RobotStatus] = []
        for received in frames if self._permit.link_is_up else ():
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
        if self._permit.link_is_up:
            self._check_silence(now_ns)
        events, self._permit = self._permit.events, replace(self._permit, events=())
        return Readings(wheels=tuple(wheels), status=tuple(status[-1:]), events=events)

    def transmit(self, now_ns: int, command: WheelCommand | None) -> tuple[OutgoingFrame, ...]:
        """Frames due now: the command, or what has the bridge stop and stand by.

        Raises ValueError for a command that is not finite or valid for no time.
        """
        parts.check_command(command)
        if not self._permit.link_is_up:
            return ()
        if self._permit.is_late(now_ns, wire.DEADMAN_S):
            self._end(self._permit.lost("no command for longer than the bridge waits"))
        match self._permit.stage:
            case Stage.REST:
                return self._rest(now_ns)
            case Stage.ARMING:
                return self._arm(now_ns)
            case Stage.STOPPING:
                return self._ramp(now_ns)
            case Stage.BRAKING:
                return self._stand(now_ns)
        if command is None:
            return ()
        self._permit = self._permit.commanded(now_ns, command)
        self._count("commands_sent")
        return parts.commanding(now_ns, command, self._motion())

    def release(self, why: str) -> None:
        """The bridge says zero and stands by from now on: no topic takes the motors' torque off."""
        self._end(self._permit.lost(why))

    def estop(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Stop in any state; whatever was wanted is dropped, and nothing is commanded again."""
        self._end(self._permit.stopped())
        return parts.estop_frames(now_ns, wire.stop_frames(self._settings))

    @property
    def _is_foreign_bridge(self) -> bool:
        return self._bridge_sum != self._check_sum

    @property
    def _or_unheard(self) -> str:
        return f", or {self._settings.stop_topic} says nothing" if self._settings.stop_topic else ""

    @property
    def _stands(self) -> bool:
        return self._settings.stands(*self._wheel_speeds)

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
        self._permit = self._permit.reset(self._seen)
        is_latched = self._flags & wire.LATCHED
        if self._permit.wanted is Request.RESET:
            if is_latched and self._is_due(now_ns):
                return parts.outgoing(now_ns, Frame(wire.RESET, b""))
        elif self._permit.estopped and not is_latched and self._is_due(now_ns):
            return parts.outgoing(now_ns, *wire.stop_frames(self._settings))
        if self._flags & wire.DRIVING and self._is_due(now_ns):
            return parts.outgoing(now_ns, wire.enable(False))
        return ()

    def _is_due(self, now_ns: int) -> bool:
        due = now_ns - self._repeat_ns >= _REPEAT_NS
        self._repeat_ns = now_ns if due else self._repeat_ns
        return due

    def _arm(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        self._permit = self._permit.begun(now_ns)
        if not self._stands:
            self._end(self._permit.given_up("not armed: the base moves; wait until it stands"))
            return self._rest(now_ns)
        if self._permit.lasts_ns(now_ns) > ARMING_TIMEOUT_NS:
            self._end(self._permit.given_up("not armed: the bridge did not begin to drive"))
            return self._rest(now_ns)
        if not self._flags & wire.DRIVING:
            return parts.outgoing(now_ns, wire.enable(True))
        self._permit = self._permit.fed_zero(now_ns)
        if self._permit.zeros > ZEROS_TO_ARM:
            self._permit = self._permit.armed(now_ns)
        return parts.outgoing(now_ns, self._motion())

    def _ramp(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Slow down with the declared deceleration, stand, then stand by."""
        self._permit = self._permit.slowed(now_ns, self._settings.stop_deceleration_rad_s2)
        if any(self._permit.speeds):
            return parts.outgoing(now_ns, self._motion())
        self._permit = self._permit.ramped()
        return self._stand(now_ns)

    def _stand(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        self._permit = self._permit.begun(now_ns)
        if self._stands or self._permit.lasts_ns(now_ns) > STOPPING_NS:
            self._permit, self._repeat_ns = self._permit.rested(), now_ns
            return parts.outgoing(now_ns, wire.enable(False))
        return parts.outgoing(now_ns, wire.speeds(0.0, 0.0))

    def _motion(self) -> Frame:
        """Of wheel speeds, by the nominal geometry; both scaled down where the base can do less."""
        left, right = self._permit.speeds
        settings = self._settings
        scale = settings.wheel_radius_m * min(1.0, settings.fastest_rad_s / max(abs(left), abs(right), 1e-9))
        return wire.speeds(0.5 * scale * (left + right), scale * (right - left) / settings.track_m)

    def _take_state(self, data: bytes, t_ns: int) -> None:
        before, self._state_ns = self._flags, t_ns
        self._flags, self._refusal, self._bridge_sum = wire.unpack_state(data)
        if self._permit.stage is Stage.REST:
            return
        if self._flags & wire.BUTTON:
            self._permit = self._permit.lost(f"a button on the base was pressed{self._or_unheard}")
        elif self._flags & wire.LATCHED:
            self._permit = self._permit.lost("stopped from outside, by `disco-hw estop` or another host")
        elif self._unfit is not None:
            self._permit = self._permit.lost(self._unfit)
        elif not self._flags & wire.ODOMETRY:
            self._permit = self._permit.lost(f"no odometry: {wire.REFUSALS[self._refusal]}")
        elif self._permit.stage is Stage.ARMED and before & wire.DRIVING and not self._flags & wire.DRIVING:
            silent = self._flags & wire.FELL_SILENT
            self._permit = self._permit.lost(
                "commands reached the bridge too late" if silent else "the bridge drives no longer"
            )

    def _take_wheels(self, data: bytes, t_ns: int) -> list[WheelSample]:
        """A sample of ANGLES and WHEELS; what the wheels could not have turned is left out."""
        assert self._newest is not None
        self._wheel_speeds, age_s = wire.unpack_wheels(data)
        fastest = 1.5 * self._settings.fastest_rad_s / wire.ANGLE_RAD
        plausible = [
            # Messages of a base do not come evenly.
            side.take_wrapping(angle, t_ns, self._permit.looked_ns, fastest, 0.1 * fastest)
            for side, angle in zip(self._turned, self._newest, strict=True)
        ]
        if not all(plausible):
            self._count("implausible_ticks")
            if self._permit.is_driving:
                self._permit = self._permit.lost("the base has restarted: its wheels' angles jumped")
        self._newest, self._wheels_ns = None, t_ns
        angles = [wire.ANGLE_RAD * side.total for side in self._turned]
        return [WheelSample(t_ns - round(age_s * 1e9), t_ns, angles[0], angles[1], *self._wheel_speeds)]

    def _take_foreign(self, frame: Frame) -> None:
        self._count("unknown_id")
        is_stop = frame.can_id == wire.STOP
        self._permit = self._permit.stop_heard() if is_stop else self._permit.command_heard("the base")

    def _check_silence(self, now_ns: int) -> None:
        self._permit = self._permit.looked(now_ns)
        if self._state_ns is None:
            return
        silent_ns = self._permit.silent_ns(self._state_ns)
        silent = silent_ns > SILENT_NS
        silent = silent or (self._wheels_ns is not None and self._permit.silent_ns(self._wheels_ns) > SILENT_NS)
        if silent and self._permit.stage is not Stage.REST:
            self._end(self._permit.lost("bridge or base fell silent"))
        elif self._permit.stage is Stage.REST and silent_ns > GONE_NS:
            self._meet_anew(self._permit.restarted("the bridge fell silent", "the bridge fell silent: waiting for it"))

    def _status(self, t_ns: int) -> RobotStatus:
        is_stopped = bool((self._flags & wire.LATCHED and self._stands) or self._flags & wire.BUTTON)
        return parts.status(t_ns, self.state, is_stopped)

    def _end(self, permit: MotionPermit) -> None:
        """Standing by is due at once where the bridge still listens."""
        self._permit, self._repeat_ns = permit, 0

    def _meet_anew(self, permit: MotionPermit) -> None:
        self._end(permit)
        self._state_ns = self._wheels_ns = self._newest = None
        for side in self._turned:
            side.begin_anew()
        self._flags, self._wheel_speeds = 0, (0.0, 0.0)

    def _count(self, name: str) -> None:
        self.stats = parts.counted(self.stats, name)


DRIVER = MotorDriver(
    "ros2_base",
    lambda settings, _key: Ros2BaseDriver(settings),
    settings=wire.Ros2BaseSettings,
    takes_body_speeds=True,
    example=wire.EXAMPLE,
    stop_frames=wire.stop_frames,
    stop_confirmation=wire.stop_confirmation,
    cyclic_frames=wire.cyclic_frames,
    safety_card=wire.safety_card,
)
