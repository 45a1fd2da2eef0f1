"""The guided first drive as steps that wait for the operator: what is asked of the wheels, tick by tick, and its pilot.

The pilot runs a procedure under a deadman held by a person, and takes the keys they answer with. All of it is pure.

A step is a generator: it yields what it wants of the tick and gets what was seen in it, or a person's answer. A step
that needs the deadman held begins again when it was let go too early.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from disco_hw.config import Robot
from disco_hw.drive import ManualInput, ManualSource, RobotView
from disco_hw.drive.hand_pilot import Deadman
from disco_hw.runtime import State
from disco_hw.runtime.core import CoreTick, PilotTick
from disco_hw.runtime.pipeline import Manual, Motion, Silent, Source
from disco_hw.runtime.supervisor import Reply, UserRequest
from drivers.types import PoseSample, WheelSample

Wheels = tuple[float, float]

SPEED_SHARE = 0.1
"""Of the robot's largest wheel speed: what is driven at."""
MOST_SHARE = 0.3
"""Of it: the largest command, for wheels that need so much before they turn at all."""
RUNAWAY_SHARE = 0.25
"""Of it: a wheel that is measured faster has got out of hand."""
SIDES = ("left", "right")
# Chosen: a controller holds its slowest speed only roughly.
_ABOVE_SLOWEST = 1.2
# Chosen: slow enough to let go in time if a wheel runs away.
_RAMP_S = 6.0
# Chosen: an operator sees it, and it is far above play of the gears.
_MOVED_RAD = 0.4
# Chosen: longer than wheels take to stop from the procedure's speed.
_REST_S = 1.0
# Chosen: longer than the turns that are asked for take; then the step ends by itself.
_TURNS_LIMIT_S = 90.0
# Chosen: the speed is steady by then.
_BEFORE_SILENCE_S = 1.5
# Chosen: above the longest watchdog of any driver and the ramp that follows it.
_SILENCE_S = 2.5
# Shorter than _SILENCE_S: an operator who lets go after it has still seen the watchdog.
_LONG_ENOUGH_S = 1.5
SLOWING = 0.8
"""A wheel is slowing down below this share of its speed."""
# Chosen: longer than a reset and its confirmation take.
_RESET_S = 3.0
# Fit into the free 1.5 m that the operator is asked for; longer shows slip and directions better.
_STRAIGHT_M = 0.5
_SHORT_M = 0.25


@dataclass(frozen=True, slots=True)
class DriveWheels:
    """Drive at these wheel speeds (rad/s, left and right) while the deadman is held; `todo`: for the person."""

    wheels: Wheels
    todo: str


@dataclass(frozen=True, slots=True)
class Silence:
    """Send nothing at all, as a host that has died."""

    todo: str


@dataclass(frozen=True, slots=True)
class Prompt:
    """Stand, and wait for one of the keys."""

    prompt: str
    keys: str


@dataclass(frozen=True, slots=True)
class Reset:
    """Let go, and clear the fault that a silence has left."""

    todo: str


Action = DriveWheels | Silence | Prompt | Reset


@dataclass(frozen=True, slots=True)
class Seen:
    """Observation of one tick: whether the wheels were driven in it, what was commanded (rad/s), and what came in.

    `fault`: the robot has one; `silent`: nothing was sent; `held`: the person held the deadman.
    """

    now_ns: int
    driving: bool
    commanded: Wheels | None
    wheels: tuple[WheelSample, ...] = ()
    poses: tuple[PoseSample, ...] = ()
    fault: bool = False
    silent: bool = False
    held: bool = True


Steps = Generator[Action, Any, Any]


@dataclass
class Track:
    """One stretch of driving: commands (t_ns, left, right), wheel samples and poses as they came."""

    commands: list[tuple[int, float, float]] = field(default_factory=list)
    wheels: list[WheelSample] = field(default_factory=list)
    poses: list[PoseSample] = field(default_factory=list)
    silent_ns: int | None = None
    """When the last command before a silence was sent."""
    ended_ns: int | None = None
    """When frames were sent again, because the robot had said that it stops by itself or the person had let go."""
    let_go: bool = False
    """Whether it was the person."""

    def add(self, seen: Seen) -> None:
        """Take in a tick."""
        if seen.commanded is not None:
            self.commands.append((seen.now_ns, *seen.commanded))
        self.wheels += seen.wheels
        self.poses += seen.poses

    def turned(self) -> Wheels:
        """Return the angles (rad) by which the wheels have turned since the track began."""
        if not self.wheels:
            return 0.0, 0.0
        first, last = self.wheels[0], self.wheels[-1]
        return last.left_angle_rad - first.left_angle_rad, last.right_angle_rad - first.right_angle_rad

    def fastest(self) -> float:
        """Return the faster wheel of the newest sample, without its sign (rad/s)."""
        if not self.wheels:
            return 0.0
        return max(abs(self.wheels[-1].left_speed_rad_s), abs(self.wheels[-1].right_speed_rad_s))


