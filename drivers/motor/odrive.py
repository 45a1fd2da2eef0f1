"""The driver of ODrive controllers on CAN Simple, firmware 0.5 and 0.6, one axis or more a side.

What the controller lacks is kept here: arming step by step with the proof in its heartbeats, the ramp of a stop, the
latched fault, and that one axis lost stops the others. Any frame to an axis may feed its watchdog, so that an armed one
gets velocities and nothing else. Never sent: what calibrates, moves before arming, or writes non-volatile memory.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from msgspec.structs import replace

from drivers.motor import odrive_protocol as protocol
from drivers.motor import vendor_parts as parts
from drivers.motor.odrive_protocol import (
    ESTOP_ERROR,
    EXAMPLE,
    WATCHDOG_ERROR,
    AxisState,
    Generation,
    OdriveSettings,
    Questions,
    cyclic_frames,
    error_words,
    recognise,
    safety_card,
    stop_confirmation,
    stop_frames,
)
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

ARMING_TIMEOUT_NS = 1_500_000_000
BEATS_TO_ARM = 2
SILENT_BEATS = 3
# Less, and a pause of the host of a few beats would be taken for the silence of an axis.
SILENT_AT_LEAST_NS = 100_000_000
_REPEAT_NS = 100_000_000
_STANDS_RAD_S = 0.1
_CLOSED_LOOP_STEP = 3
_ESTOP = 0x02
_HOST_COMMANDS = frozenset({0x06, 0x07, 0x0B, 0x0C, 0x0D, 0x0E, 0x0F, 0x16, 0x18, 0x19, 0x1A, 0x1B})
_QUIET = frozenset({AxisState.UNDEFINED, AxisState.IDLE, AxisState.CLOSED_LOOP})


@dataclass(slots=True)
class _Axis:
    """What is known of one node; turns are of the motor."""

    node: int
    heard_ns: int | None = None
    state: int = AxisState.UNDEFINED
    error: int = 0
    beats_armed: int = 0
    turned: parts.Odometer = field(default_factory=parts.Odometer)


class OdriveDriver:
    """Satisfies `drivers.types.Driver`: pure, and no frame makes it raise."""

    clock_offset_ns: int | None = None

    def __init__(self, settings: OdriveSettings) -> None:
        self._settings = settings
        self._generation = settings.generation
        self._axes = [[_Axis(node) for node in side] for side in parts.sides_of(settings.nodes)]
        self._by_node = {axis.node: axis for side in self._axes for axis in side}
        self.stats = DriverStats()
        self._permit = MotionPermit()
        self._questions = Questions(settings)
        self._arm_step = self._repeat_ns = 0

    @property
    def state(self) -> DriverState:
        """Where the driver is with its axes."""
        return self._permit.state(self._seen)

    @property
    def detail(self) -> str:
        """For a person: why the state is what it is, and what to do about it."""
        return self._permit.detail(self._seen)

    @property
    def _seen(self) -> Controllers:
        silent = ", ".join(str(axis.node) for axis in self._all if axis.heard_ns is None)
        unheard = f"no heartbeat of node {silent}; is it switched on, at this bit rate, at this id?"
        stopped = any(axis.error & ESTOP_ERROR[self._generation] for axis in self._all)
        faulty = [axis for axis in self._all if axis.error and not self._is_idle_watchdog(axis)]
        return Controllers(
            missing=None if self._questions.known else unheard if silent else "asking the nodes for their version",
            refused=self._questions.refusal,
            stopped="emergency stop; the wheels coast. Remove its cause, then reset" if stopped else None,
            faulty="; ".join(f"node {axis.node}: {self._words(axis)}" for axis in faulty) or None,
            energised=self._any_closed_loop,
        )

    @property
    def identity(self) -> Identity | None:
        """What answers as an ODrive; 0.5 does not report its version."""
        if not self._questions.known or self._questions.refusal is not None:
            return None
        if self._questions.version:
            return Identity("ODrive", self._questions.version, "device")
        return Identity("ODrive", self._settings.firmware, "robot.toml")

    @property
    def limits(self) -> Limits | None:
        """What robot.toml declares, and the watchdog where it can be read back."""
        if self.identity is None:
            return None
        settings = self._settings
        return Limits(
            max_wheel_speed_rad_s=Limit(2.0 * math.pi * settings.vel_limit_turns_s / settings.gear, "robot.toml"),
            command_timeout_s=Limit(
                settings.watchdog_s, "robot.toml" if settings.watchdog_endpoints is None else "device"
            ),
            stop_deceleration_rad_s2=Limit(settings.stop_deceleration_rad_s2, "robot.toml"),
        )

    def link_up(self, now_ns: int) -> None:
        """The medium has come up (again): whatever was agreed is void."""
        self._meet_anew(self._permit.linked(True), now_ns)

    def link_down(self, now_ns: int) -> None:
        """The medium is gone: whatever was agreed is void."""
        self._meet_anew(self._permit.linked(False), now_ns)

    def request(self, request: Request) -> None:
        """Set what the host wants; ARM only from standing by, and consumed when the axes leave their armed state."""
        before, self._permit = self._permit, self._permit.requested(request, self._seen)
        if self._permit.wanted is Request.ARM is not before.wanted:
            self._count("sessions")
            self._arm_step = 0

    def receive(self, now_ns: int, frames: Sequence[ReceivedFrame]) -> Readings:
        """Take in received frames and return what they meant; frames that come while the link is down are ignored."""
        wheels: list[WheelSample] = []
        status: list[RobotStatus] = []
        for received in frames if self._permit.link_is_up else ():
            if self._questions.take_parameter(received.frame):
                self._announce()
                self._count("frames_accepted")
                continue
            decoded = protocol.decode(self._generation, received.frame)
            if decoded is None and self._generation is Generation.V05:
                decoded = self._answer_of_another_generation(received.frame)
            if decoded is None or decoded.node not in self._by_node:
                self._count_unused(received.frame)
                continue
            self._count("frames_accepted")
            axis = self._by_node[decoded.node]
            match decoded.name:
                case "Heartbeat":
                    self._take_heartbeat(axis, decoded.values, received.t_ns)
                    status.append(parts.status(received.t_ns, self.state, self._all_in_estop))
                case "Get_Version":
                    self._questions.take_version(decoded.values)
                    self._announce()
                case "Get_Encoder_Estimates":
                    self._take_estimate(axis, decoded.values, received.t_ns)
                    if all(each.turned.is_new for each in self._all):
                        wheels.append(self._sample(received.t_ns))
        if self._permit.link_is_up:
            self._check_silence(now_ns)
        events, self._permit = self._permit.events, replace(self._permit, events=())
        return Readings(wheels=tuple(wheels), status=tuple(status[-1:]), events=events)

    def transmit(self, now_ns: int, command: WheelCommand | None) -> tuple[OutgoingFrame, ...]:
        """Frames due now; to an armed axis nothing but the command, for each frame would feed its watchdog.

        Raises ValueError for a command that is not finite or valid for no time.
        """
        parts.check_command(command)
        if not self._permit.link_is_up:
            return ()
        match self._permit.stage:
            case Stage.REST:
                return self._rest(now_ns)
            case Stage.ARMING:
                return self._arm(now_ns)
            case Stage.STOPPING:
                return self._ramp(now_ns)
        if command is None:
            return ()
        self._permit = self._permit.commanded(now_ns, command)
        self._count("commands_sent")
        return parts.commanding(now_ns, command, *self._velocity())

    def release(self, why: str) -> None:
        """Every axis idles from now on: no torque."""
        self._idle(self._permit.lost(why))

    def estop(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Frames that stop every axis in any state; whatever was wanted is dropped, and nothing is commanded again."""
        self._permit = self._permit.stopped()
        return parts.estop_frames(now_ns, stop_frames(self._settings))

    @property
    def _all(self) -> Sequence[_Axis]:
        return tuple(self._by_node.values())

    @property
    def _any_closed_loop(self) -> bool:
        return any(axis.state == AxisState.CLOSED_LOOP for axis in self._all)

    def _is_idle_watchdog(self, axis: _Axis) -> bool:
        """Whether its watchdog has run out while nobody drove it, which is no fault."""
        return axis.state == AxisState.IDLE and axis.error == WATCHDOG_ERROR[self._generation]

    def _rest(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Bring axes that are energised to idle; reset; learn the version; keep idle axes from a watchdog error."""
        if self._any_closed_loop and now_ns - self._repeat_ns >= _REPEAT_NS:
            self._repeat_ns = now_ns
            return parts.outgoing(now_ns, *self._state_frames(AxisState.IDLE))
        if self._any_closed_loop:
            return ()
        if self._permit.wanted is Request.RESET and (self._questions.known or self._questions.refusal is not None):
            return self._reset(now_ns)
        due = self._questions.due(now_ns, all(axis.heard_ns is not None for axis in self._all))
        self._announce()
        return parts.outgoing(now_ns, *due)

    def _reset(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        if not any(axis.error for axis in self._all) and self._repeat_ns and now_ns - self._repeat_ns >= _REPEAT_NS:
            self._permit = self._permit.reset(self._seen)
            return ()
        if now_ns - self._repeat_ns < 2 * _REPEAT_NS:
            return ()
        self._repeat_ns = now_ns
        return parts.outgoing(now_ns, *self._clear_frames())

    def _arm(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """One step in each tick: clear an idle watchdog's error, mode, zero velocity, closed loop, then zeros."""
        self._permit = self._permit.begun(now_ns)
        unfit = self._why_unfit if self._arm_step <= _CLOSED_LOOP_STEP else None
        if unfit is not None:
            self._idle(self._permit.given_up(f"not armed: {unfit}"))
            return ()
        if all(axis.beats_armed >= BEATS_TO_ARM for axis in self._all):
            self._permit = self._permit.armed(now_ns)
            return parts.outgoing(now_ns, *self._velocity())
        if self._permit.lasts_ns(now_ns) > ARMING_TIMEOUT_NS:
            waiting = [str(axis.node) for axis in self._all if axis.beats_armed < BEATS_TO_ARM]
            why = f"node {', '.join(waiting)} did not go to closed loop; is it calibrated (odrivetool)?"
            self._idle(self._permit.given_up(why))
            return parts.outgoing(now_ns, *self._state_frames(AxisState.IDLE))
        step, self._arm_step = self._arm_step, self._arm_step + 1
        if step == 0 and any(axis.error for axis in self._all):
            return parts.outgoing(now_ns, *self._clear_frames())
        if step <= 1:
            self._arm_step = 2
            mode = {"control_mode": protocol.VELOCITY_CONTROL, "input_mode": protocol.PASSTHROUGH}
            return parts.outgoing(now_ns, *self._each("Set_Controller_Mode", **mode))
        if step == _CLOSED_LOOP_STEP:
            for axis in self._all:
                axis.beats_armed = 0
            return parts.outgoing(now_ns, *self._state_frames(AxisState.CLOSED_LOOP))
        return parts.outgoing(now_ns, *self._velocity())

    @property
    def _why_unfit(self) -> str | None:
        """Closed loop holds zero from its first moment: a wheel that turns would be braked as hard as can be."""
        silent = [str(axis.node) for axis in self._all if axis.turned.last is None]
        if silent:
            return f"node {', '.join(silent)} sends no encoder estimates; switch them on (odrivetool)"
        fastest = max(abs(axis.turned.speed) for axis in self._all) * 2.0 * math.pi / self._settings.gear
        return "a motor turns; wait until it stands" if fastest > _STANDS_RAD_S else None

    def _ramp(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Slow down with the declared deceleration, then let the axes idle until they say that they do."""
        self._permit = self._permit.slowed(now_ns, self._settings.stop_deceleration_rad_s2)
        idle = [] if any(self._permit.speeds) else self._state_frames(AxisState.IDLE)
        frames = (*self._velocity(), *idle)
        if idle and not self._any_closed_loop:
            self._permit = self._permit.rested()
        return parts.outgoing(now_ns, *frames)

    def _velocity(self) -> list[Frame]:
        limit = self._settings.vel_limit_turns_s
        frames = []
        for side, direction, speed in zip(self._axes, self._settings.direction, self._permit.speeds, strict=True):
            turns = direction * speed * self._settings.gear / (2.0 * math.pi)
            # Adding zero takes the sign off a zero.
            turns = min(max(turns, -limit), limit) + 0.0
            frames += [
                protocol.encode(self._generation, axis.node, "Set_Input_Vel", vel_turns_s=turns, torque_nm=0.0)
                for axis in side
            ]
        return frames

    def _each(self, name: str, **values: int) -> list[Frame]:
        return [protocol.encode(self._generation, axis.node, name, **values) for axis in self._all]

    def _state_frames(self, state: AxisState) -> list[Frame]:
        return self._each("Set_Axis_State", state=int(state))

    def _clear_frames(self) -> list[Frame]:
        return self._each("Clear_Errors", **({"identify": 0} if self._generation is Generation.V06 else {}))

    def _take_heartbeat(self, axis: _Axis, values: Mapping[str, float], t_ns: int) -> None:
        axis.heard_ns = t_ns
        axis.state, axis.error = int(values["axis_state"]), int(values["axis_error"])
        if axis.state not in _QUIET:
            why = f"node {axis.node} calibrates or moves by itself (state {axis.state})"
            self._meet_anew(self._permit.restarted(why), t_ns)
            self._questions.refusal = (
                f"node {axis.node} is in state {axis.state}: wait until odrivetool has done with it"
            )
            return
        if self._questions.refusal is not None and self._questions.refusal.startswith(f"node {axis.node} is in state"):
            self._questions.refusal = None
        energised = axis.state == AxisState.CLOSED_LOOP and axis.error == 0
        axis.beats_armed = axis.beats_armed + 1 if energised and self._arm_step > _CLOSED_LOOP_STEP else 0
        stage = self._permit.stage
        if stage is Stage.ARMING and axis.error and not self._is_idle_watchdog(axis):
            self._idle(self._permit.lost(f"node {axis.node} did not arm: {self._words(axis)}"))
        elif stage is Stage.ARMED and not energised:
            what = self._words(axis) if axis.error else f"it left closed loop by itself, for state {axis.state}"
            self._idle(self._permit.lost(f"node {axis.node}: {what}"))
        elif stage is Stage.STOPPING and axis.error:
            self._idle(self._permit.lost(f"node {axis.node}: {self._words(axis)}"))

    def _answer_of_another_generation(self, frame: Frame) -> protocol.Decoded | None:
        """What 0.5 never sends: an answer for the version."""
        decoded = protocol.decode(Generation.V06, frame)
        return decoded if decoded is not None and decoded.name == "Get_Version" else None

    def _announce(self) -> None:
        said, self._questions.said = self._questions.said, None
        if said is not None:
            self._permit = replace(self._permit, note="it stands by").saying(said)

    def _take_estimate(self, axis: _Axis, values: Mapping[str, float], t_ns: int) -> None:
        position, speed = float(values["pos_turns"]), float(values["vel_turns_s"])
        if not (math.isfinite(position) and math.isfinite(speed)):
            self._count("implausible_values")
            return
        # A 32-bit float's own steps grow with the distance.
        slack = 0.05 + 2.0**-22 * abs(position)
        if not axis.turned.take(position, t_ns, self._permit.looked_ns, 1.5 * self._settings.vel_limit_turns_s, slack):
            self._count("implausible_ticks")
        axis.turned.speed = speed

    def _sample(self, t_ns: int) -> WheelSample:
        turned = [[axis.turned for axis in side] for side in self._axes]
        return parts.wheel_sample(t_ns, turned, self._settings.direction, 2.0 * math.pi / self._settings.gear)

    def _check_silence(self, now_ns: int) -> None:
        self._permit = self._permit.looked(now_ns)
        limit_ns = max(SILENT_BEATS * self._settings.heartbeat_s * 1e9, SILENT_AT_LEAST_NS)
        for axis in self._all:
            silent_ns = 0 if axis.heard_ns is None else self._permit.silent_ns(axis.heard_ns)
            if silent_ns > limit_ns:
                why = f"node {axis.node} fell silent"
                if self._permit.stage is not Stage.REST:
                    self._idle(self._permit.lost(f"{why}: no heartbeat for {limit_ns * 1e-9:g} s"))
                elif silent_ns > max(2.0 * limit_ns, 5e8):
                    self._meet_anew(self._permit.restarted(why, f"{why}: new handshake"), now_ns)
                return

    def _count_unused(self, frame: Frame) -> None:
        node, command = protocol.split(frame.can_id)
        ours = not frame.extended and node in self._by_node
        if ours and command == _ESTOP:
            self._count("unknown_id")
            self._idle(self._permit.stop_heard())
        elif ours and command in _HOST_COMMANDS and frame.data:
            self._count("unknown_id")
            self._permit = self._permit.command_heard(f"node {node}")
        elif ours and len(frame.data) != 8:
            self._count("rejected_length")
        else:
            self._count("unknown_id")

    @property
    def _all_in_estop(self) -> bool:
        # The error is latched by the frame; the motor is released a control cycle later.
        return all(
            axis.error & ESTOP_ERROR[self._generation] and axis.state != AxisState.CLOSED_LOOP for axis in self._all
        )

    def _idle(self, permit: MotionPermit) -> None:
        """Idle is due at once for all that are still energised."""
        self._permit, self._repeat_ns = permit, 0

    def _meet_anew(self, permit: MotionPermit, now_ns: int) -> None:
        self._idle(permit)
        self._questions.begin_anew(now_ns)
        self._arm_step = 0
        for axis in self._all:
            axis.heard_ns = None
            axis.state, axis.error, axis.beats_armed = AxisState.UNDEFINED, 0, 0
            axis.turned.begin_anew()

    def _words(self, axis: _Axis) -> str:
        return error_words(self._generation, axis.error)

    def _count(self, name: str) -> None:
        self.stats = parts.counted(self.stats, name)


DRIVER = MotorDriver(
    "odrive",
    lambda settings, _key: OdriveDriver(settings),
    settings=OdriveSettings,
    example=EXAMPLE,
    recognise=recognise,
    stop_frames=stop_frames,
    stop_confirmation=stop_confirmation,
    cyclic_frames=cyclic_frames,
    safety_card=safety_card,
)
