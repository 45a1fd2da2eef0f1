"""How far off the wheels are on held-out stretches, from commands alone: what a log without poses is judged by.

Their turns are given as the way and the heading that they make on the robot's geometry, in the units of the whole gap.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.data.free_runs import starts_of
from disco_hw.gap.noise.channels import WheelChannel
from disco_hw.gap.search.analysis import GapAnalysis
from disco_hw.gap.search.channel_search import ChannelResult, responding
from disco_hw.gap.search.cross_validation import PredictionErrors, Starts, fold_vectors, regimes_driven, summarise
from disco_hw.gap.search.richest_model import LATE
from disco_hw.gap.settings import GRID_STEP_S

Array = NDArray[np.float64]
Angles = dict[int, Array]

WHEEL_STAGES = ("nominal", "timed", "amended")


def only_timed(found: ChannelResult) -> ChannelResult:
    """The wheels with a delay and a lag in place of what was found: what a careful engineer fits by hand."""
    plain = found.plain or found.selector
    names = tuple(dict.fromkeys((*plain.given, *LATE)))
    selector = replace(plain, fits=dict(plain.fits), proofs={})
    selector.fits.pop(frozenset(names), None)
    responding(selector, names)
    return replace(found, selector=selector, names=names, unnamed=(), plain=None)


def wheel_table(analysis: GapAnalysis) -> dict[str, dict[float, PredictionErrors]]:
    """Errors by stage and horizon of the way (m) and heading (rad) that wheels make; empty if they were not judged.

    Each stretch is predicted by what was fitted on the others, as in the gap. `nominal`: the model as given; `timed`: a
    command delay and a motor lag; `amended`: all that was found.
    """
    found = analysis.wheels
    if found is None:
        return {}
    channel = found.channel
    assert isinstance(channel, WheelChannel)
    nominal = channel.angles(analysis.nominal_wheels)
    tracks: dict[str, Angles] = {
        "nominal": {0: nominal, 1: nominal},
        "timed": _by_fold(only_timed(found)),
        "amended": _by_fold(found),
    }
    horizons = channel.settings.prediction.horizons_s
    return {stage: {ahead_s: _errors(channel, of, ahead_s) for ahead_s in horizons} for stage, of in tracks.items()}


def _by_fold(found: ChannelResult) -> Angles:
    """Angles (M, 2) of a free run for each fold, fitted on the other one's data."""
    channel, selector = found.channel, found.selector
    assert isinstance(channel, WheelChannel)
    vectors = fold_vectors(found.fit, channel.block, selector.channel.neutral, channel.settings)
    return {held: channel.angles(*selector.channel.split(vector)) for held, vector in vectors.items()}


def _errors(channel: WheelChannel, of: Angles, ahead_s: float) -> PredictionErrors:
    drive, settings = channel.drive, channel.settings
    node = starts_of(drive.first, np.isfinite(drive.command_rad_s[:, 0]), ahead_s, settings.grid)
    ahead = round(ahead_s / GRID_STEP_S)
    block = np.floor(drive.t_s[node] / settings.prediction.fold_s).astype(np.int64)
    turned, speed = np.zeros((node.size, 2)), np.zeros(node.size)
    for held, angle in of.items():
        inside = block % 2 == held
        off = drive.angle_rad - angle
        turned[inside] = (off[node + ahead] - off[node])[inside]
        faster = drive.speed_rad_s[node + ahead] - np.gradient(angle, GRID_STEP_S, axis=0)[node + ahead]
        speed[inside] = faster.mean(axis=1)[inside]
    radius, axial = float(channel.geometry[0]), float(channel.geometry[1])
    way, heading = 0.5 * radius * turned.sum(axis=1), radius / axial * (turned[:, 1] - turned[:, 0])
    poses = np.zeros((node.size, 3))
    starts = Starts(node, poses, poses, block, tuple(regimes_driven(channel, node, ahead)))
    return summarise(np.column_stack([way, np.zeros(node.size), heading]), speed, starts, settings.prediction)