@dataclass(frozen=True)
class SideSeen:
    """One side was asked to turn forward: what the person saw ("lf", "lb", "rf", "rb", "" for nothing), the track."""

    seen: str
    track: Track
    ran_away: bool


SAW = {"1": "lf", "2": "lb", "3": "rf", "4": "rb", "0": ""}


def speed_of(robot: Robot, slowest_rad_s: float) -> float:
    """Return a tenth of the largest wheel speed, or a little above the slowest that the controller holds (rad/s)."""
    return max(SPEED_SHARE * robot.max_wheel_speed_rad_s, _ABOVE_SLOWEST * slowest_rad_s)


def sides(robot: Robot, _slowest_rad_s: float = 0.0) -> Steps:
    """Wheels up, each side forward alone: which one turns, which way, and whose encoder counts how.

    Returns a SideSeen each, left before right.
    """
    top = robot.max_wheel_speed_rad_s
    found = []
    for side in (0, 1):
        track, ran_away = yield from _ramp(side, top)
        key = yield Prompt(
            f"the {SIDES[side]} side was commanded forward. What turned? 1 left forward, 2 left backward, 3 right "
            "forward, 4 right backward, 0 nothing",
            "12340",
        )
        found.append(SideSeen(SAW[key], track, ran_away))
    return found


def _ramp(side: int, top_rad_s: float) -> Steps:
    """Speed one side up until a wheel has moved; its track, with the stop, and whether a wheel ran away."""
    todo = f"hold: the {SIDES[side]} side speeds up slowly"
    while True:
        track, start_ns, over = Track(), 0, False
        while not over:
            elapsed_s = (track.commands[-1][0] - start_ns) * 1e-9 if track.commands else 0.0
            speed = top_rad_s * MOST_SHARE * min(1.0, elapsed_s / _RAMP_S)
            seen: Seen = yield DriveWheels((speed, 0.0) if side == 0 else (0.0, speed), todo)
            if not seen.driving and track.commands:
                break
            if seen.driving:
                start_ns = start_ns or seen.now_ns
                track.add(seen)
                over = elapsed_s >= _RAMP_S or _moved(track, top_rad_s)
        ran_away = track.fastest() > RUNAWAY_SHARE * top_rad_s
        if over or max(map(abs, track.turned())) > 0.25 * _MOVED_RAD:
            seen = yield from _rest(track, _REST_S, "hold: it stops")
            yield from _clear(seen)
            return track, ran_away


def _moved(track: Track, top_rad_s: float) -> bool:
    far = max(map(abs, track.turned())) > _MOVED_RAD
    return (far and track.fastest() >= SPEED_SHARE * top_rad_s) or track.fastest() > RUNAWAY_SHARE * top_rad_s


def _rest(track: Track, seconds: float, todo: str) -> Steps:
    """Hold zero for so long, recorded; a deadman that is let go here is as good. Returns the last tick."""
    end_ns = 0
    while True:
        seen: Seen = yield DriveWheels((0.0, 0.0), todo)
        end_ns = end_ns or seen.now_ns + round(seconds * 1e9)
        track.add(seen)
        if seen.now_ns >= end_ns:
            return seen


@dataclass(frozen=True)
class TurnsSeen:
    """One turn of either side, as the person judged it, and the silence that the watchdog had to end."""

    turns: tuple[Track, Track]
    watchdog: Track


def turns(robot: Robot, slowest_rad_s: float = 0.0) -> Steps:
    """Measure, with the wheels up, ticks a turn by letting go after exactly one turn; then the watchdog.

    Returns a TurnsSeen.
    """
    speed = speed_of(robot, slowest_rad_s)
    tracks = []
    for side in (0, 1):
        wheels = (speed, 0.0) if side == 0 else (0.0, speed)
        todo = f"mark the {SIDES[side]} wheel; hold, and let go when it has made exactly one turn"
        while True:
            track = yield from _until_let_go(wheels, todo)
            key = yield Prompt(f"was that one turn of the {SIDES[side]} wheel? y yes, n again", "yn")
            if key == "y":
                break
        tracks.append(track)
    watchdog = yield from _watchdog((speed, speed))
    return TurnsSeen((tracks[0], tracks[1]), watchdog)


def _until_let_go(wheels: Wheels, todo: str) -> Steps:
    track = Track()
    while True:
        seen: Seen = yield DriveWheels(wheels, todo)
        if seen.driving:
            track.add(seen)
            if (seen.now_ns - track.commands[0][0]) * 1e-9 > _TURNS_LIMIT_S:
                return track
        elif track.commands:
            return track


