"""The gap by stage: what the model as given, refitted and amended predicts of data that it was not fitted to.

The same predictions prune the names that make the whole worse, however well they fit their own channel: where the true
form is none that is known, the best stand-in of one channel may lead the chain from command to pose astray. A name
without which held-out predictions are clearly better goes; where they are worse than with the refitted geometry alone,
one that harms them goes or another that would do as well takes its place.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.search.analysis import FinalFit, GapAnalysis, final_fit
from disco_hw.gap.search.channel_search import ChannelResult
from disco_hw.gap.search.cross_validation import (
    Chain,
    PredictionErrors,
    clearly_worse,
    errors_of,
    floor_errors,
    fold_vectors,
    smoothed_poses,
    worse_by,
)
from disco_hw.gap.search.intervals import GAIN

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StagePredictions:
    """For each stage the chains of the two folds, each fitted on the other one's data.

    `whole`: the amended chain, fitted on all data; `poses` (M, 3) twice: smoothed, and of the nearest sample alone.
    """

    body: BodyChannel
    wheels: WheelChannel | None
    chains: Mapping[str, dict[int, Chain]]
    whole: Chain
    poses: tuple[Array, Array]

    def errors(self, stage: str, ahead_s: float) -> PredictionErrors:
        """Errors of one stage, `nominal`, `refitted` or `amended`, so far ahead on held-out data."""
        return errors_of(self.body, self.wheels, self.chains[stage], ahead_s, self.poses)

    def floor(self, ahead_s: float) -> PredictionErrors:
        """What noise alone makes so far ahead."""
        return floor_errors(self.body, self.wheels, self.whole, ahead_s, self.poses)

    def table(self) -> dict[str, dict[float, PredictionErrors]]:
        """Errors by stage, with the floor, and horizon."""
        horizons = self.body.settings.prediction.horizons_s
        table = {stage: {ahead_s: self.errors(stage, ahead_s) for ahead_s in horizons} for stage in self.chains}
        table["floor"] = {ahead_s: self.floor(ahead_s) for ahead_s in horizons}
        return table


def stage_predictions(analysis: GapAnalysis, final: FinalFit | None = None) -> StagePredictions:
    """The predictions of an analysis in which the body was judged; `final` is its final fit, if it is made already."""
    final = final_fit(analysis) if final is None else final
    body, wheels = analysis.body, analysis.wheels
    assert body is not None
    assert final.final_body is not None
    channel = body.channel
    assert isinstance(channel, BodyChannel)
    settings, neutral = channel.settings, body.selector.channel.neutral
    refitted = fold_vectors(body.base, channel.block, neutral, settings)
    amended = fold_vectors(final.final_body, channel.block, neutral, settings)
    wheel_channel = None
    wheels_base = wheels_full = {0: analysis.nominal_wheels, 1: analysis.nominal_wheels}
    if wheels is not None:
        assert isinstance(wheels.channel, WheelChannel)
        wheel_channel, wheels_neutral = wheels.channel, wheels.selector.channel.neutral
        wheels_base = fold_vectors(wheels.base, wheel_channel.block, wheels_neutral, settings)
        wheels_full = fold_vectors(wheels.fit, wheel_channel.block, wheels_neutral, settings)

    def chain(of_body: Array, of_wheels: Array | None) -> Chain:
        return _chain(body, wheels, of_body, of_wheels, final.encoder_is_cause)

    def chains(of_body: dict[int, Array], of_wheels: dict[int, Array]) -> dict[int, Chain]:
        return {held: chain(of_body[held], None if wheels is None else of_wheels[held]) for held in (0, 1)}

    nominal = {0: analysis.nominal_body, 1: analysis.nominal_body}
    nominal_wheels = {0: analysis.nominal_wheels, 1: analysis.nominal_wheels}
    return StagePredictions(
        channel,
        wheel_channel,
        {
            "nominal": chains(nominal, nominal_wheels),
            "refitted": chains(refitted, wheels_base),
            "amended": chains(amended, wheels_full),
        },
        chain(final.final_body.vector, wheels.fit.vector if wheels is not None else None),
        smoothed_poses(channel, final.final_body.vector),
    )


def _chain(
    body: ChannelResult, wheels: ChannelResult | None, of_body: Array, of_wheels: Array | None, encoder_is_cause: bool
) -> Chain:
    """A chain of two vectors; where it is the encoders that count wrong, the wheels turn as commanded."""
    core, perturbation = _split(body, of_body)
    if wheels is None or of_wheels is None:
        return Chain(core, None, perturbation)
    wheels_core, wheels_perturbation = _split(wheels, of_wheels)
    if encoder_is_cause:
        places = [wheels.channel.layout.place[f"{GAIN}.{side}"] for side in ("left", "right")]
        wheels_core = wheels_core.copy()
        wheels_core[places] = 0.0
    return Chain(core, wheels_core, perturbation, wheels_perturbation)


def _split(found: ChannelResult, vector: Array) -> tuple[Array, Array | None]:
    """Entries of effects and what terms add; a vector without terms is whole already."""
    if vector.size == len(found.channel.layout.columns):
        return vector, None
    return found.selector.channel.split(vector)


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
