"""From what the searches of the channels found to the parts of the report."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects.effect import Channel
from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.data.gridded_drive import GRID_STEP_S, GriddedDrive
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.report.amend import with_terms_named
from disco_hw.gap.report.blind_spots import BlindSpot, blind_spots, experiment_of
from disco_hw.gap.report.findings import CandidateEvidence, ChannelFinding, EffectFinding, UnnamedFinding
from disco_hw.gap.report.misspecification import misspecified_effects
from disco_hw.gap.report.regimes import in_words, regimes
from disco_hw.gap.report.residue import remaining_disagreements
from disco_hw.gap.search.candidates import candidates_of, indices, parameters_of
from disco_hw.gap.search.channel_search import ChannelResult
from disco_hw.gap.search.confounding import (
    ASYMMETRY,
    ASYMMETRY_COLUMN,
    ENCODER,
    GAIN,
    OUTSIDE_TESTS,
    confounded_with,
    one_encoder,
)
from disco_hw.gap.search.cross_validation import (
    Chain,
    PredictionErrors,
    errors_of,
    floor_errors,
    fold_vectors,
    per_horizon,
    smoothed_poses,
)
from disco_hw.gap.search.evidence import inflation
from disco_hw.gap.search.intervals import ChannelEstimates, estimate_parameters, in_motion
from disco_hw.gap.search.least_squares import Fit, fit

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GapAnalysis:
    """What was found in the channels of one drive; a channel that could not be judged is None.

    `nominal_body`, `nominal_wheels` are the vectors of the model as given; `top_rad_s` the robot's largest wheel speed,
    if it is known; `pruned` what fits and was left out, as predictions are worse with it.
    """

    drive: GriddedDrive
    nominal_body: Array
    nominal_wheels: Array
    body: ChannelResult | None
    wheels: ChannelResult | None
    top_rad_s: float | None = None
    pruned: tuple[str, ...] = ()

    @cached_property
    def _estimates(self) -> tuple[ChannelEstimates | None, ChannelEstimates | None]:
        body, wheels = (None if found is None else estimate_parameters(found) for found in (self.body, self.wheels))
        if body is not None and wheels is not None:
            wheels = in_motion(wheels, body)
        return body, wheels

    @cached_property
    def _encoder(self) -> tuple[bool, bool]:
        """Whether wrong encoder counts are possible, and whether they are the one cause of two findings."""
        body, wheels = self._estimates
        if body is None or wheels is None or self.body is None or self.wheels is None:
            return GAIN in (self.wheels.names if self.wheels else ()), False
        if GAIN not in self.wheels.names or GAIN in self.wheels.selector.given:
            return False, False
        seen = body.by_name.get(ASYMMETRY_COLUMN)
        told = self._asymmetry(self.body) if seen is None else (seen.value, seen.deviation)
        return one_encoder(wheels, told, seen is not None)

    @staticmethod
    def _asymmetry(found: ChannelResult) -> tuple[float, float]:
        """Asymmetry of the wheels that would fit best if it were free too, and its standard deviation."""
        channel, best = found.selector.channel, found.fit
        place = channel.layout.place[ASYMMETRY_COLUMN]
        free = fit(channel, best.vector, (*best.active, place))
        variance = free.covariance()[-1, -1] * inflation(free, channel, (place,))
        return float(free.vector[place]), float(np.sqrt(variance))

    @cached_property
    def _final_body(self) -> tuple[Fit, ChannelEstimates] | None:
        """The body's fit; where an encoder is the cause, with its scale in place of the asymmetry."""
        estimated = self._estimates[0]
        if self.body is None or estimated is None:
            return None
        if not self._encoder[1] or self.wheels is None:
            return self.body.fit, estimated
        names = tuple(name for name in self.body.names if name != ASYMMETRY)
        channel = self.body.selector.channel
        vector = self.body.fit.vector.copy()
        vector[channel.layout.place[ASYMMETRY_COLUMN]] = 0.0
        wheels = self.wheels.fit.vector
        for side in ("left", "right"):
            gain = wheels[self.wheels.selector.channel.layout.place[f"{GAIN}.{side}"]]
            vector[channel.layout.place[f"{ENCODER}.{side}"]] = gain
        refitted = fit(channel, vector, indices(channel, names))
        selector = replace(self.body.selector, fits={frozenset(names): refitted}, proofs={})
        return refitted, estimate_parameters(replace(self.body, selector=selector, names=names))

    def parts(self) -> tuple[ChannelEstimates, ...]:
        """Estimates of the channels, for the amended model."""
        body, wheels = self._final_body, self._estimates[1]
        geometry = (1.0, 1.0) if body is None else (float(body[0].vector[0]), float(body[0].vector[1]))
        both = ((self.body, None if body is None else body[1]), (self.wheels, wheels))
        return tuple(
            with_terms_named(part, found.unnamed, geometry)
            for found, part in both
            if found is not None and part is not None
        )

    def terms(self) -> tuple[str, ...]:
        """Names of the accepted unnamed terms that a model can carry."""
        found = [found for found in (self.body, self.wheels) if found is not None]
        return tuple(one.term.model_name for each in found for one in each.unnamed if one.term.model_name is not None)

    def effects(self, given: bool = False) -> tuple[EffectFinding, ...]:
        """The effects that are missing, in order of evidence; with those `given` in the model, if asked."""
        possible, only = self._encoder
        found: list[EffectFinding] = []
        for channel, estimated in ((self.body, self._estimates[0]), (self.wheels, self._estimates[1])):
            if channel is None or estimated is None:
                continue
            same = confounded_with(channel.names, possible)
            for name in channel.names:
                if name in channel.selector.given and not given:
                    continue
                if only and name in (GAIN, ASYMMETRY):
                    continue
                found.append(self._finding(name, channel, estimated, same.get(name, ())))
        if only and self.wheels is not None and self._estimates[1] is not None:
            found.append(self._encoder_finding(self.wheels, self._estimates[1]))
        return tuple(sorted(found, key=lambda effect: -effect.evidence))

    def _finding(
        self, name: str, found: ChannelResult, estimated: ChannelEstimates, same: tuple[str, ...]
    ) -> EffectFinding:
        values = {
            parameter.name: estimated.by_name[f"{name}.{parameter.name}"] for parameter in REGISTRY[name].parameters
        }
        test = next((text for members, text in OUTSIDE_TESTS.items() if {name, *same} <= members and same), None)
        rivals = tuple(other for other in found.selector.rivals(found.names, name) if other not in same)
        if rivals:
            test = "; ".join([*([test] if test else []), experiment_of(name)])
            same = (*same, *rivals)
        return EffectFinding(name, REGISTRY[name].channel.value, values, _evidence(found, name), same, test)

    def _encoder_finding(self, wheels: ChannelResult, estimated: ChannelEstimates) -> EffectFinding:
        values = {side: estimated.by_name[f"{GAIN}.{side}"] for side in ("left", "right")}
        return EffectFinding(ENCODER, REGISTRY[ENCODER].channel.value, values, _evidence(wheels, GAIN))

    def candidates(self) -> tuple[CandidateEvidence, ...]:
        """Evidence of every named effect: of the accepted ones against their absence, of the others on top."""
        out = []
        for found in (self.body, self.wheels):
            if found is None:
                continue
            selector = found.selector
            for name in candidates_of(found.channel.layout):
                if name in found.names:
                    rest = tuple(other for other in found.names if other != name)
                    gain, verdict = selector.fit(rest).cost - found.fit.cost, "accepted"
                    score = 0.0 if name in selector.given else selector.evidence(rest, found.names).score
                else:
                    price = 0.5 * parameters_of((name,)) * math.log(max(found.channel.count, 2))
                    promise = selector.promise(found.names, name)
                    gain, score = promise + price, 2.0 * promise
                    enough = score > selector.thresholds.score
                    verdict = "moves a 2 s prediction too little, or in one stretch only" if enough else "not needed"
                    verdict = "makes held-out predictions worse" if name in self.pruned else verdict
                out.append(CandidateEvidence(REGISTRY[name].channel.value, name, gain, score, verdict))
        return tuple(sorted(out, key=lambda candidate: -candidate.score))

    def pictures(self, gap: dict[str, dict[float, PredictionErrors]]) -> dict[str, bytes]:
        """PNGs by name."""
        from disco_hw.gap.report import figures  # noqa: PLC0415  (matplotlib, slow to import)

        out: dict[str, bytes] = {}
        if gap:
            out["gap_by_horizon"] = figures.gap_by_horizon(gap)
            out["gap_by_regime"] = figures.gap_by_regime(gap)
        for name, title, found in (
            ("command_to_wheel", "command to wheel", self.wheels),
            ("wheel_to_body", "wheel to body and pose sensor", self.body),
        ):
            if found is not None:
                out[f"where_{name}"] = figures.disagreement(title, self._regimes(found))
        if self.wheels is not None:
            out["worst_stretch"] = self._worst_stretch(self.wheels)
        return out

    @staticmethod
    def _worst_stretch(wheels: ChannelResult) -> bytes:
        """Wheel speed over the six seconds in which the model as it was is furthest off."""
        from disco_hw.gap.report import figures  # noqa: PLC0415  (matplotlib, slow to import)

        channel = wheels.channel
        assert isinstance(channel, WheelChannel)
        drive = channel.drive
        angles = (channel.angles(wheels.base.vector), channel.angles(*wheels.selector.split(wheels.names)))
        before, after = (np.gradient(angle, GRID_STEP_S, axis=0) for angle in angles)
        size = np.where(np.isfinite(drive.command_rad_s[:, 0]), np.abs(before - drive.speed_rad_s).mean(axis=1), 0.0)
        width = min(600, size.size)
        begin = int(np.argmax(np.convolve(size, np.ones(width), "valid")))
        part = slice(begin, begin + width)
        return figures.stretch(
            drive.t_s[part], drive.speed_rad_s[part, 0], before[part, 0], after[part, 0], "left wheel, rad/s"
        )

    def unnamed(self) -> tuple[UnnamedFinding, ...]:
        """What is missing and none of the named effects."""
        out = []
        for place, found in ((Channel.COMMAND_TO_WHEEL, self.wheels), (Channel.WHEEL_TO_BODY, self.body)):
            if found is None:
                continue
            for one in found.unnamed:
                same = found.either if one.term.disc is not None else ()
                test = REGISTRY[same[0]].like_a_patch if same else None
                in_model = one.term.model_name is not None
                out.append(UnnamedFinding(place.value, one.form, one.evidence.score, in_model, same, test))
        return tuple(out)

    def channels(self, effects: Iterable[EffectFinding], unnamed: Iterable[str] = ()) -> tuple[ChannelFinding, ...]:
        """Which channels disagree, and where."""
        guilty = {effect.channel for effect in effects} | set(unnamed)
        out = []
        for place, found in ((Channel.COMMAND_TO_WHEEL, self.wheels), (Channel.WHEEL_TO_BODY, self.body)):
            where = "not measured in this log" if found is None else in_words(self._regimes(found))
            out.append(ChannelFinding(place.value, place.value in guilty, where))
        sensor = Channel.POSE_SENSOR.value
        out.append(ChannelFinding(sensor, sensor in guilty, out[-1].where))
        return tuple(out)

    @staticmethod
    def _regimes(found: ChannelResult):  # type: ignore[no-untyped-def]
        return regimes(found.channel, found.base.vector, *found.selector.split(found.names))

    def residue(self) -> tuple[str, ...]:
        """What is still missing after naming, by regime."""
        out: list[str] = []
        for found in (self.wheels, self.body):
            if found is not None:
                out += [*remaining_disagreements(found), *misspecified_effects(found)]
        return tuple(out)

    def blind_spots(self, effects: Iterable[EffectFinding]) -> tuple[BlindSpot, ...]:
        """Every effect that was not found, with the smallest size that would have been; blind ones first."""
        named = {effect.name for effect in effects}
        spots: list[BlindSpot] = []
        for found in (self.wheels, self.body):
            if found is not None:
                spots += [spot for spot in blind_spots(found, self.top_rad_s) if spot.name not in named]
        seen = {spot.name for spot in spots} | named
        for name, effect in REGISTRY.items():
            judged = self.wheels if effect.channel is Channel.COMMAND_TO_WHEEL else self.body
            if name not in seen and judged is None:
                first = effect.parameters[0]
                spots.append(BlindSpot(name, first.name, first.unit, None, True, experiment_of(name)))
        return tuple(sorted(spots, key=lambda spot: not spot.blind))

    def gap(self) -> dict[str, dict[float, PredictionErrors]]:
        """Errors of prediction by stage and horizon on held-out data."""
        assert self.body is not None
        assert self._final_body is not None
        body = self.body.channel
        assert isinstance(body, BodyChannel)
        final = self._final_body[0]
        wheels = None if self.wheels is None else self.wheels.channel
        assert wheels is None or isinstance(wheels, WheelChannel)
        table = {
            stage: per_horizon(lambda ahead_s, stage=stage: self.errors(stage, ahead_s))  # type: ignore[misc]
            for stage in self._stages
        }
        whole = self._chain(final.vector, self.wheels.fit.vector if self.wheels else None)
        table["floor"] = per_horizon(lambda ahead_s: floor_errors(body, wheels, whole, ahead_s, self._poses))
        return table

    def errors(self, stage: str, ahead_s: float) -> PredictionErrors:
        """Errors of prediction of one stage, `nominal`, `refitted` or `amended`, on held-out data."""
        assert self.body is not None
        assert isinstance(self.body.channel, BodyChannel)
        wheels = None if self.wheels is None else self.wheels.channel
        assert wheels is None or isinstance(wheels, WheelChannel)
        return errors_of(self.body.channel, wheels, self._stages[stage], ahead_s, self._poses)

    @cached_property
    def _poses(self) -> tuple[Array, Array]:
        """Poses at all nodes, smoothed and not."""
        assert self.body is not None
        assert self._final_body is not None
        assert isinstance(self.body.channel, BodyChannel)
        return smoothed_poses(self.body.channel, self._final_body[0].vector)

    @cached_property
    def _stages(self) -> dict[str, dict[int, Chain]]:
        """For each stage of the gap the chains of the two folds, each fitted on the other one's data."""
        assert self.body is not None
        assert self._final_body is not None
        body, final = self.body.channel, self._final_body[0]
        wheels = None if self.wheels is None else self.wheels.channel
        refitted = fold_vectors(self.body.base, body.block, self.body.selector.channel.neutral)
        amended = fold_vectors(final, body.block, self.body.selector.channel.neutral)
        wheels_base = {0: self.nominal_wheels, 1: self.nominal_wheels}
        wheels_full = wheels_base
        if self.wheels is not None and wheels is not None:
            wheels_neutral = self.wheels.selector.channel.neutral
            wheels_base = fold_vectors(self.wheels.base, wheels.block, wheels_neutral)
            wheels_full = fold_vectors(self.wheels.fit, wheels.block, wheels_neutral)

        def chains(of_body: dict[int, Array], of_wheels: dict[int, Array]) -> dict[int, Chain]:
            return {held: self._chain(of_body[held], None if wheels is None else of_wheels[held]) for held in (0, 1)}

        nominal = {0: self.nominal_body, 1: self.nominal_body}
        return {
            "nominal": chains(nominal, {0: self.nominal_wheels, 1: self.nominal_wheels}),
            "refitted": chains(refitted, wheels_base),
            "amended": chains(amended, wheels_full),
        }

    def _chain(self, body: Array, wheels: Array | None) -> Chain:
        """A chain of two vectors; where it is the encoders that count wrong, the wheels turn as commanded."""
        assert self.body is not None
        core, perturbation = _split(self.body, body)
        if self.wheels is None or wheels is None:
            return Chain(core, None, perturbation)
        wheels_core, wheels_perturbation = _split(self.wheels, wheels)
        if self._encoder[1]:
            places = [self.wheels.channel.layout.place[f"{GAIN}.{side}"] for side in ("left", "right")]
            wheels_core = wheels_core.copy()
            wheels_core[places] = 0.0
        return Chain(core, wheels_core, perturbation, wheels_perturbation)


def _split(found: ChannelResult, vector: Array) -> tuple[Array, Array | None]:
    """Entries of effects and what terms add; a vector without terms is whole already."""
    if vector.size == len(found.channel.layout.columns):
        return vector, None
    return found.selector.channel.split(vector)


def _evidence(found: ChannelResult, name: str) -> float:
    """Evidence score of one accepted effect, the others kept."""
    rest = tuple(other for other in found.names if other != name)
    if name in found.selector.given:
        return 0.0
    return found.selector.evidence(rest, found.names).score
