"""The pilot of `disco-hw run`: the task, and a person on the page for as long as the robot's heading is not known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from disco_hw.config import RobotConfig
from disco_hw.drive.coverage import Coverage
from disco_hw.drive.hand_pilot import HandPilot
from disco_hw.drive.page_source import PageSource
from disco_hw.runtime.core import CoreTick
from disco_hw.runtime.pilot import Pilot, PilotTick, TaskPilot
from disco_hw.runtime.states import State
from disco_hw.runtime.supervisor import Reply

_IN_USE = frozenset({State.ARMED, State.STOPPING})


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
        """As the task does."""
        return self._task.needs_pose

    @property
    def done(self) -> bool:
        """As the task's pilot says."""
        return self._task.done

    def step(self, now_ns: int, last: CoreTick | None) -> PilotTick:
        """Choose whose turn it is and ask that one."""
        if last is not None and last.output.state not in _IN_USE:
            estimate = last.pipeline.estimate
            missing = estimate.initialised and not estimate.heading_known
            self._now = self._by_hand if missing else self._task
        return self._now.step(now_ns, last)

    def learn(self, now_ns: int, tick: CoreTick, replies: Sequence[Reply]) -> None:
        """Pass it on."""
        self._now.learn(now_ns, tick, replies)

    def steer(self, now_ns: int, page: int, wanted: Mapping[str, Any]) -> str | None:
        """Pass it on."""
        return self._now.steer(now_ns, page, wanted)

    def status(self) -> dict[str, Any]:
        """Of the one whose turn it is; the page shows its pad by that."""
        return self._now.status()


def task_pilot(config: RobotConfig) -> UntilHeading:
    """The pilot for this robot's task."""
    top_rad_s = config.drive.speed_share * config.robot.max_wheel_speed_rad_s
    page = PageSource(top_rad_s, config.drive.turn_share)
    return UntilHeading(TaskPilot(), HandPilot(page, Coverage(top_rad_s), page))
