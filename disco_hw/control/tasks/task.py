"""What a task is: a cost for the rollouts, a figure for displays, a picture."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


class Prepared(NamedTuple):
    """What a plan needs of its task.

    `terms`: for the compiled cost, in float32. `origin_m`: world position that rollouts are relative to, so that single
    precision is fine anywhere; `begin`: the memory that they start with. `memory`: to hand back at the next plan.
    """

    terms: Any
    origin_m: tuple[float, float]
    begin: float = 0.0
    memory: float = 0.0


class Task(Protocol):
    """What the robot is to do; immutable. Its terms' type decides which compiled cost is used (tasks/terms.py)."""

    def prepare(
        self, time_s: float, x_m: float, y_m: float, memory: float | None, step_s: float, horizon: int
    ) -> Prepared:
        """What a plan from here needs.

        `time_s` since the planner's start, the position in the world, the memory that the last plan handed back (None
        at the first), and the steps that will be planned.
        """

    def instant_cost(self, time_s: float, x_m: float, y_m: float, forward_m_s: float) -> float:
        """Cost of being here at this time with this speed, for figures and displays."""

    def picture(self) -> NDArray[np.float64]:
        """The path to follow in the world frame, (N, 2)."""
