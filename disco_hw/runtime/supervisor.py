"""Walks the table of states: turns what is seen and what the user asks into what the robot is asked and allowed."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import dataclass

import msgspec

from disco_hw.runtime import ARMING, PROBLEM, C, State, Transition, connection, next_transition
from drivers.types import DriverState, LinkState, Request
from firmware_protocol.status_codes import BY_ITSELF, THEN_RESET, THEN_RESTART

FIND_HEADING = "the pose sensor measures none: drive one metre straight ahead by hand, on the page, to find it"
AFTER_A_JUMP = "check that the robot is where the page shows it, then start again"
# Chosen: nearer is what the plans of a drive without trouble leave.
OFF_END_M = 0.1
_IDLE = frozenset({DriverState.STANDBY, DriverState.READY})
_MAY_MOVE = frozenset({DriverState.ARMING, DriverState.ARMED, DriverState.STOPPING})
_ROBOT_HAS_FAULT = C.ROBOT_ESTOP | C.ROBOT_FAULT | C.ROBOT_REFUSED
_MOVABLE = C.TELEMETRY_FRESH | C.ROBOT_ARMED


class UserRequest(enum.Enum):
    """Requests that an operator can make of the daemon."""

    ARM = "arm"
    ARM_UNRECORDED = "arm_unrecorded"
    START = "start"
    STOP = "stop"
    DISARM = "disarm"
    ESTOP = "estop"
    RESET = "reset"


_TOWARDS_MOTION = frozenset({UserRequest.ARM, UserRequest.ARM_UNRECORDED, UserRequest.START, UserRequest.RESET})


@dataclass(frozen=True, slots=True)
class SupervisorSettings:
    """Ages, times and bounds of the supervisor; what motion requires, unless it is by hand.

    `heading_required`: the drive goes by poses. Then it stops where the heading is not known, the pose has jumped or
    sources contradict one another. With the wheels off the ground poses disagree with them, and are not needed.
    """

    telemetry_zero_s: float
    telemetry_disarm_s: float
    pose_required: bool
    heading_required: bool = True
    still_rad_s: float = 0.05
    arming_timeout_s: float = 2.0
    reset_timeout_s: float = 3.0


class Inputs(msgspec.Struct, frozen=True, gc=False):
    """Inputs of the supervisor in one tick.

    `telemetry_age_s` is the age of the newest wheel sample, None before the first; `wheel_speed_rad_s` the larger
    magnitude of its two speeds. `link_error` is the link's newest error, with its remedy. `preflight_errors`
    are sentences for a person and hold for as long as they are given. `task_finished`: nothing of the task is left to
    drive, and the robot is `off_end_m` from its end. `recording_fault`: why nothing is recorded although it should be,
    which keeps the robot from being armed unless that is asked for. `heading_missing`: positions come, and which way
    the robot faces is not known; `measures_no_heading`: because they have no heading.
    `pose_refusal`: why poses that come are refused, in words, else empty.
    `by_hand`: a person drives, who sees that; nobody follows the task. `poses_contradict`: which two pose sources do,
    in words, else empty. `pose_jump`: how the estimate jumped in the tick before, in words, else empty. `fence_fault`:
    why the fence lets no task go on, else empty.
    """

    link_state: LinkState
    link_generation: int
    driver_state: DriverState
    driver_detail: str
    telemetry_age_s: float | None
    wheel_speed_rad_s: float
    pose_ok: bool
    link_error: str | None = None
    preflight_errors: tuple[str, ...] = ()
    requests: tuple[UserRequest, ...] = ()
    task_finished: bool = False
    off_end_m: float = 0.0
    recording_fault: str = ""
    heading_missing: bool = False
    measures_no_heading: bool = False
    pose_refusal: str = ""
    by_hand: bool = False
    poses_contradict: str = ""
    pose_jump: str = ""
    fence_fault: str = ""


class Reply(msgspec.Struct, frozen=True, gc=False):
    """The answer to one request, in words; accepted means begun, `Output.state` shows when it is done."""

    request: UserRequest
    accepted: bool
    text: str


class Output(msgspec.Struct, frozen=True, gc=False):
    """Decision of the supervisor for one tick.

    `driver_request`: to be handed to the driver; None leaves the last one. `motion_allowed`: the plan may drive the
    wheels. `zero_only`: the command ramps to zero and stays there. Neither: no wheel command is sent. `send_estop`:
    the driver's e-stop frames are due. `estop`: to be shown as e-stop.
    """

    state: State
    detail: str
    driver_request: Request | None
    motion_allowed: bool
    zero_only: bool
    running: bool
    send_estop: bool
    estop: bool
    events: tuple[str, ...]
    replies: tuple[Reply, ...]


@dataclass(slots=True)
class _Pending:
    """A request to the robot that is under way."""

    since_ns: int
    sent: bool = False
    begun: bool = False


class Supervisor:
    """The daemon's state and the only place where motion is allowed; it has no clock, thread or I/O.

    Arming and starting happen on a user's request only: a link loss, a fault or a restart drops what was pending.
    """

    def __init__(self, settings: SupervisorSettings) -> None:
        self._settings = settings
        self._state = State.DISCONNECTED
        self._generation: int | None = None
        self._running = False
        self._by_hand = False
        self._start_pending = False
        self._just_started = False
        self._arming: _Pending | None = None
        self._resetting: _Pending | None = None
        self._estop_requested = False
        self._disarm_requested = False
        self._fault_reason = ""
        self._stop_reason = ""
        self._events: list[str] = []

    @property
    def state(self) -> State:
        """The state after the last step."""
        return self._state

    def step(self, now_ns: int, inputs: Inputs) -> Output:
        """Take in one tick's inputs, make at most one transition, and return what holds until the next step."""
        self._events = []
        self._disarm_requested = False
        seen = self._observe(inputs)
        estop_now = UserRequest.ESTOP in inputs.requests
        replies = tuple(self._reply_to(now_ns, request, estop_now, inputs, seen) for request in inputs.requests)
        self._drop_what_failed(now_ns, inputs, seen)
        before = self._state
        row = next_transition(before, seen | self._requested_conditions())
        if row is not None:
            self._enter(row, inputs)
        if self._state is State.FAULT and PROBLEM & (seen | self._requested_conditions()):
            self._fault_reason = self._fault_text(inputs)
        if row is not None:
            text = f"{row.reason}: {self._fault_reason}" if row.target is State.FAULT else _reason(row, inputs)
            self._events.append(f"{before.value} -> {row.target.value}: {text}")
        self._monitor_task(inputs)
        return self._output(inputs, seen, replies)

    def _observe(self, inputs: Inputs) -> int:
        """Return the conditions that the inputs alone decide."""
        age_s = inputs.telemetry_age_s
        link_up = inputs.link_state is LinkState.UP
        seen = _CONDITIONS[inputs.driver_state] | _union(
            (
                (C.LINK_UP, link_up),
                (C.LINK_RENEWED, link_up and inputs.link_generation != self._generation),
                # Written so that an age or a speed that is not a number counts as no telemetry and as moving.
                (C.TELEMETRY_FRESH, age_s is not None and age_s <= self._settings.telemetry_zero_s),
                (C.TELEMETRY_LOST, age_s is None or not age_s <= self._settings.telemetry_disarm_s),
                (C.WHEELS_STATIONARY, inputs.wheel_speed_rad_s < self._settings.still_rad_s),
                (C.PREFLIGHT_ERROR, bool(inputs.preflight_errors)),
            )
        )
        if link_up:
            self._generation = inputs.link_generation
        return seen

    def _requested_conditions(self) -> int:
        """Return the conditions that requests have set."""
        return _union(
            (
                (C.ARM_PENDING, self._arming is not None),
                (C.DISARM_REQUESTED, self._disarm_requested),
                (C.ESTOP_REQUESTED, self._estop_requested),
                (C.RESET_PENDING, self._resetting is not None),
            )
        )

    def _reply_to(self, now_ns: int, request: UserRequest, estop_now: bool, inputs: Inputs, seen: int) -> Reply:
        """Take up or refuse one request, in words; an e-stop beats all that could lead to motion in the same tick."""
        if estop_now and request in _TOWARDS_MOTION:
            return Reply(request, False, "an e-stop was requested at the same time")
        refusal: str | None = None
        text = ""
        match request:
            case UserRequest.ESTOP:
                self._estop_requested, self._resetting = True, None
                self._drop_pending("e-stop")
                text = "e-stop" if seen & C.LINK_UP else "e-stop requested; it is sent as soon as the link is up"
            case UserRequest.DISARM:
                self._disarm_requested = True
                self._drop_pending("disarm")
                text = "disarming" if self._state is State.ARMED else "not armed"
            case UserRequest.STOP:
                text = "stopping the task" if self._running else "no task is running"
                self._running = self._start_pending = False
            case UserRequest.ARM | UserRequest.ARM_UNRECORDED:
                refusal = self._why_not_arm(inputs, seen)
                if refusal is None and request is UserRequest.ARM and self._state is not State.ARMED:
                    refusal = inputs.recording_fault or None
                if refusal is None and self._state is State.READY and self._arming is None:
                    self._arming = _Pending(now_ns)
                text = "already armed" if self._state is State.ARMED else "arming"
            case UserRequest.START:
                refusal = self._why_not_start(inputs, seen)
                if refusal is None and not (self._running or self._start_pending):
                    self._start_pending, self._by_hand = True, inputs.by_hand
                text = "starting" if self._state is State.ARMED else "starting once armed"
            case UserRequest.RESET:
                refusal = self._why_not_reset(inputs, seen)
                if refusal is None:
                    self._estop_requested, self._resetting = False, self._resetting or _Pending(now_ns)
                text = "resetting"
        return Reply(request, refusal is None, text if refusal is None else refusal)

    def _why_not_arm(self, inputs: Inputs, seen: int) -> str | None:
        match self._state:
            case State.ARMED:
                return None
            case State.READY if not seen & C.TELEMETRY_FRESH:
                return "no recent wheel data from the robot; check the cable and the encoders"
            case State.READY if not seen & C.WHEELS_STATIONARY:
                return "the wheels are turning; wait until they stand still"
            case State.READY:
                return None
            case State.STOPPING:
                return "the robot is still stopping; try again when its state is READY"
            case State.FAULT:
                return self._fault_and_hint("correct the fault, then reset")
            case State.DISCONNECTED | State.HANDSHAKE:
                return f"not connected to the robot: {self._fault_text(inputs)}"

    def _why_not_start(self, inputs: Inputs, seen: int) -> str | None:
        if self._state is not State.ARMED and self._arming is None:
            return "the robot is not armed; arm it first"
        if self._state is State.ARMED and not seen & C.TELEMETRY_FRESH:
            return "no recent wheel data from the robot; check the cable and the encoders"
        return self._pose_fault(inputs)

    def _pose_fault(self, inputs: Inputs) -> str | None:
        """Return why the pose does not allow the task to be followed; None if it does, or while driven by hand."""
        if inputs.by_hand:
            return None
        if inputs.pose_jump and self._settings.heading_required:
            return f"{inputs.pose_jump}; {AFTER_A_JUMP}"
        if inputs.poses_contradict and self._settings.heading_required:
            return f"{inputs.poses_contradict}; find the source that is wrong and remove it from [pose] in robot.toml"
        if self._settings.heading_required and inputs.heading_missing:
            return _heading_fault(inputs)
        if self._settings.pose_required and not inputs.pose_ok:
            return f"no valid pose; {inputs.pose_refusal or 'check the pose sensor'}"
        return inputs.fence_fault or None

    def _why_not_reset(self, inputs: Inputs, seen: int) -> str | None:
        if self._state is not State.FAULT:
            return f"nothing to reset in state {self._state.value}"
        if inputs.preflight_errors:
            return f"{inputs.preflight_errors[0]}; correct it and restart the daemon"
        if self._estop_requested and not seen & C.ROBOT_ESTOP:
            return "the robot has not confirmed the e-stop yet; wait, then reset again"
        return None

    def _drop_what_failed(self, now_ns: int, inputs: Inputs, seen: int) -> None:
        """End requests to the robot that it refused or did not answer in time."""
        arming, resetting = self._arming, self._resetting
        if arming is not None:
            arming.begun = arming.begun or inputs.driver_state is DriverState.ARMING
            if arming.begun and seen & C.ROBOT_IDLE:
                self._drop_pending(f"the robot did not arm: {inputs.driver_detail}")
            elif now_ns - arming.since_ns > self._settings.arming_timeout_s * 1e9:
                self._drop_pending(
                    f"the robot did not arm within {self._settings.arming_timeout_s:g} s: {inputs.driver_detail}"
                )
        if resetting is not None and now_ns - resetting.since_ns > self._settings.reset_timeout_s * 1e9:
            self._resetting = None
            self._events.append(
                f"the robot did not reset within {self._settings.reset_timeout_s:g} s: {inputs.driver_detail}"
            )

    def _drop_pending(self, why: str) -> None:
        if self._arming is not None:
            self._events.append(f"arm request dropped: {why}")
        if self._start_pending:
            self._events.append(f"start request dropped: {why}")
        self._arming, self._start_pending = None, False

    def _enter(self, row: Transition, inputs: Inputs) -> None:
        self._state = row.target
        if row.target is State.STOPPING:
            self._stop_reason = _reason(row, inputs)
        if row.target is State.ARMED:
            self._arming = None
        else:
            self._drop_pending(row.reason)
            self._running = False
        self._resetting = None

    def _monitor_task(self, inputs: Inputs) -> None:
        """Start the task once armed, and stop it without a pose and at its end."""
        just_started, self._just_started = self._just_started, False
        if self._state is not State.ARMED:
            return
        pose_fault = self._pose_fault(inputs)
        if self._start_pending and inputs.by_hand is not self._by_hand:
            self._drop_pending("control changed between manual driving and the task")
        elif self._start_pending and pose_fault is not None:
            self._drop_pending(pose_fault)
        elif self._start_pending:
            self._start_pending, self._running, self._just_started = False, True, True
            self._events.append("task started")
        elif self._running and pose_fault is not None:
            self._running = False
            self._events.append(f"task stopped: {pose_fault}")
        elif self._running and inputs.by_hand is not self._by_hand:
            # Whoever started one has not asked for the other.
            self._running = False
            self._events.append(
                ("manual driving stopped: start again to follow the task")
                if self._by_hand
                else ("task stopped: manual driving takes over")
            )
        elif self._running and inputs.task_finished:
            self._running = False
            is_off = inputs.off_end_m > OFF_END_M
            if just_started:
                off = f", {inputs.off_end_m:.2f} m off" if is_off else ""
                self._events.append(
                    f"task stopped: nothing was driven, as the nearest place of the path is its end{off}; put the "
                    "robot at the first way-point and start again"
                )
            else:
                off = f", {inputs.off_end_m:.2f} m beside it" if is_off else ""
                self._events.append(f"task stopped: the end of the path is reached{off}")

    def _fault_and_hint(self, hint: str) -> str:
        """Return the trouble with its own remedy if it names one, else with this one.

        This host's reset always comes last.
        """
        if self._fault_reason.endswith(THEN_RESET):
            return self._fault_reason
        if self._fault_reason.endswith((BY_ITSELF, THEN_RESTART)):
            return f"{self._fault_reason}, {THEN_RESET}"
        return f"{self._fault_reason}; {hint}"

    def _fault_text(self, inputs: Inputs) -> str:
        """Return what a person should know of the present state."""
        if inputs.link_state is LinkState.UP and self._state is State.FAULT:
            if inputs.preflight_errors:
                return "; ".join(inputs.preflight_errors)
            if self._estop_requested:
                return "e-stop requested by the operator"
        age_s = inputs.telemetry_age_s
        silent = age_s is None or not age_s <= self._settings.telemetry_disarm_s
        if (
            self._state is State.HANDSHAKE
            and inputs.link_state is LinkState.UP
            and inputs.driver_state in _IDLE
            and silent
        ):
            return "the robot sends no wheel data; check the encoders and the controller"
        return connection(inputs.link_state, inputs.link_error, inputs.driver_state, inputs.driver_detail)

    def _detail(self, inputs: Inputs, seen: int) -> str:
        match self._state:
            case State.READY:
                if self._arming is None and self._settings.heading_required and inputs.heading_missing:
                    return _heading_fault(inputs)
                return ARMING if self._arming is not None else "ready to be armed"
            case State.ARMED if not seen & C.TELEMETRY_FRESH:
                return "no recent wheel data from the robot: commanding zero speed"
            case State.ARMED:
                return "running the task" if self._running else "armed, commanding zero speed"
            case State.STOPPING:
                return f"{self._stop_reason}; waiting until the robot is disarmed and its wheels have stopped"
            case State.FAULT:
                return self._fault_and_hint("correct it, then reset")
            case State.DISCONNECTED | State.HANDSHAKE:
                return self._fault_text(inputs)

    def _output(self, inputs: Inputs, seen: int, replies: tuple[Reply, ...]) -> Output:
        armed = self._state is State.ARMED
        may_move = seen & _MOVABLE == _MOVABLE
        motion_allowed = armed and self._running and may_move
        stopping = self._state in (State.STOPPING, State.FAULT)
        # With telemetry lost nothing is sent any more: the robot's own watchdog then stops it by a second way.
        braking = stopping and seen & (C.ROBOT_ARMED | C.TELEMETRY_LOST) == C.ROBOT_ARMED
        return Output(
            state=self._state,
            detail=self._detail(inputs, seen),
            driver_request=self._driver_request(seen),
            motion_allowed=motion_allowed,
            zero_only=(armed and not motion_allowed) or braking,
            running=self._running,
            send_estop=self._estop_requested and seen & (C.LINK_UP | C.ROBOT_ESTOP) == C.LINK_UP,
            estop=self._estop_requested or bool(seen & C.ROBOT_ESTOP),
            events=tuple(self._events),
            replies=replies,
        )

    def _driver_request(self, seen: int) -> Request | None:
        """Return what to ask of the driver; ARM and RESET once each, as the driver holds or consumes them."""
        if self._state is State.ARMED:
            return None
        if self._state is State.READY:
            return _first_request(self._arming, Request.ARM) if self._arming is not None else Request.READY
        if self._state is State.FAULT and self._resetting is not None and seen & _ROBOT_HAS_FAULT:
            return _first_request(self._resetting, Request.RESET)
        return Request.STANDBY


