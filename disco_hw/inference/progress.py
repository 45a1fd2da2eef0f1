"""How far an inference is, counted in simulations."""

from __future__ import annotations

from collections.abc import Callable

Tell = Callable[[str, float], None]


class Tally:
    """Counts simulations of `total` and tells the stage with the share that is done, in [0, 1]."""

    def __init__(self, total: int, tell: Tell) -> None:
        self._total = total
        self._tell = tell
        self._done = 0
        self._stage = ""

    def stage(self, text: str) -> None:
        """A new stage begins."""
        self._stage = text
        self.add(0)

    def add(self, count: int) -> None:
        """So many more simulations are done."""
        self._done += count
        self._tell(self._stage, min(self._done / self._total, 1.0))
