"""Scan of a channel's mismatch in windows of several lengths, for spans as in none of the rest of a log.

The scanned quantity is how much further the wheels turned, or the body moved, than predicted. How large it is by chance
says the log itself: of each block of time in which the robot moves the largest counts, and its logarithm is taken as
normal. A lasting mismatch enlarges many blocks, and so stands out of none. The noise that the search found would be no
measure: an event has enlarged it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from disco_hw.gap.data.free_runs import rotated
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.search.channel_result import ChannelResult

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Distance of the first and last tenth of a normal sample in standard deviations, and the variance of the sample's own
# standard deviation over that of this estimate of it. A tenth of the blocks may hold events.
_TENTHS = 2.563
_EFFICIENCY = 0.63


@dataclass(frozen=True, slots=True)
class Windows:
    """Windows of one length: begin and end (s), and by component (n, C) mismatch and predicted motion.

    `largest` (B, C): by block of time the largest mismatch. `excess` (n, C): the mismatch over that which chance makes
    in a share `event_chance` of logs; 0 where it is not worth a word or recurs.
    """

    begin_s: Array
    end_s: Array
    off: Array
    predicted: Array
    largest: Array
    excess: Array

    @property
    def middle_s(self) -> Array:
        """Middle of the windows (s)."""
        return np.asarray(0.5 * (self.begin_s + self.end_s))

    def share(self, begin_s: float, end_s: float) -> float:
        """Share of all squared mismatches that lies in a span, by component in units of the usual largest one."""
        squares = ((self.off / np.median(self.largest, axis=0)) ** 2).sum(axis=1)
        inside = (self.middle_s >= begin_s) & (self.middle_s < end_s)
        return float(squares[inside].sum() / squares.sum())


@dataclass(frozen=True, slots=True)
class _Path:
    """Motion of one channel: times (N,), stretches that are comparable, values (N, C), heading and whether it moves."""

    t_s: Array
    stretch: Index
    predicted: Array
    measured: Array
    moves: Mask
    heading: Array | None = None

    def cut(self, width_s: float) -> tuple[Array, Array, Array, Array]:
        """Return begin, end (n,), mismatch and prediction (n, C) of windows in one stretch in which the robot moves."""
        t_s, moves = self.t_s, np.concatenate([[0], np.cumsum(self.moves)])
        end = np.searchsorted(t_s, t_s + width_s - 1e-9)
        begin = np.flatnonzero(end < t_s.size)
        end = end[begin]
        # Where samples are further apart than a window is long they say nothing.
        fits = (self.stretch[begin] == self.stretch[end]) & (t_s[end] - t_s[begin] < 1.5 * width_s)
        fits &= moves[end] > moves[begin]
        begin, end = begin[fits], end[fits]
        predicted, measured = (values[end] - values[begin] for values in (self.predicted, self.measured))
        if self.heading is not None:
            middle = 0.5 * (self.heading[begin] + self.heading[end])
            for moved in (predicted, measured):
                moved[:, :2] = rotated(moved[:, :2], -middle)
        return t_s[begin], t_s[end], measured - predicted, predicted


def scan(found: ChannelResult, channels: int) -> list[Windows]:
    """Return the windows of a channel, shortest first, one of `channels` that are scanned; none if the log is short."""
    settings = found.channel.settings
    short_s, long_s = settings.report.event_span_s
    # By about the root of two, so that some window overlaps an event well.
    widths_s = np.geomspace(short_s, long_s, 1 + round(2.0 * math.log2(long_s / short_s)))
    paths, tests = _paths(found), widths_s.size * channels
    scans = [_windows(found.channel, paths, float(width_s), tests) for width_s in widths_s]
    return [one for one in scans if one.largest.shape[0] >= settings.selection.fewest_blocks]


def _windows(channel: WheelChannel | BodyChannel, paths: Sequence[_Path], width_s: float, tests: int) -> Windows:
    """Windows of about one length; the scan makes so many `tests` of each block and component."""
    settings = channel.settings
    cut = zip(*(path.cut(width_s) for path in paths), strict=True)
    begin_s, end_s, off, predicted = (np.concatenate(each) for each in cut)
    moved = np.maximum(np.abs(predicted), np.abs(predicted + off))
    if isinstance(channel, BodyChannel):
        # What it moves to the side is compared with all of its way.
        moved[:, :2] = moved[:, :2].max(axis=1, keepdims=True)
    block = np.unique(np.floor(begin_s / settings.grid.block_s), return_inverse=True)[1]
    blocks = int(block.max()) + 1 if block.size else 0
    largest = np.full((blocks, off.shape[1]), 1e-9)
    np.maximum.at(largest, block, np.abs(off))
    excess = np.zeros(off.shape)
    if blocks >= settings.selection.fewest_blocks:
        limit = _limit(largest, settings.report.event_chance / (blocks * off.shape[1] * tests))
        # What is half as large in more blocks than are told is no rare event.
        recurring = np.sort(largest, axis=0)[-min(settings.report.most_listed + 1, blocks)]
        recurs = settings.report.wide_share * np.abs(off) <= recurring
        worth = np.abs(off) > settings.report.worth_share * moved
        excess = np.where(worth & ~recurs, np.abs(off) / limit, 0.0)
    return Windows(begin_s, end_s, off, predicted, largest, excess)


def _limit(largest: Array, chance: float) -> Array:
    """Return the size (C,) that the largest mismatch of a block (B, C) exceeds with this probability."""
    low, middle, high = np.quantile(np.log(largest), (0.1, 0.5, 0.9), axis=0)
    quantile = float(stdtrit(_EFFICIENCY * (largest.shape[0] - 1), 1.0 - chance))
    return np.asarray(np.exp(middle + quantile * (high - low) / _TENTHS))


def _paths(found: ChannelResult) -> list[_Path]:
    """Predicted and measured motion of a channel, where a prediction is known."""
    channel, (vector, extra) = found.channel, found.selector.split(found.names)
    samples, drive = channel.samples, channel.drive
    rest_rad_s, speed = drive.settings.grid.rest_rad_s, drive.speed_rad_s[samples.node]
    moves = np.abs(speed).max(axis=1) > rest_rad_s
    if isinstance(channel, WheelChannel):
        command = drive.command_rad_s[samples.node]
        moves |= np.abs(command).max(axis=1) > rest_rad_s
        run = np.cumsum(channel.motion.restart).astype(np.int64)
        since_s = samples.t_s - samples.t_s[np.searchsorted(run, run)]
        known = np.isfinite(command[:, 0]) & (since_s >= drive.settings.grid.lead_s)
        angle = drive.encoder_angle_rad
        expected = angle - channel.raw_residual(vector, extra)
        return [_Path(samples.t_s[known], run[known], expected[known], angle[known], moves[known])]
    use, measured, paths = channel.use, channel.measured, []
    for window in (channel.window, _shifted(channel)):
        predicted = measured - replace(channel, window=window).raw_residual(vector, extra)
        paths.append(_Path(samples.t_s[use], window[use], predicted[use], measured[use], moves[use], measured[use, 2]))
    return paths


def _shifted(channel: BodyChannel) -> Index:
    """Windows (P,) whose borders lie in the middle of the channel's, so that no event is always cut by a border."""
    t_s, window = channel.samples.t_s, channel.window
    ends = np.flatnonzero(np.diff(window, append=-1))
    begins = np.concatenate([[0], ends[:-1] + 1])
    late = t_s > 0.5 * (t_s[begins] + t_s[ends])[window]
    crossed = late & ~np.concatenate([[False], late[:-1]])
    apart = np.diff(t_s, prepend=t_s[:1]) > channel.settings.grid.longest_silence_s
    apart |= np.diff(channel.first_node, prepend=channel.first_node[:1]) != 0
    return np.asarray(np.cumsum(apart | crossed), dtype=np.int64)
