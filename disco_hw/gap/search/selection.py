"""Which effects: forward selection with swaps and a backward check, refitting each time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.data.free_runs import displacement, starts_as_far_as
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.search.evidence import EffectEvidence, compare
from disco_hw.gap.search.least_squares import Fit, fit, inverse, sensitivity
from disco_hw.gap.search.richest_model import (
    CANDIDATES,
    DELAY_NAMES,
    Candidate,
    candidates_of,
    delays_of,
    indices,
    parameters_of,
)
from disco_hw.gap.search.unnamed_terms import ResidualChannel
from disco_hw.gap.settings import GRID_STEP_S, SelectionSettings

Array = NDArray[np.float64]
Names = tuple[str, ...]
Split = tuple[Array, Array | None]


def wheel_moves(channel: WheelChannel, geometry: Array) -> Callable[[Split, Split], float]:
    """Return a function for the distance (m) of two fits' wheel predictions, with half the way as lever arm."""
    drive = channel.drive
    settings = channel.settings.selection
    usable = np.isfinite(drive.command_rad_s[:, 0])
    usual_s = channel.settings.prediction.reported_horizon_s
    start, ahead_s = starts_as_far_as(drive.first, usable, usual_s, channel.settings.grid)
    ahead = round(ahead_s / GRID_STEP_S)

    def moves(small: Split, big: Split) -> float:
        if not start.size:
            return 0.0
        difference = channel.angles(*big) - channel.angles(*small)
        step = difference[start + ahead] - difference[start]
        way = drive.angle_rad[start + ahead] - drive.angle_rad[start]
        forward = 0.5 * geometry[0] * step.sum(axis=1)
        yaw = geometry[0] / geometry[1] * (step[:, 1] - step[:, 0])
        lever = np.abs(0.25 * geometry[0] * way.sum(axis=1)) + abs(geometry[2])
        return _where_most(forward**2 + (lever * yaw) ** 2, settings.most_moved_share)

    return moves


def body_moves(channel: BodyChannel) -> Callable[[Split, Split], float]:
    """Return a function for the distance (m) of two fits' body predictions at the usual horizon."""
    drive = channel.drive
    settings = channel.settings.selection
    everywhere = np.ones(drive.t_s.size, dtype=bool)
    usual_s = channel.settings.prediction.reported_horizon_s
    start, ahead_s = starts_as_far_as(drive.first, everywhere, usual_s, channel.settings.grid)
    heading = np.interp(drive.t_s[start], channel.samples.t_s, channel.measured[:, 2])

    def moves(small: Split, big: Split) -> float:
        if not start.size:
            return 0.0
        ends = []
        for p, extra in (small, big):
            ends.append(
                displacement(
                    p, drive.first, channel.track(p, extra), channel.carried(p), start, heading, ahead_s,
                    drive.poses_moved_s,
                )
            )  # fmt: skip
        apart = ends[1] - ends[0]
        lever = 0.5 * np.hypot(ends[1][:, 0], ends[1][:, 1])
        return _where_most(apart[:, 0] ** 2 + apart[:, 1] ** 2 + (lever * apart[:, 2]) ** 2, settings.most_moved_share)

    return moves


def _where_most(squares: Array, share: float) -> float:
    """Root of the mean of the largest `share` of some squares (n,)."""
    few = max(round(share * squares.size), 1)
    return float(np.sqrt(np.partition(squares, squares.size - few)[-few:].mean()))


@dataclass(frozen=True, slots=True)
class Thresholds:
    """When an effect is accepted: evidence score, of one without a name too, and shift of the 2 s predictions."""

    score: float
    moves_m: float
    unnamed_score: float