def _watchdog(wheels: Wheels) -> Steps:
    """Turn, then fall silent; the track says whether the robot stopped by itself."""
    while True:
        track = Track()
        while not track.commands or (track.commands[-1][0] - track.commands[0][0]) * 1e-9 < _BEFORE_SILENCE_S:
            seen: Seen = yield DriveWheels(
                wheels, "hold: both sides turn, then this computer stops sending for a moment"
            )
            if not seen.driving and track.commands:
                break
            if seen.driving:
                track.add(seen)
        else:
            track.silent_ns = seen.now_ns
            while (seen.now_ns - track.silent_ns) * 1e-9 < _SILENCE_S:
                seen = yield Silence("hold: the robot must stop by itself now")
                if not (seen.silent or track.ended_ns):
                    track.ended_ns, track.let_go = seen.now_ns, not seen.held
                    if not seen.held and (seen.now_ns - track.silent_ns) * 1e-9 < _LONG_ENOUGH_S:
                        break
                track.wheels += seen.wheels
            else:
                yield from _clear(seen)
                return track


def _clear(seen: Seen) -> Steps:
    """Have a fault cleared that was brought about on purpose."""
    begun_ns = seen.now_ns
    while seen.fault and (seen.now_ns - begun_ns) * 1e-9 < _RESET_S:
        seen = yield Reset("let go: the controller reports the test as a fault, which is then cleared")


@dataclass(frozen=True)
class FloorSeen:
    """The drive on the floor: straight, half a turn left, half a turn right, a quarter left, straight again."""

    straight: Track
    left: Track
    right: Track
    straight_again: Track


def floor(robot: Robot, slowest_rad_s: float = 0.0) -> Steps:
    """On the floor, half a metre straight, half a turn each way, a quarter, a quarter of a metre; a FloorSeen.

    Each ends where the wheels say so, or after half as long again as it should take.
    """
    speed = speed_of(robot, slowest_rad_s)
    ahead, left, right = (speed, speed), (-speed, speed), (speed, -speed)
    straight = yield from _leg(robot, ahead, _STRAIGHT_M, "half a metre straight on")
    turned_left = yield from _leg(robot, left, 0.5 * math.pi * robot.axial_distance_m, "half a turn to the left")
    turned_right = yield from _leg(robot, right, 0.5 * math.pi * robot.axial_distance_m, "half a turn to the right")
    yield from _leg(robot, left, 0.25 * math.pi * robot.axial_distance_m, "a quarter turn to the left")
    again = yield from _leg(robot, ahead, _SHORT_M, "a quarter of a metre straight on")
    return FloorSeen(straight, turned_left, turned_right, again)


def _leg(robot: Robot, wheels: Wheels, travel_m: float, what: str) -> Steps:
    """Drive both wheels at these speeds until they have travelled `travel_m`, with a rest before and after.

    Let go on the way, it goes on from there with what is left.
    """
    limit_s = 1.5 * travel_m / (max(wheels) * robot.wheel_radius_m)
    track, driven_ns, last_ns = Track(), 0, 0
    while not track.commands or (track.commands[-1][0] - track.commands[0][0]) * 1e-9 < _REST_S:
        seen: Seen = yield DriveWheels((0.0, 0.0), f"hold: {what}")
        if seen.driving:
            track.add(seen)
    while driven_ns * 1e-9 < limit_s:
        left, right = track.turned()
        if 0.5 * (abs(left) + abs(right)) * robot.wheel_radius_m >= travel_m:
            break
        seen = yield DriveWheels(wheels, f"hold: {what}")
        driven_ns += seen.now_ns - last_ns if seen.driving and last_ns else 0
        last_ns = seen.now_ns
        track.add(seen)
    yield from _rest(track, _REST_S, f"hold: {what}, done")
    return track


class Procedure:
    """Runner of steps, which `see` moves on and `answer` hands a key; `result` is what the steps returned."""

    def __init__(self, steps: Steps) -> None:
        self._steps = steps
        self.action: Action | None = next(steps)
        """Action that is due now; None when all is done."""
        self.result: Any = None

    def see(self, seen: Seen) -> None:
        """Hand on what the tick saw; a question waits for its answer instead."""
        if self.action is not None and not isinstance(self.action, Prompt):
            self._send(seen)

    def answer(self, key: str) -> bool:
        """Answer the question that waits; whether this key is one of its answers."""
        if not isinstance(self.action, Prompt) or key not in self.action.keys:
            return False
        self._send(key)
        return True

    def _send(self, value: Seen | str) -> None:
        try:
            self.action = self._steps.send(value)
        except StopIteration as end:
            self.action, self.result = None, end.value


