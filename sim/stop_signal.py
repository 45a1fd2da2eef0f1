"""SIGTERM and SIGINT as something that a select loop can wait on."""

from __future__ import annotations

import os
import signal
from types import FrameType


class StopSignal:
    """From its making on, SIGTERM and SIGINT set `requested` and make `fileno()` readable; main thread only."""

    def __init__(self) -> None:
        self.requested = False
        self._wake_read, self._wake_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        # Without the wake-up descriptor a signal just before select() would go unnoticed until its timeout.
        signal.set_wakeup_fd(self._wake_write, warn_on_full_buffer=False)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._handle)

    def fileno(self) -> int:
        """Descriptor that becomes readable when a signal has come."""
        return self._wake_read

    def _handle(self, _number: int, _frame: FrameType | None) -> None:
        self.requested = True
