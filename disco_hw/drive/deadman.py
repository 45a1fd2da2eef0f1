"""The deadman: what must hold for a person's wheel speeds to count, and when the robot is armed and disarmed."""

from __future__ import annotations

from dataclasses import dataclass

from disco_hw.drive.source import INPUT_LIMIT_NS, ManualInput
from disco_hw.runtime.pipeline import Manual, Stand
from disco_hw.runtime.states import State
from disco_hw.runtime.supervisor import UserRequest


@dataclass(frozen=True, slots=True)
class Verdict:
    """One tick's requests, the motion while motion is allowed, and a sentence where something changed."""

    requests: tuple[UserRequest, ...]
    motion: Manual | Stand
    event: str | None = None


class Deadman:
    """Arms and starts on a press while the robot is ready, disarms on release, loss or silence; pure.

    A press is a fresh input with the deadman held right after a fresh one with it open. So after a loss, a silence, a
    fault or a disarming by anybody, and at the start, the deadman must be seen open before it counts again: nothing
    arms by itself. Whoever else arms the robot finds it disarmed again.
    """

    def __init__(self, limit_ns: int = INPUT_LIMIT_NS) -> None:
        self._limit_ns = limit_ns
        self._seen_open = False
        self._engaged = False
        self._was_armed = False

    @property
    def engaged(self) -> bool:
        """Whether the press that began this stretch of driving still holds."""
        return self._engaged

    def step(self, now_ns: int, newest: ManualInput | None, state: State) -> Verdict:
        """Judge the newest input (None: the device is gone) in the daemon's present state."""
        fresh = newest is not None and 0 <= now_ns - newest.t_ns <= self._limit_ns
        held = newest is not None and fresh and newest.deadman
        requests, event = self._hold(newest, fresh, held, state) if self._engaged else self._press(held, state)
        if state is State.ARMED and not self._engaged and not requests:
            requests = (UserRequest.DISARM,)
        self._seen_open = fresh and not held
        self._was_armed = state is State.ARMED
        if self._engaged and newest is not None:
            return Verdict(requests, Manual(newest.left_rad_s, newest.right_rad_s), event)
        return Verdict(requests, Stand(), event)

    def refused(self, why: str) -> str:
        """Take in that the daemon refused to arm or start; returns the sentence for the person."""
        self._engaged = False
        return f"not armed: {why}; release the deadman and press it again"

    def _press(self, held: bool, state: State) -> tuple[tuple[UserRequest, ...], str | None]:
        if not (held and self._seen_open):
            return (), None
        if state is not State.READY:
            return (), f"the robot is {state.value}, not ready; release the deadman and press it again once it is"
        self._engaged = True
        return (UserRequest.ARM, UserRequest.START), "deadman pressed: arming"

    def _hold(
        self, newest: ManualInput | None, fresh: bool, held: bool, state: State
    ) -> tuple[tuple[UserRequest, ...], str | None]:
        if not held:
            self._engaged = False
            if newest is None:
                return (UserRequest.DISARM,), "the input device is gone: stopping"
            if not fresh:
                limit_ms = self._limit_ns // 1_000_000
                return (UserRequest.DISARM,), f"no input for more than {limit_ms} ms: stopping"
            return (UserRequest.DISARM,), "deadman released: stopping"
        if state not in {State.READY, State.ARMED} or (self._was_armed and state is State.READY):
            self._engaged = False
            return (), "no longer armed; release the deadman and press it again"
        return (), None
