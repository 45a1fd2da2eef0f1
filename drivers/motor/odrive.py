"""The driver of ODrive controllers on CAN Simple, firmware 0.5 and 0.6, one axis or more a side.

What the controller lacks is kept here: arming step by step with the proof in its heartbeats, the ramp of a stop, the
latched fault, and that one axis lost stops the others. Any frame to an axis may feed its watchdog, so that an armed one
gets velocities and nothing else. Never sent: what calibrates, moves before arming, or writes non-volatile memory.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from drivers.motor import odrive_protocol as protocol
from drivers.motor import vendor_parts as parts
from drivers.motor.odrive_protocol import (
    ESTOP_ERROR,
    EXAMPLE,
    WATCHDOG_ERROR,
    AxisState,
    Generation,
    OdriveSettings,
    cyclic_frames,
    error_words,
    recognise,
    safety_card,
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

ARMING_TIMEOUT_NS = 1_500_000_000
BEATS_TO_ARM = 2
SILENT_BEATS = 3
VERSION_TRIES = 3
WATCHDOG_TRIES = 5
_VERSION_PERIOD_NS = 100_000_000
_REPEAT_NS = 100_000_000
_SAME_TIMEOUT_S = 0.002
_ALIVE_PERIOD_NS = 30_000_000
_HOST_COMMANDS = frozenset({0x02, 0x06, 0x07, 0x0B, 0x0C, 0x0D, 0x0E, 0x0F, 0x16, 0x18, 0x19, 0x1A, 0x1B})
_QUIET = frozenset({AxisState.UNDEFINED, AxisState.IDLE, AxisState.CLOSED_LOOP})


@dataclass(slots=True)
class _Axis:
    """What is known of one node; turns are of the motor."""

    node: int
    heard_ns: int | None = None
    state: int = AxisState.UNDEFINED
    error: int = 0
    beats_armed: int = 0
    pos_turns: float | None = None
    vel_turns_s: float = 0.0
    estimated_ns: int = 0
    moved_turns: float = 0.0
    is_new: bool = False
    watchdog_on: bool | None = None
    watchdog_s: float | None = None


class OdriveDriver:
    """Satisfies `drivers.types.Driver`: pure, and no frame makes it raise."""

    clock_offset_ns: int | None = None

    def __init__(self, settings: OdriveSettings) -> None:
        self._settings = settings
        self._generation = settings.generation
        self._axes = [[_Axis(node) for node in side] for side in settings.sides]
        self._by_node = {axis.node: axis for side in self._axes for axis in side}
        self.stats = DriverStats()
        self._attention = parts.Attention()
        self._link_is_up = False
        self._known = False
        self._refusal: str | None = None
        self._introduced, self._version = False, ""
        self._asked_watchdog = 0
        self._asked_version = 0
        self._asked_ns = 0
        self._stage = Stage.REST
        self._wanted = Request.STANDBY
        self._note = "it stands by"
        self._fault: str | None = None
        self._estopped = False
        self._arm_step = 0
        self._stage_ns: int | None = None
        self._last_sent_ns = 0
        self._repeat_ns = 0
        self._speeds = (0.0, 0.0)
        self._foreign = False
        self._events: list[str] = []

    @property
    def state(self) -> DriverState:
        """Where the driver is with its axes."""
        if not self._link_is_up:
            return DriverState.DISCONNECTED
        if self._refusal is not None:
            return DriverState.REFUSED
        if not self._known:
            return DriverState.HANDSHAKE
        if self._estopped or any(axis.error & ESTOP_ERROR[self._generation] for axis in self._by_node.values()):
            return DriverState.ESTOP
        if self._fault is not None or any(axis.error and not self._is_idle_watchdog(axis) for axis in self._all):
            return DriverState.FAULT
        if self._stage is Stage.ARMED:
            return DriverState.ARMED
        if self._stage is Stage.STOPPING or (self._stage is Stage.REST and self._any_closed_loop):
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
                silent = [str(axis.node) for axis in self._all if axis.heard_ns is None]
                if silent:
                    return f"no heartbeat of node {', '.join(silent)}; is it switched on, at this bit rate, at this id?"
                return "asking the nodes for their version"
            case DriverState.ESTOP:
                return "emergency stop; the wheels coast. Remove its cause, then reset"
            case DriverState.FAULT:
                said = [f"node {axis.node}: {self._words(axis)}" for axis in self._all if axis.error]
                return f"{self._fault or '; '.join(said)}; remove the cause, then reset"
            case DriverState.ARMED:
                return "armed"
        return self._note

    @property
    def identity(self) -> Identity | None:
        """What answers as an ODrive; 0.5 does not tell its version."""
        if not self._known or self._refusal is not None:
            return None
        if self._version:
            return Identity("ODrive", self._version, "device")
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
        self._restart("the link was lost", now_ns)
        self._link_is_up = True

    def link_down(self, now_ns: int) -> None:
        """The medium is gone: whatever was agreed is void."""
        self._restart("the link was lost", now_ns)
        self._link_is_up = False

    def request(self, request: Request) -> None:
        """Set what the host wants; ARM only from standing by, and consumed when the axes leave their armed state."""
        if request is self._wanted:
            return
        if request is Request.ARM:
            if self.state not in (DriverState.STANDBY, DriverState.READY):
                self._note = f"not arming: {self.detail}"
                return
            self.stats = replace(self.stats, sessions=self.stats.sessions + 1)
            self._note, self._stage, self._arm_step, self._stage_ns = "arming", Stage.ARMING, 0, None
            self._speeds = (0.0, 0.0)
        elif self._wanted is Request.ARM and self._stage is not Stage.REST:
            self._stop("stopping as asked")
        self._wanted = request

    def receive(self, now_ns: int, frames: Sequence[ReceivedFrame]) -> Readings:
        """Take in received frames and return what they meant; frames that come while the link is down are ignored."""
        wheels: list[WheelSample] = []
        status: list[RobotStatus] = []
        for received in frames if self._link_is_up else ():
            if self._take_parameter(received.frame):
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
                    status.append(self._status(received.t_ns))
                case "Get_Version":
                    self._take_version(decoded.values)
                case "Get_Encoder_Estimates":
                    self._take_estimate(axis, decoded.values, received.t_ns)
                    if all(each.is_new for each in self._all):
                        wheels.append(self._sample(received.t_ns))
        if self._link_is_up:
            self._check_silence(now_ns)
        events, self._events = tuple(self._events), []
        return Readings(wheels=tuple(wheels), status=tuple(status[-1:]), events=events)

    def transmit(self, now_ns: int, command: WheelCommand | None) -> tuple[OutgoingFrame, ...]:
        """Frames due now; to an armed axis nothing but the command, for each frame would feed its watchdog.

        Raises ValueError for a command that is not finite or valid for no time.
        """
        parts.check_command(command)
        if not self._link_is_up:
            return ()
        match self._stage:
            case Stage.REST:
                return self._rest(now_ns)
            case Stage.ARMING:
                return self._arm(now_ns)
            case Stage.STOPPING:
                return self._ramp(now_ns)
        if command is None:
            return ()
        self._speeds = (command.left_rad_s, command.right_rad_s)
        self._last_sent_ns = now_ns
        self._count("commands_sent")
        # Half of its validity may pass on the way.
        return parts.outgoing(now_ns, *self._velocity(self._speeds), life_ns=round(0.5e9 * command.valid_for_s))

    def estop(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Frames that stop every axis in any state; whatever was wanted is dropped, and nothing is commanded again."""
        self._wanted, self._stage, self._estopped = Request.STANDBY, Stage.REST, True
        self._note = "emergency stop sent"
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
        if self._wanted is Request.RESET:
            return self._reset(now_ns)
        if not self._known and self._refusal is None:
            return self._ask_version(now_ns) if not self._introduced else self._ask_watchdog(now_ns)
        if now_ns - self._asked_ns < _ALIVE_PERIOD_NS:
            return ()
        self._asked_ns = now_ns
        asked = protocol.TELEMETRY[self._generation]["Get_Bus_Voltage_Current"].command
        return parts.outgoing(now_ns, *(protocol.ask(axis.node, asked) for axis in self._all))

    def _ask_version(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        if any(axis.heard_ns is None for axis in self._all) or now_ns - self._asked_ns < _VERSION_PERIOD_NS:
            return ()
        self._asked_ns = now_ns
        self._asked_version += 1
        if self._asked_version <= VERSION_TRIES:
            return parts.outgoing(now_ns, *(protocol.ask(axis.node, protocol.GET_VERSION) for axis in self._all))
        if self._generation is Generation.V05:
            # That generation does not know the question.
            self._introduce()
        else:
            self._refusal = 'the nodes do not answer for their version as 0.6 does; write link.firmware = "0.5"'
        return ()

    def _ask_watchdog(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Ask until every axis has said whether its watchdog is on and how long it waits; what it says is compared."""
        if now_ns - self._asked_ns < _VERSION_PERIOD_NS:
            return ()
        self._asked_ns = now_ns
        self._asked_watchdog += 1
        endpoints = self._settings.watchdog_endpoints or ()
        waiting = [axis.node for axis in self._all if axis.watchdog_on is None or axis.watchdog_s is None]
        if self._asked_watchdog > WATCHDOG_TRIES:
            self._refusal = f"node {waiting[0]} does not tell its watchdog; correct link.watchdog_endpoints"
            return ()
        return parts.outgoing(
            now_ns, *(protocol.read_parameter(node, number) for node in waiting for number in endpoints)
        )

    def _take_parameter(self, frame: Frame) -> bool:
        """Whether the frame answers for a watchdog, which is then judged."""
        axis = self._by_node.get(protocol.split(frame.can_id)[0])
        if axis is None or self._settings.watchdog_endpoints is None or not self._introduced:
            return False
        enabled, timeout = self._settings.watchdog_endpoints
        is_on = protocol.parameter(frame, axis.node, enabled, "bool")
        timeout_s = protocol.parameter(frame, axis.node, timeout, "f32")
        if is_on is None and timeout_s is None:
            return False
        axis.watchdog_on = axis.watchdog_on if is_on is None else bool(is_on)
        axis.watchdog_s = axis.watchdog_s if timeout_s is None else float(timeout_s)
        wanted_s = self._settings.watchdog_s
        if axis.watchdog_on is False:
            self._refusal = f"node {axis.node}: its watchdog is off; set axis0.config.enable_watchdog (odrivetool)"
        elif axis.watchdog_s is not None and not abs(axis.watchdog_s - wanted_s) <= _SAME_TIMEOUT_S:
            self._refusal = f"node {axis.node}: its watchdog waits {axis.watchdog_s:g} s; set {wanted_s:g} s there"
        elif not self._known and all(each.watchdog_on and each.watchdog_s is not None for each in self._all):
            self._announce(f", watchdog {wanted_s:g} s")
        return True

    def _reset(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        if not any(axis.error for axis in self._all) and self._repeat_ns and now_ns - self._repeat_ns >= _REPEAT_NS:
            self._fault, self._estopped, self._wanted, self._note = None, False, Request.STANDBY, "it stands by"
            return ()
        if now_ns - self._repeat_ns < 2 * _REPEAT_NS:
            return ()
        self._repeat_ns = now_ns
        return parts.outgoing(now_ns, *self._clear_frames())

    def _arm(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """One step in each tick: clear an idle watchdog's error, mode, zero velocity, closed loop, then zeros."""
        if self._stage_ns is None:
            self._stage_ns = now_ns
        if all(axis.beats_armed >= BEATS_TO_ARM for axis in self._all):
            self._stage, self._note = Stage.ARMED, "armed"
            self._last_sent_ns, self._speeds = now_ns, (0.0, 0.0)
            return parts.outgoing(now_ns, *self._velocity((0.0, 0.0)))
        if now_ns - self._stage_ns > ARMING_TIMEOUT_NS:
            waiting = [str(axis.node) for axis in self._all if axis.beats_armed < BEATS_TO_ARM]
            self._give_up(f"node {', '.join(waiting)} did not go to closed loop; is it calibrated (odrivetool)?")
            return parts.outgoing(now_ns, *self._state_frames(AxisState.IDLE))
        step, self._arm_step = self._arm_step, self._arm_step + 1
        if step == 0 and any(axis.error for axis in self._all):
            return parts.outgoing(now_ns, *self._clear_frames())
        if step <= 1:
            self._arm_step = 2
            mode = {"control_mode": protocol.VELOCITY_CONTROL, "input_mode": protocol.PASSTHROUGH}
            return parts.outgoing(now_ns, *self._each("Set_Controller_Mode", **mode))
        if step == 3:
            for axis in self._all:
                axis.beats_armed = 0
            return parts.outgoing(now_ns, *self._state_frames(AxisState.CLOSED_LOOP))
        return parts.outgoing(now_ns, *self._velocity((0.0, 0.0)))

    def _ramp(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Slow down with the declared deceleration, then let the axes idle until they say that they do."""
        elapsed_ns, self._last_sent_ns = now_ns - self._last_sent_ns, now_ns
        self._speeds = parts.slowed(self._speeds, self._settings.stop_deceleration_rad_s2, elapsed_ns)
        if any(self._speeds):
            return parts.outgoing(now_ns, *self._velocity(self._speeds))
        if not self._any_closed_loop:
            self._stage = Stage.REST
        return parts.outgoing(now_ns, *self._velocity((0.0, 0.0)), *self._state_frames(AxisState.IDLE))

    def _velocity(self, speeds: tuple[float, float]) -> list[Frame]:
        limit = self._settings.vel_limit_turns_s
        frames = []
        for side, direction, speed in zip(self._axes, self._settings.direction, speeds, strict=True):
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
            self._restart(f"node {axis.node} calibrates or moves by itself (state {axis.state})", t_ns)
            self._refusal = f"node {axis.node} is in state {axis.state}: wait until odrivetool has done with it"
            return
        if self._refusal is not None and self._refusal.startswith(f"node {axis.node} is in state"):
            self._refusal = None
        energised = axis.state == AxisState.CLOSED_LOOP and axis.error == 0
        axis.beats_armed = axis.beats_armed + 1 if energised and self._arm_step > 3 else 0
        if self._stage is Stage.ARMING and axis.error and not self._is_idle_watchdog(axis):
            self._lose(f"node {axis.node} did not arm: {self._words(axis)}")
        elif self._stage is Stage.ARMED and not energised:
            what = self._words(axis) if axis.error else f"it left closed loop by itself, for state {axis.state}"
            self._lose(f"node {axis.node}: {what}")
        elif self._stage is Stage.STOPPING and axis.error:
            self._lose(f"node {axis.node}: {self._words(axis)}")

    def _answer_of_another_generation(self, frame: Frame) -> protocol.Decoded | None:
        """What 0.5 never sends: an answer for the version."""
        decoded = protocol.decode(Generation.V06, frame)
        return decoded if decoded is not None and decoded.name == "Get_Version" else None

    def _take_version(self, values: Mapping[str, float]) -> None:
        if self._generation is Generation.V05:
            self._refusal = 'the nodes answer for their version, which 0.5 does not; write link.firmware = "0.6"'
        elif not self._introduced:
            version = ".".join(str(values[f"fw_{part}"]) for part in ("major", "minor", "revision"))
            self._introduce(version)

    def _introduce(self, version: str = "") -> None:
        self._introduced, self._version = True, version
        if self._settings.watchdog_endpoints is None:
            self._announce()

    def _announce(self, watchdog: str = "") -> None:
        self._known, self._note = True, "it stands by"
        nodes = ", ".join(str(axis.node) for axis in self._all)
        version = self._version and f", firmware {self._version}"
        self._events.append(f"nodes {nodes} are there: ODrive {self._settings.firmware}{version}{watchdog}")

    def _take_estimate(self, axis: _Axis, values: Mapping[str, float], t_ns: int) -> None:
        position, speed = float(values["pos_turns"]), float(values["vel_turns_s"])
        if not (math.isfinite(position) and math.isfinite(speed)):
            self._count("implausible_values")
            return
        if axis.pos_turns is not None:
            moved = position - axis.pos_turns
            # A 32-bit float's own steps grow with the distance.
            fastest = 1.5 * self._settings.vel_limit_turns_s * (t_ns - axis.estimated_ns) * 1e-9
            if abs(moved) <= fastest + 0.05 + 2.0**-22 * abs(position):
                axis.moved_turns += moved
            else:
                self._count("implausible_ticks")
        axis.pos_turns, axis.vel_turns_s, axis.estimated_ns, axis.is_new = position, speed, t_ns, True

    def _sample(self, t_ns: int) -> WheelSample:
        per_turn = 2.0 * math.pi / self._settings.gear
        angles, speeds = [], []
        for side, direction in zip(self._axes, self._settings.direction, strict=True):
            # Those estimated earlier are carried on to the newest at their speed.
            turns = [a.moved_turns + a.vel_turns_s * (t_ns - a.estimated_ns) * 1e-9 for a in side]
            angles.append(direction * per_turn * sum(turns) / len(side))
            speeds.append(direction * per_turn * sum(axis.vel_turns_s for axis in side) / len(side))
        for axis in self._all:
            axis.is_new = False
        return WheelSample(t_ns, t_ns, angles[0], angles[1], speeds[0], speeds[1])

    def _check_silence(self, now_ns: int) -> None:
        self._attention.look(now_ns)
        limit_ns = SILENT_BEATS * self._settings.heartbeat_s * 1e9
        for axis in self._all:
            silent_ns = 0 if axis.heard_ns is None else self._attention.silent_ns(axis.heard_ns)
            if silent_ns > limit_ns:
                why = f"node {axis.node} fell silent"
                if self._stage is not Stage.REST:
                    self._lose(f"{why}: no heartbeat for {limit_ns * 1e-9:g} s")
                elif silent_ns > max(2.0 * limit_ns, 5e8):
                    self._restart(why, now_ns)
                    self._events.append(f"{why}: new handshake")
                return

    def _count_unused(self, frame: Frame) -> None:
        node, command = protocol.split(frame.can_id)
        ours = not frame.extended and node in self._by_node
        if ours and command in _HOST_COMMANDS and frame.data:
            self._count("unknown_id")
            if not self._foreign:
                self._foreign = True
                self._events.append(f"another host is on the link: it commands node {node}; disconnect it")
            if self._stage is not Stage.REST and command != 0x02:
                self._lose(f"another host commands node {node}; disconnect it")
        elif ours and len(frame.data) != 8:
            self._count("rejected_length")
        else:
            self._count("unknown_id")

    def _status(self, t_ns: int) -> RobotStatus:
        return parts.status(t_ns, self.state, self._all_in_estop)

    @property
    def _all_in_estop(self) -> bool:
        return all(axis.error & ESTOP_ERROR[self._generation] for axis in self._all)

    def _stop(self, why: str) -> None:
        """Ramp down and idle; from before the closed loop, idle at once."""
        self._note = why
        self._stage, self._stage_ns = Stage.STOPPING, None

    def _give_up(self, why: str) -> None:
        self._wanted, self._stage, self._stage_ns, self._note = Request.STANDBY, Stage.REST, None, why
        # Idle is due at once for all that are still energised.
        self._repeat_ns = 0

    def _lose(self, why: str) -> None:
        """One axis is lost: zero and idle for all, latched."""
        self._give_up(f"disarmed: {why}")
        self._fault = why
        self._events.append(f"disarmed: {why}")

    def _restart(self, why: str, now_ns: int) -> None:
        if self._wanted is Request.ARM:
            self._note = f"disarmed: {why}"
        self._wanted, self._stage, self._stage_ns = Request.STANDBY, Stage.REST, None
        self._known, self._refusal, self._fault, self._foreign = False, None, None, False
        self._introduced, self._version, self._asked_watchdog = False, "", 0
        self._asked_version, self._asked_ns, self._repeat_ns, self._arm_step = 0, now_ns - _VERSION_PERIOD_NS, 0, 0
        for axis in self._all:
            axis.heard_ns = axis.pos_turns = axis.watchdog_on = axis.watchdog_s = None
            axis.state, axis.error, axis.beats_armed, axis.is_new = AxisState.UNDEFINED, 0, 0, False

    def _words(self, axis: _Axis) -> str:
        return error_words(self._generation, axis.error)

    def _count(self, name: str) -> None:
        self.stats = replace(self.stats, **{name: getattr(self.stats, name) + 1})


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
