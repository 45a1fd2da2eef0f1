"""Prints sentences without ever waiting for the reader, and says which are worth repeating."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
from collections.abc import Callable

from disco_hw.runtime.states import State

STANDARD_OUTPUT, STANDARD_ERROR = 1, 2
_MOST_LINES = 1000


class AsyncPrinter:
    """Writes a line for each sentence to a descriptor, from a thread of its own: called as `say(topic, text)`.

    Who holds the output, by Ctrl-S, a pager or a connection that hangs, would hold up the control loop with it. What
    comes while a thousand lines wait is dropped and counted; a reader that has gone gets nothing more. The thread
    begins with the first sentence, and so has the priority of who says that: one of normal priority could be set aside
    with the interpreter's lock in its hand, and the loop with it.
    """

    def __init__(self, descriptor: int, line_of: Callable[[str, str], str], most: int = _MOST_LINES) -> None:
        self.dropped = 0
        self._descriptor = descriptor
        self._line_of = line_of
        self._most = most
        self._lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def __call__(self, topic: str, text: str) -> None:
        """Have the sentence written."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._write, name="async printer", daemon=True)
            self._thread.start()
        if self._lines.qsize() < self._most:
            self._put(topic, text)
        else:
            self.dropped += 1

    def close(self, timeout_s: float = 1.0) -> None:
        """Wait at most `timeout_s` until everything is written; safe to call twice."""
        if self.dropped:
            self._put("output", f"{self.dropped} sentences are missing here, as nobody read those before them")
            self.dropped = 0
        if self._thread is not None:
            self._lines.put(None)
            self._thread.join(timeout_s)

    def _put(self, topic: str, text: str) -> None:
        self._lines.put(f"{self._line_of(topic, text)}\n".encode(errors="surrogateescape"))

    def _write(self) -> None:
        # Straight to the descriptor: a thread that is held inside of `print` would keep the process from ending.
        while (line := self._lines.get()) is not None:
            with contextlib.suppress(OSError):
                while line:
                    line = line[os.write(self._descriptor, line) :]


_WAITS_FOR_ROBOT = frozenset({State.DISCONNECTED, State.HANDSHAKE})
_PATIENT_AFTER = 60
_EVERY = 60


class Waiting:
    """Asked once a second; what stays the same for a minute is then said once a minute, as a journal is not endless."""

    def __init__(self) -> None:
        self._said = ""
        self._repeated = 0

    def is_worth_saying(self, state: State, words: str) -> bool:
        """Whether these words of this state should be said now."""
        if words != self._said:
            self._said, self._repeated = words, 0
            return True
        self._repeated += 1
        return state in _WAITS_FOR_ROBOT and (self._repeated < _PATIENT_AFTER or self._repeated % _EVERY == 0)