def _heading_fault(inputs: Inputs) -> str:
    """Return how the heading that is missing is found: by driving, or by poses that fail to come."""
    if inputs.measures_no_heading:
        return f"heading not known; {FIND_HEADING}"
    return "heading too uncertain; wait for poses with a heading, then start again"


def _reason(row: Transition, inputs: Inputs) -> str:
    """Return the row's reason; where the robot acted first, with what the driver knows of its reason."""
    return f"{row.reason}: {inputs.driver_detail}" if C.ROBOT_ARMED & row.blocked_by else row.reason


def _first_request(pending: _Pending, request: Request) -> Request | None:
    """Return the request the first time, None from then on."""
    if pending.sent:
        return None
    pending.sent = True
    return request


def _union(flags: Iterable[tuple[int, bool]]) -> int:
    return sum([flag for flag, holds in flags if holds])


def _condition_of(robot: DriverState) -> int:
    """Return the conditions that the driver's state alone decides."""
    return _union(
        (
            (C.ROBOT_TALKS, robot in _IDLE | _MAY_MOVE),
            (C.ROBOT_IDLE, robot in _IDLE),
            (C.ROBOT_ARMED, robot is DriverState.ARMED),
            (C.ROBOT_MAY_MOVE, robot in _MAY_MOVE),
            (C.ROBOT_REFUSED, robot is DriverState.REFUSED),
            (C.ROBOT_FAULT, robot is DriverState.FAULT),
            (C.ROBOT_ESTOP, robot is DriverState.ESTOP),
        )
    )


_CONDITIONS = {robot: _condition_of(robot) for robot in DriverState}
