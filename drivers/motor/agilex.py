"""The driver of AgileX bases on CAN v2: Scout, Scout Mini, Bunker, Tracer.

The base takes speed and turn rate of the body and makes wheel speeds of them by its own track: what the model learns as
axial distance is base and inner factor together. Who holds the remote control comes first: then this driver stands by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

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
        self._attention = parts.Attention()
        self._link_is_up = False
        self._stage = Stage.REST
        self._stage_ns: int | None = None
        self._wanted, self._note = Request.STANDBY, "it stands by"
        self._fault: str | None = None
        self._estopped = False
        self._state_ns: int | None = None
        self._motion_ns: int | None = None
        self._vehicle = self._mode = self._error = 0
        self._stands = True
        self._speed = (0.0, 0.0)
        self._odometry: tuple[int, int] | None = None
        self._odometry_ns = 0
        self._moved_mm = (0, 0)
        self._zeros = 0
        self._speeds = (0.0, 0.0)
        self._last_sent_ns = self._repeat_ns = 0
        self._foreign = False
        self._events: list[str] = []

    @property
    def state(self) -> DriverState:
        """Where the driver is with its base."""
        if not self._link_is_up:
            return DriverState.DISCONNECTED
        if self._estopped or self._vehicle == protocol.EMERGENCY_STOP:
            return DriverState.ESTOP
        if self._state_ns is None or self._motion_ns is None or self._odometry is None:
            return DriverState.HANDSHAKE
        if self._fault is not None or self._is_faulty:
            return DriverState.FAULT
        if self._stage is Stage.ARMED:
            return DriverState.ARMED
        if self._stage is Stage.STOPPING or (self._stage is Stage.REST and self._mode == protocol.CAN_MODE):
            return DriverState.STOPPING
        rest = {Request.ARM: DriverState.ARMING, Request.READY: DriverState.READY}
        return rest.get(self._wanted, DriverState.STANDBY)

    @property
    def detail(self) -> str:
        """For a person: why the state is what it is, and what to do about it."""
        match self.state:
            case DriverState.DISCONNECTED:
                return "the link is down"
            case DriverState.HANDSHAKE:
                return "no answer from the base; is it switched on, and the bus at 500 kbit/s?"
            case DriverState.ESTOP:
                pressed = self._vehicle == protocol.EMERGENCY_STOP
                return "a button on the base is pressed" if pressed else "emergency stop; remove its cause, then reset"
            case DriverState.FAULT:
                return f"{self._fault or self._fault_words}; remove the cause, then reset"
            case DriverState.ARMED:
                return "armed"
            case DriverState.STANDBY | DriverState.READY if self._mode == protocol.RC_MODE:
                return "a person drives it by remote control; switch that off to drive it from here"
        return self._note

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
        self._restart("the link was lost")
        self._link_is_up = True

    def link_down(self, now_ns: int) -> None:
        """The medium is gone: whatever was agreed is void."""
        self._restart("the link was lost")
        self._link_is_up = False

    def request(self, request: Request) -> None:
        """Set what the host wants; ARM only from standing by, and consumed when the base leaves its CAN mode."""
        if request is self._wanted:
            return
        if request is Request.ARM:
            if self.state not in (DriverState.STANDBY, DriverState.READY) or self._mode == protocol.RC_MODE:
                self._note = f"not arming: {self.detail}"
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
                    status.append(self._status(received.t_ns))
                case "motion_state":
                    self._motion_ns, self._stands = received.t_ns, stands(decoded)
                    self._speed = (float(decoded.values["linear_m_s"]), float(decoded.values["angular_rad_s"]))
                case "odometry":
                    self._take_odometry(int(decoded.values["left_mm"]), int(decoded.values["right_mm"]), received.t_ns)
                    if self._motion_ns is not None:
                        wheels.append(self._sample(received.t_ns))
        if self._link_is_up:
            self._check_silence(now_ns)
        events, self._events = tuple(self._events), []
        return Readings(wheels=tuple(wheels), status=tuple(status[-1:]), events=events)

    def transmit(self, now_ns: int, command: WheelCommand | None) -> tuple[OutgoingFrame, ...]:
        """Frames due now: the command, or what stops and leaves the CAN mode.

        Raises ValueError for a command that is not finite or valid for no time.
        """
        parts.check_command(command)
        if not self._link_is_up:
            return ()
        late = now_ns - self._last_sent_ns > TIMEOUT_S * 1e9
        if late and (self._stage is Stage.ARMED or (self._stage is Stage.STOPPING and any(self._speeds))):
            # The base stays in its CAN mode: the next command would move it again.
            self._lose("no command for longer than the base's time-out")
            return self._rest(now_ns)
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
        """Zero and standby in any state; whatever was wanted is dropped, and nothing is commanded again."""
        self._wanted, self._stage, self._estopped = Request.STANDBY, Stage.REST, True
        self._note, self._repeat_ns = "emergency stop sent", 0
        return parts.estop_frames(now_ns, stop_frames(self._settings))

    @property
    def _is_faulty(self) -> bool:
        return self._vehicle == protocol.EXCEPTION or bool(self._error & ~_WARNINGS)

    @property
    def _fault_words(self) -> str:
        return f"the base reports an error ({self._error:#06x}); its manual's table of faults names it"

    def _rest(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Bring a base that listens to CAN to standby, standing; clear errors when asked."""
        if self._wanted is Request.RESET:
            if self._state_ns is not None and not self._is_faulty and self._vehicle == protocol.NORMAL:
                if self._fault is None or self._mode != protocol.CAN_MODE:
                    self._fault, self._estopped = None, False
                    self._wanted, self._note = Request.STANDBY, "it stands by"
                    return ()
            elif now_ns - self._repeat_ns >= _REPEAT_NS:
                self._repeat_ns = now_ns
                return parts.outgoing(now_ns, protocol.clear_errors())
        if self._mode == protocol.CAN_MODE and now_ns - self._repeat_ns >= _REPEAT_NS:
            self._repeat_ns = now_ns
            return parts.outgoing(now_ns, *stop_frames(self._settings))
        return ()

    def _arm(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        self._stage_ns = now_ns if self._stage_ns is None else self._stage_ns
        if not self._stands:
            self._give_up("not armed: the base moves; wait until it stands")
            return ()
        if now_ns - self._stage_ns > ARMING_TIMEOUT_NS:
            self._give_up("not armed: the base did not take its CAN mode; switch the remote control off")
            return ()
        self._last_sent_ns = now_ns
        if self._mode != protocol.CAN_MODE:
            return parts.outgoing(now_ns, protocol.control_mode(protocol.CAN_MODE))
        self._zeros += 1
        if self._zeros > ZEROS_TO_ARM:
            self._stage, self._note = Stage.ARMED, "armed"
        return parts.outgoing(now_ns, protocol.motion(0.0, 0.0))

    def _ramp(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Slow down with the declared deceleration, stand, then leave the CAN mode."""
        self._stage_ns = now_ns if self._stage_ns is None else self._stage_ns
        elapsed_ns, self._last_sent_ns = now_ns - self._last_sent_ns, now_ns
        self._speeds = parts.slowed(self._speeds, self._settings.stop_deceleration_rad_s2, elapsed_ns)
        if any(self._speeds):
            return parts.outgoing(now_ns, self._motion(self._speeds))
        if self._stands or now_ns - self._stage_ns > STOPPING_NS:
            self._stage, self._repeat_ns = Stage.REST, now_ns
            return parts.outgoing(now_ns, *stop_frames(self._settings))
        return parts.outgoing(now_ns, protocol.motion(0.0, 0.0))

    def _motion(self, speeds: tuple[float, float]) -> Frame:
        """Of wheel speeds, by the nominal geometry; both scaled down where the base can do less."""
        left, right = speeds
        radius = self._settings.wheel_radius_m
        scale = min(1.0, self._settings.max_speed_m_s / max(radius * max(abs(left), abs(right)), 1e-9))
        linear = scale * radius * (left + right) / 2.0
        return protocol.motion(linear, scale * radius * (right - left) / self._settings.track_m)

    def _take_state(self, decoded: protocol.Decoded, t_ns: int) -> None:
        values = decoded.values
        self._vehicle, self._mode = int(values["vehicle_state"]), int(values["control_mode"])
        self._error, self._state_ns = int(values["error_code"]), t_ns
        if self._stage in (Stage.REST, Stage.STOPPING):
            return
        if self._vehicle == protocol.EMERGENCY_STOP:
            self._lose("a button on the base was pressed")
        elif self._is_faulty:
            self._lose(self._fault_words)
        elif self._stage is Stage.ARMED and self._mode == protocol.RC_MODE:
            # A person has taken over, which is no fault.
            self._give_up("disarmed: a person has taken the remote control")
            self._events.append("disarmed: a person has taken the remote control")
        elif self._stage is Stage.ARMED and self._mode != protocol.CAN_MODE:
            self._lose(f"the base left its CAN mode by itself, for {_MODES.get(self._mode, self._mode)}")

    def _take_odometry(self, left_mm: int, right_mm: int, t_ns: int) -> None:
        if self._odometry is not None:
            pairs = zip((left_mm, right_mm), self._odometry, strict=True)
            moved = [(new - old + 2**31) % 2**32 - 2**31 for new, old in pairs]
            fastest = 1.5e3 * self._settings.max_speed_m_s * (t_ns - self._odometry_ns) * 1e-9 + 10.0
            if max(map(abs, moved)) <= fastest:
                self._moved_mm = (self._moved_mm[0] + moved[0], self._moved_mm[1] + moved[1])
            else:
                self._count("implausible_ticks")
                if self._stage in (Stage.ARMING, Stage.ARMED):
                    self._lose("the base has restarted: its odometry jumped")
        self._odometry, self._odometry_ns = (left_mm, right_mm), t_ns

    def _sample(self, t_ns: int) -> WheelSample:
        radius, track = self._settings.wheel_radius_m, self._settings.track_m
        linear, angular = self._speed
        left, right = (1e-3 * moved / radius for moved in self._moved_mm)
        speeds = (linear - 0.5 * track * angular, linear + 0.5 * track * angular)
        return WheelSample(t_ns, t_ns, left, right, speeds[0] / radius, speeds[1] / radius)

    def _take_foreign(self, frame: Frame) -> None:
        self._count("unknown_id")
        is_stop = frame in stop_frames(self._settings)
        if is_stop and frame.can_id == protocol.CONTROL_MODE:
            if self._stage is not Stage.REST:
                self._events.append("stopped from outside on the link, by `disco-hw estop` or another host")
            self._wanted, self._stage, self._estopped = Request.STANDBY, Stage.REST, True
        if is_stop:
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
        silent = silent or (
            self._motion_ns is not None and self._attention.silent_ns(self._motion_ns) > MOTION_SILENT_NS
        )
        if silent and self._stage is not Stage.REST:
            self._lose("the base fell silent")
        elif self._stage is Stage.REST and silent_ns > GONE_NS:
            self._restart("the base fell silent")
            self._events.append("the base fell silent: waiting for it")

    def _status(self, t_ns: int) -> RobotStatus:
        at_rest = self._stands and self._mode != protocol.CAN_MODE
        return parts.status(t_ns, self.state, at_rest or self._vehicle == protocol.EMERGENCY_STOP)

    def _give_up(self, why: str) -> None:
        self._wanted, self._stage, self._stage_ns, self._note = Request.STANDBY, Stage.REST, None, why
        # Standby is due at once where it still listens.
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
        self._state_ns = self._motion_ns = self._odometry = None
        self._vehicle, self._mode, self._error, self._stands = protocol.NORMAL, protocol.STANDBY, 0, True

    def _count(self, name: str) -> None:
        self.stats = replace(self.stats, **{name: getattr(self.stats, name) + 1})


DRIVER = MotorDriver(
    "agilex",
    lambda settings, _key: AgilexDriver(settings),
    settings=AgilexSettings,
    example=EXAMPLE,
    recognise=recognise,
    latches_stop=False,
    stop_frames=stop_frames,
    stop_confirmation=stop_confirmation,
    cyclic_frames=cyclic_frames,
    safety_card=safety_card,
)
