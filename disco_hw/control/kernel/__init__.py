"""The compiled step of DISCO: how its buffers are laid out, and what it calls.

That is a system's rollout of a block and a task's cost. Samples are the innermost dimension everywhere, in blocks of
BLOCK: every loop over them becomes vector instructions without a remainder, and a block's commands and state stay in
the first-level cache. All of it is float32; docs/kernel.md draws the rows and says what each one costs.

What the functions of a task are is written in disco_hw/tasks; they are chosen by the type of the task's terms.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numba import types
from numpy.typing import NDArray

from disco_hw import tasks
from disco_hw.jit import cast_like, fast_length, fast_norm, fast_norm_and_inverse, specialise
from disco_hw.tasks import Found

Floats: TypeAlias = NDArray[np.float32]
# Any: the compiler takes any named tuple with the functions of its kind, which differ in their fields.
Terms: TypeAlias = Any
"""The terms of a task's cost (disco_hw/tasks)."""
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
POINT, AHEAD0, AHEAD1, SCALED0, SCALED1 = (U(row) * BLOCK for row in (5, 15, 25, 35, 45))
# Within those ten: the tracked point, the task's memory, the cost so far; then, for a task with a table, what was kept
# for the cost, the row to look up, and the four numbers found there, of one sample after the other.
X, Y, MEMORY, TOTAL, KEPT, ROW, FOUND = (U(row) * BLOCK for row in range(7))
COLUMNS = U(4)
STATE_ROWS = 55

# While the wheels are turned, the state's first rows hold their speeds, and those behind them the means of commands.
LEFT, RIGHT, REMEMBERED = U(0) * BLOCK, BLOCK, U(2) * BLOCK
# Means of the body: where its terms act, no point shares another's rollout at another scale, and these rows are free.
BODY_REMEMBERED = SCALED0
# The wheels' motion: for every step a row of their sum and one of right minus left; then a row of the sum's change.
SUM, DIFFERENCE = U(0) * BLOCK, BLOCK
WHEEL_STRIDE = U(2) * BLOCK
WHEEL_ROWS = 3

# Places in the start of a rollout: position relative to the task's origin (m), heading, wheel speeds (rad/s), time (s),
# the task's memory; how far the ground carries the robot in a step (m).
START_X, START_Y, START_COS, START_SIN, START_LEFT, START_RIGHT, START_TIME, START_MEMORY = range(8)
CARRIED_X, CARRIED_Y = 8, 9
START_SIZE = 10

CHANNELS = 2
"""Commands of a skid-steer robot: left and right."""

# Bytes, on x86-64 and most of ARM.
_CACHE_LINE = 64


def aligned_zeros(size: int, dtype: type = np.float32) -> NDArray[np.floating]:
    """Return a flat array of zeros that starts on a cache line, so that no vector of a row straddles two."""
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


_registered: set[Callable[..., object]] = set()


def stage_cost(
    terms: object, memory: float, step: int, x_old: float, y_old: float, x: float, y: float,
    cos_yaw: float, sin_yaw: float, forward: float, found: Found,
) -> tuple[float, float]:  # fmt: skip
    """Cost of one step of a rollout and the task's memory after it: `stage` of the terms; compiled code only."""
    raise TypeError(f"{type(terms).__name__} has no stage cost")


def terminal_cost(
    terms: object, memory: float, x: float, y: float, cos_yaw: float, sin_yaw: float, found: Found
) -> float:
    """Cost of the state that a rollout ends in: `terminal` of the terms; compiled code only."""
    raise TypeError(f"{type(terms).__name__} has no terminal cost")


def follow(terms: object, memory: float, x: float, y: float, forward: float, found: Found) -> tuple[float, float]:
    """Return the memory after a step, and a number to keep for its cost: `follow` of terms with a table.

    Compiled only.
    """
    raise TypeError(f"{type(terms).__name__} has no table to follow")


def row_of(terms: object, memory: float) -> int:
    """Return the table's row for a memory: `row_of` of terms with a table; compiled code only."""
    raise TypeError(f"{type(terms).__name__} has no table")


def place_of(terms: object, place: float, x: float, y: float) -> float:
    """Return the place on the line beside a position: `place_of` of terms with a line; compiled code only."""
    raise TypeError(f"{type(terms).__name__} has no line")


def line_at(terms: object, place: float, ahead_m: float) -> tuple[float, float, float, float, float, float]:
    """Return the point and motion on the line of a task's terms.

    The order is that of `line_at` of terms with a line; compiled code only.
    """
    raise TypeError(f"{type(terms).__name__} has no line")


def looks_up(terms: object) -> bool | None:
    """None for terms without a table, anything else for terms with one; a constant to the compiler."""
    raise TypeError(f"{type(terms).__name__} is no named tuple of terms")


def _chosen(terms: Any, name: str) -> Callable[..., object] | None:
    """Return the function of that name of the terms whose numba type this is; None if they have none."""
    for function in tasks.HELPERS:
        if function not in _registered:
            _registered.add(function)
            specialise(function)(lambda *_, _function=function: _function)
    found: Callable[..., object] | None = getattr(getattr(terms, "instance_class", None), name, None)
    return found


specialise(stage_cost)(lambda terms, *_: _chosen(terms, "stage"))
specialise(terminal_cost)(lambda terms, *_: _chosen(terms, "terminal"))
specialise(follow)(lambda terms, *_: _chosen(terms, "follow"))
specialise(row_of)(lambda terms, *_: _chosen(terms, "row_of"))
specialise(place_of)(lambda terms, *_: _chosen(terms, "place_of"))
specialise(line_at)(lambda terms, *_: _chosen(terms, "line_at"))


@specialise(looks_up)
def _looks_up(terms: Any) -> Callable[[Any], bool | None] | None:
    fields = getattr(getattr(terms, "instance_class", None), "_fields", None)
    if fields is None:
        return None
    has_table = "table" in fields and not isinstance(terms[fields.index("table")], types.NoneType)
    return (lambda terms: True) if has_table else (lambda terms: None)


# The compiler wants Python code, which calls the compiled function.
specialise(tasks.norm)(lambda x, y: lambda x, y: fast_norm(x, y))  # noqa: PLW0108
specialise(tasks.norm_and_inverse)(lambda x, y: lambda x, y: fast_norm_and_inverse(x, y))  # noqa: PLW0108
specialise(tasks.norm_of_three)(lambda x, y, z: lambda x, y, z: fast_length(x, y, z))  # noqa: PLW0108
specialise(tasks.constant)(lambda value, like: lambda value, like: cast_like(value, like))  # noqa: PLW0108