# Chosen: a fault that the procedure clears by itself lasts for less.
_FAULT_NS = 1_000_000_000


class CommissionPilot:
    """Drives as the procedure says while the deadman of `source` is held; satisfies `disco_hw.runtime.core.Pilot`.

    `keys`: those typed since it was asked last, for the procedure's questions. `is_ignored`: whether a key is held that
    does not count, which the person is told once.
    """

    # This drive is there to find the wiring, and whether the poses are right.
    needs_pose, finds_wiring = False, True

    def __init__(
        self,
        procedure: Procedure,
        source: ManualSource,
        keys: Callable[[], str],
        is_ignored: Callable[[], bool] = lambda: False,
    ) -> None:
        self.procedure = procedure
        self._source = source
        self._keys = keys
        self._is_ignored = is_ignored
        self._was_ignored = False
        self._deadman = Deadman()
        self._driving = self._held = self._was_ready = False
        self._last_prompt = ""
        self._messages: list[str] = []
        self._fault_ns: int | None = None
        self.fault_text: str | None = None
        """The fault that ended the drive, in words."""

    @property
    def done(self) -> bool:
        """Whether the procedure is over, or the person gave up."""
        return self.procedure.action is None or self._source.ended is not None or self.fault_text is not None

    def step(self, now_ns: int, last: CoreTick | None) -> PilotTick:
        """Hear the person, and want what the procedure wants."""
        state = State.DISCONNECTED if last is None else last.output.state
        held = self._source.poll(now_ns, RobotView(state, self._driving))
        for key in self._keys():
            self.procedure.answer(key)
        action = self.procedure.action
        newest, self._held = held, held is not None and held.deadman
        if held is not None:
            left, right = action.wheels if isinstance(action, DriveWheels) else (0.0, 0.0)
            newest = ManualInput(held.t_ns, left, right, held.deadman and isinstance(action, DriveWheels | Silence))
        verdict = self._deadman.step(now_ns, newest, state)
        motion: Motion = verdict.motion
        if isinstance(action, Silence) and isinstance(motion, Manual):
            motion = Silent()
        self._was_ready |= state is State.READY
        before, self._was_ignored = self._was_ignored, self._is_ignored()
        if self._was_ignored and not before:
            self._messages.append("the key does not count yet: release all keys for half a second, then hold it again")
        events = [*self._messages, *([verdict.event] if verdict.event is not None else []), *self._new_prompt()]
        self._messages.clear()
        requests = verdict.requests
        # What a person has stopped, a person alone may reset.
        if isinstance(action, Reset) and state is State.FAULT and last is not None and not last.output.estop:
            requests = (*requests, UserRequest.RESET)
        return PilotTick(requests, motion, tuple(events))

    def learn(self, now_ns: int, tick: CoreTick, replies: Sequence[Reply]) -> None:
        """Hand the procedure what the tick saw."""
        refusals = [reply.text for reply in replies if not reply.accepted]
        if refusals and not isinstance(self.procedure.action, Reset):
            self._messages.append(self._deadman.refused(refusals[0]))
        command = tick.command
        self._driving = command is not None and tick.pipeline.source is Source.MANUAL
        commanded = (command.left_rad_s, command.right_rad_s) if command is not None and self._driving else None
        fault, silent = tick.output.state is State.FAULT, tick.pipeline.source is Source.SILENT
        self._fault_ns = (
            (self._fault_ns or now_ns) if fault and isinstance(self.procedure.action, DriveWheels) else None
        )
        if self._fault_ns is not None and now_ns - self._fault_ns > _FAULT_NS:
            self.fault_text = tick.output.detail
        if tick.output.estop:
            # How wheels stop now shows no watchdog. The e-stop must go on being sent until the robot has confirmed it.
            if fault and not tick.output.send_estop:
                self.fault_text = tick.output.detail
            return
        self.procedure.see(
            Seen(now_ns, self._driving, commanded, tick.readings.wheels, tick.readings.poses, fault, silent, self._held)
        )

    def steer(self, now_ns: int, page: int, steering: Mapping[str, Any]) -> str | None:
        """No page drives here."""
        return "the robot is being commissioned from its terminal"

    def status(self) -> dict[str, Any]:
        """Return an empty dict: the status gets no more entries."""
        return {}

    def _new_prompt(self) -> list[str]:
        action = self.procedure.action
        prompt = "" if action is None else action.prompt if isinstance(action, Prompt) else action.todo
        # Who is told to hold a key before the robot is ready holds it in vain.
        if prompt == self._last_prompt or not self._was_ready:
            return []
        self._last_prompt = prompt
        return [prompt] if prompt else []
