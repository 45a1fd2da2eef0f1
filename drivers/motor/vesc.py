"""The driver of VESC controllers on CAN, one or more a side.

A VESC knows no armed state: the first speed that it is sent moves it. Armed is what this driver says it is: every
controller has answered, its status is fresh, its motor stands, and zeros were sent for a while. Faults are asked for,
as no status message has them; the question feeds no timeout.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from msgspec.structs import replace

from drivers.motor import vendor_parts as parts
from drivers.motor import vesc_codec as codec
from drivers.motor import vesc_settings as declared
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

ZEROS_TO_ARM = 10
TIMEOUT_TRIES = 5
SILENT_NS = 100_000_000
GONE_NS = 500_000_000
ARMING_TIMEOUT_NS = 1_500_000_000
BRAKING_NS = 3_000_000_000
_PING_PERIOD_NS = 100_000_000
_FAULT_PERIOD_NS = 50_000_000
_POLL_PERIOD_NS = 18_000_000
_SET_COMMANDS = frozenset(number for number, _ in codec.CAN_COMMANDS.values())
_ERPM_PER_STEP_S = 10.0
"""Electrical rpm of a motor whose tachometer counts a step a second."""
_BRAKE = codec.CAN_COMMANDS["set_brake_current"][0]


@dataclass(slots=True)
class _Motor:
    """What is known of one controller; `turned` is in steps of its tachometer, six in an electrical turn."""

    node: int
    turned: parts.Odometer = field(default_factory=parts.Odometer)
    answered: bool = False
    erpm_ns: int | None = None
    fault: int | None = None
    timed_out: bool = False
    killed: bool = False
    timeout: tuple[float, float] | None = None
    asked_timeout: int = 0

    @property
    def stands(self) -> bool:
        """As it said last."""
        return abs(_ERPM_PER_STEP_S * self.turned.speed) < declared.STANDS_ERPM

    @property
    def may_report_timeout(self) -> bool:
        """Whether its timeout is not known yet, and it has not been asked often enough to give up."""
        return self.timeout is None and self.asked_timeout < TIMEOUT_TRIES

    def take_speed(self, erpm: float, t_ns: int) -> None:
        """Its newest."""
        self.turned.speed, self.erpm_ns = erpm / _ERPM_PER_STEP_S, t_ns


class VescDriver:
    """Satisfies `drivers.types.Driver`: pure, and no frame makes it raise."""

    clock_offset_ns: int | None = None

    def __init__(self, settings: declared.VescSettings) -> None:
        self._settings = settings
        self._sides = [[_Motor(node) for node in side] for side in parts.sides_of(settings.nodes)]
        self._motors = {motor.node: motor for side in self._sides for motor in side}
        self._reassembly = codec.Reassembly(declared.HOST_ID)
        self.stats = DriverStats()
        self._permit = MotionPermit(after_loss=Stage.BRAKING)
        self._pinged_ns = self._asked_ns = 0
        self._next_asked = 0

    @property
    def state(self) -> DriverState:
        """Where the driver is with its controllers."""
        return self._permit.state(self._seen)

    @property
    def _seen(self) -> Controllers:
        killed = any(motor.killed for motor in self._all)
        faulty = "; ".join(_in_words(motor) for motor in self._all if motor.fault)
        return Controllers(
            missing=self._missing,
            refused=self._refusal,
            stopped="its kill switch is pressed" if killed else None,
            faulty=faulty or None,
        )

    @property
    def detail(self) -> str:
        """For a person: why the state is what it is, and what to do about it."""
        return self._permit.detail(self._seen)

    @property
    def identity(self) -> Identity | None:
        """What answers as VESCs do."""
        is_met = self._missing is None and self._refusal is None
        return Identity("VESC", "", "robot.toml") if is_met else None

    @property
    def limits(self) -> Limits | None:
        """What robot.toml declares, and the time-out where all of them report it."""
        if self.identity is None:
            return None
        settings, reported = self._settings, all(motor.timeout is not None for motor in self._all)
        return Limits(
            max_wheel_speed_rad_s=Limit(settings.max_erpm / settings.erpm_per_rad_s, "robot.toml"),
            command_timeout_s=Limit(settings.watchdog_s, "device" if reported else "robot.toml"),
            stop_deceleration_rad_s2=Limit(settings.stop_deceleration_rad_s2, "robot.toml"),
        )

    def link_up(self, now_ns: int) -> None:
        """The medium has come up (again): whatever was agreed is void."""
        self._meet_anew(self._permit.linked(True), now_ns)

    def link_down(self, now_ns: int) -> None:
        """The medium is gone: whatever was agreed is void."""
        self._meet_anew(self._permit.linked(False), now_ns)

    def request(self, request: Request) -> None:
        """Set what the host wants; ARM only from standing by, and consumed when the motors are let go."""
        before, self._permit = self._permit, self._permit.requested(request, self._seen)
        if self._permit.wanted is Request.ARM is not before.wanted:
            self._count("sessions")

    def receive(self, now_ns: int, frames: Sequence[ReceivedFrame]) -> Readings:
        """Take in received frames and return what they meant; frames that come while the link is down are ignored."""
        wheels: list[WheelSample] = []
        status: list[RobotStatus] = []
        for received in frames if self._permit.link_is_up else ():
            if self._take_packet(received):
                if self._settings.uart_node is not None and all(each.turned.is_new for each in self._all):
                    status.append(parts.status(received.t_ns, self.state, self._stands))
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
                    motor.take_speed(decoded.values["erpm"], received.t_ns)
                    status.append(parts.status(received.t_ns, self.state, self._stands))
                case "status5":
                    self._take_tachometer(motor, int(decoded.values["tachometer"]), received.t_ns)
                    if all(each.turned.is_new and each.erpm_ns is not None for each in self._all):
                        wheels.append(self._sample(received.t_ns))
        if self._permit.link_is_up:
            self._check(now_ns)
        events, self._permit = self._permit.events, replace(self._permit, events=())
        return Readings(wheels=tuple(wheels), status=tuple(status[-1:]), events=events)

    def transmit(self, now_ns: int, command: WheelCommand | None) -> tuple[OutgoingFrame, ...]:
        """Frames due now: the command, or what stops; and the questions, which feed no timeout.

        Raises ValueError for a command that is not finite or valid for no time.
        """
        parts.check_command(command)
        if not self._permit.link_is_up:
            return ()
        asked = self._questions(now_ns)
        if self._permit.is_late(now_ns, self._settings.watchdog_s):
            self._permit = self._permit.lost("no command for longer than the controllers' timeout")
            return (*self._brake(now_ns), *asked)
        match self._permit.stage:
            case Stage.REST:
                if all(motor.fault is not None for motor in self._all):
                    # It ends its own fault when the cause has gone.
                    self._permit = self._permit.reset(self._seen)
                return asked
            case Stage.ARMING:
                return (*self._arm(now_ns), *asked)
            case Stage.STOPPING:
                return (*self._ramp(now_ns), *asked)
            case Stage.BRAKING:
                return (*self._brake(now_ns), *asked)
        if command is None:
            return asked
        self._permit = self._permit.commanded(now_ns, command)
        self._count("commands_sent")
        return (*parts.commanding(now_ns, command, *self._velocity()), *asked)

    def release(self, why: str) -> None:
        """Every motor is braked by a current from now on, then let go, which needs no speed loop."""
        self._permit = self._permit.lost(why)

    def estop(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Frames that brake every motor in any state; the driver goes on with that until they stand."""
        self._permit = self._permit.stopped()
        return parts.estop_frames(now_ns, declared.stop_frames(self._settings))

    @property
    def _all(self) -> Sequence[_Motor]:
        return tuple(self._motors.values())

    @property
    def _stands(self) -> bool:
        return all(motor.stands for motor in self._all)

    @property
    def _refusal(self) -> str | None:
        timeouts = ((motor.node, motor.timeout) for motor in self._all if motor.timeout is not None)
        return next(
            (why for node, timeout in timeouts if (why := declared.timeout_fault(self._settings, node, *timeout))), None
        )

    @property
    def _missing(self) -> str | None:
        silent = [str(motor.node) for motor in self._all if not motor.answered]
        if silent:
            return f"controller {', '.join(silent)} does not answer; is it switched on, at this bit rate, at this id?"
        complete = all(
            m.erpm_ns is not None and m.turned.last is not None and not m.may_report_timeout for m in self._all
        )
        return (
            None if complete else "no status messages 1 and 5; switch them on, at 50 Hz (VESC Tool, App Settings, CAN)"
        )

    def _questions(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        if not all(motor.answered for motor in self._all):
            if now_ns - self._pinged_ns < _PING_PERIOD_NS:
                return ()
            self._pinged_ns = now_ns
            return parts.outgoing(now_ns, *(codec.ping(motor.node, declared.HOST_ID) for motor in self._all))
        polled = self._settings.uart_node is not None
        if now_ns - self._asked_ns < (_POLL_PERIOD_NS if polled else _FAULT_PERIOD_NS):
            return ()
        self._asked_ns = now_ns
        mute = [motor for motor in self._all if motor.may_report_timeout]
        if mute and self._permit.stage is Stage.REST:
            motor = min(mute, key=lambda each: each.asked_timeout)
            motor.asked_timeout += 1
            return parts.outgoing(now_ns, *codec.fragments(motor.node, declared.HOST_ID, bytes([codec.GET_APPCONF])))
        if polled:
            return parts.outgoing(now_ns, *declared.questions(self._settings))
        self._next_asked = (self._next_asked + 1) % len(self._all)
        node = self._all[self._next_asked].node
        return parts.outgoing(
            now_ns, *codec.fragments(node, declared.HOST_ID, codec.ask_values(codec.FAULT_AND_STATUS))
        )

    def _arm(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Zeros, for as long as the motors stand, until there were enough."""
        self._permit = self._permit.begun(now_ns)
        if not self._stands:
            self._permit = self._permit.given_up("not armed: a motor turns; wait until it stands")
            return ()
        if any(motor.fault is None for motor in self._all):
            # Nothing is known of its faults yet.
            if self._permit.lasts_ns(now_ns) > ARMING_TIMEOUT_NS:
                self._permit = self._permit.given_up("not armed: a controller does not say whether it has a fault")
            return ()
        self._permit = self._permit.fed_zero(now_ns)
        if self._permit.zeros > ZEROS_TO_ARM:
            self._permit = self._permit.armed(now_ns)
        return parts.outgoing(now_ns, *self._velocity())

    def _ramp(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Slow down with the declared deceleration, then let go, then say nothing."""
        self._permit = self._permit.slowed(now_ns, self._settings.stop_deceleration_rad_s2)
        if max(map(abs, self._permit.speeds)) > declared.slowest_rad_s(self._settings):
            return parts.outgoing(now_ns, *self._velocity())
        # Below the slowest speed that it holds it would roll on: brake there.
        self._permit = self._permit.ramped()
        return self._brake(now_ns)

    def _brake(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        self._permit = self._permit.begun(now_ns)
        known = all(motor.erpm_ns is not None for motor in self._all)
        # One that still says that it turns may be on a slope; of one that has fallen silent nobody knows.
        says_it_turns = any(not m.stands and now_ns - (m.erpm_ns or 0) < SILENT_NS for m in self._all)
        gives_up = self._permit.lasts_ns(now_ns) > BRAKING_NS and not says_it_turns
        if (known and self._stands) or gives_up:
            self._permit = self._permit.rested()
            return parts.outgoing(now_ns, *(codec.command(motor.node, "set_current", 0.0) for motor in self._all))
        amperes = self._settings.brake_current_a
        return parts.outgoing(now_ns, *(codec.command(m.node, "set_brake_current", amperes) for m in self._all))

    def _velocity(self) -> list[Frame]:
        limit = self._settings.max_erpm
        frames = []
        for side, direction, speed in zip(self._sides, self._settings.direction, self._permit.speeds, strict=True):
            erpm = min(max(direction * speed * self._settings.erpm_per_rad_s, -limit), limit)
            frames += [codec.command(motor.node, "set_erpm", erpm) for motor in side]
        return frames

    def _take_packet(self, received: ReceivedFrame) -> bool:
        """Whether the frame belongs to an answer for this host; what the answer says is taken."""
        frame = received.frame
        if not frame.extended or frame.can_id & 0xFF != declared.HOST_ID or frame.can_id >> 8 == codec.PONG:
            return False
        found = self._reassembly.feed(frame)
        if found is not None and found[0] in self._motors:
            read: Mapping[str, float] = codec.values(found[2]) or {}
            motor = self._motors[found[0]]
            motor.timeout = codec.timeout(found[2], motor.node) or motor.timeout
            if "erpm" in read:
                motor.take_speed(read["erpm"], received.t_ns)
                self._take_tachometer(motor, int(read["tachometer"]), received.t_ns)
            motor.fault = int(read["fault"]) if "fault" in read else motor.fault
            byte = int(read.get("status_byte", 0))
            motor.timed_out, motor.killed = bool(byte & codec.TIMED_OUT), bool(byte & codec.KILL_SWITCH)
            self._count("frames_accepted")
        return True

    def _take_tachometer(self, motor: _Motor, tachometer: int, t_ns: int) -> None:
        fastest = 1.5 * self._settings.max_erpm / _ERPM_PER_STEP_S
        if not motor.turned.take_wrapping(tachometer, t_ns, self._permit.looked_ns, fastest, 12.0):
            self._count("implausible_ticks")
            if self._permit.is_driving:
                self._permit = self._permit.lost(f"controller {motor.node} has restarted")

    def _sample(self, t_ns: int) -> WheelSample:
        per_step = 2.0 * math.pi / (6.0 * self._settings.pole_pairs * self._settings.gear)
        turned = [[motor.turned for motor in side] for side in self._sides]
        return parts.wheel_sample(t_ns, turned, self._settings.direction, per_step)

    def _check(self, now_ns: int) -> None:
        """Faults, silence and timeouts of an armed controller stop all."""
        self._permit = self._permit.looked(now_ns)
        for motor in self._all:
            silent_ns = 0 if motor.erpm_ns is None else self._permit.silent_ns(motor.erpm_ns)
            why = self._why_lost(now_ns, motor, silent_ns) if self._permit.is_driving else None
            if why is not None:
                self._permit = self._permit.lost(why)
            elif silent_ns > GONE_NS and self._permit.stage is Stage.REST:
                why = f"controller {motor.node} fell silent"
                self._meet_anew(self._permit.restarted(why, f"{why}: asking anew"), now_ns)

    def _why_lost(self, now_ns: int, motor: _Motor, silent_ns: int) -> str | None:
        if motor.fault:
            return _in_words(motor)
        if motor.killed:
            return f"controller {motor.node}: its kill switch is pressed"
        if silent_ns > SILENT_NS:
            return f"controller {motor.node} fell silent"
        # An answer of before the first command is not meant.
        is_armed_long = self._permit.lasts_ns(now_ns) > 2 * len(self._all) * _FAULT_PERIOD_NS + SILENT_NS
        if self._permit.stage is Stage.ARMED and motor.timed_out and is_armed_long:
            return f"controller {motor.node}: its timeout ran out, no command came in time"
        return None

    def _count_unused(self, frame: Frame) -> None:
        number, to = frame.can_id >> 8, frame.can_id & 0xFF
        ours = frame.extended and (to in self._motors or to == codec.EVERYBODY)
        self._count("unknown_id")
        if not (ours and number in _SET_COMMANDS):
            return
        is_stop = number == _BRAKE
        self._permit = self._permit.stop_heard() if is_stop else self._permit.command_heard(f"controller {to}")

    def _meet_anew(self, permit: MotionPermit, now_ns: int) -> None:
        self._permit, self._pinged_ns = permit, now_ns - _PING_PERIOD_NS
        for motor in self._all:
            motor.answered = motor.timed_out = motor.killed = False
            motor.erpm_ns = motor.fault = motor.timeout = None
            motor.turned.speed, motor.asked_timeout = 0.0, 0
            motor.turned.begin_anew()

    def _count(self, name: str) -> None:
        self.stats = parts.counted(self.stats, name)


def _in_words(motor: _Motor) -> str:
    return f"controller {motor.node}: {declared.FAULTS.get(motor.fault or 0, f'fault {motor.fault}')}"


DRIVER = MotorDriver(
    "vesc",
    lambda settings, _key: VescDriver(settings),
    settings=declared.VescSettings,
    example=declared.EXAMPLE,
    recognise=declared.recognise,
    latches_stop=False,
    stop_frames=declared.stop_frames,
    stop_confirmation=declared.stop_confirmation,
    cyclic_frames=declared.cyclic_frames,
    safety_card=declared.safety_card,
    kinds=("can", "serial"),
    exchange=declared.VescExchange,
    serial_field="uart_node",
    slowest_rad_s=declared.slowest_rad_s,
)
