"""The pilots with a person in them: by hand or script, and by hand until the heading is known; pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from disco_hw.config import RobotConfig
from disco_hw.drive import INPUT_LIMIT_NS, ManualInput, ManualSource, PageSource, RobotView, steering_from
from disco_hw.drive.coverage import Coverage
from disco_hw.runtime import IN_USE, State
from disco_hw.runtime.core import CoreTick, Pilot, PilotTick, TaskPilot
from disco_hw.runtime.fence_guard import STOPS_MOTION
from disco_hw.runtime.pipeline import Manual, Source, Standstill
from disco_hw.runtime.supervisor import Reply, UserRequest


@dataclass(frozen=True, slots=True)
class DeadmanVerdict:
    """One tick's requests, the motion while motion is allowed, and a sentence where something changed."""

    requests: tuple[UserRequest, ...]
    motion: Manual | Standstill
    event: str | None = None


class Deadman:
    """Arms and starts on a press while the robot is ready, disarms on release, loss or silence; pure.

    A press is a fresh input with the deadman held right after a fresh one with it open. So after a loss, a silence, a
    fault or a disarming by anybody, and at the start, the deadman must be seen open before it counts again: nothing
    arms by itself. Whoever else arms the robot finds it disarmed again. Who holds on is asked once to let go.
    """

    def __init__(self) -> None:
        self._seen_open = False
        self._engaged = False
        self._was_armed = False
        self._release_requested = False

    def step(self, now_ns: int, newest: ManualInput | None, state: State) -> DeadmanVerdict:
        """Judge the newest input (None: the device is gone) in the daemon's present state."""
        fresh = newest is not None and 0 <= now_ns - newest.t_ns <= INPUT_LIMIT_NS
        is_held = newest is not None and fresh and newest.deadman
        requests, event = self._hold(newest, fresh, is_held, state) if self._engaged else self._press(is_held, state)
        if state is State.ARMED and not self._engaged and not requests:
            requests = (UserRequest.DISARM,)
        self._seen_open = fresh and not is_held
        if self._seen_open or self._engaged:
            self._release_requested = False
        self._was_armed = state is State.ARMED
        if self._engaged and newest is not None:
            return DeadmanVerdict(requests, Manual(newest.left_rad_s, newest.right_rad_s), event)
        return DeadmanVerdict(requests, Standstill(), event)

    def refused(self, why: str) -> str:
        """Take in that the daemon refused to arm or start; returns the sentence for the person."""
        self._engaged, self._release_requested = False, True
        return f"not armed: {why}; release the deadman and press it again"

    def _press(self, is_held: bool, state: State) -> tuple[tuple[UserRequest, ...], str | None]:
        if not is_held:
            return (), None
        if not self._seen_open:
            if state is not State.READY or self._release_requested:
                return (), None
            self._release_requested = True
            return (), "the deadman was pressed before the robot was ready; release it and press it again"
        if state is not State.READY:
            self._release_requested = True
            return (
                (),
                f"the robot is not ready but {state.value}; when it is ready, release the deadman and press again",
            )
        self._engaged = True
        return (UserRequest.ARM, UserRequest.START), "deadman pressed: arming"

    def _hold(
        self, newest: ManualInput | None, fresh: bool, is_held: bool, state: State
    ) -> tuple[tuple[UserRequest, ...], str | None]:
        if not is_held:
            self._engaged = False
            if newest is None:
                return (UserRequest.DISARM,), "the input device is disconnected: stopping"
            if not fresh:
                limit_ms = INPUT_LIMIT_NS // 1_000_000
                return (UserRequest.DISARM,), f"no input for more than {limit_ms} ms: stopping"
            return (UserRequest.DISARM,), "deadman released: stopping"
        if state not in {State.READY, State.ARMED} or (self._was_armed and state is State.READY):
            self._engaged, self._release_requested = False, True
            return (), "the robot is no longer armed; release the deadman and press it again"
        return (), None


# Chosen: the newest, until they are shown; older ones are of no use any more.
_MESSAGES = 5


