"""What the searches of the channels ended with, and the one fit of it that every finding rests on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.data.gridded_drive import GriddedDrive
from disco_hw.gap.search.channel_search import ChannelResult
from disco_hw.gap.search.evidence import inflation
from disco_hw.gap.search.intervals import (
    ASYMMETRY,
    ASYMMETRY_COLUMN,
    ENCODER,
    GAIN,
    ChannelEstimates,
    estimate_parameters,
    in_motion,
    one_encoder,
)
from disco_hw.gap.search.least_squares import Fit, fit
from disco_hw.gap.search.richest_model import indices

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GapAnalysis:
    """What was found in the channels of one drive; a channel that could not be judged is None.

    `nominal_body`, `nominal_wheels` are the vectors of the model as given; `pruned` what fits and was left out, as
    predictions are worse with it.
    """

    drive: GriddedDrive
    nominal_body: Array
    nominal_wheels: Array
    body: ChannelResult | None
    wheels: ChannelResult | None
    pruned: tuple[str, ...] = ()

    @property
    def found_any(self) -> bool:
        """Whether anything is missing in the model, by name or without."""
        channels = [found for found in (self.body, self.wheels) if found is not None]
        return any(found.unnamed or set(found.names) - set(found.selector.given) for found in channels)


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
    return one_encoder(wheels, asymmetry, seen is not None, analysis.drive.settings.selection)


def _free_asymmetry(found: ChannelResult) -> tuple[float, float]:
    """Asymmetry of the wheels that would fit best if it were free too, and its standard deviation."""
    channel, best = found.selector.channel, found.fit
    place = channel.layout.place[ASYMMETRY_COLUMN]
    free = fit(channel, best.vector, (*best.active, place))
    variance = free.covariance()[-1, -1] * inflation(free, channel, (place,))
    return float(free.vector[place]), float(np.sqrt(variance))


def _with_encoder(body: ChannelResult, wheels: ChannelResult) -> tuple[Fit, ChannelEstimates]:
    """The body's fit with the scale of the encoders, as the wheels' gains give it, in place of the asymmetry."""
    names = tuple(name for name in body.names if name != ASYMMETRY)
    channel = body.selector.channel
    vector = body.fit.vector.copy()
    vector[channel.layout.place[ASYMMETRY_COLUMN]] = 0.0
    for side in ("left", "right"):
        gain = wheels.fit.vector[wheels.selector.channel.layout.place[f"{GAIN}.{side}"]]
        vector[channel.layout.place[f"{ENCODER}.{side}"]] = gain
    refitted = fit(channel, vector, indices(channel, names))
    selector = replace(body.selector, fits={frozenset(names): refitted}, proofs={})
    return refitted, estimate_parameters(replace(body, selector=selector, names=names))
