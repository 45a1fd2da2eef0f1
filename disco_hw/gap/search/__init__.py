"""Which effects are missing: fits, evidence, selection, held-out predictions.

Here the gap by stage: what the model as given, refitted and amended predicts of data that it was not fitted to. The
amended model keeps of all that was found what these predictions need: where the true form is none that is known, the
best stand-in of one channel may lead the chain from command to pose astray.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from disco_hw.effects import Stage
from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.noise import sensor_noise
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.search.analysis import GAIN, FinalFit, GapAnalysis, final_fit, lacking, least_evident_first
from disco_hw.gap.search.channel_result import ChannelResult
from disco_hw.gap.search.cross_validation import (
    Chain,
    PredictionErrors,
    errors_of,
    floor_errors,
    fold_of,
    fold_vectors,
    scored_horizon_s,
    smoothed_poses,
)
from disco_hw.gap.search.decision import best_of, excess
from disco_hw.gap.search.end_to_end import Ahead, Freed, JointFit, Part
from disco_hw.gap.search.least_squares import Fit, inverse
from disco_hw.gap.search.richest_model import DELAY_COLUMNS, DELAY_STARTS_S, with_delay

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StagePredictions:
    """For each stage the chains of the folds, each fitted on the data of the others.

    `poses` (M, 3) twice: smoothed, and of the nearest sample alone; `joint`: of stages that were fitted end to end,
    what was freed and the fit on all data; `kept`: what `amended` has of all that was found.
    """

    body: BodyChannel
    wheels: WheelChannel | None
    chains: Mapping[str, dict[int, Chain]]
    poses: tuple[Array, Array]
    joint: Mapping[str, tuple[Freed, JointFit]] = field(default_factory=dict)
    kept: tuple[GapAnalysis, FinalFit] | None = None

    @property
    def scored_horizon_s(self) -> float:
        """Horizon at which stages are compared (s)."""
        return scored_horizon_s(self.body, self.poses)

    def errors(self, stage: str, ahead_s: float | None = None) -> PredictionErrors:
        """Errors of one stage on held-out data so far ahead, or as far as stages are compared."""
        ahead_s = self.scored_horizon_s if ahead_s is None else ahead_s
        return errors_of(self.body, self.wheels, self.chains[stage], ahead_s, self.poses)

    def errors_of_body(self, stage: str) -> PredictionErrors | None:
        """Errors of one stage with the wheels as they were measured; None where they are measured in any case."""
        if self.wheels is None:
            return None
        measured = {block: replace(chain, wheels=None) for block, chain in self.chains[stage].items()}
        return errors_of(self.body, None, measured, self.scored_horizon_s, self.poses)

    def table(self) -> dict[str, dict[float, PredictionErrors]]:
        """Errors by stage and horizon, with the floor, for which the wheels' path is that of the geometry alone."""
        horizons = self.body.settings.prediction.horizons_s
        table = {stage: {ahead_s: self.errors(stage, ahead_s) for ahead_s in horizons} for stage in self.chains}
        table["floor"] = {ahead_s: self.floor(ahead_s) for ahead_s in horizons}
        return table

    def floor(self, ahead_s: float) -> PredictionErrors:
        """Errors of a perfect model so far ahead, by the sensors' noise."""
        noise = sensor_noise(self.body, with_delay(self.body, self.chains["refitted"][0].body))
        return floor_errors(self.body, noise, ahead_s, self.poses)


def stage_predictions(analysis: GapAnalysis, final: FinalFit) -> StagePredictions:
    """Predictions of `refitted` and `amended`, the channels fitted apart, where the body was judged."""
    body, wheels = analysis.body, analysis.wheels
    assert body is not None
    assert final.final_body is not None
    channel = body.channel
    assert isinstance(channel, BodyChannel)
    wheel_channel = None if wheels is None else wheels.channel
    assert wheel_channel is None or isinstance(wheel_channel, WheelChannel)
    chains = {
        stage: _chains(analysis, final, _by_fold(analysis, fits))
        for stage, fits in (("refitted", _base(analysis)), ("amended", _all_fits(analysis, final)))
    }
    poses = smoothed_poses(channel, final.final_body.vector)
    return StagePredictions(channel, wheel_channel, chains, poses)


@dataclass(frozen=True)
class _Fitted:
    """A stage that was fitted end to end: what was freed, the fit on all data, and those on the data of one fold."""

    of: Freed
    joint: JointFit
    folds: Mapping[int, JointFit]

    @classmethod
    def to(cls, ahead: Ahead, of: Freed) -> _Fitted:
        """Fit all data, and from there the data without each fold."""
        joint = ahead.fit(of)
        start = of.at(joint.vectors)
        return cls(of, joint, {fold: ahead.fit(start, fold) for fold in range(ahead.folds)})

    def at(self, fold: int | None = None) -> Freed:
        """Return the freed entries around the fit to all data, or to those without one fold."""
        return self.of.at((self.joint if fold is None else self.folds[fold]).vectors)

    @property
    def chains(self) -> dict[int, Chain]:
        """The chains of the folds."""
        return {fold: self.of.chain(fitted.vectors) for fold, fitted in self.folds.items()}


