"""Delay after which the wheels act on commands, estimated from the wheel angles before any other fit.

A search that begins without a delay of 0.3 s does not find it: it takes the traces of the delay for effects and noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.data.stamp_clock import StampClock, clock_of, picked
from disco_hw.gap.data.timing import apart, lowest, mismatch_of, most_distinct_delay, scanned_delays
from disco_hw.gap.settings import GridSettings
from disco_hw.jit import kernel_function
from disco_hw.log.drive import Commands, Wheels

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Pairs whose commands do not change fit as well at every delay, but for rounding.
_SAME_NATS = 1e-4


@dataclass(frozen=True, slots=True)
class Turned:
    """Rotation of both wheels between pairs of samples (n,) of one segment: times, segment, angles."""

    begin_s: Array
    end_s: Array
    segment: Index
    left_rad: Array
    right_rad: Array

    @classmethod
    def of(cls, wheels: Wheels, settings: GridSettings) -> Turned:
        """Pairs `delay_span_s` apart, about `most_command_pairs` of them at most."""
        if wheels.t_s.size < 2:
            none = np.empty(0, np.int64)
            return cls(np.empty(0), np.empty(0), none, np.empty(0), np.empty(0))
        # Held speeds may come less often.
        span_s = max(settings.delay_span_s, float(np.median(np.diff(wheels.t_s))))
        first, second = apart(wheels.t_s, wheels.segment, span_s)
        every = max(first.size // settings.most_command_pairs, 1)
        first, second = first[::every], second[::every]
        left, right = (angle[second] - angle[first] for angle in (wheels.left_angle_rad, wheels.right_angle_rad))
        return cls(wheels.t_s[first], wheels.t_s[second], wheels.segment[first], left, right)

    def between(self, low_s: float, high_s: float) -> Turned:
        """Return the pairs that begin in a span of time."""
        return picked(self, (self.begin_s >= low_s) & (self.begin_s < high_s))


@dataclass(frozen=True, slots=True)
class WheelResponse:
    """Ideal wheels that follow both commands through a lag: speeds and angles (N, 2) at the commands' times."""

    commands: Commands
    lag_s: float
    commanded: Array
    speed: Array
    angle: Array
    unknown_s: Array

    @classmethod
    def of(cls, commands: Commands, lag_s: float) -> WheelResponse:
        """Return the response to commands; unknown commands count as zero, and their time as `unknown_s`."""
        commanded = np.column_stack([commands.left_rad_s, commands.right_rad_s])
        unknown = np.isnan(commanded[:, 0])
        commanded = np.nan_to_num(commanded)
        speed, angle = np.empty(commanded.shape), np.empty(commanded.shape)
        _integrate_response(commands.t_s, commanded, commands.segment, lag_s, speed, angle)
        unknown_s = np.concatenate([[0.0], np.cumsum(np.diff(commands.t_s) * unknown[:-1])])
        return cls(commands, lag_s, commanded, speed, angle, unknown_s)

    def best(self, turned: Turned, about_s: float, step_s: float, fewest: int) -> tuple[float, float]:
        """Return the delay (s) of the least mismatch, within `step_s` of `about_s`, and that mismatch (nats)."""
        return lowest(lambda some: self.mismatches(turned, some, fewest), about_s, step_s)

    def mismatches(self, turned: Turned, delays: Array, fewest: int) -> Array:
        """Minus the log likelihood per pair and wheel at each of some delays (D,); infinite for too few pairs."""
        mismatch = np.full(delays.size, np.inf)
        for place, delay_s in enumerate(delays.tolist()):
            known = self.known(turned, delay_s)
            if np.count_nonzero(known) >= fewest:
                mismatch[place] = self._mismatch(picked(turned, known), delay_s)
        return mismatch

    def is_distinct(self, turned: Turned, delay_s: float, reach_s: float) -> bool:
        """Whether the same pairs fit worse at a delay that is shorter, and at one that is longer, by `reach_s`."""
        delays = (delay_s - reach_s, delay_s, delay_s + reach_s)
        shared = picked(turned, np.all([self.known(turned, each) for each in delays], axis=0))
        if not shared.begin_s.size:
            return False
        shorter, there, longer = (self._mismatch(shared, each) for each in delays)
        return min(shorter, longer) > there + _SAME_NATS

    def known(self, turned: Turned, delay_s: float) -> Mask:
        """Between which pairs (n,) commands are known at a delay."""
        (unknown_s, inside), (more_s, also_inside) = (
            self._unknown(at - delay_s, turned.segment) for at in (turned.begin_s, turned.end_s)
        )
        return np.asarray(inside & also_inside & (more_s - unknown_s < 1e-9))

    def _mismatch(self, turned: Turned, delay_s: float) -> float:
        began, ended = (self._angles(at - delay_s) for at in (turned.begin_s, turned.end_s))
        left, right = ended - began
        sides = (turned.left_rad, turned.right_rad)
        return float(sum(mismatch_of(right - left, right + left, measured) for measured in sides))

    def _in_force(self, t_s: Array) -> tuple[Index, Array]:
        """Return the place of the command in force at some times (n,), and for how long (s) it has been in force."""
        k = np.maximum(np.searchsorted(self.commands.t_s, t_s, side="right") - 1, 0)
        # Before the first command nothing is known, and is not counted below.
        return k, np.maximum(t_s - self.commands.t_s[k], 0.0)

    def _unknown(self, t_s: Array, segment: Index) -> tuple[Array, Mask]:
        """Time (s) without a known command until some times (n,), and whether the segment's commands are in force."""
        commands = self.commands
        k, since_s = self._in_force(t_s)
        inside = (commands.segment[k] == segment) & (t_s >= commands.t_s[0]) & (t_s <= commands.t_s[-1])
        return self.unknown_s[k] + since_s * np.isnan(commands.left_rad_s[k]), inside

    def _angles(self, t_s: Array) -> Array:
        """Return the ideal wheels' angles (2, n) in rad at some times."""
        lag_s = self.lag_s
        k, since_s = self._in_force(t_s)
        slow = lag_s * (1.0 - np.exp(-since_s / lag_s)) if lag_s > 0.0 else 0.0
        # By sides: numpy is slow along an axis of two. Rows first: to take columns, it would copy a whole long log.
        now, speed, angle = (
            np.ascontiguousarray(each.take(k, axis=0).T) for each in (self.commanded, self.speed, self.angle)
        )
        return np.asarray(angle + now * since_s + (speed - now) * slow)


