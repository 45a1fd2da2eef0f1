"""The driver of VESC controllers on CAN, one or more a side.

A VESC knows no armed state: the first speed that it is sent moves it. Armed is what this driver says it is: every
controller has answered, its status is fresh, its motor stands, and zeros were sent for a while. Faults are asked for,
as no status message tells them; the question feeds no timeout.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from drivers.motor import vendor_parts as parts
from drivers.motor import vesc_codec as codec
from drivers.motor.vendor_parts import Stage
from drivers.motor.vesc_settings import (
    EXAMPLE,
    FAULTS,
    HOST_ID,
    STANDS_ERPM,
    VescExchange,
    VescSettings,
    cyclic_frames,
    questions,
    recognise,
    safety_card,
    slowest_rad_s,
    stop_confirmation,
    stop_frames,
)
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

ZEROS_TO_ARM = 10
TIMEOUT_TRIES = 5
SILENT_NS = 100_000_000
GONE_NS = 500_000_000
ARMING_TIMEOUT_NS = 1_500_000_000
BRAKING_NS = 3_000_000_000
_PING_PERIOD_NS = 100_000_000
_FAULT_PERIOD_NS = 50_000_000
_POLL_PERIOD_NS = 18_000_000
_SAME_TIMEOUT_S, _SAME_CURRENT_A = 0.002, 0.1
_SET_COMMANDS = frozenset(number for number, _ in codec.CAN_COMMANDS.values())
_BRAKE = codec.CAN_COMMANDS["set_brake_current"][0]


@dataclass(slots=True)
class _Motor:
    """What is known of one controller; steps are of its tachometer, six in an electrical turn."""

    node: int
    answered: bool = False
    erpm: float = 0.0
    erpm_ns: int | None = None
    tachometer: int | None = None
    tachometer_ns: int = 0
    steps: int = 0
    is_new: bool = False
    fault: int | None = None
    timed_out: bool = False
    killed: bool = False
    timeout: tuple[float, float] | None = None
    asked_timeout: int = 0

    @property
    def may_tell_timeout(self) -> bool:
        """Whether its timeout is not known yet, and it has not been asked often enough to give up."""
        return self.timeout is None and self.asked_timeout < TIMEOUT_TRIES


class VescDriver:
    """Satisfies `drivers.types.Driver`: pure, and no frame makes it raise."""

    clock_offset_ns: int | None = None

    def __init__(self, settings: VescSettings) -> None:
        self._settings = settings
        self._sides = [[_Motor(node) for node in side] for side in settings.sides]
        self._motors = {motor.node: motor for side in self._sides for motor in side}
        self._reassembly = codec.Reassembly(HOST_ID)
        self.stats = DriverStats()
        self._attention = parts.Attention()
        self._link_is_up = False
        self._stage = Stage.REST
        self._stage_ns: int | None = None
        self._wanted, self._note = Request.STANDBY, "it stands by"
        self._fault: str | None = None
        self._estopped = False
        self._zeros = 0
        self._speeds = (0.0, 0.0)
        self._last_sent_ns = 0
        self._pinged_ns = self._asked_ns = 0
        self._next_asked = 0
        self._foreign = False
        self._events: list[str] = []

    @property
    def state(self) -> DriverState:
        """Where the driver is with its controllers."""
        if not self._link_is_up:
            return DriverState.DISCONNECTED
        if self._estopped or any(motor.killed for motor in self._all):
            return DriverState.ESTOP
        if self._refusal is not None:
            return DriverState.REFUSED
        if not self._is_known:
            return DriverState.HANDSHAKE
        if self._fault is not None or any(motor.fault for motor in self._all):
            return DriverState.FAULT
        if self._stage is Stage.ARMED:
            return DriverState.ARMED
        if self._stage in (Stage.STOPPING, Stage.BRAKING):
            return DriverState.STOPPING
        rest = {Request.ARM: DriverState.ARMING, Request.READY: DriverState.READY}
        return rest.get(self._wanted, DriverState.STANDBY)

    @property
    def detail(self) -> str:
        """For a person: why the state is what it is, and what to do about it."""
        match self.state:
            case DriverState.DISCONNECTED:
                return "the link is down"
            case DriverState.REFUSED:
                return self._refusal or ""
            case DriverState.HANDSHAKE:
                return self._missing()
            case DriverState.ESTOP:
                killed = any(motor.killed for motor in self._all)
                return "its kill switch is pressed" if killed else "emergency stop; remove its cause, then reset"
            case DriverState.FAULT:
                said = [f"controller {motor.node}: {_words(motor.fault)}" for motor in self._all if motor.fault]
                return f"{self._fault or '; '.join(said)}; remove the cause, then reset"
            case DriverState.ARMED:
                return "armed"
        return self._note

    @property
    def identity(self) -> Identity | None:
        """What answers as VESCs do."""
        if not self._is_known or self._refusal is not None:
            return None
        return Identity("VESC", "", "robot.toml")

    @property
    def limits(self) -> Limits | None:
        """What robot.toml declares, and the time-out where all of them tell it."""
        if self.identity is None:
            return None
        settings = self._settings
        return Limits(
            max_wheel_speed_rad_s=Limit(settings.max_erpm / settings.erpm_per_rad_s, "robot.toml"),
            command_timeout_s=Limit(
                settings.watchdog_s, "robot.toml" if any(motor.timeout is None for motor in self._all) else "device"
            ),
            stop_deceleration_rad_s2=Limit(settings.stop_deceleration_rad_s2, "robot.toml"),
        )

    def link_up(self, now_ns: int) -> None:
        """The medium has come up (again): whatever was agreed is void."""
        self._restart("the link was lost", now_ns)
        self._link_is_up = True

    def link_down(self, now_ns: int) -> None:
        """The medium is gone: whatever was agreed is void."""
        self._restart("the link was lost", now_ns)
        self._link_is_up = False

    def request(self, request: Request) -> None:
        """Set what the host wants; ARM only from standing by, and consumed when the motors are let go."""
        if request is self._wanted:
            return
        if request is Request.ARM:
            if self.state not in (DriverState.STANDBY, DriverState.READY):
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
            if self._take_packet(received):
                if self._settings.uart_node is not None and all(each.is_new for each in self._all):
                    status.append(self._status(received.t_ns))
                    wheels.append(self._sample(received.t_ns))
                continue
            decoded = codec.decode(received.frame)
            if decoded is None or decoded.controller not in self._motors:
                self._count_unused(received.frame)
                continue
            self._count("frames_accepted")
            motor = self._motors[decoded.controller]
            match decoded.name:
                case "pong":
                    motor.answered = True
                case "status":
                    motor.erpm, motor.erpm_ns = decoded.values["erpm"], received.t_ns
                    status.append(self._status(received.t_ns))
                case "status5":
                    self._take_tachometer(motor, int(decoded.values["tachometer"]), received.t_ns)
                    if all(each.is_new and each.erpm_ns is not None for each in self._all):
                        wheels.append(self._sample(received.t_ns))
        if self._link_is_up:
            self._check(now_ns)
        events, self._events = tuple(self._events), []
        return Readings(wheels=tuple(wheels), status=tuple(status[-1:]), events=events)

    def transmit(self, now_ns: int, command: WheelCommand | None) -> tuple[OutgoingFrame, ...]:
        """Frames due now: the command, or what stops; and the questions, which feed no timeout.

        Raises ValueError for a command that is not finite or valid for no time.
        """
        parts.check_command(command)
        if not self._link_is_up:
            return ()
        asked = self._questions(now_ns)
        late = now_ns - self._last_sent_ns > self._settings.watchdog_s * 1e9
        if late and (self._stage is Stage.ARMED or (self._stage is Stage.STOPPING and any(self._speeds))):
            # They have no armed state to fall out of: the next speed would move them again.
            self._lose("no command for longer than the controllers' timeout")
            return (*self._brake(now_ns), *asked)
        match self._stage:
            case Stage.REST:
                self._reset()
                return asked
            case Stage.ARMING:
                return (*self._arm(now_ns), *asked)
            case Stage.STOPPING:
                return (*self._ramp(now_ns), *asked)
            case Stage.BRAKING:
                return (*self._brake(now_ns), *asked)
        if command is None:
            return asked
        self._speeds, self._last_sent_ns = (command.left_rad_s, command.right_rad_s), now_ns
        self._count("commands_sent")
        # Half of its validity may pass on the way.
        life_ns = round(0.5e9 * command.valid_for_s)
        return (*parts.outgoing(now_ns, *self._velocity(self._speeds), life_ns=life_ns), *asked)

    def estop(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Frames that brake every motor in any state; the driver goes on with that until they stand."""
        self._wanted, self._estopped = Request.STANDBY, True
        self._stage, self._stage_ns, self._note = Stage.BRAKING, now_ns, "emergency stop sent"
        return parts.estop_frames(now_ns, stop_frames(self._settings))

    @property
    def _all(self) -> Sequence[_Motor]:
        return tuple(self._motors.values())

    @property
    def _is_known(self) -> bool:
        return all(
            m.answered and m.erpm_ns is not None and m.tachometer is not None and not m.may_tell_timeout
            for m in self._all
        )

    @property
    def _refusal(self) -> str | None:
        """What a controller's timeout is other than robot.toml declares."""
        settings = self._settings
        for motor in self._all:
            if motor.timeout is None:
                continue
            timeout_s, brake_current_a = motor.timeout
            named = f"controller {motor.node}: its timeout"
            if timeout_s <= 0.0:
                return f"{named} is off; set {1e3 * settings.watchdog_s:g} ms (VESC Tool, App Settings, General)"
            if abs(timeout_s - settings.watchdog_s) > _SAME_TIMEOUT_S:
                return f"{named} is {timeout_s:g} s; set {settings.watchdog_s:g} s there, or write link.watchdog_s"
            if not abs(brake_current_a - settings.timeout_brake_current_a) <= _SAME_CURRENT_A:
                return f"{named} brakes with {brake_current_a:g} A; write that in link.timeout_brake_current_a"
        return None

    @property
    def _stands(self) -> bool:
        return all(abs(motor.erpm) < STANDS_ERPM for motor in self._all)

    def _missing(self) -> str:
        silent = [str(motor.node) for motor in self._all if not motor.answered]
        if silent:
            return f"controller {', '.join(silent)} does not answer; is it switched on, at this bit rate, at this id?"
        return "no status messages 1 and 5; switch them on, at 50 Hz (VESC Tool, App Settings, CAN)"

    def _questions(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        if not all(motor.answered for motor in self._all):
            if now_ns - self._pinged_ns < _PING_PERIOD_NS:
                return ()
            self._pinged_ns = now_ns
            return parts.outgoing(now_ns, *(codec.ping(motor.node, HOST_ID) for motor in self._all))
        polled = self._settings.uart_node is not None
        if now_ns - self._asked_ns < (_POLL_PERIOD_NS if polled else _FAULT_PERIOD_NS):
            return ()
        self._asked_ns = now_ns
        mute = [motor for motor in self._all if motor.may_tell_timeout]
        if mute and self._stage is Stage.REST:
            motor = min(mute, key=lambda each: each.asked_timeout)
            motor.asked_timeout += 1
            return parts.outgoing(now_ns, *codec.fragments(motor.node, HOST_ID, bytes([codec.GET_APPCONF])))
        if polled:
            return parts.outgoing(now_ns, *questions(self._settings))
        self._next_asked = (self._next_asked + 1) % len(self._all)
        node = self._all[self._next_asked].node
        return parts.outgoing(now_ns, *codec.fragments(node, HOST_ID, codec.ask_values(codec.FAULT_AND_STATUS)))

    def _arm(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Zeros, for as long as the motors stand, until there were enough."""
        self._stage_ns = now_ns if self._stage_ns is None else self._stage_ns
        if not self._stands:
            self._give_up("not armed: a motor turns; wait until it stands")
            return ()
        if any(motor.fault is None for motor in self._all):
            # Nothing is known of its faults yet.
            if now_ns - self._stage_ns > ARMING_TIMEOUT_NS:
                self._give_up("not armed: a controller does not say whether it has a fault")
            return ()
        self._zeros += 1
        if self._zeros > ZEROS_TO_ARM:
            self._stage, self._note = Stage.ARMED, "armed"
        self._last_sent_ns = now_ns
        return parts.outgoing(now_ns, *self._velocity((0.0, 0.0)))

    def _ramp(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Slow down with the declared deceleration, then let go, then say nothing."""
        elapsed_ns, self._last_sent_ns = now_ns - self._last_sent_ns, now_ns
        self._speeds = parts.slowed(self._speeds, self._settings.stop_deceleration_rad_s2, elapsed_ns)
        if max(map(abs, self._speeds)) > slowest_rad_s(self._settings):
            return parts.outgoing(now_ns, *self._velocity(self._speeds))
        # Below the slowest speed that it holds it would roll on: brake there.
        self._stage, self._stage_ns = Stage.BRAKING, now_ns
        return self._brake(now_ns)

    def _brake(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        self._stage_ns = now_ns if self._stage_ns is None else self._stage_ns
        known = all(motor.erpm_ns is not None for motor in self._all)
        if (known and self._stands) or now_ns - self._stage_ns > BRAKING_NS:
            self._stage = Stage.REST
            return parts.outgoing(now_ns, *(codec.command(motor.node, "set_current", 0.0) for motor in self._all))
        amperes = self._settings.brake_current_a
        return parts.outgoing(now_ns, *(codec.command(m.node, "set_brake_current", amperes) for m in self._all))

    def _reset(self) -> None:
        """Clear what is latched here; a controller ends its own fault when its cause has gone."""
        if self._wanted is Request.RESET and not any(motor.fault or motor.killed for motor in self._all):
            self._fault, self._estopped, self._wanted, self._note = None, False, Request.STANDBY, "it stands by"

    def _velocity(self, speeds: tuple[float, float]) -> list[Frame]:
        limit = self._settings.max_erpm
        frames = []
        for side, direction, speed in zip(self._sides, self._settings.direction, speeds, strict=True):
            erpm = min(max(direction * speed * self._settings.erpm_per_rad_s, -limit), limit)
            frames += [codec.command(motor.node, "set_erpm", erpm) for motor in side]
        return frames

    def _take_packet(self, received: ReceivedFrame) -> bool:
        """Whether the frame belongs to an answer for this host; what the answer says is taken."""
        frame = received.frame
        if not frame.extended or frame.can_id & 0xFF != HOST_ID or frame.can_id >> 8 == codec.PONG:
            return False
        found = self._reassembly.feed(frame)
        if found is not None and found[0] in self._motors:
            read: Mapping[str, float] = codec.values(found[2]) or {}
            motor = self._motors[found[0]]
            motor.timeout = codec.timeout(found[2], motor.node) or motor.timeout
            if "erpm" in read:
                motor.erpm, motor.erpm_ns = read["erpm"], received.t_ns
                self._take_tachometer(motor, int(read["tachometer"]), received.t_ns)
            motor.fault = int(read["fault"]) if "fault" in read else motor.fault
            byte = int(read.get("status_byte", 0))
            motor.timed_out, motor.killed = bool(byte & codec.TIMED_OUT), bool(byte & codec.KILL_SWITCH)
            self._count("frames_accepted")
        return True

    def _take_tachometer(self, motor: _Motor, tachometer: int, t_ns: int) -> None:
        if motor.tachometer is not None:
            moved = (tachometer - motor.tachometer + 2**31) % 2**32 - 2**31
            fastest = 1.5 * self._settings.max_erpm / 10.0 * (t_ns - motor.tachometer_ns) * 1e-9
            if abs(moved) <= fastest + 12:
                motor.steps += moved
            else:
                self._count("implausible_ticks")
                if self._stage in (Stage.ARMING, Stage.ARMED):
                    self._lose(f"controller {motor.node} has restarted")
        motor.tachometer, motor.tachometer_ns, motor.is_new = tachometer, t_ns, True

    def _sample(self, t_ns: int) -> WheelSample:
        per_step = 2.0 * math.pi / (6.0 * self._settings.pole_pairs * self._settings.gear)
        angles, speeds = [], []
        for side, direction in zip(self._sides, self._settings.direction, strict=True):
            erpm = sum(motor.erpm for motor in side) / len(side)
            # Ten of its steps a second are one electrical rpm: those counted earlier are carried on to the newest.
            steps = [m.steps + m.erpm / 10.0 * (t_ns - m.tachometer_ns) * 1e-9 for m in side]
            angles.append(direction * per_step * sum(steps) / len(side))
            speeds.append(direction * erpm / self._settings.erpm_per_rad_s)
        for motor in self._all:
            motor.is_new = False
        return WheelSample(t_ns, t_ns, angles[0], angles[1], speeds[0], speeds[1])

    def _check(self, now_ns: int) -> None:
        """Faults, silence and timeouts of an armed controller stop all."""
        self._attention.look(now_ns)
        for motor in self._all:
            age_ns = None if motor.erpm_ns is None else self._attention.silent_ns(motor.erpm_ns)
            if self._stage in (Stage.ARMING, Stage.ARMED, Stage.STOPPING):
                if motor.fault:
                    self._lose(f"controller {motor.node}: {_words(motor.fault)}")
                elif motor.killed:
                    self._lose(f"controller {motor.node}: its kill switch is pressed")
                elif age_ns is not None and age_ns > SILENT_NS:
                    self._lose(f"controller {motor.node} fell silent")
                elif self._stage is Stage.ARMED and motor.timed_out and self._zeros_are_old(now_ns):
                    self._lose(f"controller {motor.node}: its timeout ran out, no command came in time")
            elif age_ns is not None and age_ns > GONE_NS and self._stage is Stage.REST:
                self._restart(f"controller {motor.node} fell silent", now_ns)
                self._events.append(f"controller {motor.node} fell silent: asking anew")

    def _zeros_are_old(self, now_ns: int) -> bool:
        """Whether an answer of before the first command cannot be meant any more."""
        return now_ns - (self._stage_ns or now_ns) > 2 * len(self._all) * _FAULT_PERIOD_NS + SILENT_NS

    def _count_unused(self, frame: Frame) -> None:
        number, to = frame.can_id >> 8, frame.can_id & 0xFF
        ours = frame.extended and (to in self._motors or to == codec.EVERYBODY)
        self._count("unknown_id")
        if not (ours and number in _SET_COMMANDS):
            return
        if number == _BRAKE:
            self._wanted, self._estopped, self._stage, self._stage_ns = Request.STANDBY, True, Stage.BRAKING, None
            self._events.append("e-stop from outside on the link, by `disco-hw estop` or another host")
            return
        if not self._foreign:
            self._foreign = True
            self._events.append(f"another host is on the link: it commands controller {to}; disconnect it")
        if self._stage in (Stage.ARMING, Stage.ARMED):
            self._lose(f"another host commands controller {to}; disconnect it")

    def _status(self, t_ns: int) -> RobotStatus:
        names = {DriverState.ARMED: "ARMED", DriverState.FAULT: "FAULT", DriverState.STOPPING: "STOPPING"}
        names[DriverState.ESTOP] = "ESTOP" if self._stands else "STOPPING"
        return parts.status(t_ns, names.get(self.state, "STANDBY"))

    def _give_up(self, why: str) -> None:
        self._wanted, self._stage, self._stage_ns, self._note = Request.STANDBY, Stage.REST, None, why

    def _lose(self, why: str) -> None:
        """One controller is lost: all brake, latched."""
        self._give_up(f"disarmed: {why}")
        self._stage, self._fault = Stage.BRAKING, why
        self._events.append(f"disarmed: {why}")

    def _restart(self, why: str, now_ns: int) -> None:
        if self._wanted is Request.ARM:
            self._note = f"disarmed: {why}"
        self._wanted, self._stage, self._stage_ns = Request.STANDBY, Stage.REST, None
        self._fault, self._foreign, self._pinged_ns = None, False, now_ns - _PING_PERIOD_NS
        for motor in self._all:
            motor.answered = motor.is_new = motor.timed_out = motor.killed = False
            motor.erpm, motor.erpm_ns, motor.tachometer, motor.fault = 0.0, None, None, None
            motor.timeout, motor.asked_timeout = None, 0

    def _count(self, name: str) -> None:
        self.stats = replace(self.stats, **{name: getattr(self.stats, name) + 1})


def _words(fault: int | None) -> str:
    return FAULTS.get(fault or 0, f"fault {fault}")


DRIVER = MotorDriver(
    "vesc",
    lambda settings, _key: VescDriver(settings),
    settings=VescSettings,
    example=EXAMPLE,
    recognise=recognise,
    latches_stop=False,
    stop_frames=stop_frames,
    stop_confirmation=stop_confirmation,
    cyclic_frames=cyclic_frames,
    safety_card=safety_card,
    kinds=("can", "serial"),
    exchange=VescExchange,
    serial_field="uart_node",
    slowest_rad_s=slowest_rad_s,
)
