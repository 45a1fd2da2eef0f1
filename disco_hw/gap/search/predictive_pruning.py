"""Names that make the whole prediction worse are not told, however well they fit their own channel.

Where the true form is none that is known, the best stand-in of one channel may lead the chain from command to pose
astray. Held-out predictions decide: a name without which they are clearly better goes; where they are worse than with
the refitted geometry alone, one that does harm goes or another that would do as well takes its place.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain

from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.report.findings import REPORTED_HORIZON_S
from disco_hw.gap.search.analysis import Outcome
from disco_hw.gap.search.channel_search import Found
from disco_hw.gap.search.cross_validation import WORSE, Errors, clearly_worse, worse_by

_MOST_CHANGES = 4


def harmless(outcome: Outcome) -> Outcome:
    """The outcome without what makes its held-out predictions worse."""
    if outcome.body is None:
        return outcome
    refitted = outcome.errors("refitted", REPORTED_HORIZON_S)
    for _ in range(_MOST_CHANGES):
        now = _amended(outcome)
        if clearly_worse(refitted, now):
            better = _best(refitted, worse_by(refitted, now), chain(_lacking_one(outcome), _swapped_one(outcome)))
        else:
            better = _best(now, 1.0 / WORSE, _lacking_one(outcome))
            if better is not None and not clearly_worse(_amended(better), now):
                better = None
        if better is None:
            break
        outcome = better
    return outcome


def _amended(outcome: Outcome) -> Errors:
    return outcome.errors("amended", REPORTED_HORIZON_S)


def _best(than: Errors, below: float, options: Iterable[Outcome]) -> Outcome | None:
    """Of some outcomes the one that predicts best, if its errors are less than `below` times those of another."""
    ratios = [(worse_by(than, _amended(option)), place, option) for place, option in enumerate(options)]
    if not ratios or not min(ratios)[0] < below:
        return None
    return min(ratios)[2]


def _lacking_one(outcome: Outcome) -> Iterator[Outcome]:
    """Outcomes that lack one of the names, or the terms of a channel."""
    for found in (outcome.wheels, outcome.body):
        if found is None:
            continue
        for name, rest in _each(found):
            yield _changed(outcome, found, replace(found, names=rest), (name,))
        if found.unnamed and found.plain is not None:
            bare = replace(found, selector=found.plain, unnamed=(), plain=None)
            yield _changed(outcome, found, bare, tuple(term.form for term in found.unnamed))


def _swapped_one(outcome: Outcome) -> Iterator[Outcome]:
    """Outcomes that have, in place of one of the names, another that would do as well."""
    for found in (outcome.wheels, outcome.body):
        if found is None:
            continue
        for name, rest in _each(found):
            for rival in found.selector.rivals(found.names, name):
                yield _changed(outcome, found, replace(found, names=(*rest, rival)), (name,))


def _each(found: Found) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Every name that was found, and the others."""
    for name in found.names:
        if name not in found.selector.given:
            yield name, tuple(other for other in found.names if other != name)


def _changed(outcome: Outcome, old: Found, new: Found, harmful: tuple[str, ...]) -> Outcome:
    harmful = (*outcome.harmful, *harmful)
    if old is outcome.wheels:
        return replace(outcome, wheels=new, harmful=harmful)
    return replace(outcome, body=new, harmful=harmful)


def left_out(outcome: Outcome) -> list[str]:
    """Sentences on what was left out for its harm."""
    return [
        f"{REGISTRY[name].channel.value if name in REGISTRY else 'unnamed'}: {name} fits, and yet makes held-out "
        "predictions worse: it only stands for what is missing"
        for name in outcome.harmful
    ]
