"""The seam between DISCO and a system: rolling one block of command sequences out and costing it."""

from __future__ import annotations

from typing import Any


def roll_block(
    system: Any, costs: Any, points: int, padded: int, block: int, horizon: int, commands: Any, state: Any
) -> None:
    """Costs of one block of samples under all parameter points; compiled code only.

    `system` is the named tuple of a system's terms; its file overloads this function for it. Writes
    `costs[i * padded + block * BLOCK + b]` for parameter point i and sample b of the block, from the block's
    `commands`; `state` is scratch of STATE_ROWS rows.
    """
    raise TypeError(f"{type(system).__name__} cannot be rolled out")