@kernel_function
def _integrate_response(t_s: Array, commanded: Array, segment: Index, lag_s: float, state: Array, angle: Array) -> None:
    """Speeds (N, 2) of wheels that follow commands with a lag at the instants of these, and the way turned by then.

    A segment begins with wheels that follow its first command: nothing is known of what was before.
    """
    for side in range(commanded.shape[1]):
        state[0, side], angle[0, side] = commanded[0, side], 0.0
        for k in range(1, t_s.shape[0]):
            step_s, before = t_s[k] - t_s[k - 1], commanded[k - 1, side]
            left = math.exp(-step_s / lag_s) if lag_s > 0.0 else 0.0
            behind = state[k - 1, side] - before
            angle[k, side] = angle[k - 1, side] + before * step_s + behind * lag_s * (1.0 - left)
            state[k, side] = before + behind * left if segment[k] == segment[k - 1] else commanded[k, side]


@dataclass(frozen=True, slots=True)
class Response:
    """First estimate of the response to commands: `delay_s` after their stamps, a lag, and the mismatch in nats.

    `known`: whether a shorter and a longer delay and a longer lag fit worse. A delay that does not stand out is 0 and
    not known; with too few commands it is 0 and known.
    """

    delay_s: float = 0.0
    lag_s: float = 0.0
    mismatch: float = 0.0
    known: bool = True


