"""When `run` says how things are: every second while the robot is waited for, else when it has something new to say."""

from __future__ import annotations

from disco_hw.runtime.states import State

_WAITS_FOR_ROBOT = frozenset({State.DISCONNECTED, State.HANDSHAKE})
_PATIENT_AFTER = 60
_EVERY = 60


class Waiting:
    """Asked once a second; what stays the same for a minute is then said once a minute, as a journal is not endless."""

    def __init__(self) -> None:
        self._said = ""
        self._repeated = 0

    def is_worth_saying(self, state: State, words: str) -> bool:
        """Tell whether these words of this state should be said now."""
        if words != self._said:
            self._said, self._repeated = words, 0
            return True
        self._repeated += 1
        return state in _WAITS_FOR_ROBOT and (self._repeated < _PATIENT_AFTER or self._repeated % _EVERY == 0)
