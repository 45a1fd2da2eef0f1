"""The pilot that drives by hand or script: source, deadman and coverage in one tick; pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

from disco_hw.drive.coverage import Coverage
from disco_hw.drive.deadman import Deadman
from disco_hw.drive.page_source import PageSource, steering_from
from disco_hw.drive.source import ManualSource, RobotView
from disco_hw.runtime.core import CoreTick
from disco_hw.runtime.pilot import PilotTick
from disco_hw.runtime.pipeline import Source
from disco_hw.runtime.states import State
from disco_hw.runtime.supervisor import Reply

_MESSAGES = 5


class HandPilot:
    """Drives as its source says, while its deadman is held."""

    def __init__(self, source: ManualSource, coverage: Coverage, page: PageSource | None = None) -> None:
        """`page` is what hears the page: the source itself, or the deadman of its script."""
        self._source = source
        self._page = page
        self._coverage = coverage
        self._deadman = Deadman()
        self._driving = False
        self._task = ""
        self._told: deque[str] = deque()
        self._messages: deque[str] = deque(maxlen=_MESSAGES)

    @property
    def needs_pose(self) -> bool:
        """The person sees the robot."""
        return False

    @property
    def done(self) -> bool:
        """Whether the source has ended."""
        return self._source.ended is not None

    def step(self, now_ns: int, last: CoreTick | None) -> PilotTick:
        """Poll the source once and judge what it says."""
        state = State.DISCONNECTED if last is None else last.output.state
        newest = self._source.poll(now_ns, RobotView(state, self._driving, _measured(last)))
        verdict = self._deadman.step(now_ns, newest, state)
        if self._source.ended is not None:
            self._told.append(self._source.ended)
        elif verdict.event is not None:
            self._told.append(verdict.event)
        if self._driving and self._source.task not in {"", self._task}:
            self._task = self._source.task
            self._told.append(self._task)
        events = tuple(self._told)
        self._told.clear()
        self._messages += events
        return PilotTick(verdict.requests, verdict.motion, events)

    def learn(self, now_ns: int, tick: CoreTick, replies: Sequence[Reply]) -> None:
        """Count what was excited; take in that arming was refused."""
        refusals = [reply.text for reply in replies if not reply.accepted]
        if refusals:
            self._told.append(self._deadman.refused(refusals[0]))
        self._messages += tick.events
        command = tick.command
        self._driving = command is not None and tick.pipeline.source is Source.MANUAL
        if command is not None and self._driving:
            self._coverage.add(tick.pipeline.t_ns, command.left_rad_s, command.right_rad_s)
        else:
            self._coverage.pause()

    def steer(self, now_ns: int, page: int, wanted: Mapping[str, Any]) -> str | None:
        """Pass on what a page wants, if pages drive."""
        if self._page is None:
            return "this drive does not listen to the page; start it with --page"
        try:
            return self._page.steer(now_ns, page, steering_from(wanted))
        except ValueError as error:
            return str(error)

    def status(self) -> dict[str, Any]:
        """What the source is at, the coverage and the newest messages, as `drive`."""
        return {
            "drive": {
                "driving": self._driving,
                "by_page": self._page is not None,
                "words": self._source.words,
                "task": self._source.task,
                "messages": list(self._messages),
                "coverage": self._coverage.as_dict(),
                "coverage_words": self._coverage.in_words(),
            }
        }


def _measured(last: CoreTick | None) -> tuple[float, float] | None:
    if last is None or not last.pipeline.estimate.wheels_ok:
        return None
    return last.pipeline.estimate.left_speed_rad_s, last.pipeline.estimate.right_speed_rad_s