def joint_predictions(analysis: GapAnalysis, final: FinalFit) -> StagePredictions:
    """Predictions of every stage, each of which ends with a fit of the whole chain, from commands to poses.

    `nominal`: the model as given; `refitted`: its geometry, and the effects that it had; `timed`: also what makes
    wheels late; `amended`: what predictions need of all that was found, from where the channels apart have it or, if
    held-out data are predicted better so, on top of `timed`.
    """
    apart = stage_predictions(analysis, final)
    ahead = Ahead.of(apart.body, apart.wheels, apart.poses)
    base = _base(analysis)
    nominal = [analysis.nominal_body, analysis.nominal_wheels][: len(base)]
    every = dict.fromkeys(range(analysis.drive.folds.count), nominal)
    chains = {"nominal": _chains(analysis, final, every)}
    parts = tuple(
        Part(channel.layout, one.vector, one.active, _roughly(channel, one))
        for channel, one in zip((apart.body, apart.wheels), base, strict=False)
        if channel is not None
    )
    refitted = _Fitted.to(
        ahead, Freed(parts, lambda vectors: Chain(vectors[0], vectors[1] if len(vectors) > 1 else None))
    )
    timed = _Fitted.to(ahead, _timed(ahead, refitted.at()))
    floor, worth = apart.floor(apart.scored_horizon_s), analysis.drive.settings.report.worth_share
    needed = _needed(of_every_log(analysis, final), timed, ahead, apart, floor, worth)
    amended = _Fitted(needed.candidate.of, needed.fit(ahead), needed.folds)
    stages = {"refitted": refitted, "timed": timed, "amended": amended}
    chains |= {name: stage.chains for name, stage in stages.items()}
    joint = {name: (stage.of, stage.joint) for name, stage in stages.items()}
    kept = needed.candidate.analysis, needed.candidate.final
    return StagePredictions(apart.body, apart.wheels, chains, apart.poses, joint, kept)


@dataclass(frozen=True)
class _Candidate:
    """A model that may be handed out: what was found of it, what a fit of all data frees, and one of each fold."""

    analysis: GapAnalysis
    final: FinalFit
    of: Freed
    by_fold: Mapping[int, Freed]

    @classmethod
    def of_channels(cls, analysis: GapAnalysis, apart: StagePredictions) -> _Candidate:
        """All that was found, from where the channels apart have it."""
        trust, final = apart.body.settings.prediction.joint_trust**-2.0, final_fit(analysis)
        fits = _all_fits(analysis, final)

        def chain(vectors: Sequence[Array]) -> Chain:
            return _chain(analysis, final, vectors)

        of_all = tuple(
            Part(one.selector.channel.layout, fitted.vector, fitted.active, trust * fitted.information())
            for one, fitted in zip((analysis.body, analysis.wheels), fits, strict=False)
            if one is not None
        )
        by_fold = {}
        for fold, vectors in _by_fold(analysis, fits).items():
            inside = zip(of_all, vectors, fits, (apart.body, apart.wheels), strict=False)
            folded = tuple(
                replace(part, vector=vector, information=trust * _information(one, channel, fold))
                for part, vector, one, channel in inside
                if channel is not None
            )
            by_fold[fold] = Freed(folded, chain)
        return cls(analysis, final, Freed(of_all, chain), by_fold)

    def on_top(self, timed: _Fitted) -> tuple[_Candidate, ...]:
        """Return the candidate on top of `timed`, and once more from the channels' values if these are far from it.

        A fit should not begin at a lag that stands for something that it contains.
        """
        starts = (True, False) if self._begins_far(timed.at()) else (True,)
        return tuple(
            replace(
                self,
                of=_on_top(self.of, timed.at(), there),
                by_fold={fold: _on_top(of, timed.at(fold), there) for fold, of in self.by_fold.items()},
            )
            for there in starts
        )

    def _begins_far(self, timed: Freed) -> bool:
        """Whether `timed` makes wheels late by much more or less than their channel."""
        if len(timed.parts) == 1:
            return False
        amended, plain = self.of.parts[1], timed.parts[1].vector
        delay_places = [amended.layout.place[name] for name in DELAY_COLUMNS]
        far_s: float = self.analysis.drive.settings.prediction.delay_far_s
        return bool(np.abs(amended.vector[delay_places] - plain[delay_places]).max() > far_s)

    def evaluate(self, ahead: Ahead, apart: StagePredictions) -> _Evaluated:
        """Evaluate the candidate's errors on held-out data."""
        joint = ahead.fit(self.of)
        folds = {fold: self._fit_without(fold, joint, ahead) for fold in self.by_fold}
        chains = {fold: of.chain(folds[fold].vectors) for fold, of in self.by_fold.items()}
        errors = errors_of(apart.body, apart.wheels, chains, apart.scored_horizon_s, apart.poses)
        return _Evaluated(self, joint, folds, errors)

    def _fit_without(self, fold: int, joint: JointFit, ahead: Ahead) -> JointFit:
        """Fit the data without one fold, from the values that the channels have without it.

        Where that ends far above what the fit of all data costs on the same data, it begins there. Elsewhere it must
        not: what only the left out data tell would stay as they tell it.
        """
        of, worth = self.by_fold[fold], self.analysis.drive.settings.report.worth_share
        own = ahead.fit(of, fold)
        costs = [ahead.usual_cost(of.chain(one.vectors), fold) for one in (own, joint)]
        return own if costs[0] <= costs[1] + worth else ahead.fit(of, fold, joint.vectors)


