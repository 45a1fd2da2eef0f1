"""The driver of this project's own wheel controller, which speaks firmware_protocol/disco_robot.dbc.

Its parts lie beside it: frames and telemetry, arming and the watch over an armed robot, house-keeping frames.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from typing import Any

from drivers.device_clock import DEVICE_CLOCK_MODULUS_US, DeviceClock
from drivers.motor import reference_frames as telemetry
from drivers.motor import reference_protocol as protocol
from drivers.motor.permit import STOPPED_FROM_OUTSIDE
from drivers.motor.reference_arming import MESSAGES as HANDSHAKE_MESSAGES
from drivers.motor.reference_arming import ArmedWatch, Arming, Handshake
from drivers.motor.reference_frames import FrameReception, FrameTransmission
from drivers.motor.reference_protocol import HouseKeeping
from drivers.motor.vendor_parts import ESTOP_LIFE_NS, ESTOP_REPEATS, check_command
from drivers.types import (
    DriverState,
    DriverStats,
    Identity,
    Limits,
    MotorDriver,
    NoSettings,
    OutgoingFrame,
    Readings,
    ReceivedFrame,
    Request,
    RobotStatus,
    WheelCommand,
)
from firmware_protocol import status_codes
from firmware_protocol.codec import PROTOCOL_MAJOR, PROTOCOL_MINOR, Codec, Decoded

# Five periods of SYSTEM_STATE (0.1 s): then the handshake begins anew.
SILENCE_NS = 500_000_000
# Chosen: longer, as a robot that was refused is not to be refused again for each short pause.
REFUSED_SILENCE_NS = 3_000_000_000
# Five periods of WHEEL_COMMAND at 50 Hz, as for any command that may lose some.
ZERO_VALID_FOR_S = 0.1
# Chosen: a shorter command would have run out before its frame has crossed the bus.
SHORTEST_VALID_FOR_S = 0.002
COASTING_NS = 200_000_000
"""Released wheels roll freely for this long and lose their speed gently; then the controller's brake holds them."""
# Chosen: frames of one e-stop come within it, as they are repeated; a later one is another.
_ONE_STOP_NS = 1_000_000_000
_STATES = {
    "BOOT": DriverState.HANDSHAKE,
    "STANDBY": DriverState.STANDBY,
    "READY": DriverState.STANDBY,
    "ARMED": DriverState.STOPPING,
    "STOPPING": DriverState.STOPPING,
    "FAULT": DriverState.FAULT,
    "ESTOP": DriverState.ESTOP,
}
_MAY_ARM = frozenset(DriverState) - {
    DriverState.DISCONNECTED,
    DriverState.HANDSHAKE,
    DriverState.REFUSED,
    DriverState.FAULT,
    DriverState.ESTOP,
}


