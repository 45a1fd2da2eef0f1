"""Data that a log loses on import: counted by signal, reported with its share, and refused where most is lost."""

from __future__ import annotations

from disco_hw.errors import LogError

WARNING = "warning: "
"""Notes that begin with this are printed before everything else."""
WARNED_SHARE, REFUSED_SHARE = 0.05, 0.5
"""Shares of a signal whose loss is a warning, and an error."""


def loss_note(source: str, signal: str, dropped: int, total: int, what: str, hint: str) -> str:
    """Return the sentence on `dropped` of `total` samples of a signal; `what` says what is wrong with them.

    It begins with WARNING if over 5 % of the signal is lost. Raises LogError if over half of it is.
    """
    share = dropped / total
    text = f"{signal}: {dropped} of {total} {what} ({_percent(share)})"
    if share > REFUSED_SHARE:
        raise LogError(f"{source}: {text}; {hint}")
    return f"{WARNING if share > WARNED_SHARE else ''}{source}: {text}"


def warnings_first(notes: tuple[str, ...]) -> tuple[str, ...]:
    """Return the notes with the warnings ahead of the others, each kind in its order."""
    return tuple(sorted(notes, key=lambda note: not note.startswith(WARNING)))


def _percent(share: float) -> str:
    return "under 0.1 %" if share < 0.001 else f"{100.0 * share:.1f} %" if share < 0.1 else f"{100.0 * share:.0f} %"
