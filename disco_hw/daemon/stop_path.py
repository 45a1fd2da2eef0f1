"""What must happen at the end, step after step, whatever fails on the way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


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
