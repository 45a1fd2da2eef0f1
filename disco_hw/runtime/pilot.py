"""Who says where the robot goes while motion is allowed: the task's planner, or somebody in its place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from disco_hw.runtime.core import CoreTick
from disco_hw.runtime.pipeline import FollowTask, Motion
from disco_hw.runtime.supervisor import Reply, UserRequest


@dataclass(frozen=True, slots=True)
class PilotTick:
    """What a pilot wants of one tick: requests as a person makes them, the motion, and events to record.

    `by_hand`: a person holds a deadman and sees where the robot goes, which needs no pose.
    """

    requests: tuple[UserRequest, ...] = ()
    motion: Motion = FollowTask()  # noqa: RUF009 - it is frozen and empty
    events: tuple[str, ...] = ()
    by_hand: bool = False


class Pilot(Protocol):
    """Called once before and once after each tick; it never waits and never raises on what a person does."""

    @property
    def needs_pose(self) -> bool:
        """Whether motion needs a pose where robot.toml requires one."""

    @property
    def done(self) -> bool:
        """Whether nothing more is wanted: the daemon then stops the robot and ends."""

    def step(self, now_ns: int, last: CoreTick | None) -> PilotTick:
        """Return what is wanted of the tick at `now_ns`; `last` is the tick before."""

    def learn(self, now_ns: int, tick: CoreTick, replies: Sequence[Reply]) -> None:
        """Take in the result: the replies to its own requests."""

    def steer(self, now_ns: int, page: int, wanted: Mapping[str, Any]) -> str | None:
        """Take in how a page, known by a number, wants to drive; returns why that does not count, in words."""

    def status(self) -> dict[str, Any]:
        """What the daemon's status says in addition."""


@runtime_checkable
class FindsWiring(Protocol):
    """A pilot that finds out how the wheels are wired and what poses mean, and is not stopped for what it looks for."""

    @property
    def finds_wiring(self) -> bool:
        """True."""


class TaskPilot:
    """Leaves everything to the task and to the requests on the control socket."""

    @property
    def needs_pose(self) -> bool:
        """A task cannot be followed without."""
        return True

    @property
    def done(self) -> bool:
        """The task has no end of its own."""
        return False

    def step(self, now_ns: int, last: CoreTick | None) -> PilotTick:
        """Follow the task."""
        return PilotTick()

    def learn(self, now_ns: int, tick: CoreTick, replies: Sequence[Reply]) -> None:
        """Nothing is learnt."""

    def steer(self, now_ns: int, page: int, wanted: Mapping[str, Any]) -> str | None:
        """A task is followed."""
        return "this daemon follows its task; stop it and start `disco-hw drive ROBOT.toml --page`"

    def status(self) -> dict[str, Any]:
        """Nothing is added."""
        return {}
