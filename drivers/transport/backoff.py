"""How long to wait before the next attempt to bring a link up."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class BackoffPolicy:
    """Delays that double from `first_s` to `longest_s`; a link that was up for `steady_s` starts afresh."""

    first_s: float = 0.05
    longest_s: float = 2.0
    steady_s: float = 1.0


DEFAULT_BACKOFF = BackoffPolicy()


def next_delay_s(policy: BackoffPolicy, previous_s: float | None, up_for_s: float) -> float:
    """Return the delay before the next attempt, in seconds.

    `previous_s` is the delay before the attempt that has just failed, None if there was none; `up_for_s` how long the
    link was up after it (0 if it never came up). A link that flaps keeps backing off.
    """
    if previous_s is None or up_for_s >= policy.steady_s:
        return policy.first_s
    return min(2.0 * previous_s, policy.longest_s)