@dataclass
class Selector:
    """Fits sets of effects of one channel, each once; `moves` gives how far a fit moves the prediction of another.

    Effects `given` are in from the beginning, with values of `start`. `closely`: whether all sets are fitted as those
    that are told, and not only as closely as it takes to compete.
    """

    channel: ResidualChannel
    moves: Callable[[Split, Split], float]
    thresholds: Thresholds
    given: Names = ()
    start: Array | None = None
    closely: bool = False
    fits: dict[frozenset[str], Fit] = field(default_factory=dict)
    proofs: dict[tuple[frozenset[str], frozenset[str]], EffectEvidence] = field(default_factory=dict)

    @property
    def settings(self) -> SelectionSettings:
        """Settings that decide between effects."""
        return self.channel.settings.selection

    def exact(self, names: Names) -> Fit:
        """Return the best fit of a set to full accuracy, as results that are reported and proved need."""
        found = self.fit(names)
        if found.loose:
            found = self.fits[frozenset(names)] = fit(self.channel, found, found.active)
        return found

    def fit(self, names: Names) -> Fit:
        """Return the best fit of a set, begun at the best known subsets, as accurate as a comparison needs."""
        key = frozenset(names)
        if key not in self.fits:
            if key <= frozenset(self.given):
                begin = self.channel.neutral if self.start is None else self.start
                self.fits[key] = fit(self.channel, begin, indices(self.channel, names))
            else:
                new = [name for name in names if key - {name} in self.fits] or [names[-1]]
                options = [
                    self._with(self.fit(tuple(other for other in names if other != name)), names, CANDIDATES[name])
                    for name in new
                ]
                self.fits[key] = min(options, key=lambda option: option.cost)
        return self.fits[key]

    def split(self, names: Names) -> Split:
        """Vector of effects of a set's fit, and what its unnamed terms add."""
        return self.channel.split(self.exact(names).vector)

    def _with(self, parent: Fit, names: Names, new: Candidate) -> Fit:
        """Fit `names` from `parent`, which lacks `new`."""
        channel, layout = self.channel, self.channel.layout
        active = indices(channel, names)
        if new.profile is not None:
            return self._profiled(parent, active, new)
        if new.starts is None:
            return fit(channel, parent, active, loose=not self.closely)
        tried = []
        places = [layout.place[column] for column in new.columns]
        for values in new.starts(channel):
            vector = parent.vector.copy()
            vector[places] = values
            tried.append(fit(channel, vector, active, 2, loose=not self.closely))
        best = min(tried, key=lambda option: option.cost) if tried else parent
        return fit(channel, best, active, loose=not self.closely)

    def _profiled(self, parent: Fit, active: tuple[int, ...], new: Candidate) -> Fit:
        """Search the profiled entry by its linear gain, then closer around the best, then refit everything."""
        assert new.profile is not None
        values = new.profile.values(self.channel)
        if not values:
            return fit(self.channel, parent, active, loose=not self.closely)
        gains = {value: self._linear_gain(parent, new, value) for value in values}
        spacing = values[1] - values[0]
        while spacing > new.profile.refine:
            spacing *= 0.5
            best = max(gains, key=gains.__getitem__)
            for value in (best - spacing, best + spacing):
                if value not in gains:
                    gains[value] = self._linear_gain(parent, new, value)
        best = max(gains, key=gains.__getitem__)
        found = self._at(parent, active, new, best)
        if 2.0 * (parent.cost - found.cost) < self.thresholds.score:
            return found
        refined = {best: found}
        step = new.profile.refine
        for _ in range(self.settings.profile_searches):
            centre = min(refined, key=lambda value: refined[value].cost)
            for value in (centre - step, centre + step):
                if value not in refined:
                    refined[value] = self._at(refined[centre], active, new, value, 2)
        return min(refined.values(), key=lambda option: option.cost)

    def _at(
        self, start: Fit, active: tuple[int, ...], new: Candidate, value: float, iterations: int | None = None
    ) -> Fit:
        """Fit from another fit, with the profiled entry at a value."""
        assert new.profile is not None
        channel, vector = self.channel, start.vector.copy()
        vector[channel.layout.place[new.profile.column]] = value
        begin: Fit | Array = vector
        if start.active == active and not self.closely:
            # One of the same set, at a neighbouring value.
            residual = channel.residual(vector)
            begin = replace(start, vector=vector, residual=residual, slope=start.jacobian, carried=True)
        elif self._neutral(start, new):
            # When something that is not there begins does not matter.
            begin = replace(start, vector=vector, slope=start.jacobian)
        return fit(channel, begin, active, iterations, loose=not self.closely)

    def _linear_gain(self, parent: Fit, new: Candidate, value: float | None = None) -> float:
        """Gain in nats that the candidate promises to first order, from the parent's fit."""
        channel, layout = self.channel, self.channel.layout
        vector, residual = parent.vector, parent.residual
        if value is not None:
            assert new.profile is not None
            vector = vector.copy()
            vector[layout.place[new.profile.column]] = value
            if not self._neutral(parent, new):
                residual = channel.residual(vector)
        places = tuple(layout.place[column] for column in new.columns)
        columns = sensitivity(channel, vector, places, residual)
        gradient = parent.gradient if residual is parent.residual else parent.jacobian.T @ residual
        gradient = np.concatenate([gradient, columns.T @ residual])
        across = parent.jacobian.T @ columns
        normal = np.block([[parent.normal, across], [across.T, columns.T @ columns]])
        return parent.cost - 0.5 * float(residual @ residual) + 0.5 * float(gradient @ inverse(normal) @ gradient)

    def _neutral(self, parent: Fit, new: Candidate) -> bool:
        """Whether an effect with other parameters than the profiled one does nothing at a fit."""
        layout = self.channel.layout
        places = [layout.place[column] for column in new.columns]
        return bool(places) and bool((parent.vector[places] == layout.neutral[places]).all())

    def evidence(self, smaller: Names, larger: Names) -> EffectEvidence:
        """Evidence for the larger set against the smaller one."""
        key = (frozenset(smaller), frozenset(larger))
        if key not in self.proofs:
            parameters = parameters_of(larger) - parameters_of(smaller)
            self.proofs[key] = compare(self.exact(smaller), self.exact(larger), self.channel, parameters)
        return self.proofs[key]

    def acceptable(self, smaller: Names, larger: Names) -> bool:
        """Whether what the larger set has more is accepted."""
        limits = self.thresholds
        gain = self.fit(smaller).cost - self.fit(larger).cost
        if 2.0 * gain < limits.score:
            return False
        proof = self.evidence(smaller, larger)
        # What begins at some time can be begun before whatever happened once.
        is_alternative = any(CANDIDATES[name].is_alternative for name in set(larger) - set(smaller))
        price = parameters_of(larger) - parameters_of(smaller)
        # A delay is wrong by as much as a lag beside it is missing, however little that moves.
        layout, new = self.channel.layout, set(larger) - set(smaller)
        delays = set(delays_of(layout))
        lags_too = new <= set(DELAY_NAMES) - delays and not delays.isdisjoint(smaller)
        # All commands are late alike: that few of them change says nothing against it.
        repeats = (layout.of_wheels and new <= delays) or proof.holds_without_two_best(self.channel.count)
        return (
            (not is_alternative or proof.score_without_best(price, self.channel.count) > 0.0)
            and (proof.score > limits.score or self._dominant(smaller, gain))
            and repeats
            and (
                self.moves(self.split(smaller), self.split(larger)) > limits.moves_m
                or (lags_too and proof.score > limits.unnamed_score)
            )
        )

    def _dominant(self, smaller: Names, gain: float) -> bool:
        """Whether a gain is a large part of what a poor fit lacks: the right family in a wrong form, then.

        Such a fit scatters from block to block more than any noise, and the score alone would never take it.
        """
        lacking = self.fit(smaller).cost - 0.5 * self.channel.count
        poor = self.fit(smaller).cost > self.channel.settings.noise.poor_fit * 0.5 * self.channel.count
        return poor and gain > self.settings.large_share * lacking

    def promise(self, accepted: Names, name: str) -> float:
        """Gain in nats of one more effect, less half its parameters' price; fitted only if it may be worth it."""
        candidate = CANDIDATES[name]
        price = 0.5 * candidate.parameters * np.log(self.channel.count)
        smooth = candidate.starts is None and candidate.profile is None
        if smooth and frozenset((*accepted, name)) not in self.fits:
            worth = float(self._linear_gain(self.fit(accepted), candidate) - price)
            if 2.0 * worth < self.thresholds.score:
                return worth
        return float(self.fit(accepted).cost - self.fit((*accepted, name)).cost - price)

    def ranked(self, accepted: Names) -> list[str]:
        """Candidates that are not in yet, the most promising first."""
        rest = [name for name in candidates_of(self.channel.layout) if name not in accepted]
        promises = {name: self.promise(accepted, name) for name in rest}
        return sorted((name for name in rest if promises[name] > 0.0), key=lambda name: -promises[name])

    def _next(self, accepted: Names) -> str | None:
        """Return the most promising candidate that is accepted on top of a set, or None."""
        acceptable = (name for name in self.ranked(accepted) if self.acceptable(accepted, (*accepted, name)))
        return next(acceptable, None)

    def greedy(self, begin: Names = (), settle: Callable[[Selector, Names], None] | None = None) -> Names:
        """Forward steps only, from a set that is kept; `settle` may better the fit of a set before the next step."""
        accepted = begin or self.given
        while True:
            new = self._next(accepted)
            if new is None:
                return accepted
            accepted = (*accepted, new)
            if settle is not None:
                settle(self, accepted)

    def select(self, begin: Names = ()) -> Names:
        """Forward, swap, backward, until nothing changes; from what is needed of a set to begin with, swapped too.

        Swaps and drops may come back to a set that was there before: then it is the best of those on the way.
        """
        accepted = self.needed(self.swapped(self.needed(begin))) if begin else self.given
        visited = {frozenset(accepted): accepted}
        while True:
            new = self._next(accepted)
            if new is None:
                return accepted
            larger = self.needed(self.swapped((*accepted, new)))
            if frozenset(larger) in visited:
                return min(visited.values(), key=self.priced)
            visited[frozenset(larger)] = accepted = larger

    def priced(self, names: Names) -> float:
        """Misfit of a set in nats with half the price of its parameters."""
        return float(self.fit(names).cost + 0.5 * parameters_of(names) * np.log(self.channel.count))

    def swapped(self, accepted: Names, among: Names | None = None) -> Names:
        """Replace effects by others, both `among` some, as long as that gains more than the price of the parameters."""
        for _ in range(len(accepted)):
            best, score = accepted, self.settings.telling_nats
            for place, old in enumerate(accepted):
                if old in self.given or (among is not None and old not in among):
                    continue
                rest = (*accepted[:place], *accepted[place + 1 :])
                worth = self._worth(rest, accepted, old)
                for name in candidates_of(self.channel.layout) if among is None else among:
                    if name not in accepted and self.promise(rest, name) - worth > score:
                        best, score = (
                            (*accepted[:place], name, *accepted[place + 1 :]),
                            self.promise(rest, name) - worth,
                        )
            if best == accepted:
                return accepted
            accepted = best
        return accepted

    def rivals(self, accepted: Names, name: str) -> Names:
        """Effects that would do in place of an accepted one: not clearly worse, the price of parameters paid."""
        rest = tuple(other for other in accepted if other != name)
        worth = self._worth(rest, accepted, name) - self.settings.telling_nats
        others = (other for other in candidates_of(self.channel.layout) if other not in accepted)
        return tuple(other for other in others if self.promise(rest, other) > worth)

    def _worth(self, rest: Names, accepted: Names, name: str) -> float:
        """Gain in nats of an accepted effect, less half its parameters' price."""
        price = 0.5 * CANDIDATES[name].parameters * np.log(self.channel.count)
        return float(self.fit(rest).cost - self.fit(accepted).cost - price)

    def needed(self, accepted: Names, among: Names | None = None) -> Names:
        """Drop effects, `among` some, that the others have made unnecessary, the one that is missed least first."""
        idle = []
        for name in accepted:
            if name in self.given or (among is not None and name not in among):
                continue
            rest = tuple(other for other in accepted if other != name)
            self._refit_without(accepted, name, rest)
            if not self.acceptable(rest, accepted):
                idle.append((self._worth(rest, accepted, name), rest))
        return self.needed(min(idle)[1], among) if idle else accepted

    def _refit_without(self, accepted: Names, name: str, rest: Names) -> None:
        """Fit `rest` from the fit of the larger set too: what has thresholds may have found better ones there."""
        if not rest or frozenset(rest) <= frozenset(self.given):
            return
        candidate, layout = CANDIDATES[name], self.channel.layout
        vector = self.fit(accepted).vector.copy()
        columns = (*candidate.columns, *((candidate.profile.column,) if candidate.profile is not None else ()))
        places = [layout.place[column] for column in columns]
        vector[places] = layout.neutral[places]
        option, key = fit(self.channel, vector, indices(self.channel, rest), loose=not self.closely), frozenset(rest)
        if option.cost < self.fit(rest).cost - self.channel.settings.fit.enough_nats:
            self.fits[key] = option
            self.proofs = {pair: proof for pair, proof in self.proofs.items() if key not in pair}
