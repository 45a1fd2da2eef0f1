"""The driver of VESC controllers on CAN or a serial line, one or more a side.

A VESC knows no armed state: the first speed that it is sent moves it. Armed is what this driver says it is: every
controller has answered, its status is fresh, its motor stands, and zeros were sent for a while. Faults are asked for,
as no status message has them; the question feeds no timeout.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from drivers.motor import vendor_parts as parts
from drivers.motor import vesc_codec as codec
from drivers.motor import vesc_settings as declared
from drivers.motor.permit import Controllers, MotionPermit, Stage
from drivers.motor.vendor_driver import (
    BRAKING_NS,
    IMPLAUSIBLE,
    UNKNOWN,
    FrameReport,
    Objection,
    Pending,
    Port,
    Source,
    Table,
    VendorDriver,
    stop_confirmation,
)
from drivers.types import (
    Frame,
    Identity,
    Limit,
    Limits,
    MotorDriver,
    OutgoingFrame,
    ReceivedFrame,
    WheelSample,
)

# Chosen: twice as many as of the others, 0.2 s at 50 Hz, as a VESC acknowledges no command.
ZEROS_TO_ARM = 10
# Chosen: a controller that does not answer so often reports no timeout, and the operator is told.
TIMEOUT_TRIES = 5
# Five status messages at 50 Hz; gone when a controller could have been switched off and on.
SILENT_NS, GONE_NS = 100_000_000, 500_000_000
# Chosen: pings go out until all controllers have answered; faults are asked for one controller at a time.
_PING_PERIOD_NS = 100_000_000
_FAULT_PERIOD_NS = 50_000_000
# A little under the 20 ms of a tick at 50 Hz, so that a tick that comes early is not left out.
_POLL_PERIOD_NS = 18_000_000
_ERPM_PER_STEP_S = 10.0
"""Electrical rpm of a motor whose tachometer counts a step a second."""
_BRAKE = codec.COMMANDS["set_brake_current"][0]


@dataclass(slots=True)
class _Motor:
    """State of one controller; `turned` is in steps of its tachometer, six in an electrical turn."""

    node: int
    turned: parts.Odometer = field(default_factory=parts.Odometer)
    answered: bool = False
    erpm_ns: int | None = None
    fault: int | None = None
    timed_out: bool = False
    killed: bool = False
    timeout: tuple[float, float] | None = None
    requested_timeout: int = 0

    @property
    def is_stationary(self) -> bool:
        """Whether the motor stands, by its last report."""
        return abs(_ERPM_PER_STEP_S * self.turned.speed) < declared.STATIONARY_ERPM

    @property
    def may_report_timeout(self) -> bool:
        """Whether its timeout is not known yet, and it has not been asked often enough to give up."""
        return self.timeout is None and self.requested_timeout < TIMEOUT_TRIES

    def handle_speed(self, erpm: float, t_ns: int) -> None:
        """Store the newest speed."""
        self.turned.speed, self.erpm_ns = erpm / _ERPM_PER_STEP_S, t_ns


class _VescPort(Port):
    """Port of `VendorDriver` for VESC controllers, which need nothing at rest: released motors roll."""

    def __init__(self, settings: declared.VescSettings) -> None:
        self._settings = settings
        self.table = Table(
            stop_deceleration_rad_s2=settings.stop_deceleration_rad_s2,
            watchdog_s=settings.watchdog_s,
            zeros_to_arm=ZEROS_TO_ARM,
            # Below the slowest speed that it holds it would roll on: brake there.
            slowest_rad_s=declared.slowest_rad_s(settings),
            after_loss=Stage.BRAKING,
        )
        self._sides = [[_Motor(node) for node in side] for side in parts.sides_of(settings.nodes)]
        self._motors = {motor.node: motor for side in self._sides for motor in side}
        self._reassembly = codec.Reassembly(declared.HOST_ID)
        self._pinged_ns = self._requested_ns = self._next_requested = 0

    @property
    def seen(self) -> Controllers:
        timeouts = ((motor.node, motor.timeout) for motor in self._all if motor.timeout is not None)
        refusals = (declared.timeout_fault(self._settings, node, *timeout) for node, timeout in timeouts)
        return Controllers(
            missing=self._missing,
            refused=next(filter(None, refusals), None),
            stopped="its kill switch is pressed" if any(motor.killed for motor in self._all) else None,
            faulty="; ".join(_describe(motor) for motor in self._all if motor.fault) or None,
        )

    @property
    def identity(self) -> Identity | None:
        """Identity of the VESCs; None while one is missing or refused."""
        seen = self.seen
        return Identity("VESC", "", "robot.toml") if seen.missing is seen.refused is None else None

    @property
    def limits(self) -> Limits:
        """Limits that robot.toml declares, and the time-out where all controllers report it."""
        settings, reported = self._settings, all(motor.timeout is not None for motor in self._all)
        fastest = Limit(settings.max_erpm / settings.erpm_per_rad_s, "robot.toml")
        return parts.limits(
            fastest,
            Limit(settings.watchdog_s, "device" if reported else "robot.toml"),
            self.table.stop_deceleration_rad_s2,
        )

    @property
    def is_stopped(self) -> bool:
        """Whether every motor stands, as it said last: nothing else confirms a stop here."""
        return all(motor.erpm_ns is not None and motor.is_stationary for motor in self._all)

    def reset_state(self, now_ns: int) -> None:
        self._pinged_ns = now_ns - _PING_PERIOD_NS
        for motor in self._all:
            motor.answered = motor.timed_out = motor.killed = False
            motor.erpm_ns = motor.fault = motor.timeout = None
            motor.turned.speed, motor.requested_timeout = 0.0, 0
            motor.turned.reset_state()

    def handle(self, received: ReceivedFrame, permit: MotionPermit) -> FrameReport:
        """Take in a frame of a controller, a part of an answer to this host, or a frame of another host."""
        frame, t_ns = received.frame, received.t_ns
        if frame.extended and frame.can_id & 0xFF == declared.HOST_ID and frame.can_id >> 8 != codec.PONG:
            report = self._handle_packet(received, permit)
            if self._settings.uart_node is None or not all(motor.turned.is_new for motor in self._all):
                return report
            return FrameReport(counts=report.counts, lost=report.lost, is_status=True, wheels=self._sample(t_ns))
        decoded = codec.decode(frame)
        if decoded is None or decoded.node not in self._motors:
            return self._unused(frame)
        motor = self._motors[decoded.node]
        match decoded.name:
            case "pong":
                motor.answered = True
            case "status":
                motor.handle_speed(decoded.values["erpm"], t_ns)
                return FrameReport(is_status=True)
            case "status5":
                report = self._handle_tachometer(motor, int(decoded.values["tachometer"]), t_ns, permit)
                is_new = all(each.turned.is_new and each.erpm_ns is not None for each in self._all)
                return FrameReport(
                    counts=report.counts, lost=report.lost, wheels=self._sample(t_ns) if is_new else None
                )
        return FrameReport()

    def sources(self) -> Sequence[Source]:
        return [Source(f"controller {motor.node}", motor.erpm_ns, SILENT_NS, GONE_NS) for motor in self._all]

    def objection(self, permit: MotionPermit) -> Objection | None:
        """Return what ends a drive: a fault, a kill switch, or a timeout that ran out."""
        # An answer of before the first command is not meant.
        is_armed_long = permit.lasts_ns(permit.looked_ns) > 2 * len(self._all) * _FAULT_PERIOD_NS + SILENT_NS
        for motor in self._all:
            if motor.fault:
                return Objection(_describe(motor))
            if motor.killed:
                return Objection(f"controller {motor.node}: its kill switch is pressed")
            if permit.stage is Stage.ARMED and motor.timed_out and is_armed_long:
                return Objection(f"controller {motor.node}: its timeout expired, no command came in time")
        return None

    def prepare(self, now_ns: int, permit: MotionPermit) -> Pending | None:
        """Wait until every controller has said whether it has a fault."""
        if not self.is_stopped:
            return Pending(why="a motor is turning; wait until it stands still", is_final=True)
        if any(motor.fault is None for motor in self._all):
            return Pending(why="a controller does not report whether it has a fault; it needs firmware 5.03 or later")
        return None

    def speeds(self, now_ns: int, left_rad_s: float, right_rad_s: float) -> Sequence[Frame]:
        limit, commanded = self._settings.max_erpm, (left_rad_s, right_rad_s)
        frames = []
        for side, direction, speed in zip(self._sides, self._settings.direction, commanded, strict=True):
            erpm = min(max(direction * speed * self._settings.erpm_per_rad_s, -limit), limit)
            frames += [codec.command(motor.node, "set_erpm", erpm) for motor in side]
        return frames

    def brake(self, now_ns: int, lasts_ns: int) -> tuple[Sequence[Frame], bool]:
        """Brake by a current until the motors stand, then let go."""
        # One that still says that it turns may be on a slope; of one that has fallen silent nobody knows.
        reports_turning = any(not m.is_stationary and now_ns - (m.erpm_ns or 0) < SILENT_NS for m in self._all)
        if self.is_stopped or (lasts_ns > BRAKING_NS and not reports_turning):
            return [codec.command(motor.node, "set_current", 0.0) for motor in self._all], True
        amperes = self._settings.brake_current_a
        return [codec.command(motor.node, "set_brake_current", amperes) for motor in self._all], False

    def may_reset(self, now_ns: int) -> bool:
        """Whether the faults are known; a controller ends its own when the cause has gone."""
        return all(motor.fault is not None for motor in self._all)

    def questions(self, now_ns: int, permit: MotionPermit) -> tuple[OutgoingFrame, ...]:
        """Whether all are there; at rest their timeouts; then their faults, in turn. None of them feeds a timeout."""
        if not all(motor.answered for motor in self._all):
            if now_ns - self._pinged_ns < _PING_PERIOD_NS:
                return ()
            self._pinged_ns = now_ns
            return parts.outgoing(now_ns, *(codec.ping(motor.node, declared.HOST_ID) for motor in self._all))
        polled = self._settings.uart_node is not None
        if now_ns - self._requested_ns < (_POLL_PERIOD_NS if polled else _FAULT_PERIOD_NS):
            return ()
        self._requested_ns = now_ns
        mute = [motor for motor in self._all if motor.may_report_timeout]
        if mute and permit.stage is Stage.REST:
            motor = min(mute, key=lambda each: each.requested_timeout)
            motor.requested_timeout += 1
            return self._request(now_ns, motor, bytes([codec.GET_APPCONF]))
        if polled:
            return parts.outgoing(now_ns, *self._poll())
        self._next_requested = (self._next_requested + 1) % len(self._all)
        return self._request(now_ns, self._all[self._next_requested], codec.request_values(codec.FAULT_AND_STATUS))

    def stop_frames(self) -> tuple[Frame, ...]:
        """Return the frames that brake with the declared current, all motors at once; nothing latches it.

        On a serial line they also ask whether the motors stand.
        """
        brake = codec.command(codec.EVERYBODY, "set_brake_current", self._settings.brake_current_a)
        return (brake,) if self._settings.uart_node is None else (brake, *self._poll())

    @property
    def _all(self) -> Sequence[_Motor]:
        return tuple(self._motors.values())

    @property
    def _missing(self) -> str | None:
        silent = [str(motor.node) for motor in self._all if not motor.answered]
        if silent:
            # On a serial line a ping is asked as values, which older firmware answers too shortly.
            is_new = "" if self._settings.uart_node is None else ", and runs firmware 5.03 or later"
            return (
                f"controller {', '.join(silent)} does not answer; check that it is switched on, has this bit rate and "
                f"this id{is_new}"
            )
        complete = all(
            m.erpm_ns is not None and m.turned.last is not None and not m.may_report_timeout for m in self._all
        )
        return (
            None if complete else "no status messages 1 and 5; switch them on, at 50 Hz (VESC Tool, App Settings, CAN)"
        )

    def _poll(self) -> Sequence[Frame]:
        """Return the questions for all that must be known of each motor: no status messages come on a serial line."""
        query = codec.request_values(codec.ALL_OF_A_MOTOR)
        return [codec.packet_frame(motor.node, declared.HOST_ID, query) for motor in self._all]

    def _request(self, now_ns: int, motor: _Motor, payload: bytes) -> tuple[OutgoingFrame, ...]:
        return parts.outgoing(now_ns, codec.packet_frame(motor.node, declared.HOST_ID, payload))

    def _handle_packet(self, received: ReceivedFrame, permit: MotionPermit) -> FrameReport:
        found = self._reassembly.feed(received.frame)
        if found is None or found[0] not in self._motors:
            return FrameReport(counts=())
        read: Mapping[str, float] = codec.values(found[2]) or {}
        motor = self._motors[found[0]]
        motor.timeout = codec.timeout(found[2], motor.node) or motor.timeout
        motor.fault = int(read["fault"]) if "fault" in read else motor.fault
        byte = int(read.get("status_byte", 0))
        motor.timed_out, motor.killed = bool(byte & codec.TIMED_OUT), bool(byte & codec.KILL_SWITCH)
        if "erpm" not in read:
            return FrameReport()
        motor.handle_speed(read["erpm"], received.t_ns)
        return self._handle_tachometer(motor, int(read["tachometer"]), received.t_ns, permit)

    def _handle_tachometer(self, motor: _Motor, tachometer: int, t_ns: int, permit: MotionPermit) -> FrameReport:
        fastest = 1.5 * self._settings.max_erpm / _ERPM_PER_STEP_S
        if motor.turned.add_wrapping(tachometer, t_ns, permit.looked_ns, fastest, 12.0):
            return FrameReport()
        return FrameReport(counts=IMPLAUSIBLE, lost=f"controller {motor.node} has restarted")

    def _sample(self, t_ns: int) -> WheelSample:
        per_step = 2.0 * math.pi / (6.0 * self._settings.pole_pairs * self._settings.gear)
        turned = [[motor.turned for motor in side] for side in self._sides]
        return parts.wheel_sample(t_ns, turned, self._settings.direction, per_step)

    def _unused(self, frame: Frame) -> FrameReport:
        number, to = frame.can_id >> 8, frame.can_id & 0xFF
        is_addressed = frame.extended and (to in self._motors or to == codec.EVERYBODY)
        if not (is_addressed and number in codec.SET_COMMANDS):
            return UNKNOWN
        is_stop = number == _BRAKE
        return FrameReport(counts=("unknown_id",), is_stop=is_stop, commanded=None if is_stop else f"controller {to}")


def _describe(motor: _Motor) -> str:
    return f"controller {motor.node}: {declared.FAULTS.get(motor.fault or 0, f'fault {motor.fault}')}"


DRIVER = MotorDriver(
    "vesc",
    lambda settings, _key: VendorDriver(_VescPort(settings)),
    settings=declared.VescSettings,
    example=declared.EXAMPLE,
    recognise=declared.recognise,
    latches_stop=False,
    stop_frames=lambda settings: _VescPort(settings).stop_frames(),
    stop_confirmation=lambda settings: stop_confirmation(_VescPort(settings)),
    cyclic_frames=declared.cyclic_frames,
    safety_card=declared.safety_card,
    kinds=("can", "serial"),
    exchange=declared.VescExchange,
    serial_field="uart_node",
    slowest_rad_s=declared.slowest_rad_s,
)