@dataclass(frozen=True)
class _Evaluated:
    """A candidate, its fits to all data and without each fold, and the errors of these on that."""

    candidate: _Candidate
    joint: JointFit
    folds: Mapping[int, JointFit]
    errors: PredictionErrors

    def fit(self, ahead: Ahead) -> JointFit:
        """Return the best fit of all data, of those begun at the candidate's values and at each fold's fit.

        From a start far off the whole log may end where no fold does.
        """
        of = self.candidate.of
        fits = [self.joint, *(ahead.fit(of, begin=fold.vectors) for fold in self.folds.values())]
        return min(fits, key=lambda one: ahead.usual_cost(of.chain(one.vectors)))


def of_every_log(analysis: GapAnalysis, final: FinalFit) -> GapAnalysis:
    """Return the analysis without effects of the pose source that may hold for this log only.

    These are delays of poses whose clock runs unevenly, and effects with the neutral value of each parameter inside its
    interval.
    """
    estimated = {} if final.body_estimates is None else final.body_estimates.by_name
    for which, name in least_evident_first(analysis):
        effect = None if name is None else REGISTRY[name]
        if effect is None or effect.stage not in (Stage.POSE, Stage.POSE_TIME):
            continue
        known = [estimated[column] for column in effect.columns]
        none = all(e.low <= p.neutral <= e.high for e, p in zip(known, effect.parameters, strict=True))
        if none or (effect.stage is Stage.POSE_TIME and not analysis.drive.pose_clock_even):
            analysis = lacking(analysis, which, name)
    return analysis


def _needed(
    analysis: GapAnalysis, timed: _Fitted, ahead: Ahead, apart: StagePredictions, floor: PredictionErrors | None,
    worth: float,
) -> _Evaluated:  # fmt: skip
    """Return the candidate reduced to what predictions need of all that was found.

    Effects and terms are dropped, the least evident first, where the mean score of held-out data without them
    (`decision.py`) exceeds the best candidate's by `worth` at most. What predictions do not need may hold for this log
    only. `floor`: errors of a perfect model, by the sensors' noise.
    """
    of_channels = _Candidate.of_channels(analysis, apart)
    kept = of_channels.evaluate(ahead, apart)
    if not analysis.found_any:
        return kept

    def best_of_these(*options: _Evaluated) -> _Evaluated:
        return best_of(options, lambda one: one.errors, floor)

    def topped(candidate: _Candidate) -> _Evaluated:
        return best_of_these(*(one.evaluate(ahead, apart) for one in candidate.on_top(timed)))

    best = best_of_these(kept, topped(of_channels))
    if excess(best.errors, kept.errors, floor) > worth:
        kept = best
    for which, name in least_evident_first(analysis):
        fewer = lacking(kept.candidate.analysis, which, name)
        if not fewer.found_any:
            break
        option = topped(_Candidate.of_channels(fewer, apart))
        if excess(best.errors, option.errors, floor) <= worth:
            kept = option
        best = best_of_these(best, option)
    return kept


def _on_top(amended: Freed, timed: Freed, there: bool) -> Freed:
    """Free the entries of `amended` on top of `timed`: geometry and delays as free as in `timed`, the rest as trusted.

    `there`: whether they begin at the values of `timed`, or at those of the channels.

    If a channel's form is none of the known ones, its best fit may be far from what predicts best, with too narrow an
    interval.
    """
    parts = []
    for part, plain in zip(amended.parts, timed.parts, strict=True):
        active = (*plain.active, *(place for place in part.active if place not in plain.active))
        others = [k for k, place in enumerate(part.active) if place not in plain.active]
        trusted = inverse(inverse(part.information)[np.ix_(others, others)])
        vector, low, both = part.vector.copy(), part.layout.low.copy(), list(plain.active)
        low[both] = plain.layout.low[both]
        vector[both] = plain.vector[both] if there else np.maximum(vector[both], low[both])
        information = block_diag(plain.information, trusted) if others else plain.information
        parts.append(Part(replace(part.layout, low=low), vector, active, information))
    return replace(amended, parts=tuple(parts))


