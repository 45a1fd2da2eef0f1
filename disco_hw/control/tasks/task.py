"""What a task is: a cost for the rollouts, a figure for displays, a picture."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


class Task(Protocol):
    """What the robot is to do; immutable. Its terms' type decides which compiled cost is used (tasks/terms.py)."""

    @property
    def origin_m(self) -> tuple[float, float]:
        """World position that rollouts are relative to, so that single precision is fine anywhere."""

    def terms(
        self, time_s: float, x_m: float, y_m: float, memory: float | None, step_s: float, horizon: int
    ) -> tuple[Any, float]:
        """Terms for the compiled cost, in float32, and the memory that rollouts start with.

        `time_s` since the planner's start, the position in the world, the memory that the last plan started with (None
        at the first), and the steps that will be planned.
        """

    def instant_cost(self, time_s: float, x_m: float, y_m: float, forward_m_s: float) -> float:
        """Cost of being here at this time with this speed, for figures and displays."""

    def picture(self) -> NDArray[np.float64]:
        """The path to follow in the world frame, (N, 2)."""
