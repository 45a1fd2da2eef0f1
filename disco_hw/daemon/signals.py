"""Signals that ask the daemon to stop: the handler only notes it, the loop acts on it before its next tick."""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import FrameType, TracebackType
from typing import Any

# A terminal that closes must not end the process before it has stopped the wheels, hence SIGHUP.
_STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
_MAY_STAY_IGNORED = signal.SIGHUP


class StopSignals:
    """Catches the signals while entered, in the main thread; the former handlers come back on exit.

    To be entered around the stop path too: the second signal of somebody impatient must not break it off. SIGHUP stays
    ignored where it was, as by nohup; SIGINT does not: a shell has it ignored in what a script starts with `&`, and
    whoever presses Ctrl-C wants the robot to stop.
    """

    def __init__(self, signals: Sequence[signal.Signals] = _STOP_SIGNALS) -> None:
        self._signals = tuple(signals)
        self._former: dict[signal.Signals, Any] = {}
        self._received: signal.Signals | None = None

    @property
    def received(self) -> signal.Signals | None:
        """The first signal that came, or None."""
        return self._received

    def __enter__(self) -> StopSignals:
        for number in self._signals:
            if number is not _MAY_STAY_IGNORED or signal.getsignal(number) is not signal.SIG_IGN:
                self._former[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for number, handler in self._former.items():
            # A handler that was not set from Python is known as None only and cannot be put back.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        self._former.clear()

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self._received is None:
            self._received = signal.Signals(number)


@dataclass(frozen=True, slots=True)
class StepOutcome:
    """How one step ended; `error` is in words, None if it did what it should."""

    name: str
    error: str | None

    @property
    def ok(self) -> bool:
        """Whether the step did what it should."""
        return self.error is None


class StopPath:
    """Steps to stop with, each in a guard of its own; what was added last runs first, so the wheels are added last.

    A step must not wait for ever: its guard holds exceptions, not time.
    """

    def __init__(self) -> None:
        self._steps: list[tuple[str, Callable[[], object]]] = []

    def add(self, name: str, step: Callable[[], object]) -> None:
        """Add a step, which will run before all those added so far."""
        self._steps.append((name, step))

    def run(self) -> list[StepOutcome]:
        """Run every step once and return how each ended; never raises, and a second call runs nothing."""
        outcomes = []
        while self._steps:
            name, step = self._steps.pop()
            try:
                step()
            # Also SystemExit and KeyboardInterrupt: nothing may keep the steps after this one from running.
            except BaseException as error:
                outcomes.append(StepOutcome(name, f"{type(error).__name__}: {error}"))
            else:
                outcomes.append(StepOutcome(name, None))
        return outcomes
