"""The seam between DISCO and a system: rolling one block of command sequences out and costing it."""

from __future__ import annotations

from collections.abc import Callable

from disco_hw.control.kernel.layout import Floats, System
from disco_hw.jit import specialise


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
