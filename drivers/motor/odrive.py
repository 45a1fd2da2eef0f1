"""The driver of ODrive controllers on CAN Simple, firmware 0.5 and 0.6, one axis or more a side.

Arming goes step by step, with the proof in the axes' heartbeats; one axis lost stops the others. Any frame to an axis
may feed its watchdog, so that an armed one gets velocities and nothing else. Never sent: what calibrates, moves before
arming, or writes non-volatile memory.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from drivers.motor import odrive_protocol as protocol
from drivers.motor import vendor_parts as parts
from drivers.motor.odrive_protocol import (
    ESTOP_ERROR,
    WATCHDOG_ERROR,
    AxisState,
    OdriveSettings,
    Questions,
)
from drivers.motor.permit import Controllers, MotionPermit, Stage
from drivers.motor.vendor_driver import (
    IMPLAUSIBLE,
    REJECTED_LENGTH,
    REPEAT_NS,
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
    ReceivedFrame,
    Request,
    WheelSample,
)

# The first heartbeat may have been on its way before the request; the second shows the new state.
BEATS_TO_ARM = 2
# Chosen: two lost heartbeats in a row are no silence yet; docs/safety.md names three.
SILENT_BEATS = 3
# Less, and a pause of the host of a few beats would be taken for the silence of an axis.
SILENT_AT_LEAST_NS = 100_000_000
_STATIONARY_RAD_S = 0.1
_CLOSED_LOOP_STEP = 3
_ESTOP = 0x02
_HOST_COMMANDS = frozenset({0x06, 0x07, 0x0B, 0x0C, 0x0D, 0x0E, 0x0F, 0x16, 0x18, 0x19, 0x1A, 0x1B})
_QUIET = frozenset({AxisState.UNDEFINED, AxisState.IDLE, AxisState.CLOSED_LOOP})


@dataclass(slots=True)
class _Axis:
    """State of one ODrive node; turns are of the motor."""

    node: int
    received_ns: int | None = None
    state: int = AxisState.UNDEFINED
    error: int = 0
    beats_armed: int = 0
    turned: parts.Odometer = field(default_factory=parts.Odometer)


class _OdrivePort(Port):
    """Port of `VendorDriver` for ODrive boards. Asks nothing but at rest: it would feed the watchdogs."""

    def __init__(self, settings: OdriveSettings) -> None:
        self._settings = settings
        self.table = Table(stop_deceleration_rad_s2=settings.stop_deceleration_rad_s2)
        self._sides = [[_Axis(node) for node in side] for side in parts.sides_of(settings.nodes)]
        self._axes = {axis.node: axis for side in self._sides for axis in side}
        self._questions = Questions(settings)
        self._arm_step = 0

    @property
    def seen(self) -> Controllers:
        silent = ", ".join(str(axis.node) for axis in self._all if axis.received_ns is None)
        unheard = f"no heartbeat of node {silent}; check that it is switched on and has this bit rate and this id"
        stopped = any(axis.error & ESTOP_ERROR[self._settings.firmware] for axis in self._all)
        faulty = [axis for axis in self._all if axis.error and not self._is_idle_watchdog(axis)]
        return Controllers(
            missing=None if self._questions.known else unheard if silent else "requesting the version of the nodes",
            refused=self._questions.refusal,
            stopped="emergency stop; the wheels coast. Remove its cause, then reset" if stopped else None,
            faulty="; ".join(f"node {axis.node}: {self._fault_text(axis)}" for axis in faulty) or None,
            energised=self._any_closed_loop,
        )

    @property
    def identity(self) -> Identity | None:
        """Identity of the ODrives; firmware 0.5 does not report its version. None before all is known or if refused."""
        if not self._questions.known or self._questions.refusal is not None:
            return None
        if self._questions.version:
            return Identity("ODrive", self._questions.version, "device")
        return Identity("ODrive", self._settings.firmware, "robot.toml")

    @property
    def limits(self) -> Limits:
        """Limits that robot.toml declares, and the watchdog where it can be read back."""
        it = self._settings
        fastest = Limit(2.0 * math.pi * it.vel_limit_turns_s / it.gear, "robot.toml")
        return parts.limits(
            fastest,
            Limit(it.watchdog_s, "robot.toml" if it.watchdog_endpoints is None else "device"),
            self.table.stop_deceleration_rad_s2,
        )

    @property
    def is_stopped(self) -> bool:
        """Whether every axis has the error of an e-stop and lets its motor go, which is a control cycle later."""
        estop = ESTOP_ERROR[self._settings.firmware]
        return all(axis.error & estop and axis.state != AxisState.CLOSED_LOOP for axis in self._all)

    def reset_state(self, now_ns: int) -> None:
        self._questions.reset_state(now_ns)
        for axis in self._all:
            axis.received_ns = None
            axis.state, axis.error, axis.beats_armed = AxisState.UNDEFINED, 0, 0
            axis.turned.reset_state()

    def handle(self, received: ReceivedFrame, permit: MotionPermit) -> FrameReport:
        frame, t_ns = received.frame, received.t_ns
        if self._questions.handle_parameter(frame):
            return FrameReport(message=self._questions.new_messages())
        decoded = protocol.decode(self._settings.firmware, frame)
        if decoded is None and self._settings.firmware == "0.5":
            # What 0.5 never sends: an answer for the version.
            decoded = protocol.decode("0.6", frame)
            decoded = decoded if decoded is not None and decoded.name == "Get_Version" else None
        if decoded is None or decoded.node not in self._axes:
            return self._unused(frame)
        axis = self._axes[decoded.node]
        match decoded.name:
            case "Heartbeat":
                return self._handle_heartbeat(axis, decoded.values, t_ns)
            case "Get_Version":
                self._questions.handle_version(decoded.values)
                return FrameReport(message=self._questions.new_messages())
            case "Get_Encoder_Estimates":
                return self._handle_estimate(axis, decoded.values, t_ns, permit.looked_ns)
        return FrameReport()

    def sources(self) -> Sequence[Source]:
        silent_ns = max(SILENT_BEATS * self._settings.heartbeat_s * 1e9, SILENT_AT_LEAST_NS)
        gone_ns = max(2.0 * silent_ns, 5e8)
        return [Source(f"node {axis.node}", axis.received_ns, silent_ns, gone_ns) for axis in self._all]

    def objection(self, permit: MotionPermit) -> Objection | None:
        """Return what ends a drive: an error, or an axis that has left closed loop by itself."""
        for axis in self._all:
            if permit.stage is Stage.ARMED and (axis.error or axis.state != AxisState.CLOSED_LOOP):
                idles = f"it left closed loop without a request, for state {axis.state}"
                return Objection(f"node {axis.node}: {self._fault_text(axis) if axis.error else idles}")
            if permit.stage is Stage.ARMING and axis.error and not self._is_idle_watchdog(axis):
                return Objection(f"node {axis.node} did not arm: {self._fault_text(axis)}")
            if permit.stage in (Stage.STOPPING, Stage.BRAKING) and axis.error:
                return Objection(f"node {axis.node}: {self._fault_text(axis)}")
        return None

    def prepare(self, now_ns: int, permit: MotionPermit) -> Pending | None:
        """One step in each tick: clear an idle watchdog's error, mode, zero velocity, closed loop, then zeros."""
        if permit.lasts_ns(now_ns) == 0:
            self._arm_step = 0
        unfit = self._why_unfit if self._arm_step <= _CLOSED_LOOP_STEP else None
        if unfit is not None:
            return Pending(why=unfit, is_final=True)
        waiting = ", ".join(str(axis.node) for axis in self._all if axis.beats_armed < BEATS_TO_ARM)
        if not waiting:
            return None
        step, self._arm_step = self._arm_step, self._arm_step + 1
        frames: Sequence[Frame] = self.speeds(now_ns, 0.0, 0.0)
        if step == 0 and any(axis.error for axis in self._all):
            frames = self._clear_frames()
        elif step <= 1:
            self._arm_step = 2
            mode = {"control_mode": protocol.VELOCITY_CONTROL, "input_mode": protocol.PASSTHROUGH}
            frames = self._each("Set_Controller_Mode", **mode)
        elif step == _CLOSED_LOOP_STEP:
            for axis in self._all:
                axis.beats_armed = 0
            frames = self._state_frames(AxisState.CLOSED_LOOP)
        why = f"node {waiting} did not enter closed loop; check that it is calibrated (odrivetool)"
        return Pending(why=why, frames=tuple(frames))

    def speeds(self, now_ns: int, left_rad_s: float, right_rad_s: float) -> Sequence[Frame]:
        limit = self._settings.vel_limit_turns_s
        frames = []
        for side, direction, speed in zip(
            self._sides, self._settings.direction, (left_rad_s, right_rad_s), strict=True
        ):
            turns = direction * speed * self._settings.gear / (2.0 * math.pi)
            # Adding zero takes the sign off a zero.
            turns = min(max(turns, -limit), limit) + 0.0
            frames += [
                protocol.encode(self._settings.firmware, axis.node, "Set_Input_Vel", vel_turns_s=turns, torque_nm=0.0)
                for axis in side
            ]
        return frames

    def brake(self, now_ns: int, lasts_ns: int) -> tuple[Sequence[Frame], bool]:
        """Zero velocity and idle, until every axis says that it idles."""
        frames = (*self.speeds(now_ns, 0.0, 0.0), *self._state_frames(AxisState.IDLE))
        return frames, not self._any_closed_loop

    def rest(self, now_ns: int, permit: MotionPermit) -> Sequence[Frame]:
        """Bring axes that are energised to idle; reset; learn the version; keep idle axes from a watchdog error."""
        if self._any_closed_loop:
            return self._state_frames(AxisState.IDLE) if self._is_due(now_ns) else ()
        if permit.target is Request.RESET and self._may_be_cleared:
            return self._clear_frames() if self._is_due(now_ns, 2 * REPEAT_NS) else ()
        return self._questions.due(now_ns, all(axis.received_ns is not None for axis in self._all))

    def may_reset(self, now_ns: int) -> bool:
        """Whether errors were cleared a while ago, and none has come since."""
        is_cleared = self._repeat_ns and now_ns - self._repeat_ns >= REPEAT_NS
        return bool(is_cleared and self._may_be_cleared) and not any(axis.error for axis in self._all)

    def stop_frames(self) -> tuple[Frame, ...]:
        """Return the e-stop to every axis: it idles with an error that stays until it is cleared."""
        return tuple(self._each("Estop"))

    @property
    def _all(self) -> Sequence[_Axis]:
        return tuple(self._axes.values())

    @property
    def _any_closed_loop(self) -> bool:
        return any(axis.state == AxisState.CLOSED_LOOP for axis in self._all)

    @property
    def _may_be_cleared(self) -> bool:
        return self._questions.known or self._questions.refusal is not None

    def _is_idle_watchdog(self, axis: _Axis) -> bool:
        """Whether its watchdog has run out while nobody drove it, which is no fault."""
        return axis.state == AxisState.IDLE and axis.error == WATCHDOG_ERROR[self._settings.firmware]

    @property
    def _why_unfit(self) -> str | None:
        """Closed loop holds zero from its first moment: a wheel that turns would be braked as hard as can be."""
        silent = [str(axis.node) for axis in self._all if axis.turned.last is None]
        if silent:
            return f"node {', '.join(silent)} sends no encoder estimates; switch them on (odrivetool)"
        fastest = max(abs(axis.turned.speed) for axis in self._all) * 2.0 * math.pi / self._settings.gear
        return "a motor is turning; wait until it stands still" if fastest > _STATIONARY_RAD_S else None

    def _each(self, name: str, **values: int) -> list[Frame]:
        return [protocol.encode(self._settings.firmware, axis.node, name, **values) for axis in self._all]

    def _state_frames(self, state: AxisState) -> list[Frame]:
        return self._each("Set_Axis_State", state=int(state))

    def _clear_frames(self) -> list[Frame]:
        return self._each("Clear_Errors", **({"identify": 0} if self._settings.firmware == "0.6" else {}))

    def _handle_heartbeat(self, axis: _Axis, values: Mapping[str, float], t_ns: int) -> FrameReport:
        state, error = int(values["axis_state"]), int(values["axis_error"])
        busy = f"node {axis.node} is in state"
        restarted = None
        if state not in _QUIET:
            restarted = f"node {axis.node} calibrates or moves without a request (state {state})"
            self.reset_state(t_ns)
            self._questions.refusal = f"{busy} {state}: wait until odrivetool has finished with it"
        elif self._questions.refusal is not None and self._questions.refusal.startswith(busy):
            self._questions.refusal = None
        axis.received_ns, axis.state, axis.error = t_ns, state, error
        energised = state == AxisState.CLOSED_LOOP and error == 0
        axis.beats_armed = axis.beats_armed + 1 if energised and self._arm_step > _CLOSED_LOOP_STEP else 0
        return FrameReport(is_status=True, restarted=restarted, message=self._questions.new_messages())

    def _handle_estimate(self, axis: _Axis, values: Mapping[str, float], t_ns: int, looked_ns: int) -> FrameReport:
        position, speed = float(values["pos_turns"]), float(values["vel_turns_s"])
        if not (math.isfinite(position) and math.isfinite(speed)):
            return FrameReport(counts=("frames_accepted", "implausible_values"), wheels=self._sample(t_ns))
        # A 32-bit float's own steps grow with the distance.
        slack = 0.05 + 2.0**-22 * abs(position)
        plausible = axis.turned.add(position, t_ns, looked_ns, 1.5 * self._settings.vel_limit_turns_s, slack)
        axis.turned.speed = speed
        return FrameReport(counts=FrameReport().counts if plausible else IMPLAUSIBLE, wheels=self._sample(t_ns))

    def _sample(self, t_ns: int) -> WheelSample | None:
        if not all(axis.turned.is_new for axis in self._all):
            return None
        turned = [[axis.turned for axis in side] for side in self._sides]
        return parts.wheel_sample(t_ns, turned, self._settings.direction, 2.0 * math.pi / self._settings.gear)

    def _unused(self, frame: Frame) -> FrameReport:
        node, command = protocol.split(frame.can_id)
        if frame.extended or node not in self._axes:
            return UNKNOWN
        if command == _ESTOP:
            return FrameReport(counts=("unknown_id",), is_stop=True)
        if command in _HOST_COMMANDS and frame.data:
            return FrameReport(counts=("unknown_id",), commanded=f"node {node}")
        return UNKNOWN if len(frame.data) == 8 else REJECTED_LENGTH

    def _fault_text(self, axis: _Axis) -> str:
        """Return the meaning of the bits of an axis' error as text."""
        texts = [text for bit, text in protocol.ERRORS[self._settings.firmware].items() if axis.error & bit]
        return "; ".join(texts) or f"error {axis.error:#x}"


DRIVER = MotorDriver(
    "odrive",
    lambda settings, _key: VendorDriver(_OdrivePort(settings)),
    settings=OdriveSettings,
    example=protocol.EXAMPLE,
    recognise=protocol.recognise,
    stop_frames=lambda settings: _OdrivePort(settings).stop_frames(),
    stop_confirmation=lambda settings: stop_confirmation(_OdrivePort(settings)),
    cyclic_frames=protocol.cyclic_frames,
    safety_card=protocol.safety_card,
)
