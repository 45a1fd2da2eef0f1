"""The driver of AgileX bases on CAN v2: Scout, Scout Mini, Bunker, Tracer.

The base takes speed and turn rate of the body and makes wheel speeds of them by its own track: what the model learns as
axial distance is base and inner factor together. Who holds the remote control comes first: then this driver stands by.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from drivers.motor import agilex_protocol as protocol
from drivers.motor import vendor_parts as parts
from drivers.motor.agilex_protocol import (
    EXAMPLE,
    TIMEOUT_S,
    AgilexSettings,
    cyclic_frames,
    recognise,
    safety_card,
    stands,
    stop_confirmation,
    stop_frames,
)
from drivers.motor.vendor_parts import Controllers, MotionPermit, Stage
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
SILENT_NS = 350_000_000
MOTION_SILENT_NS = 100_000_000
GONE_NS = 1_000_000_000
ARMING_TIMEOUT_NS = 1_500_000_000
STOPPING_NS = 3_000_000_000
_MODE_SEEN_NS = 400_000_000
_REPEAT_NS = 100_000_000
_WARNINGS = 0x0606
"""Bits of the error word that only warn, in the SDK's byte and in the manual's: battery low, remote control lost."""
_MODES = {protocol.STANDBY: "standby", protocol.UART_MODE: "serial mode", protocol.RC_MODE: "remote control"}
_HOST_COMMANDS = frozenset({protocol.MOTION_COMMAND, protocol.CONTROL_MODE, protocol.STATE_RESET, protocol.BRAKE})


class AgilexDriver:
    """Satisfies `drivers.types.Driver`: pure, and no frame makes it raise."""

    clock_offset_ns: int | None = None

    def __init__(self, settings: AgilexSettings) -> None:
        self._settings = settings
        self.stats = DriverStats()
        self._permit = MotionPermit()
        self._state_ns: int | None = None
        self._motion_ns: int | None = None
        self._vehicle = self._mode = self._error = 0
        self._stands = True
        self._speed = (0.0, 0.0)
        self._driven_mm = (parts.Odometer(), parts.Odometer())
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
        heard = None not in (self._state_ns, self._motion_ns, self._driven_mm[0].last)
        faulty = self._vehicle == protocol.EXCEPTION or bool(self._error & ~_WARNINGS)
        words = f"the base reports an error ({self._error:#06x}); its manual's table of faults names it"
        driven = "a person drives it by remote control; switch that off to drive it from here"
        return Controllers(
            missing=None if heard else "no answer from the base; is it switched on, and the bus at 500 kbit/s?",
            stopped="a button on the base is pressed" if self._vehicle == protocol.EMERGENCY_STOP else None,
            faulty=words if faulty else None,
            unfit=driven if self._mode == protocol.RC_MODE else None,
            energised=self._mode == protocol.CAN_MODE,
        )

    @property
    def identity(self) -> Identity | None:
        """What answers as these bases do."""
        if self._state_ns is None:
            return None
        return Identity("AgileX base, CAN v2", "", "robot.toml")

    @property
    def limits(self) -> Limits | None:
        """What robot.toml declares of the base, and the time-out of them all."""
        if self.identity is None:
            return None
        settings = self._settings
        return Limits(
            max_wheel_speed_rad_s=Limit(settings.max_speed_m_s / settings.wheel_radius_m, "robot.toml"),
            command_timeout_s=Limit(TIMEOUT_S, "fixed"),
            stop_deceleration_rad_s2=Limit(settings.stop_deceleration_rad_s2, "robot.toml"),
        )

    def link_up(self, now_ns: int) -> None:
        """The medium has come up (again): whatever was agreed is void."""
        self._meet_anew(self._permit.linked(True))

    def link_down(self, now_ns: int) -> None:
        """The medium is gone: whatever was agreed is void."""
        self._meet_anew(self._permit.linked(False))

    def request(self, request: Request) -> None:
        """Set what the host wants; ARM only from standing by, and consumed when the base leaves its CAN mode."""
        before, self._permit = self._permit, self._permit.requested(request, self._seen)
        if self._permit.wanted is Request.ARM is not before.wanted:
            self._count("sessions")

    def receive(self, now_ns: int, frames: Sequence[ReceivedFrame]) -> Readings:
        """Take in received frames and return what they meant; frames that come while the link is down are ignored."""
        wheels: list[WheelSample] = []
        status: list[RobotStatus] = []
        for received in frames if self._permit.link_is_up else ():
            if not received.frame.extended and received.frame.can_id in _HOST_COMMANDS:
                self._take_foreign(received.frame)
                continue
            decoded = protocol.decode(received.frame)
            if decoded is None:
                known = received.frame.can_id in protocol.LAYOUTS and not received.frame.extended
                self._count("rejected_length" if known else "unknown_id")
                continue
            self._count("frames_accepted")
            match decoded.name:
                case "system_state":
                    self._take_state(decoded, received.t_ns)
                    status.append(parts.status(received.t_ns, self.state, self._is_stopped))
                case "motion_state":
                    self._motion_ns, self._stands = received.t_ns, stands(decoded)
                    self._speed = (float(decoded.values["linear_m_s"]), float(decoded.values["angular_rad_s"]))
                case "odometry":
                    self._take_odometry(int(decoded.values["left_mm"]), int(decoded.values["right_mm"]), received.t_ns)
                    if self._motion_ns is not None:
                        wheels.append(self._sample(received.t_ns))
        if self._permit.link_is_up:
            self._check_silence(now_ns)
        events, self._permit = self._permit.events, replace(self._permit, events=())
        return Readings(wheels=tuple(wheels), status=tuple(status[-1:]), events=events)

    def transmit(self, now_ns: int, command: WheelCommand | None) -> tuple[OutgoingFrame, ...]:
        """Frames due now: the command, or what stops and leaves the CAN mode.

        Raises ValueError for a command that is not finite or valid for no time.
        """
        parts.check_command(command)
        if not self._permit.link_is_up:
            return ()
        if self._permit.is_late(now_ns, TIMEOUT_S):
            # The base stays in its CAN mode: the next command would move it again.
            self._end(self._permit.lost("no command for longer than the base's time-out"))
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
        """Zero and standby from now on: the base has no frame that takes its motors' torque off."""
        self._end(self._permit.lost(why))

    def estop(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Zero and standby in any state; whatever was wanted is dropped, and nothing is commanded again."""
        self._end(self._permit.stopped())
        return parts.estop_frames(now_ns, stop_frames(self._settings))

    @property
    def _is_stopped(self) -> bool:
        standing_by = self._stands and self._mode != protocol.CAN_MODE
        return standing_by or self._vehicle == protocol.EMERGENCY_STOP

    def _rest(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Bring a base that listens to CAN to standby, standing; clear errors when asked."""
        self._permit = self._permit.reset(self._seen)
        is_due = now_ns - self._repeat_ns >= _REPEAT_NS
        seen = self._seen
        if self._permit.wanted is Request.RESET and (seen.missing or seen.stopped or seen.faulty) and is_due:
            self._repeat_ns = now_ns
            return parts.outgoing(now_ns, protocol.clear_errors())
        if self._mode == protocol.CAN_MODE and is_due:
            self._repeat_ns = now_ns
            return parts.outgoing(now_ns, *stop_frames(self._settings))
        return ()

    def _arm(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        self._permit = self._permit.begun(now_ns)
        if not self._stands:
            self._end(self._permit.given_up("not armed: the base moves; wait until it stands"))
            return ()
        if self._permit.lasts_ns(now_ns) > ARMING_TIMEOUT_NS:
            why = "not armed: the base did not take its CAN mode; switch the remote control off"
            self._end(self._permit.given_up(why))
            return ()
        if self._mode != protocol.CAN_MODE:
            return parts.outgoing(now_ns, protocol.control_mode(protocol.CAN_MODE))
        self._permit = self._permit.fed_zero(now_ns)
        if self._permit.zeros > ZEROS_TO_ARM:
            self._permit = self._permit.armed(now_ns)
        return parts.outgoing(now_ns, self._motion())

    def _ramp(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Slow down with the declared deceleration, stand, then leave the CAN mode."""
        self._permit = self._permit.slowed(now_ns, self._settings.stop_deceleration_rad_s2)
        if any(self._permit.speeds):
            return parts.outgoing(now_ns, self._motion())
        self._permit = self._permit.ramped()
        return self._stand(now_ns)

    def _stand(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        self._permit = self._permit.begun(now_ns)
        if self._stands or self._permit.lasts_ns(now_ns) > STOPPING_NS:
            self._permit, self._repeat_ns = self._permit.rested(), now_ns
            return parts.outgoing(now_ns, *stop_frames(self._settings))
        return parts.outgoing(now_ns, protocol.motion(0.0, 0.0))

    def _motion(self) -> Frame:
        """Of wheel speeds, by the nominal geometry; both scaled down where the base can do less."""
        left, right = self._permit.speeds
        radius = self._settings.wheel_radius_m
        scale = min(1.0, self._settings.max_speed_m_s / max(radius * max(abs(left), abs(right)), 1e-9))
        linear = scale * radius * (left + right) / 2.0
        return protocol.motion(linear, scale * radius * (right - left) / self._settings.track_m)

    def _take_state(self, decoded: protocol.Decoded, t_ns: int) -> None:
        values = decoded.values
        self._vehicle, self._mode = int(values["vehicle_state"]), int(values["control_mode"])
        self._error, self._state_ns = int(values["error_code"]), t_ns
        seen, stage = self._seen, self._permit.stage
        if stage is Stage.REST:
            return
        if seen.stopped is not None:
            self._end(self._permit.lost("a button on the base was pressed"))
        elif seen.faulty is not None:
            self._end(self._permit.lost(seen.faulty))
        elif stage is not Stage.ARMING and self._mode == protocol.RC_MODE:
            # A person has taken over, which is no fault.
            why = "disarmed: a person has taken the remote control"
            self._end(self._permit.given_up(why).saying(why))
        elif stage is Stage.ARMED and self._mode != protocol.CAN_MODE:
            mode = _MODES.get(self._mode, self._mode)
            self._end(self._permit.lost(f"the base left its CAN mode by itself, for {mode}"))

    def _take_odometry(self, left_mm: int, right_mm: int, t_ns: int) -> None:
        fastest, looked_ns = 1.5e3 * self._settings.max_speed_m_s, self._permit.looked_ns
        left, right = self._driven_mm
        is_left_plausible = left.take_wrapping(left_mm, t_ns, looked_ns, fastest, 10.0)
        if not (right.take_wrapping(right_mm, t_ns, looked_ns, fastest, 10.0) and is_left_plausible):
            self._count("implausible_ticks")
            if self._permit.is_driving:
                self._end(self._permit.lost("the base has restarted: its odometry jumped"))

    def _sample(self, t_ns: int) -> WheelSample:
        radius, track = self._settings.wheel_radius_m, self._settings.track_m
        linear, angular = self._speed
        left, right = (1e-3 * side.total / radius for side in self._driven_mm)
        speeds = (linear - 0.5 * track * angular, linear + 0.5 * track * angular)
        return WheelSample(t_ns, t_ns, left, right, speeds[0] / radius, speeds[1] / radius)

    def _take_foreign(self, frame: Frame) -> None:
        self._count("unknown_id")
        is_stop = frame in stop_frames(self._settings)
        if not is_stop:
            self._permit = self._permit.command_heard("the base")
        elif frame.can_id == protocol.CONTROL_MODE:
            self._end(self._permit.stop_heard())

    def _check_silence(self, now_ns: int) -> None:
        self._permit = self._permit.looked(now_ns)
        if self._state_ns is None:
            return
        silent_ns = self._permit.silent_ns(self._state_ns)
        silent = silent_ns > SILENT_NS
        silent = silent or (self._motion_ns is not None and self._permit.silent_ns(self._motion_ns) > MOTION_SILENT_NS)
        if silent and self._permit.stage is not Stage.REST:
            self._end(self._permit.lost("the base fell silent"))
        elif self._permit.stage is Stage.REST and silent_ns > GONE_NS:
            self._meet_anew(self._permit.restarted("the base fell silent", "the base fell silent: waiting for it"))

    def _end(self, permit: MotionPermit) -> None:
        """Standby is due at once where it still listens."""
        self._permit, self._repeat_ns = permit, 0

    def _meet_anew(self, permit: MotionPermit) -> None:
        self._end(permit)
        self._state_ns = self._motion_ns = None
        self._vehicle, self._mode, self._error, self._stands = protocol.NORMAL, protocol.STANDBY, 0, True
        for side in self._driven_mm:
            side.begin_anew()

    def _count(self, name: str) -> None:
        self.stats = parts.counted(self.stats, name)


DRIVER = MotorDriver(
    "agilex",
    lambda settings, _key: AgilexDriver(settings),
    settings=AgilexSettings,
    takes_body_speeds=True,
    example=EXAMPLE,
    recognise=recognise,
    latches_stop=False,
    stop_frames=stop_frames,
    stop_confirmation=stop_confirmation,
    cyclic_frames=cyclic_frames,
    safety_card=safety_card,
)
