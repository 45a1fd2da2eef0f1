"""Free run: the model from a known state through given commands, in double precision."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects.registry import DELAY
from disco_hw.jit import compiled_for, kernel_function
from disco_hw.model.coefficients import Base, Coefficients, base_point, effect_point
from disco_hw.model.model import Model, coefficient_tables
from disco_hw.model.step import axle_of, delay_steps, in_force, integration_from, integration_series, step, tracked_of

Array = NDArray[np.float64]


class FreeRun:
    """The model at L parameter points `theta` (L, P), in steps of `step_s`, ready to run."""

    def __init__(self, model: Model, theta: Array, step_s: float) -> None:
        self._base, self._effects = coefficient_tables(model, theta, step_s)
        self._series = integration_series(step_s, wide=True)
        delay = getattr(self._effects, DELAY.name)
        self._run: Callable[..., None] | None = None
        self.past_rows = 0 if delay is None else int(delay[0].max()) + 1

    def states(self, start: Array, commands: Array, history: int, time_s: float = 0.0, point: int = 0) -> Array:
        """States (N + 1, 5) from `start` (5,): x, y (m), yaw (rad, not wrapped), wheel speeds (rad/s).

        `commands` (history + N, 2) rad/s, each held for a step; the first `history` rows were sent before and must be
        at least `past_rows`. `time_s`: the time at the start, for effects that depend on it. `point`: which of theta.
        """
        states = np.empty((commands.shape[0] - history + 1, 5))
        states[0] = start
        # A fresh copy, as a read-only array or a strided one is another type and would be compiled anew, in mid-loop.
        own = np.array(commands, dtype=np.float64, order="C")
        arguments = states, own, history, float(time_s), point, self._base, self._effects, self._series
        if self._run is None:
            self._run = compiled_for(run_states, *arguments)
        self._run(*arguments)
        return states


def simulate(model: Model, commands: Array, step_s: float = 0.02, start: Array | None = None) -> Array:
    """Where a model's point values lead: states (N + 1, 5) x, y (m), yaw (rad, not wrapped), wheel speeds (rad/s).

    `commands` (N, 2): wheel speeds wanted, left and right (rad/s), each held for `step_s`; before them the wheels were
    commanded to stand. `start` (5,): the first state, the origin at rest if None. Raises ValueError for other
    shapes and for what is not finite.
    """
    wanted = np.asarray(commands, dtype=np.float64)
    begin = np.zeros(5) if start is None else np.asarray(start, dtype=np.float64)
    if wanted.ndim != 2 or wanted.shape[1] != 2 or begin.shape != (5,):
        raise ValueError(
            f"commands of shape (N, 2) and a start of shape (5,) are needed, not {wanted.shape}, {begin.shape}"
        )
    if not (np.isfinite(wanted).all() and np.isfinite(begin).all()):
        raise ValueError("commands and start have to be finite numbers")
    run = FreeRun(model, model.point()[None], step_s)
    before = np.zeros((run.past_rows, 2))
    return run.states(begin, np.vstack([before, wanted]), run.past_rows)


@kernel_function
def run_states(
    states: Array, commands: Array, history: int, time_s: float, point: int, base: Base, effects: Coefficients,
    series: NDArray[np.floating],
) -> None:  # fmt: skip
    """Fill `states[1:]` from `states[0]`; as `FreeRun.states`."""
    integration = integration_from(series, True)
    here, acting = base_point(base, point), effect_point(effects, point)
    x, y, yaw = states[0, 0], states[0, 1], states[0, 2]
    wheel_left, wheel_right = states[0, 3], states[0, 4]
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    axle_x, axle_y = axle_of(x, y, cos_yaw, sin_yaw, here)
    late = history - delay_steps(acting)
    for t in range(states.shape[0] - 1):
        recent, older = max(t + late, 0), max(t + late - 1, 0)
        left = in_force(commands[recent, 0], commands[older, 0], acting)
        right = in_force(commands[recent, 1], commands[older, 1], acting)
        axle_x, axle_y, cos_yaw, sin_yaw, wheel_left, wheel_right, _, turn = step(
            axle_x, axle_y, cos_yaw, sin_yaw, wheel_left, wheel_right, left, right,
            time_s + t * integration.step_s, here, acting, integration,
        )  # fmt: skip
        yaw = yaw + (turn + turn) * integration.step_s
        states[t + 1, 0], states[t + 1, 1] = tracked_of(axle_x, axle_y, cos_yaw, sin_yaw, here)
        states[t + 1, 2] = yaw
        states[t + 1, 3] = wheel_left
        states[t + 1, 4] = wheel_right
