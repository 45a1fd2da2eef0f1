"""What was commanded before: means over steps of the commands already sent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.plan import SentCommand


def command_history(
    sent: Sequence[SentCommand], end_ns: int, step_s: float, count: int, otherwise: tuple[float, float]
) -> NDArray[np.float64]:
    """Mean commands (count, 2) over the `count` steps that end at `end_ns`, oldest first.

    `sent` is oldest first; a command holds until the next one. What was before the first one counts as equal to it, and
    without any command all are `otherwise`.
    """
    means = np.empty((count, 2))
    if not sent:
        means[:] = otherwise
        return means
    step_ns = step_s * 1e9
    index = len(sent) - 1
    for row in range(count - 1, -1, -1):
        until = end_ns - (count - 1 - row) * step_ns
        since = until - step_ns
        left = right = 0.0
        upper = until
        while upper > since:
            while index > 0 and sent[index].t_ns >= upper:
                index -= 1
            command = sent[index]
            lower = since if index == 0 else max(since, float(command.t_ns))
            left += command.left_rad_s * (upper - lower)
            right += command.right_rad_s * (upper - lower)
            upper = lower
        means[row] = left / step_ns, right / step_ns
    return means
