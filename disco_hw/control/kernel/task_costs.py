"""The seam between the rollout and a task: calls in compiled code become those of the task's own functions.

What these functions are is written in disco_hw/tasks/cost.py. Here they are chosen by the type of the task's terms.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any  # Any: the compiler's types, which numba does not type.

from disco_hw.jit import cast_like, quick_length, quick_norm, quick_norm_and_inverse, specialise
from disco_hw.tasks import cost
from disco_hw.tasks.cost import Found

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
    """The memory after a step, and a number to keep for its cost: `follow` of terms with a table; compiled only."""
    raise TypeError(f"{type(terms).__name__} has no table to follow")


def row_of(terms: object, memory: float) -> int:
    """The table's row for a memory: `row_of` of terms with a table; compiled code only."""
    raise TypeError(f"{type(terms).__name__} has no table")


def place_of(terms: object, place: float, x: float, y: float) -> float:
    """The place on the line beside a position: `place_of` of terms with a line; compiled code only."""
    raise TypeError(f"{type(terms).__name__} has no line")


def line_at(terms: object, place: float, ahead_m: float) -> tuple[float, float, float, float, float, float]:
    """Where and how to be on the line: `line_at` of terms with a line; compiled code only."""
    raise TypeError(f"{type(terms).__name__} has no line")


def looks_up(terms: object) -> bool | None:
    """None for terms without a table, anything else for terms with one; a constant to the compiler."""
    raise TypeError(f"{type(terms).__name__} is no named tuple of terms")


def _chosen(terms: Any, name: str) -> Callable[..., object] | None:
    """The function of that name of the terms whose numba type this is; None if they have none."""
    for function in cost.HELPERS:
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
    return (lambda terms: True) if "table" in fields else (lambda terms: None)


@specialise(cost.norm)
def _norm(x: Any, y: Any) -> Callable[..., float]:
    return lambda x, y: quick_norm(x, y)  # noqa: PLW0108 - the compiler wants Python code


@specialise(cost.norm_and_inverse)
def _norm_and_inverse(x: Any, y: Any) -> Callable[..., tuple[float, float]]:
    return lambda x, y: quick_norm_and_inverse(x, y)  # noqa: PLW0108 - the compiler wants Python code


@specialise(cost.norm_of_three)
def _norm_of_three(x: Any, y: Any, z: Any) -> Callable[..., float]:
    return lambda x, y, z: quick_length(x, y, z)  # noqa: PLW0108 - the compiler wants Python code


@specialise(cost.constant)
def _constant(value: Any, like: Any) -> Callable[..., float]:
    return lambda value, like: cast_like(value, like)  # noqa: PLW0108 - the compiler wants Python code