class ReferenceDriver:
    """Driver of the reference firmware's protocol (a `drivers.types.Driver`); pure, and no frame makes it raise.

    `request(ARM)` leads from STANDBY or READY through a new session to ARMED; it is ignored, with the reason in
    `detail`, before the handshake is complete. `transmit` raises ValueError for a command that is not finite or out of
    the wire's range (callers clip first): it never reaches the wire.
    """

    def __init__(self, codec: Codec, draw_session: Callable[[], int], key: bytes | None = None) -> None:
        """`draw_session` returns any non-negative integer, best at random: session ids are made of it.

        With a `key` (16 bytes) commands are authenticated, and a robot that does not ask for that is refused.
        """
        self._codec = codec
        self._has_key = key is not None
        self._reception = FrameReception(codec)
        self._transmission = FrameTransmission(codec, key)
        self._house_keeping = HouseKeeping(self._transmission, codec.dbc_hash)
        self._clock = DeviceClock()
        self._telemetry = telemetry.Telemetry(self._clock)
        self._handlers = self._create_handlers()
        self._arming = Arming(codec.dbc_hash, draw_session)
        self._blocker_bits = codec.choices("SESSION_STATE", "blockers")
        self._link_is_up = False
        self._commands_sent = 0
        self._watch = ArmedWatch()
        self._clock_errors = 0
        self._last_received_ns = 0
        self._events: list[str] = []
        self._released: str | None = None
        self._released_ns = 0
        self._now_ns = 0
        self._restart("the driver is new")

    def _restart(self, why: str) -> None:
        """Void whatever was agreed with the robot."""
        self._handshake = Handshake(PROTOCOL_MAJOR, PROTOCOL_MINOR, self._codec.dbc_hash, has_key=self._has_key)
        self._reception.reset()
        self._transmission.clear()
        self._arming.reset(why)
        self._telemetry.restart()
        self._clock.clear()
        self._house_keeping.clear()
        self._device_us: int | None = None
        self._status: RobotStatus | None = None
        self._host_accepted = False
        self._reported_clock_errors: int | None = None
        self._foreign_reported = False

    @property
    def is_stop_over(self) -> bool:
        """Whether the robot has left the armed state, or cannot be reached; it ends every stop by itself."""
        return self.state not in (DriverState.ARMING, DriverState.ARMED, DriverState.STOPPING)

    @property
    def state(self) -> DriverState:
        """State of the driver with its robot."""
        if not self._link_is_up:
            return DriverState.DISCONNECTED
        if self._handshake.refusal is not None:
            return DriverState.REFUSED
        if self.identity is None or self._status is None:
            return DriverState.HANDSHAKE
        state = _STATES.get(self._status.state, DriverState.HANDSHAKE)
        if self._released is not None and state is not DriverState.ESTOP:
            return DriverState.FAULT
        if self._arming.armed:
            return DriverState.ARMED
        if state is DriverState.STANDBY and self._arming.target is Request.ARM:
            return DriverState.ARMING
        return DriverState.READY if self._arming.ready else state

    @property
    def detail(self) -> str:
        """One sentence for the operator: why the state is what it is and what to do about it."""
        state, status, note = self.state, self._status, self._arming.note
        if self._released is not None and state is DriverState.FAULT:
            return f"{self._released}; remove the cause, then reset"
        if state in (DriverState.ARMING, DriverState.ARMED):
            return "arming" if state is DriverState.ARMING else "armed"
        if state is DriverState.DISCONNECTED:
            return f"the link is down; {note}" if note else "the link is down"
        if self._handshake.refusal is not None:
            return self._handshake.refusal
        if state is DriverState.HANDSHAKE or status is None:
            return self._handshake_detail()
        match state:
            case DriverState.FAULT:
                return f"the robot reports {status_codes.fault(status.fault)}"
            case DriverState.ESTOP:
                return status_codes.estop(status.estop_source)
            case DriverState.STOPPING if status.state == "ARMED":
                return note or "the robot is armed without a request from this host; it is being stopped"
        return note or f"the robot is in {status.state}"

    @property
    def identity(self) -> Identity | None:
        """Identity that the robot reported in the handshake; None before it is complete."""
        return self._handshake.identity

    @property
    def limits(self) -> Limits | None:
        """Limits that the robot reported in the handshake; None before it is complete."""
        return self._handshake.limits

    @property
    def stats(self) -> DriverStats:
        """A snapshot of the counters."""
        reception = self._reception
        return DriverStats(
            frames_accepted=reception.accepted,
            rejected_crc=reception.rejected_crc,
            rejected_sequence=reception.rejected_sequence,
            rejected_length=reception.rejected_length,
            unknown_id=reception.unknown_id,
            lost_frames=reception.lost,
            implausible_ticks=self._telemetry.implausible_ticks,
            implausible_values=self._telemetry.implausible_values,
            commands_sent=self._commands_sent,
            sessions=self._arming.sessions,
            robot_clock_errors=self._clock_errors,
            late_commands=self._watch.late_commands,
            silent_states=self._watch.silent,
        )

    @property
    def clock_offset_ns(self) -> int | None:
        """Host time minus device time, as estimated now; None before the first estimate."""
        return self._clock.offset_ns(self._now_ns)

    @property
    def synced(self) -> bool:
        """Whether samples are stamped with the device's time of measurement; before, with their reception."""
        return self._clock.synced(self._now_ns)

    def link_up(self, now_ns: int) -> None:
        """Start the handshake, because the medium has come up (again); any session is void."""
        self._now_ns = now_ns
        self._restart("the link was lost")
        self._link_is_up = True

    def link_down(self, now_ns: int) -> None:
        """Drop any session, because the medium is gone."""
        self._now_ns = now_ns
        self._restart("the link was lost")
        self._link_is_up = False

    def request(self, request: Request) -> None:
        """Set what the host wants; held until changed. ARM and RESET are consumed, see `Arming`."""
        if self._released is not None:
            if self._is_coasting:
                # What is asked for meanwhile would end in a ramp, which needs the encoders.
                return
            self._released = None if request is Request.RESET else self._released
        if request is Request.ARM and self.state not in _MAY_ARM:
            self._arming.note = f"not arming: {self.detail}"
        elif request is not Request.READY or self._handshake.refusal is None:
            self._arming.request(request)

    def receive(self, now_ns: int, frames: Sequence[ReceivedFrame]) -> Readings:
        """Take in received frames and return what they meant; frames that come while the link is down are ignored."""
        self._now_ns = now_ns
        collected: dict[str, list[Any]] = {}
        stopped_ns = self._reception.outside_stop_ns
        for received in frames if self._link_is_up else ():
            decoded = self._reception.accept(received)
            if decoded is None:
                continue
            self._last_received_ns = min(received.t_ns, now_ns)
            if decoded.name in self._handlers:
                kind, handle = self._handlers[decoded.name]
                sample = handle(decoded, received.t_ns)
                if sample is not None:
                    collected.setdefault(kind, []).append(sample)
        self._check_liveness(now_ns)
        self._report_outside_stop(stopped_ns)
        other_host = None if self._reception.foreign is None else f"it sends {self._reception.foreign}"
        if other_host is not None and not self._foreign_reported:
            self._foreign_reported = True
            self._events.append(f"another host is on the link: {other_host}; disconnect it")
        events, self._events = tuple(self._events), []
        samples_by_kind = {kind: tuple(samples) for kind, samples in collected.items()}
        return Readings(**samples_by_kind, events=events, other_host=other_host)

    def transmit(self, now_ns: int, command: WheelCommand | None) -> tuple[OutgoingFrame, ...]:
        """Return the frames due now: the command (only while armed; zeros while arming) and house-keeping.

        Raises ValueError for a command that is not finite, out of the wire's range, or valid for no time.
        """
        self._now_ns = now_ns
        check_command(command, SHORTEST_VALID_FOR_S)
        if not self._link_is_up:
            return ()
        self._check_liveness(now_ns)
        self._arming.step(now_ns)
        frames = []
        if self._is_coasting:
            frames.append(self._coast(now_ns))
        elif self._arming.armed and command is not None:
            frames.append(self._wheel_command(now_ns, "SPEED", command))
        elif self._arming.needs_zeros:
            frames.append(self._wheel_command(now_ns, "HOLD_ZERO", WheelCommand(0.0, 0.0, ZERO_VALID_FOR_S)))
        else:
            self._watch.rest()
        refused = self._handshake.refusal is not None
        introduced = self._host_accepted and self.identity is not None and not refused
        state, samples = self._arming.host_state(), self._clock.count
        frames += self._house_keeping.frames(now_ns, state, samples, introduced=introduced, refused=refused)
        return self._transmission.proved(frames)

    def release(self, why: str) -> None:
        """Switch the motors off (COAST), then disarm, which brakes; without a session only disarm."""
        self._released, self._released_ns = why, self._now_ns
        self._events.append(f"disarmed: {why}")
        if not self._arming.armed:
            self._arming.give_up(f"disarmed: {why}")

    def estop(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Frames that stop the robot in any state; whatever was wanted is dropped."""
        self._arming.request(Request.STANDBY)
        frame = self._transmission.frame("ESTOP", now_ns, ESTOP_LIFE_NS, reason="UNSPECIFIED")
        return (frame,) * ESTOP_REPEATS

    @property
    def _is_coasting(self) -> bool:
        """Whether the released motors of an armed robot roll out."""
        return self._released is not None and self._arming.armed

    def _coast(self, now_ns: int) -> OutgoingFrame:
        """Return the command that switches the motors off.

        The last one ends the session, and with it the armed state.
        """
        if now_ns - self._released_ns > COASTING_NS:
            self._arming.give_up(f"disarmed: {self._released}")
        return self._wheel_command(now_ns, "COAST", WheelCommand(0.0, 0.0, ZERO_VALID_FOR_S))

    def _wheel_command(self, now_ns: int, mode: str, command: WheelCommand) -> OutgoingFrame:
        frame = self._transmission.frame(
            "WHEEL_COMMAND",
            now_ns,
            # Half of its validity may pass on the way; the firmware counts the whole from the reception.
            round(0.5e9 * command.valid_for_s),
            mode=mode,
            left_speed=command.left_rad_s,
            right_speed=command.right_rad_s,
            valid_for=command.valid_for_s,
            session=self._arming.session,
        )
        self._watch.sent(self._commands_sent, now_ns)
        self._commands_sent += 1
        return frame

    def _create_handlers(self) -> dict[str, tuple[str, Callable[[Decoded, int], Any]]]:
        """Return, by message name, the field of `Readings` and the function that makes a sample of a frame."""
        return {
            **dict.fromkeys(telemetry.WHEEL_MESSAGES, ("wheels", self._telemetry.wheels)),
            **dict.fromkeys(telemetry.POSE_MESSAGES, ("poses", self._telemetry.pose)),
            **dict.fromkeys(HANDSHAKE_MESSAGES, ("", self._on_handshake)),
            "SYSTEM_STATE": ("status", self._on_status),
            "SESSION_STATE": ("", self._on_session),
            "TIME_RESPONSE": ("", self._on_time),
            "MAC_CHALLENGE": ("", lambda decoded, _: self._transmission.challenge(int(decoded.values["nonce"]))),
            "MOTOR": ("motors", telemetry.motor),
            "POWER": ("power", telemetry.power),
            "LINK_HEALTH": ("link_health", telemetry.link_health),
        }

    def _on_handshake(self, decoded: Decoded, _received_ns: int) -> None:
        before, refusal = (self.identity, self.limits), self._handshake.refusal
        self._handshake.handle(decoded)
        identity, limits = self.identity, self.limits
        ticks_per_rev = limits and limits.ticks_per_rev
        if identity and limits and ticks_per_rev and (identity, limits) != before:
            self._telemetry.configure(int(ticks_per_rev.value), limits.max_wheel_speed_rad_s.value)
            self._events.append(f"handshake complete: firmware {identity.firmware}, {identity.details}")
        if self._handshake.refusal not in (None, refusal):
            self._arming.reset("the handshake was refused")
            self._events.append(f"handshake refused: {self._handshake.refusal}")

    def _on_status(self, decoded: Decoded, received_ns: int) -> RobotStatus:
        values = decoded.values
        names = {
            signal: self._codec.choice_name("SYSTEM_STATE", signal, values[signal])
            for signal in ("state", "fault", "estop_source", "stop_cause", "reject_reason")
        }
        status = RobotStatus(
            t_ns=received_ns,
            fault_code=int(values["fault"]),
            session=int(values["session"]),
            rejected_count=int(values["rejected_count"]),
            **names,
        )
        before, self._status = self._status, status
        if before is None or (before.state, before.fault) != (status.state, status.fault):
            fault = f", fault {status_codes.fault(status.fault)}" if status.fault_code else ""
            came_from = before.state if before is not None else "unknown"
            self._events.append(f"robot {came_from} -> {status.state}{fault}")
        self._arming.handle_status(status.state, status.session, status.stop_cause, status.reject_reason)
        self._watch.reported(int(values["last_command_counter"]), received_ns)
        return status

    def _on_session(self, decoded: Decoded, received_ns: int) -> None:
        values = decoded.values
        self._host_accepted = bool(values["host_accepted"])
        bits = int(values["blockers"])
        blockers = tuple(name for bit, name in self._blocker_bits.items() if bits & bit)
        self._arming.handle_session(int(values["challenge"]), int(values["session"]), blockers, received_ns)
        self._count_clock_errors(int(values["clock_error_count"]))

    def _report_outside_stop(self, before_ns: int | None) -> None:
        """Say that somebody else sent an e-stop, once for frames that come within a second."""
        newest_ns = self._reception.outside_stop_ns
        if newest_ns is not None and (before_ns is None or newest_ns - before_ns > _ONE_STOP_NS):
            self._events.append(STOPPED_FROM_OUTSIDE)

    def _count_clock_errors(self, reported: int) -> None:
        before, self._reported_clock_errors = self._reported_clock_errors, reported
        # A smaller count is that of a robot that has restarted meanwhile.
        if before is not None and reported > before:
            self._clock_errors += reported - before
            self._events.append(
                "the robot's controller saw its clock go backwards and counted a nominal period instead"
            )

    def _on_time(self, decoded: Decoded, received_ns: int) -> None:
        sent_ns = self._house_keeping.requested_time_ns(int(decoded.values["sequence"]))
        if sent_ns is None:
            return
        device_us = int(decoded.values["receive_time"])
        before_us, self._device_us = self._device_us, device_us
        if not self._clock.add(sent_ns, received_ns, device_us):
            return
        why, cause = "the robot has restarted", "its clock was set back"
        if before_us is not None and (device_us - before_us) % DEVICE_CLOCK_MODULUS_US < DEVICE_CLOCK_MODULUS_US // 2:
            why = "the robot's clock jumped"
            cause = "this computer was suspended, or the controller's clock is over 200 ppm off"
        self._restart(why)
        self._events.append(f"{why}: {cause}")

    def _check_liveness(self, now_ns: int) -> None:
        """Start afresh with a robot that has fallen silent or has sample times that contradict its clock."""
        refused = self._handshake.refusal is not None
        known = refused or self._status is not None or self.identity is not None
        if known and now_ns - self._last_received_ns > (REFUSED_SILENCE_NS if refused else SILENCE_NS):
            self._restart("the robot stopped sending")
            self._events.append(
                "the robot stopped sending: starting a new handshake; check the cable and the robot's power"
            )
        objection = self._watch.objection(now_ns) if self._arming.armed else None
        if objection is not None:
            self._arming.give_up(f"disarmed: {objection}")
            self._events.append(f"disarmed: {objection}")
        if self._telemetry.distrusts_clock:
            self._clock.clear()
            self._telemetry.restart()
            self._events.append("sample times disagree with the robot's clock: synchronising the clocks again")

    def _handshake_detail(self) -> str:
        missing = self._handshake.missing
        if len(missing) == 3:
            return "no answer from the robot; check that it is switched on and uses the same bit rate"
        if missing:
            return f"waiting for the robot's {', '.join(missing)}"
        if self._status is None:
            return "waiting for the robot's SYSTEM_STATE"
        return f"the robot is in {self._status.state}"


def _create(_settings: NoSettings, key: bytes | None) -> ReferenceDriver:
    # Session ids are unpredictable, so that no old one fits by accident.
    return ReferenceDriver(Codec(), lambda: secrets.randbits(16), key)


DRIVER = MotorDriver(
    "reference",
    _create,
    stop_frames=protocol.stop_frames,
    stop_confirmation=protocol.stop_confirmation,
    cyclic_frames=protocol.cyclic_frames,
    safety_card=protocol.safety_card,
    recognise=protocol.recognise,
    kinds=("can", "serial"),
    authenticates=True,
    reports_reception=True,
)
