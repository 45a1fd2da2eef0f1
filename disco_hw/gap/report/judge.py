"""From what was found to the findings: which effects, how sure, what else they may be, and which are doubtful."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects import Channel, Effect, Parameter
from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.data.gridded_drive import GriddedDrive
from disco_hw.gap.report import (
    AcrossLogs,
    CandidateEvidence,
    ChannelFinding,
    EffectFinding,
    LowConfidence,
    UnnamedFinding,
)
from disco_hw.gap.report.blind_spots import BlindSpot, blind_spots, experiment_of
from disco_hw.gap.report.misspecification import (
    Regime,
    describe,
    disputed_names,
    gain_of,
    regimes,
    remaining_disagreements,
)
from disco_hw.gap.search import of_every_log
from disco_hw.gap.search.analysis import ASYMMETRY, ENCODER, GAIN, FinalFit, GapAnalysis, confounded_with
from disco_hw.gap.search.channel_result import (
    ChannelEstimates,
    ChannelResult,
    ParameterEstimate,
    in_equal_parts,
    in_logs,
)
from disco_hw.gap.search.evidence import Z95
from disco_hw.gap.search.richest_model import candidates_of, parameters_of
from disco_hw.gap.settings import GRID_STEP_S, ReportSettings
from disco_hw.model.terms import TERMS

_PLACES = {2: ("first half of the log", "second"), 3: ("first third of the log", "second", "last")}


def effect_findings(analysis: GapAnalysis, final: FinalFit, given: bool = False) -> tuple[EffectFinding, ...]:
    """Return the missing effects, most evident first; if `given`, also those that the model already has."""
    only = final.encoder_is_cause
    out: list[EffectFinding] = []
    for found, estimated in ((analysis.body, final.body_estimates), (analysis.wheels, final.wheel_estimates)):
        if found is None or estimated is None:
            continue
        same = confounded_with(found.names, final.encoder_possible)
        for name in found.names:
            if name in found.selector.given and not given:
                continue
            if only and name in (GAIN, ASYMMETRY):
                continue
            out.append(_finding(name, found, estimated, same.get(name, ())))
    if only and analysis.wheels is not None and final.wheel_estimates is not None:
        values = {side: final.wheel_estimates.by_name[f"{GAIN}.{side}"] for side in ("left", "right")}
        out.append(EffectFinding(ENCODER, REGISTRY[ENCODER].channel.value, values, _score(analysis.wheels, GAIN)))
    return tuple(sorted(out, key=lambda effect: -effect.evidence))


def _finding(name: str, found: ChannelResult, estimated: ChannelEstimates, same: tuple[str, ...]) -> EffectFinding:
    values = {parameter.name: estimated.by_name[f"{name}.{parameter.name}"] for parameter in REGISTRY[name].parameters}
    mimicked = REGISTRY[same[0]].mimics if len(same) == 1 else None
    # What decides between the two lies outside such logs.
    test = None if mimicked is None else mimicked.decided_by
    rivals = tuple(other for other in found.selector.rivals(found.names, name) if other not in same)
    if rivals:
        test = "; ".join([*([test] if test else []), experiment_of(name)])
        same = (*same, *rivals)
    return EffectFinding(name, REGISTRY[name].channel.value, values, _score(found, name), same, test)


def _score(found: ChannelResult, name: str) -> float:
    """Evidence score of one accepted effect, the others kept."""
    if name in found.selector.given:
        return 0.0
    rest = tuple(other for other in found.names if other != name)
    return found.selector.evidence(rest, found.names).score


def unnamed_findings(analysis: GapAnalysis) -> tuple[UnnamedFinding, ...]:
    """Return the findings that no named effect explains, as terms without a name."""
    out = []
    for place, found in ((Channel.COMMAND_TO_WHEEL, analysis.wheels), (Channel.WHEEL_TO_BODY, analysis.body)):
        if found is None:
            continue
        for one in found.unnamed:
            same = found.either if one.term.disc is not None else ()
            test = REGISTRY[same[0]].like_a_patch if same else None
            name = one.term.model_name
            description = None if name is None else TERMS[name].describe(float(one.form.split()[2]))
            out.append(
                UnnamedFinding(place.value, one.form, one.evidence.score, name is not None, same, test, description)
            )
    return tuple(out)


def channel_findings(
    analysis: GapAnalysis, effects: Iterable[EffectFinding], unnamed: Iterable[UnnamedFinding] = ()
) -> tuple[ChannelFinding, ...]:
    """Which channels disagree, and where."""
    guilty = {effect.channel for effect in effects} | {term.channel for term in unnamed}
    excess = analysis.drive.settings.noise.poor_fit
    out = []
    for place, found in ((Channel.COMMAND_TO_WHEEL, analysis.wheels), (Channel.WHEEL_TO_BODY, analysis.body)):
        where = "not measured in this log" if found is None else describe(regimes_of(found), excess)
        out.append(ChannelFinding(place.value, place.value in guilty, where))
    sensor = Channel.POSE_SENSOR.value
    out.append(ChannelFinding(sensor, sensor in guilty, out[-1].where))
    return tuple(out)


def regimes_of(found: ChannelResult) -> list[Regime]:
    """Residuals of a channel by regime, without anything that is missing and with all that was found."""
    return regimes(found.channel, found.base.vector, *found.selector.split(found.names))


def candidate_evidence(analysis: GapAnalysis) -> tuple[CandidateEvidence, ...]:
    """Evidence of every named effect: of the accepted ones against their absence, of the others on top."""
    out = []
    for found in analysis.channels:
        selector = found.selector
        for name in candidates_of(found.channel.layout):
            if name in found.names:
                gain, score, verdict = gain_of(found, name), _score(found, name), "accepted"
            else:
                price = 0.5 * parameters_of((name,)) * math.log(max(found.channel.count, 2))
                promise = selector.promise(found.names, name)
                gain, score = promise + price, 2.0 * promise
                enough = score > selector.thresholds.score
                verdict = "moves a 2 s prediction too little, or in one stretch only" if enough else "not needed"
            out.append(CandidateEvidence(REGISTRY[name].channel.value, name, gain, score, verdict))
    return tuple(sorted(out, key=lambda candidate: -candidate.score))


def residue_sentences(analysis: GapAnalysis) -> tuple[str, ...]:
    """Describe disagreements that naming has left, by regime."""
    return tuple(sentence for found in analysis.channels[::-1] for sentence in remaining_disagreements(found))


def left_out_notes(analysis: GapAnalysis, final: FinalFit, kept: GapAnalysis) -> tuple[str, ...]:
    """Sentences on what was found, with its `final` fit, and the amended model does not have."""
    of_this_log = of_every_log(analysis, final).left_out
    of_poses = [name for name in kept.left_out if name in of_this_log]
    others = [name for name in kept.left_out if name not in of_poses]
    out = []
    if of_poses:
        out.append(
            f"the amended model leaves out {', '.join(of_poses)}: this log does not say how poses are in another drive"
        )
    if others:
        out.append(f"the amended model leaves out {', '.join(others)}: held-out data are predicted as well without")
    return tuple(out)


def drifting_parameters(analysis: GapAnalysis, final: FinalFit) -> tuple[str, ...]:
    """Sentences on parameters of effects that go one way along a log: something warms up or wears.

    Over its thirds, or over its halves where a third of it says too little.
    """
    settings, out = analysis.drive.settings, []
    for found, estimated in ((analysis.body, final.body_estimates), (analysis.wheels, final.wheel_estimates)):
        if found is None or estimated is None:
            continue
        for name, parts in (in_equal_parts(found, 2) | in_equal_parts(found, 3)).items():
            values = [float(value) for value in parts.values]
            size = max(abs(values[0]), abs(values[-1]))
            far = abs(values[-1] - values[0]) > settings.report.worth_share * size
            sure = abs(parts.apart(0, len(values) - 1)) > settings.selection.sure_sigmas
            if "." in name and far and sure and sorted(values) in (values, values[::-1]):
                texts = [
                    f"{value:.3g} in the {place}" for value, place in zip(values, _PLACES[len(values)], strict=True)
                ]
                out.append(f"{name} drifts: {', '.join(texts)}")
    return tuple(out)


def across_logs(analysis: GapAnalysis) -> tuple[AcrossLogs, ...]:
    """Every parameter that each of several logs determines, and whether they differ in it by more than their noise."""
    settings, out = analysis.drive.settings, []
    for found in analysis.channels:
        for name, logs in in_logs(found).items():
            if logs.values.size != len(analysis.drive.log_begins_s):
                continue
            low, high = int(np.argmin(logs.values)), int(np.argmax(logs.values))
            # A point of turning near the axle is compared with the robot's size.
            size = found.fit.vector[1] if name == "x_icr_m" else np.abs(logs.values).max()
            share = settings.report.worth_share if "." in name else settings.report.differ_share
            far = logs.values[high] - logs.values[low] > share * size
            reach = Z95 * logs.deviations
            ends = np.column_stack([logs.values, logs.values - reach, logs.values + reach]).tolist()
            values = tuple((value, least, most) for value, least, most in ends)
            out.append(AcrossLogs(name, values, bool(far and logs.apart(low, high) > settings.selection.sure_sigmas)))
    return tuple(out)


def blind_spot_findings(
    analysis: GapAnalysis, effects: Iterable[EffectFinding], top_rad_s: float | None
) -> tuple[BlindSpot, ...]:
    """Every effect that was not found, with the smallest size that would have been; blind ones first."""
    named = {effect.name for effect in effects}
    spots: list[BlindSpot] = []
    for found in analysis.channels[::-1]:
        spots += [spot for spot in blind_spots(found, top_rad_s) if spot.name not in named]
    seen = {spot.name for spot in spots} | named
    for name, effect in REGISTRY.items():
        searched = analysis.wheels if effect.channel is Channel.COMMAND_TO_WHEEL else analysis.body
        if name not in seen and searched is None:
            first = effect.parameters[0]
            spots.append(BlindSpot(name, first.name, first.unit, None, True, experiment_of(name)))
    return tuple(sorted(spots, key=lambda spot: not spot.blind))


Array = NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """Measured facts against which findings are checked.

    The drive, its geometry (radius and axial distance, m), and names that the residuals dispute, with the reason.
    """

    drive: GriddedDrive
    geometry: tuple[float, float]
    disputed: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, analysis: GapAnalysis, final: FinalFit) -> Measured:
        """Collect the facts of a searched drive."""
        vector = analysis.nominal_body if final.final_body is None else final.final_body.vector
        disputed = {name: why for found in analysis.channels for name, why in disputed_names(found).items()}
        return cls(analysis.drive, (float(vector[0]), float(vector[1])), disputed)


def classify_findings(
    effects: Iterable[EffectFinding], measured: Measured
) -> tuple[tuple[EffectFinding, ...], tuple[LowConfidence, ...]]:
    """Effects that may be reported as found, and those that may not, each with the reason."""
    sure, doubtful = [], []
    for effect in effects:
        why = low_confidence_of(effect, measured)
        if why is None:
            sure.append(effect)
        else:
            doubtful.append(LowConfidence(effect.name, why))
    return tuple(sure), tuple(doubtful)


def low_confidence_of(effect: EffectFinding, measured: Measured) -> str | None:
    """Why an effect is not reported as found; None if nothing speaks against it."""
    described, settings = REGISTRY[effect.name], measured.drive.settings.report
    pairs = [(parameter, effect.parameters[parameter.name]) for parameter in described.parameters]
    if all(is_weakly_known(parameter, estimate, settings) for parameter, estimate in pairs):
        values = " and ".join(_written(parameter, estimate) for parameter, estimate in pairs)
        return f"{values} is hardly known: its interval is wider than the value"
    if includes_no_effect(effect):
        values = " and ".join(_written(parameter, estimate) for parameter, estimate in pairs)
        return f"{values}: its interval includes no effect"
    return _exceeded(described, pairs[0][1], measured) or measured.disputed.get(effect.name)


def includes_no_effect(effect: EffectFinding) -> bool:
    """Whether the intervals of all that make an effect's size include the value at which it does nothing."""
    sizes = [each for each in REGISTRY[effect.name].parameters if math.isfinite(each.neutral)]
    intervals = [(effect.parameters[each.name], each.neutral) for each in sizes]
    # A limit does nothing only where it is infinite, which no interval includes.
    return not REGISTRY[effect.name].is_limit and all(each.low <= none <= each.high for each, none in intervals)