class HandPilot:
    """Drives as its source says, while its deadman is held."""

    # The person sees the robot.
    needs_pose = False

    def __init__(self, source: ManualSource, coverage: Coverage, page: PageSource | None = None) -> None:
        """`page` is what hears the page: the source itself, or the deadman of its script."""
        self._source = source
        self._page = page
        self._coverage = coverage
        self._deadman = Deadman()
        self._driving = False
        self._task = ""
        self._pending_messages: deque[str] = deque()
        self._messages: deque[str] = deque(maxlen=_MESSAGES)

    @property
    def done(self) -> bool:
        """Whether the source has ended."""
        return self._source.ended is not None

    def step(self, now_ns: int, last: CoreTick | None) -> PilotTick:
        """Poll the source once and judge what it says."""
        view = _view(last, self._driving)
        newest = self._source.poll(now_ns, view)
        verdict = self._deadman.step(now_ns, newest, view.state)
        if self._source.ended is not None:
            self._pending_messages.append(self._source.ended)
        elif verdict.event is not None:
            self._pending_messages.append(verdict.event)
        if self._driving and self._source.task not in {"", self._task}:
            self._task = self._source.task
            self._pending_messages.append(self._task)
        events = tuple(self._pending_messages)
        self._pending_messages.clear()
        self._messages += events
        return PilotTick(verdict.requests, verdict.motion, events, by_hand=True)

    def learn(self, now_ns: int, tick: CoreTick, replies: Sequence[Reply]) -> None:
        """Count what was excited; take in that arming was refused."""
        refusals = [reply.text for reply in replies if not reply.accepted]
        if refusals:
            self._pending_messages.append(self._deadman.refused(refusals[0]))
        self._messages += tick.events
        command = tick.command
        self._driving = command is not None and tick.pipeline.source is Source.MANUAL
        if command is not None and self._driving:
            self._coverage.add(tick.pipeline.t_ns, command.left_rad_s, command.right_rad_s)
        else:
            self._coverage.pause()

    def steer(self, now_ns: int, page: int, steering: Mapping[str, Any]) -> str | None:
        """Pass on what a page wants, if pages drive."""
        if self._page is None:
            return "this drive takes no input from the page; start it with --page"
        try:
            return self._page.steer(now_ns, page, steering_from(steering))
        except ValueError as error:
            return str(error)

    def status(self) -> dict[str, Any]:
        """Return the source's state, the coverage and the newest messages, under the key `drive`."""
        return {
            "drive": {
                "driving": self._driving,
                "by_page": self._page is not None,
                "words": self._source.status_text,
                "task": self._source.task,
                "messages": list(self._messages),
                "coverage": self._coverage.as_dict(),
                "coverage_words": self._coverage.describe(),
            }
        }


def _view(last: CoreTick | None, driving: bool) -> RobotView:
    if last is None:
        return RobotView(State.DISCONNECTED, driving)
    estimate = last.pipeline.estimate
    return RobotView(
        last.output.state,
        driving,
        (estimate.left_speed_rad_s, estimate.right_speed_rad_s) if estimate.wheels_ok else None,
        (estimate.x_m, estimate.y_m, estimate.yaw_rad) if estimate.ok else None,
        last.pipeline.fence.verdict in STOPS_MOTION,
    )


class UntilHeading:
    """Hands over between two drives only: who drives stays the same from arming until the robot is disarmed.

    Poses without heading need a metre of driving before there is anything that a task could be followed by. The task's
    pilot takes over with the robot disarmed, so that a person arms and starts anew.
    """

    def __init__(self, task: Pilot, by_hand: Pilot) -> None:
        self._task = task
        self._by_hand = by_hand
        self._now = task

    @property
    def needs_pose(self) -> bool:
        """Whether the task needs a pose."""
        return self._task.needs_pose

    @property
    def done(self) -> bool:
        """Whether the task's pilot is done."""
        return self._task.done

    def step(self, now_ns: int, last: CoreTick | None) -> PilotTick:
        """Choose whose turn it is and ask that one."""
        if last is not None and last.output.state not in IN_USE:
            estimate = last.pipeline.estimate
            missing = estimate.initialised and not estimate.heading_known
            self._now = self._by_hand if missing else self._task
        return self._now.step(now_ns, last)

    def learn(self, now_ns: int, tick: CoreTick, replies: Sequence[Reply]) -> None:
        """Pass the tick to the pilot in charge."""
        self._now.learn(now_ns, tick, replies)

    def steer(self, now_ns: int, page: int, steering: Mapping[str, Any]) -> str | None:
        """Pass the page's steering to the pilot in charge."""
        return self._now.steer(now_ns, page, steering)

    def status(self) -> dict[str, Any]:
        """Return the status of the pilot in charge, by which the page shows its pad."""
        return self._now.status()


def task_pilot(config: RobotConfig) -> UntilHeading:
    """Return the pilot for this robot's task."""
    top_rad_s = config.drive.speed_share * config.robot.max_wheel_speed_rad_s
    page = PageSource(top_rad_s, config.drive.turn_share)
    return UntilHeading(TaskPilot(), HandPilot(page, Coverage(top_rad_s), page))
