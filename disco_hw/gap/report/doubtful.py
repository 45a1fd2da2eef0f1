"""What fits and is not told as found: values that are not known, and ones that their own log contradicts."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects.effect import Effect, Parameter
from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.data.gridded_drive import GriddedDrive
from disco_hw.gap.report.findings import Doubt, EffectFinding
from disco_hw.gap.search.intervals import ParameterEstimate
from disco_hw.gap.settings import GRID_STEP_S, ReportSettings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """What sentences are checked against: the drive, and its geometry (radius and axial distance, m)."""

    drive: GriddedDrive
    geometry: tuple[float, float]


def sort_out(
    effects: Iterable[EffectFinding], measured: Measured
) -> tuple[tuple[EffectFinding, ...], tuple[Doubt, ...]]:
    """Effects that may be told as found, and those that may not, each with the reason."""
    sure, doubtful = [], []
    for effect in effects:
        why = doubt_of(effect, measured)
        if why is None:
            sure.append(effect)
        else:
            doubtful.append(Doubt(effect.name, why))
    return tuple(sure), tuple(doubtful)


def doubt_of(effect: EffectFinding, measured: Measured) -> str | None:
    """Why an effect is not told as found; None if nothing speaks against it."""
    described, settings = REGISTRY[effect.name], measured.drive.settings.report
    pairs = [(parameter, effect.parameters[parameter.name]) for parameter in described.parameters]
    for parameter, estimate in pairs:
        if _at_end(parameter, estimate.value, settings):
            return f"{_written(parameter, estimate)} lies at the end of its range"
    if all(_unknown(parameter, estimate, settings) for parameter, estimate in pairs):
        said = " and ".join(_written(parameter, estimate) for parameter, estimate in pairs)
        return f"{said} is not known well enough to be told from none"
    return _exceeded(described, pairs[0][1], measured)


def _at_end(parameter: Parameter, value: float, settings: ReportSettings) -> bool:
    """Whether a value lies where the fit was not allowed to go further; neutral is no such end."""
    low = parameter.low if parameter.least_fitted is None else parameter.least_fitted
    ends = [end for end in (low, parameter.high) if math.isfinite(end) and end != parameter.neutral]
    return any(abs(value - end) <= settings.end_share * abs(end) for end in ends)


def _unknown(parameter: Parameter, estimate: ParameterEstimate, settings: ReportSettings) -> bool:
    """Whether an interval is so wide that the value says little: nearly to neutral, or of a limit to half of it."""
    half = 0.5 * (estimate.high - estimate.low)
    limits = math.isinf(parameter.neutral)
    size = settings.limit_share * estimate.value if limits else abs(estimate.value - parameter.neutral)
    return half > settings.wide_share * size


def _written(parameter: Parameter, estimate: ParameterEstimate) -> str:
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    return f"{parameter.name} {estimate.value:.3g} [{estimate.low:.3g}, {estimate.high:.3g}]{unit}"


def _exceeded(effect: Effect, limit: ParameterEstimate, measured: Measured) -> str | None:
    """That the wheels themselves went beyond a limit, for how long and how far."""
    if not effect.is_limit or effect.limited is None:
        return None
    drive, settings = measured.drive, measured.drive.settings.report
    reached = effect.limited(_calm(drive), measured.geometry)
    beyond = reached > max(limit.high, limit.value * settings.beyond_limit)
    seconds = float(beyond.sum()) * GRID_STEP_S
    if seconds < max(settings.beyond_s, settings.beyond_share * drive.duration_s):
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