def is_weakly_known(parameter: Parameter, estimate: ParameterEstimate, settings: ReportSettings) -> bool:
    """Whether an interval is so wide that the estimated value says little.

    Its half width is compared with the distance of the value from neutral; of a limit, with `limit_share` of the value.
    """
    half = 0.5 * (estimate.high - estimate.low)
    limits = math.isinf(parameter.neutral)
    size = settings.limit_share * estimate.value if limits else abs(estimate.value - parameter.neutral)
    return half > settings.wide_share * size


def _written(parameter: Parameter, estimate: ParameterEstimate) -> str:
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    return f"{parameter.name} {estimate.value:.3g} [{estimate.low:.3g}, {estimate.high:.3g}]{unit}"


def _exceeded(effect: Effect, limit: ParameterEstimate, measured: Measured) -> str | None:
    """Describe for how long and how far the wheels exceeded a limit; None if they did not."""
    if not effect.is_limit or effect.limited is None:
        return None
    drive, settings = measured.drive, measured.drive.settings.report
    reached = effect.limited(_calm(drive), measured.geometry)
    beyond = reached > limit.value * (1.0 + settings.worth_share)
    seconds = float(beyond.sum()) * GRID_STEP_S
    if seconds < settings.beyond_s:
        return None
    unit = effect.parameters[0].unit
    return (
        f"a limit of {limit.value:.3g} {unit} is exceeded for {seconds:.1f} s of this log, up to "
        f"{float(np.quantile(reached, 0.999)):.3g} {unit}"
    )


def _calm(drive: GriddedDrive) -> Array:
    """Measured wheel speeds (M, 2), means over a quarter of a second, which single readings do not move."""
    width = round(0.25 / GRID_STEP_S)
    kernel = np.ones(width) / width
    return np.column_stack([np.convolve(drive.speed_rad_s[:, side], kernel, "same") for side in (0, 1)])
