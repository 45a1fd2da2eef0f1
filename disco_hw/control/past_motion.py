"""Running means of commands and wheel speeds that a model's terms use, from tick to tick and at a rollout's start."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.plan import PlannerState
from disco_hw.effects.registry import DELAY
from disco_hw.model import Model
from disco_hw.model.terms import Remembered, memories_of, of_wheels

Array = NDArray[np.float64]
DELAYED_BY = DELAY.columns[0]


class DriveMeans:
    """The means of a drive that begins with nothing before it, of commands and of wheel speeds; pure.

    `half_radius_m`: of the wheels, forward speed for each rad/s of their sum. `commands`: the means of both wheels'
    commands, one pair for each term, up to the last one added; `body`: those of the wheels' speeds, one for each term.
    """

    def __init__(
        self, of_commands: tuple[Remembered, ...], of_body: tuple[Remembered, ...], half_radius_m: float
    ) -> None:
        self._of_commands, self._of_body, self._half_radius_m = of_commands, of_body, half_radius_m
        self.commands = tuple((0.0, 0.0) for _ in of_commands)
        self.body = tuple(0.0 for _ in of_body)

    @classmethod
    def of(cls, model: Model) -> DriveMeans | None:
        """Return the running means that a model needs, or None if none of its effects needs any."""
        memories = memories_of(setting.name for setting in model.effects)
        return cls(*memories, 0.5 * model.wheel_radius_m) if any(memories) else None

    def add_command(self, left_rad_s: float, right_rad_s: float, duration_s: float) -> None:
        """Take in a command that was held for so long."""
        self.commands = tuple(
            (
                memory.after(left, memory.of(left_rad_s, right_rad_s), duration_s, 1.0),
                memory.after(right, memory.of(right_rad_s, left_rad_s), duration_s, 1.0),
            )
            for memory, (left, right) in zip(self._of_commands, self.commands, strict=True)
        )

    def add_wheels(self, left_rad_s: float, right_rad_s: float, for_s: float) -> None:
        """Take in wheel speeds of so long; what is not finite counts as standing."""
        left, right = (speed if math.isfinite(speed) else 0.0 for speed in (left_rad_s, right_rad_s))
        self.body = tuple(
            memory.after(mean, of_wheels(memory, left, right), for_s, self._half_radius_m)
            for memory, mean in zip(self._of_body, self.body, strict=True)
        )


class PastMotion:
    """The means that a model keeps, n of them, at a time of the recent past, under each of its parameter points.

    Commands act later under a longer delay. What was before a state's first command, and before its wheel speeds, is
    known by its means alone.
    """

    def __init__(self, model: Model, delays_s: Array, mean_delay_s: float) -> None:
        self._commands, self._body = memories_of(setting.name for setting in model.effects)
        self._delays_s, self._mean_delay_s = delays_s, mean_delay_s

    @classmethod
    def of(cls, model: Model, theta: Array, mean_theta: Array) -> PastMotion | None:
        """Return the past motion for points (L, P) and mean (1, P) of a model; None if no effect needs any."""
        if not any(memories_of(setting.name for setting in model.effects)):
            return None
        if DELAYED_BY not in model.parameter_names:
            return cls(model, np.zeros(len(theta)), 0.0)
        column = model.parameter_names.index(DELAYED_BY)
        return cls(model, theta[:, column], float(mean_theta[0, column]))

    def of_mean(self, state: PlannerState, t_ns: int) -> Array:
        """Means (n,) at `t_ns` in the mean of what is believed, in the order of the compiled step."""
        of_body = state.body_means or np.zeros(len(self._body))
        return np.concatenate([self._of_commands(state, t_ns, self._mean_delay_s), of_body])

    def of_points(self, state: PlannerState, t_ns: int, of_mean: Array) -> Array:
        """Means (L, n) at `t_ns` under the points, from those of the mean (n,) at that time."""
        means = np.tile(of_mean, (len(self._delays_s), 1))
        for delay_s in np.unique(self._delays_s):
            of_commands = self._of_commands(state, t_ns, float(delay_s))
            means[self._delays_s == delay_s, : of_commands.size] = of_commands
        return means

    def _of_commands(self, state: PlannerState, t_ns: int, delay_s: float) -> Array:
        if not self._commands or not state.sent:
            return np.zeros(2 * len(self._commands))
        commanded = np.array([(one.left_rad_s, one.right_rad_s) for one in state.sent])
        begins_s = np.array([(one.t_ns - t_ns) * 1e-9 + delay_s for one in state.sent])
        begins_s = np.minimum(begins_s, 0.0)
        ends_s = np.append(begins_s[1:], 0.0)
        found = np.empty((len(self._commands), 2))
        before = state.command_means or np.zeros_like(found)
        for n, memory in enumerate(self._commands):
            share = np.exp(ends_s / memory.time_s) - np.exp(begins_s / memory.time_s)
            left = np.exp(begins_s[0] / memory.time_s)
            found[n] = left * np.array(before[n]) + share @ memory.of(commanded, commanded[:, ::-1])
        return found.ravel()
