"""Signals that ask the daemon to stop: the handler only notes it, the loop acts on it before its next tick."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from types import FrameType, TracebackType

# A terminal that closes must not end the process before it has stopped the wheels, hence SIGHUP.
STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class StopSignals:
    """Catches the signals while entered, in the main thread; the former handlers come back on exit."""

    def __init__(self, signals: Sequence[signal.Signals] = STOP_SIGNALS) -> None:
        self._signals = tuple(signals)
        self._former: dict[signal.Signals, object] = {}
        self._received: signal.Signals | None = None

    @property
    def received(self) -> signal.Signals | None:
        """The first signal that came, or None."""
        return self._received

    def __enter__(self) -> StopSignals:
        for number in self._signals:
            self._former[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for number, handler in self._former.items():
            # A handler that was not set from Python is given as None; the default is the nearest to it.
            signal.signal(number, handler if callable(handler) or isinstance(handler, int) else signal.SIG_DFL)
        self._former.clear()

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self._received is None:
            self._received = signal.Signals(number)
