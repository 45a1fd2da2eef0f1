"""Result of the searches of both channels, and the one fit to it on which every finding rests.

It also has what algebra confounds, effects with the same equations and one cause seen in two channels, and analyses
without one of the names.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects import Channel
from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.data.gridded_drive import GriddedDrive
from disco_hw.gap.search.channel_result import ChannelEstimates, ChannelResult, ParameterEstimate, estimate_parameters
from disco_hw.gap.search.evidence import inflation
from disco_hw.gap.search.least_squares import Fit, fit
from disco_hw.gap.search.richest_model import DELAY_NAMES, indices
from disco_hw.gap.settings import SelectionSettings

Array = NDArray[np.float64]

# Of the robot's turning, which act on the wheels: known in wheel speeds, times radius over axial distance.
_OF_TURNING = tuple(
    column
    for effect in REGISTRY.values()
    if effect.uses_geometry and effect.channel is Channel.COMMAND_TO_WHEEL
    for column in effect.columns
)


def in_motion(wheels: ChannelEstimates, body: ChannelEstimates) -> ChannelEstimates:
    """Return the wheels' estimates, with the uncertainty of the geometry in `body` added to the turning parameters.

    Those parameters are of the robot's motion, and the wheels show them only times wheel radius over axial distance. So
    the relative variance of this ratio adds to each one's own, and to their covariance.
    """
    slope = np.zeros(len(body.fitted))
    for name, sign in (("wheel_radius_m", 1.0), ("axial_distance_m", -1.0)):
        if name in body.fitted:
            slope[body.fitted.index(name)] = sign / body.by_name[name].value
    of_ratio = float(slope @ body.covariance @ slope)
    moved = {name: wheels.by_name[name] for name in _OF_TURNING if name in wheels.by_name}
    added = np.array([moved[name].value if name in moved else 0.0 for name in wheels.fitted])
    by_name = {
        name: ParameterEstimate.around(each.value, float(np.hypot(each.deviation, each.value * of_ratio**0.5)))
        for name, each in moved.items()
    }
    covariance = wheels.covariance + of_ratio * np.outer(added, added)
    return ChannelEstimates({**wheels.by_name, **by_name}, wheels.fitted, covariance)


_MIMICS = {name: effect.mimics for name, effect in REGISTRY.items() if effect.mimics is not None}
# The cause that shows in two channels: as a gain of the drive, and as unequal wheels.
ENCODER, _SHOWN = next((name, one) for name, one in _MIMICS.items() if one.seen_too is not None)
GAIN = _SHOWN.effect.name
ASYMMETRY = _SHOWN.seen_too_as.EFFECT.name
ASYMMETRY_COLUMN = REGISTRY[ASYMMETRY].columns[0]


def one_encoder(
    wheels: ChannelEstimates, asymmetry: tuple[float, float], settings: SelectionSettings
) -> tuple[bool, bool]:
    """Whether an encoder that counts wrong explains the wheels' gains, and whether it is the only explanation.

    An encoder's scale shows as a gain of its wheel and, with the opposite sign, as an asymmetry of half the difference;
    `asymmetry` is what the body alone gives for it, with its standard deviation. That decides, however small, where it
    is clearly what the gains make it and clearly not none: gains that are hardly known agree with every asymmetry.
    """
    gains = [wheels.by_name.get(f"{GAIN}.{side}") for side in ("left", "right")]
    if gains[0] is None or gains[1] is None:
        return False, False
    left, right = gains[0].value, gains[1].value
    assert _SHOWN.seen_too is not None
    expected = _SHOWN.seen_too((left, right))
    spread = 0.5 * (gains[0].deviation + gains[1].deviation)
    value, deviation = asymmetry
    variance = deviation**2 + spread**2
    possible = abs(value - expected) < settings.sure_sigmas * variance**0.5
    nats = 0.5 * (value**2 - (value - expected) ** 2) / variance
    return possible, possible and nats > settings.telling_nats


def confounded_with(names: tuple[str, ...], encoder_possible: bool) -> dict[str, tuple[str, ...]]:
    """Map each accepted effect to the effects that are confounded with it in every drive.

    The pairs are those of `Effect.mimics` in `disco_hw.effects`; one that shows in two channels counts only if it is
    `encoder_possible`.
    """
    found: dict[str, tuple[str, ...]] = {}
    for other, mimicked in _MIMICS.items():
        if mimicked.effect.name in names and (mimicked.seen_too is None or encoder_possible):
            found[mimicked.effect.name] = (*found.get(mimicked.effect.name, ()), other)
    return found


@dataclass(frozen=True)
class GapAnalysis:
    """Findings in the channels of one drive; a channel that could not be evaluated is None.

    `nominal_body`, `nominal_wheels` are the vectors of the model as given; `left_out` names what was found and the
    amended model lacks, as predictions do not need it.
    """

    drive: GriddedDrive
    nominal_body: Array
    nominal_wheels: Array
    body: ChannelResult | None
    wheels: ChannelResult | None
    left_out: tuple[str, ...] = ()

    @property
    def channels(self) -> tuple[ChannelResult, ...]:
        """Results of the channels that could be judged, the body first."""
        return tuple(found for found in (self.body, self.wheels) if found is not None)

    @property
    def found_any(self) -> bool:
        """Whether anything is missing in the model, by name or without."""
        return any(found.unnamed or set(found.names) - set(found.selector.given) for found in self.channels)

    @property
    def adds_to_timed(self) -> bool:
        """Whether anything is missing beyond a delay and a lag."""
        return any(found.unnamed or set(found.names) - {*found.selector.given, *DELAY_NAMES} for found in self.channels)


@dataclass(frozen=True)
class FinalFit:
    """Intervals of both channels, and what they say of the encoders; None for a channel that was not judged.

    `encoder_possible`: whether wrong encoder counts explain the wheels' gains; `encoder_is_cause`: whether they are the
    one cause of what was found in both channels. `final_body`, `final_body_estimates`: the body's fit, with the
    encoder's scale in place of the asymmetry if so; `body_estimates` are those of the body as it was found.
    """

    body_estimates: ChannelEstimates | None
    wheel_estimates: ChannelEstimates | None
    encoder_possible: bool
    encoder_is_cause: bool
    final_body: Fit | None
    final_body_estimates: ChannelEstimates | None


def final_fit(analysis: GapAnalysis) -> FinalFit:
    """Estimate everything that was found, and settle whether an encoder is behind both channels."""
    body = None if analysis.body is None else estimate_parameters(analysis.body)
    wheels = None if analysis.wheels is None else estimate_parameters(analysis.wheels)
    if body is not None and wheels is not None:
        wheels = in_motion(wheels, body)
    possible, is_cause = _encoder(analysis, body, wheels)
    final = None if analysis.body is None else (analysis.body.fit, body)
    if analysis.body is not None and analysis.wheels is not None and is_cause:
        final = _with_encoder(analysis.body, analysis.wheels)
    return FinalFit(body, wheels, possible, is_cause, *(final or (None, None)))


def _encoder(
    analysis: GapAnalysis, body: ChannelEstimates | None, wheels: ChannelEstimates | None
) -> tuple[bool, bool]:
    """Whether wrong encoder counts are possible, and whether they are the one cause of two findings."""
    if body is None or wheels is None or analysis.body is None or analysis.wheels is None:
        return GAIN in (analysis.wheels.names if analysis.wheels else ()), False
    if GAIN not in analysis.wheels.names or GAIN in analysis.wheels.selector.given:
        return False, False
    seen = body.by_name.get(ASYMMETRY_COLUMN)
    asymmetry = _free_asymmetry(analysis.body) if seen is None else (seen.value, seen.deviation)
    return one_encoder(wheels, asymmetry, analysis.drive.settings.selection)


def _free_asymmetry(found: ChannelResult) -> tuple[float, float]:
    """Asymmetry of the wheels that would fit best if it were free too, and its standard deviation."""
    channel, best = found.selector.channel, found.fit
    place = channel.layout.place[ASYMMETRY_COLUMN]
    free = fit(channel, best.vector, (*best.active, place))
    variance = free.covariance()[-1, -1] * inflation(free, channel, (place,))
    return float(free.vector[place]), float(np.sqrt(variance))


def _with_encoder(body: ChannelResult, wheels: ChannelResult) -> tuple[Fit, ChannelEstimates]:
    """Refit the body with encoder scales in place of the asymmetry; return the fit and its estimates.

    The scales are the gains that were found in the wheels.
    """
    names = tuple(name for name in body.names if name != ASYMMETRY)
    channel = body.selector.channel
    vector = body.fit.vector.copy()
    vector[channel.layout.place[ASYMMETRY_COLUMN]] = 0.0
    for side in ("left", "right"):
        gain = wheels.reported.vector[wheels.selector.channel.layout.place[f"{GAIN}.{side}"]]
        vector[channel.layout.place[f"{ENCODER}.{side}"]] = gain
    refitted = fit(channel, vector, indices(channel, names))
    selector = replace(body.selector, fits={frozenset(names): refitted}, proofs={})
    return refitted, estimate_parameters(replace(body, selector=selector, names=names))


def least_evident_first(analysis: GapAnalysis) -> list[tuple[str, str | None]]:
    """List findings beyond `timed` by evidence, least first: channel and name, or None for a channel's terms."""
    out: list[tuple[float, str, str | None]] = []
    for which in ("wheels", "body"):
        found: ChannelResult | None = getattr(analysis, which)
        if found is None:
            continue
        for name in found.names:
            if name not in found.selector.given and name not in DELAY_NAMES:
                rest = tuple(other for other in found.names if other != name)
                out.append((found.selector.evidence(rest, found.names).score, which, name))
        if found.unnamed:
            out.append((max(term.evidence.score for term in found.unnamed), which, None))
    return [(which, name) for _, which, name in sorted(out, key=lambda one: one[0])]


def lacking(analysis: GapAnalysis, which: str, name: str | None) -> GapAnalysis:
    """Return the analysis without one effect of a channel, or without its unnamed terms if `name` is None."""
    found: ChannelResult = getattr(analysis, which)
    if name is None:
        left_out = tuple(term.form for term in found.unnamed)
        fewer = replace(found, selector=found.plain or found.selector, unnamed=(), plain=None)
    else:
        left_out, fewer = (name,), replace(found, names=tuple(other for other in found.names if other != name))
    analysis = replace(analysis, left_out=(*analysis.left_out, *left_out))
    return replace(analysis, wheels=fewer) if which == "wheels" else replace(analysis, body=fewer)
