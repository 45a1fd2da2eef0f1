"""How the buffers of the compiled step are laid out, and the call by which a system rolls one block of them out.

Samples are the innermost dimension everywhere, in blocks of BLOCK: every loop over them becomes vector instructions
without a remainder, and a block's commands and state stay in the first-level cache.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from disco_hw.jit import specialise

Floats: TypeAlias = NDArray[np.float32]
# Any: the compiler takes any named tuple with the functions of its kind, which differ in their fields.
Terms: TypeAlias = Any
"""The terms of a task's cost (disco_hw/tasks/cost.py)."""
# Any: as above; SkidSteer and PendulumTerms are two.
System: TypeAlias = Any
"""What is rolled out: a named tuple for which `roll_block` has a form."""

# All indices in the hot loops are unsigned: a signed one is checked for wrap-around at every access. All buffers are
# flat with rows at constant distances, which spares the compiler most checks for overlap.
U = np.uintp
BLOCK = U(80)

# The rows of a block's state, in the order of docs/kernel.md. What all points of a rollout share:
AXLE_X, AXLE_Y, COS, SIN, FORWARD = (U(row) * BLOCK for row in range(5))
# Then ten rows for the rollout's own point and for each of the four that are equivalent to it.
OWN, AHEAD0, AHEAD1, SCALED0, SCALED1 = (U(row) * BLOCK for row in (5, 15, 25, 35, 45))
# Within those ten: the tracked point, the task's memory, the cost so far; then, for a task with a table, what was kept
# for the cost, the row to look up, and the four numbers found there, of one sample after the other.
X, Y, MEMORY, TOTAL, KEPT, ROW, FOUND = (U(row) * BLOCK for row in range(7))
COLUMNS = U(4)
STATE_ROWS = 55

# While the wheels are turned, the state's first rows hold their speeds.
LEFT, RIGHT = U(0) * BLOCK, BLOCK
# The wheels' motion: for every step a row of their sum and one of right minus left; then a row of the sum's change.
SUM, DIFFERENCE = U(0) * BLOCK, BLOCK
WHEEL_STRIDE = U(2) * BLOCK
WHEEL_ROWS = 3

CHANNELS = 2
"""Commands of a skid-steer robot: left and right."""

_CACHE_LINE = 64


def aligned_zeros(size: int, dtype: type = np.float32) -> NDArray[np.floating]:
    """A flat array of zeros that starts on a cache line, so that no vector of a row straddles two."""
    raw = np.zeros(size * np.dtype(dtype).itemsize + _CACHE_LINE, np.uint8)
    offset = -raw.ctypes.data % _CACHE_LINE
    return raw[offset : offset + size * np.dtype(dtype).itemsize].view(dtype)


def block_count(samples: int) -> int:
    """Blocks needed for `samples`; the last one may be partly idle."""
    return math.ceil(samples / int(BLOCK))


def roll_block(
    system: System, costs: Floats, points: int, padded: int, block: int, horizon: int, commands: Floats, state: Floats
) -> None:
    """Costs of one block of samples under all parameter points; compiled code only.

    `system` is the named tuple of a system's terms; its file gives the form for it with `rolls_out`. Writes
    `costs[i * padded + block * BLOCK + b]` for parameter point i and sample b of the block, from the block's
    `commands`; `state` is scratch of STATE_ROWS rows.
    """
    raise TypeError(f"{type(system).__name__} cannot be rolled out")


def rolls_out(system_class: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a function the form of `roll_block` for the systems of a class."""

    def register(function: Callable[..., None]) -> Callable[..., None]:
        specialise(roll_block)(
            lambda system, *_: function if getattr(system, "instance_class", None) is system_class else None
        )
        return function

    return register
