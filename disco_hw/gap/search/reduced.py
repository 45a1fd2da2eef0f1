"""Analyses that have less than another one, or another name in the place of one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from disco_hw.gap.search.analysis import GapAnalysis
from disco_hw.gap.search.channel_search import ChannelResult
from disco_hw.gap.search.richest_model import LATE


def least_evident_first(analysis: GapAnalysis) -> list[tuple[str, str | None]]:
    """What was found and `timed` does not have, as its channel and its name, or None for the terms of a channel."""
    out: list[tuple[float, str, str | None]] = []
    for which in ("wheels", "body"):
        found: ChannelResult | None = getattr(analysis, which)
        if found is None:
            continue
        for name, rest in each_name(found):
            if name not in LATE:
                out.append((found.selector.evidence(rest, found.names).score, which, name))
        if found.unnamed:
            out.append((max(term.evidence.score for term in found.unnamed), which, None))
    return [(which, name) for _, which, name in sorted(out, key=lambda one: one[0])]


def lacking_one(analysis: GapAnalysis) -> Iterator[GapAnalysis]:
    """Analyses that lack one of the names, or the terms of a channel."""
    for which in ("wheels", "body"):
        found: ChannelResult | None = getattr(analysis, which)
        if found is None:
            continue
        for name, _ in each_name(found):
            yield lacking(analysis, which, name)
        if found.unnamed:
            yield lacking(analysis, which, None)


def lacking(analysis: GapAnalysis, which: str, name: str | None) -> GapAnalysis:
    """An analysis without a name in one of its channels, or without the terms there."""
    found: ChannelResult = getattr(analysis, which)
    if name is not None:
        rest = tuple(other for other in found.names if other != name)
        return _changed(analysis, found, replace(found, names=rest), (name,))
    bare = replace(found, selector=found.plain or found.selector, unnamed=(), plain=None)
    return _changed(analysis, found, bare, tuple(term.form for term in found.unnamed))


def swapped_one(analysis: GapAnalysis) -> Iterator[GapAnalysis]:
    """Analyses that have, in place of one of the names, another that would do as well."""
    for found in (analysis.wheels, analysis.body):
        if found is None:
            continue
        for name, rest in each_name(found):
            for rival in found.selector.rivals(found.names, name):
                yield _changed(analysis, found, replace(found, names=(*rest, rival)), (name,))


def each_name(found: ChannelResult) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Every name that was found, and the others."""
    for name in found.names:
        if name not in found.selector.given:
            yield name, tuple(other for other in found.names if other != name)


def _changed(analysis: GapAnalysis, old: ChannelResult, new: ChannelResult, pruned: tuple[str, ...]) -> GapAnalysis:
    pruned = (*analysis.pruned, *pruned)
    if old is analysis.wheels:
        return replace(analysis, wheels=new, pruned=pruned)
    return replace(analysis, body=new, pruned=pruned)