def _information(found: Fit, channel: BodyChannel | WheelChannel, left_out: int) -> Array:
    """Return the information of the data without one fold about a fit's active entries, with its prior, (A, A)."""
    inside = fold_of(channel) != left_out
    slope = found.jacobian[inside]
    return np.asarray(slope.T @ slope) + (0.0 if found.precision is None else np.diag(found.precision))


def _roughly(channel: BodyChannel | WheelChannel, found: Fit) -> Array:
    """Return a weak prior that keeps the geometry near the body's, for logs with few commands; zero for the rest."""
    known = np.zeros(len(found.active))
    share = channel.settings.prediction.rough_geometry
    known[: len(channel.free)] = (share * found.vector[[0, 1, 1]][: len(channel.free)]) ** -2.0
    return np.diag(known)


def _timed(ahead: Ahead, refitted: Freed) -> Freed:
    """Free delay and lag of the wheels too, from the start that fits best; unchanged without commands."""
    if len(refitted.parts) == 1:
        return refitted
    body, wheels = refitted.parts
    places = tuple(wheels.layout.place[column] for column in DELAY_COLUMNS)
    new = tuple(place for place in places if place not in wheels.active)
    information = block_diag(wheels.information, np.zeros((len(new),) * 2))
    # Wheels are never ahead of their command in a model that drives.
    low = wheels.layout.low.copy()
    low[list(places)] = np.maximum(low[list(places)], 0.0)
    layout = replace(wheels.layout, low=low)
    wider = replace(wheels, layout=layout, active=(*wheels.active, *new), information=information)
    options = []
    for delays_s in DELAY_STARTS_S:
        vector = wider.vector.copy()
        vector[list(places)] = delays_s
        options.append(replace(refitted, parts=(body, replace(wider, vector=vector))))
    fitted = [option.at(ahead.fit(option).vectors) for option in options]
    return min(fitted, key=lambda one: ahead.usual_cost(one.chain([part.vector for part in one.parts])))


def _base(analysis: GapAnalysis) -> list[Fit]:
    """Fits of both channels, or of the body, without anything that is missing."""
    return [found.base for found in analysis.channels]


def _all_fits(analysis: GapAnalysis, final: FinalFit) -> list[Fit]:
    """Fits of both channels, or of the body, with all that was found."""
    assert final.final_body is not None
    return [final.final_body, *([] if analysis.wheels is None else [analysis.wheels.reported])]


def _by_fold(analysis: GapAnalysis, fits: Sequence[Fit]) -> dict[int, list[Array]]:
    """For each fold the vectors of the channels, fitted on the data of the others."""
    count, settings = analysis.drive.folds.count, analysis.drive.settings
    by_channel = [
        fold_vectors(one, fold_of(found.channel), count, found.selector.channel.neutral, settings)
        for found, one in zip(analysis.channels, fits, strict=True)
    ]
    return {fold: [vectors[fold] for vectors in by_channel] for fold in range(count)}


def _chains(analysis: GapAnalysis, final: FinalFit, by_fold: Mapping[int, Sequence[Array]]) -> dict[int, Chain]:
    return {fold: _chain(analysis, final, vectors) for fold, vectors in by_fold.items()}


def _chain(analysis: GapAnalysis, final: FinalFit, vectors: Sequence[Array]) -> Chain:
    """Return the chain of the channels' vectors, without gains of the wheels where the encoders count wrong."""
    assert analysis.body is not None
    core, perturbation = _split(analysis.body, vectors[0])
    wheels = analysis.wheels
    if wheels is None:
        return Chain(core, None, perturbation)
    wheels_core, wheels_perturbation = _split(wheels, vectors[1])
    if final.encoder_is_cause:
        places = [wheels.channel.layout.place[f"{GAIN}.{side}"] for side in ("left", "right")]
        wheels_core = wheels_core.copy()
        wheels_core[places] = 0.0
    return Chain(core, wheels_core, perturbation, wheels_perturbation)


def _split(found: ChannelResult, vector: Array) -> tuple[Array, Array | None]:
    """Entries of effects and what terms add; a vector without terms is whole already."""
    if vector.size == len(found.channel.layout.columns):
        return vector, None
    return found.selector.channel.split(vector)