def response(turned: Turned, commands: Commands, settings: GridSettings) -> Response:
    """Estimate the delay and the lag with which both commands explain the turning of the wheels best.

    Scanned over delays of +-`most_pose_delay_s` behind a few lags; about the best, wherever that lies between the steps
    of the scan, over delays that are as long in all behind each of `lags_s`. Delays at which commands are known for
    less than three quarters of the pairs are left out: they would be judged by another part of the log.
    """
    if commands.t_s.size < 2:
        return Response()
    responses = {lag_s: WheelResponse.of(commands, lag_s) for lag_s in (0.0, *settings.lags_s)}
    step_s, coarse_s = settings.delay_step_s, 2.0 * settings.delay_step_s
    delays = scanned_delays(settings.most_pose_delay_s, coarse_s)
    most = max(int(responses[0.0].known(turned, delay_s).sum()) for delay_s in delays.tolist())
    fewest = max(settings.fewest_samples, 3 * most // 4)
    scanned = {lag_s: responses[lag_s].mismatches(turned, delays, fewest) for lag_s in (0.0, *settings.lags_s[1::3])}
    ordinary = scanned[0.0][np.isfinite(scanned[0.0])]
    if not ordinary.size:
        return Response()
    lag_s = min(scanned, key=lambda one: float(scanned[one].min()))
    least = int(np.argmin(scanned[lag_s]))
    if not (0 < least < delays.size - 1 and np.isfinite(scanned[lag_s][least - 1 : least + 2]).all()):
        return Response(known=False)
    centre_s, _ = responses[lag_s].best(turned, float(delays[least]), coarse_s, fewest)
    near = {}
    for other_s, response_model in responses.items():
        about = centre_s + lag_s - other_s + scanned_delays(settings.lag_reach_s, step_s)
        mismatch = response_model.mismatches(turned, about, fewest)
        near[other_s] = float(mismatch.min()), float(about[int(np.argmin(mismatch))])
    # Between steps some fit better than where the scan met them.
    bound = min(near.values())[0] + settings.least_delay_nats
    found = Response(centre_s, lag_s, math.inf)
    for other_s, (mismatch_there, about_s) in near.items():
        if mismatch_there <= bound:
            delay_s, best = responses[other_s].best(turned, about_s, step_s, fewest)
            if best < found.mismatch:
                found = Response(delay_s, other_s, best, other_s < max(settings.lags_s))
    deep = float(np.median(ordinary)) - found.mismatch >= settings.least_delay_nats
    shown = deep and responses[found.lag_s].is_distinct(turned, found.delay_s, settings.lag_reach_s)
    return found if shown else Response(known=False)


@dataclass(frozen=True, slots=True)
class CommandAlignment:
    """Commands beside the wheels, as their clock is sought, and the answer behind the lag of the whole log."""

    turned: Turned
    first: Response
    response_model: WheelResponse
    settings: GridSettings

    @property
    def span_s(self) -> tuple[float, float]:
        """Stamps of the first and of the last known command."""
        known = self.response_model.commands.t_s[np.isfinite(self.response_model.commands.left_rad_s)]
        return (float(known[0]), float(known[-1])) if known.size else (0.0, 0.0)

    @property
    def stretch_s(self) -> float:
        """Length of the stretches that are looked at one by one: longer where speeds come less often."""
        begin_s, settings = self.turned.begin_s, self.settings
        spacing_s = float(np.median(np.diff(begin_s))) if begin_s.size > 1 else math.inf
        return max(settings.clock_stretch_s, 1.5 * settings.fewest_samples * spacing_s)

    def fitted(self, clock: StampClock) -> tuple[float, float]:
        """Age of all commands, their stamps corrected by a clock, and the misfit of a pair and wheel."""
        commands = self.response_model.commands
        found = self.first if clock.even else response(self.turned, clock.corrected(commands), self.settings)
        return -found.delay_s, found.mismatch if found.known else math.inf

    def part_delay_s(self, low_s: float, high_s: float) -> float | None:
        """Age of the commands in force in a stretch; None where it does not show."""
        step_s = 2.0 * self.settings.delay_step_s
        found_s = most_distinct_delay(lambda some: self._mismatches(low_s, high_s, some), step_s, self.settings)
        return None if found_s is None else -found_s

    def part_mismatch(self, low_s: float, high_s: float, delay_s: float) -> float:
        """Misfit of all pairs of a stretch at an age."""
        mismatch = float(self._mismatches(low_s, high_s, np.full(1, -delay_s))[0])
        count = self.turned.between(low_s, high_s).begin_s.size
        return count * mismatch if np.isfinite(mismatch) else 0.0

    def _mismatches(self, low_s: float, high_s: float, delays: Array) -> Array:
        return self.response_model.mismatches(self.turned.between(low_s, high_s), delays, self.settings.fewest_samples)


def command_clock(wheels: Wheels, commands: Commands, settings: GridSettings) -> tuple[StampClock, bool]:
    """Return the delay of the commands as a clock, which may drift or jump, and whether it is known."""
    turned = Turned.of(wheels, settings)
    first = response(turned, commands, settings)
    if not first.known or not first.delay_s:
        return StampClock(-first.delay_s), first.known
    align = CommandAlignment(turned, first, WheelResponse.of(commands, first.lag_s), settings)
    return clock_of(align, settings, settings.least_link_error_s, settings.least_delay_nats), True
