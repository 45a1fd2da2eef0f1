"""How late what logs hold is stamped, where several are searched together: every log has clocks of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any, Generic, TypeVar

import numpy as np

from disco_hw.gap.data.stamp_clock import Samples, StampClock
from disco_hw.log.drive import Commands, Poses, Wheels

# So long before its log begins nothing is stamped; logs that are joined lie further apart.
_EARLY_S = 2.0

ClockOf = Callable[[Wheels, Samples], tuple[StampClock, bool]]
"""The clock of samples against that of the wheels, and whether the log shows it."""


@dataclass(frozen=True, slots=True)
class Aligned(Generic[Samples]):
    """Samples whose stamps run evenly, older than these by `delay_s` in every log.

    `known`: whether any log shows how late they are; `even`: whether stamps ran so by themselves; `apart_s`: standard
    deviation by which logs differed, 0 where they are taken as one; `notes`: what a person has to know.
    """

    samples: Samples
    delay_s: float
    known: bool
    even: bool
    apart_s: float
    notes: tuple[str, ...]


def aligned(
    wheels: Wheels, samples: Samples, begins_s: Sequence[float], clock_of: ClockOf[Samples], least_s: float, whose: str
) -> Aligned[Samples]:
    """Samples of one log, or of several that begin at `begins_s`, laid by the clock of each.

    Delays of logs that lie within `least_s` about their median are taken as one. Of a log that does not show its own
    nobody knows a better one than that of the others; where no log does, they are looked at together. `whose`: "poses'"
    or "commands'".
    """
    edges_s = [-np.inf, *(begin_s - _EARLY_S for begin_s in begins_s[1:]), np.inf]
    logs = [(_between(wheels, *span), _between(samples, *span)) for span in pairwise(edges_s)]
    clocks = [clock_of(*log) for log in logs] if len(logs) > 1 else []
    delays = [clock.delay_s for clock, known in clocks if known]
    if not delays:
        clock, known = clock_of(wheels, samples)
        return Aligned(clock.corrected(samples), clock.delay_s, known, clock.even, 0.0, clock.notes(whose))
    middle_s = float(np.median(delays))
    apart = max(abs(delay_s - middle_s) for delay_s in delays) >= least_s
    parts: list[Samples] = []
    uneven: list[str] = []
    notes: list[str] = []
    for number, ((_, own), (clock, known)) in enumerate(zip(logs, clocks, strict=True), 1):
        even = clock.corrected(own)
        parts.append(replace(even, t_s=even.t_s - (clock.delay_s - middle_s)) if apart and known else even)
        if not clock.even:
            how = f"{1e3 * clock.drift_s:+.0f} ms over" if clock.drift_s else f"{1e3 * clock.jump_s:+.0f} ms at once in"
            uneven.append(f"{how} log {number}")
    if uneven:
        notes.append(
            f"the {whose} clock runs unevenly against the wheels' ({', '.join(uneven)}): their stamps are corrected; "
            "synchronise the clocks"
        )
    if apart:
        said = ", ".join(f"{clock.delay_s:.3g} s" if known else "not known" for clock, known in clocks)
        notes.append(
            f"the {whose} delay against the wheels differs from log to log ({said}): each log is laid by its own, as if"
            f" it were {middle_s:.3g} s in all; synchronise the clocks"
        )
    joined = {each.name: np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(samples)}
    return Aligned(
        replace(samples, **joined),
        middle_s,
        True,
        not uneven,
        float(np.std(delays, ddof=1)) if apart else 0.0,
        tuple(notes),
    )


Part = TypeVar("Part", Commands, Wheels, Poses)


def _between(of: Part, begin_s: float, end_s: float) -> Part:
    inside = (of.t_s >= begin_s) & (of.t_s < end_s)
    values = ((each.name, getattr(of, each.name)) for each in fields(of))
    chosen: dict[str, Any] = {name: value[inside] for name, value in values if isinstance(value, np.ndarray)}
    return replace(of, **chosen)
