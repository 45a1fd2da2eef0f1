"""Names that make the whole prediction worse are not told, however well they fit their own channel.

Where the true form is none that is known, the best stand-in of one channel may lead the chain from command to pose
further astray than none. Held-out predictions decide: it goes, or another that would do as well takes its place.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from disco_hw.gap.held_out import WORSE, worse_by
from disco_hw.gap.outcome import Outcome
from disco_hw.gap.report import REPORTED_HORIZON_S
from disco_hw.gap.search import Found
from disco_hw.model.effects import REGISTRY

_MOST_CHANGES = 4


def harmless(outcome: Outcome) -> Outcome:
    """The outcome without what makes its held-out predictions worse than those of the refitted geometry."""
    if outcome.body is None:
        return outcome
    worse = _worse(outcome)
    for _ in range(_MOST_CHANGES):
        if not worse > WORSE:
            break
        options = [(_worse(option), place, option) for place, option in enumerate(_without_one(outcome))]
        if not options or min(options)[0] >= worse:
            break
        worse, _, outcome = min(options)
    return outcome


def _worse(outcome: Outcome) -> float:
    before, after = (outcome.errors(stage, REPORTED_HORIZON_S) for stage in ("refitted", "amended"))
    return worse_by(before, after)


def _without_one(outcome: Outcome) -> Iterator[Outcome]:
    """Outcomes that lack one of the names, or have a rival in its place, or lack the terms of a channel."""
    for found in (outcome.wheels, outcome.body):
        if found is None:
            continue
        for name in found.names:
            if name in found.selector.given:
                continue
            rest = tuple(other for other in found.names if other != name)
            for instead in ((), *((rival,) for rival in found.selector.rivals(found.names, name))):
                yield _changed(outcome, found, replace(found, names=(*rest, *instead)), (name,))
        if found.unnamed and found.plain is not None:
            bare = replace(found, selector=found.plain, unnamed=(), plain=None)
            yield _changed(outcome, found, bare, tuple(term.form for term in found.unnamed))


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
