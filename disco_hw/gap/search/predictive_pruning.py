"""Names that make the whole prediction worse are not told, however well they fit their own channel.

Where the true form is none that is known, the best stand-in of one channel may lead the chain from command to pose
astray. Held-out predictions decide: a name without which they are clearly better goes; where they are worse than with
the refitted geometry alone, one that does harm goes or another that would do as well takes its place.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain

from disco_hw.gap.search.analysis import GapAnalysis
from disco_hw.gap.search.channel_search import ChannelResult
from disco_hw.gap.search.cross_validation import PredictionErrors, clearly_worse, worse_by
from disco_hw.gap.search.stages import stage_predictions


def prune(analysis: GapAnalysis) -> GapAnalysis:
    """The analysis without what makes its held-out predictions worse."""
    if analysis.body is None:
        return analysis
    settings = analysis.drive.settings.prediction
    predictions = stage_predictions(analysis)
    refitted = predictions.errors("refitted", settings.reported_horizon_s)
    now = predictions.errors("amended", settings.reported_horizon_s)
    for _ in range(settings.most_changes):
        if clearly_worse(refitted, now, settings):
            options = chain(_lacking_one(analysis), _swapped_one(analysis))
            better = _best(refitted, worse_by(refitted, now), options)
        else:
            better = _best(now, 1.0 / settings.worse, _lacking_one(analysis))
            if better is not None and not clearly_worse(better[1], now, settings):
                better = None
        if better is None:
            break
        analysis, now = better
    return analysis


def _best(
    than: PredictionErrors, below: float, options: Iterable[GapAnalysis]
) -> tuple[GapAnalysis, PredictionErrors] | None:
    """Of some analyses the one that predicts best, if its errors are less than `below` times those of another."""
    best, least = None, below
    for option in options:
        horizon_s = option.drive.settings.prediction.reported_horizon_s
        errors = stage_predictions(option).errors("amended", horizon_s)
        ratio = worse_by(than, errors)
        if ratio < least:
            best, least = (option, errors), ratio
    return best


def _lacking_one(analysis: GapAnalysis) -> Iterator[GapAnalysis]:
    """Analyses that lack one of the names, or the terms of a channel."""
    for found in (analysis.wheels, analysis.body):
        if found is None:
            continue
        for name, rest in _each(found):
            yield _changed(analysis, found, replace(found, names=rest), (name,))
        if found.unnamed and found.plain is not None:
            bare = replace(found, selector=found.plain, unnamed=(), plain=None)
            yield _changed(analysis, found, bare, tuple(term.form for term in found.unnamed))


def _swapped_one(analysis: GapAnalysis) -> Iterator[GapAnalysis]:
    """Analyses that have, in place of one of the names, another that would do as well."""
    for found in (analysis.wheels, analysis.body):
        if found is None:
            continue
        for name, rest in _each(found):
            for rival in found.selector.rivals(found.names, name):
                yield _changed(analysis, found, replace(found, names=(*rest, rival)), (name,))


def _each(found: ChannelResult) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Every name that was found, and the others."""
    for name in found.names:
        if name not in found.selector.given:
            yield name, tuple(other for other in found.names if other != name)


def _changed(analysis: GapAnalysis, old: ChannelResult, new: ChannelResult, pruned: tuple[str, ...]) -> GapAnalysis:
    pruned = (*analysis.pruned, *pruned)
    if old is analysis.wheels:
        return replace(analysis, wheels=new, pruned=pruned)
    return replace(analysis, body=new, pruned=pruned)
