"""The pilot of the guided first drive: a procedure, a deadman held by a person, and the keys they answer with; pure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from disco_hw.drive.hand_pilot import Deadman
from disco_hw.drive.sources import ManualInput, ManualSource, RobotView
from disco_hw.first_use.procedure import Ask, DriveWheels, Procedure, Reset, Seen, Silence
from disco_hw.runtime.core import CoreTick, PilotTick
from disco_hw.runtime.pipeline import Manual, Motion, Silent, Source
from disco_hw.runtime.states import State
from disco_hw.runtime.supervisor import Reply, UserRequest

_FAULT_NS = 1_000_000_000


class CommissionPilot:
    """Drives as the procedure says while the deadman of `source` is held; satisfies `disco_hw.runtime.core.Pilot`.

    `keys`: those typed since it was asked last, for the procedure's questions. `in_vain`: whether a key is held that
    does not count, which the person is told once.
    """

    def __init__(
        self,
        procedure: Procedure,
        source: ManualSource,
        keys: Callable[[], str],
        in_vain: Callable[[], bool] = lambda: False,
    ) -> None:
        self.procedure = procedure
        self._source = source
        self._keys = keys
        self._in_vain = in_vain
        self._was_in_vain = False
        self._deadman = Deadman()
        self._driving = self._held = self._was_ready = False
        self._said = ""
        self._told: list[str] = []
        self._fault_ns: int | None = None
        self.trouble: str | None = None
        """The fault that ended the drive, in words."""

    @property
    def needs_pose(self) -> bool:
        """Whether the poses are right is to be found."""
        return False

    @property
    def finds_wiring(self) -> bool:
        """That is what it is for."""
        return True

    @property
    def done(self) -> bool:
        """Whether the procedure is over, or the person gave up."""
        return self.procedure.action is None or self._source.ended is not None or self.trouble is not None

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
        before, self._was_in_vain = self._was_in_vain, self._in_vain()
        if self._was_in_vain and not before:
            self._told.append("the key does not count yet: release all keys for half a second, then hold it again")
        events = [*self._told, *([verdict.event] if verdict.event is not None else []), *self._new_words()]
        self._told.clear()
        requests = verdict.requests
        if isinstance(action, Reset) and state is State.FAULT:
            requests = (*requests, UserRequest.RESET)
        return PilotTick(requests, motion, tuple(events))

    def learn(self, now_ns: int, tick: CoreTick, replies: Sequence[Reply]) -> None:
        """Hand the procedure what the tick saw."""
        refusals = [reply.text for reply in replies if not reply.accepted]
        if refusals and not isinstance(self.procedure.action, Reset):
            self._told.append(self._deadman.refused(refusals[0]))
        command = tick.command
        self._driving = command is not None and tick.pipeline.source is Source.MANUAL
        commanded = (command.left_rad_s, command.right_rad_s) if command is not None and self._driving else None
        fault, silent = tick.output.state is State.FAULT, tick.pipeline.source is Source.SILENT
        self._fault_ns = (
            (self._fault_ns or now_ns) if fault and isinstance(self.procedure.action, DriveWheels) else None
        )
        if self._fault_ns is not None and now_ns - self._fault_ns > _FAULT_NS:
            self.trouble = tick.output.detail
        self.procedure.see(
            Seen(now_ns, self._driving, commanded, tick.readings.wheels, tick.readings.poses, fault, silent, self._held)
        )

    def steer(self, now_ns: int, page: int, wanted: Mapping[str, Any]) -> str | None:
        """No page drives here."""
        return "the robot is being commissioned from its terminal"

    def status(self) -> dict[str, Any]:
        """Nothing is added."""
        return {}

    def _new_words(self) -> list[str]:
        action = self.procedure.action
        words = "" if action is None else action.question if isinstance(action, Ask) else action.todo
        # Who is told to hold a key before the robot is ready holds it in vain.
        if words == self._said or not self._was_ready:
            return []
        self._said = words
        return [words] if words else []
