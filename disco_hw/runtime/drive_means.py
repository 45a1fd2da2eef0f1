"""What a model's terms remember of a drive: means of commands and of wheel speeds, kept up from tick to tick."""

from __future__ import annotations

import math

from disco_hw.model import Model
from disco_hw.model.memory import Remembered, of_wheels
from disco_hw.model.terms import memories_of


class DriveMeans:
    """The means of a drive that begins with nothing before it; pure."""

    def __init__(self, of_commands: tuple[Remembered, ...], of_body: tuple[Remembered, ...]) -> None:
        self._memories, self._body = of_commands, of_body
        self._commands = tuple((0.0, 0.0) for _ in of_commands)
        self._wheels = tuple(0.0 for _ in of_body)

    @classmethod
    def of(cls, model: Model) -> DriveMeans | None:
        """Those of a model; None if it remembers nothing."""
        memories = memories_of(setting.name for setting in model.effects)
        return cls(*memories) if any(memories) else None

    @property
    def commands(self) -> tuple[tuple[float, float], ...]:
        """Of both wheels' commands, one pair a term, up to the last one taken in."""
        return self._commands

    @property
    def body(self) -> tuple[float, ...]:
        """Of the wheels' speeds, one a term."""
        return self._wheels

    def add_command(self, left_rad_s: float, right_rad_s: float, held_s: float) -> None:
        """Take in a command that was held for so long."""
        self._commands = tuple(
            (
                _followed(left, memory.of(left_rad_s, right_rad_s), held_s, memory.time_s),
                _followed(right, memory.of(right_rad_s, left_rad_s), held_s, memory.time_s),
            )
            for memory, (left, right) in zip(self._memories, self._commands, strict=True)
        )

    def add_wheels(self, left_rad_s: float, right_rad_s: float, for_s: float) -> None:
        """Take in wheel speeds of so long; what is not finite counts as standing."""
        left, right = (speed if math.isfinite(speed) else 0.0 for speed in (left_rad_s, right_rad_s))
        self._wheels = tuple(
            _followed(mean, of_wheels(memory, left, right), for_s, memory.time_s)
            for memory, mean in zip(self._body, self._wheels, strict=True)
        )


def _followed(mean: float, signal: float, for_s: float, time_s: float) -> float:
    return signal + (mean - signal) * math.exp(-max(for_s, 0.0) / time_s)
