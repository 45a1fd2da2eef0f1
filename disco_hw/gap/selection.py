"""Which effects: forward selection with swaps and a backward check, refitting everything each time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.candidates import Candidate, candidates_of, indices
from disco_hw.gap.channels import Channel
from disco_hw.gap.evidence import Evidence, compare
from disco_hw.gap.fit import Fit, fit

Array = NDArray[np.float64]
Names = tuple[str, ...]

_MOST_EFFECTS = 6


@dataclass(frozen=True, slots=True)
class Thresholds:
    """When an effect is accepted: evidence score, chance that its held-out gain is none, shift of a 2 s prediction."""

    score: float = 20.0
    p_value: float = 0.01
    moves_m: float = 0.0005


@dataclass
class Selector:
    """Fits sets of effects of one channel, each once; `moves` tells how far a fit moves the prediction of another."""

    channel: Channel
    moves: Callable[[Fit, Fit], float]
    thresholds: Thresholds = Thresholds()
    extra: Array | None = None
    fits: dict[frozenset[str], Fit] = field(default_factory=dict)

    def fit(self, names: Names) -> Fit:
        """The best fit of a set, started from the best smaller ones known."""
        key = frozenset(names)
        if key not in self.fits:
            parents = [self.fits[key - {name}] for name in names if key - {name} in self.fits]
            if not names:
                self.fits[key] = fit(self.channel, self.channel.neutral, indices(self.channel, ()), self.extra)
            else:
                new = [name for name in names if key - {name} in self.fits] or [names[-1]]
                parents = parents or [self.fit(names[:-1])]
                options = [
                    self._with(parent, names, candidates_of(self.channel)[name])
                    for parent, name in zip(parents, new, strict=True)
                ]
                self.fits[key] = min(options, key=lambda option: option.cost)
        return self.fits[key]

    def _with(self, parent: Fit, names: Names, new: Candidate) -> Fit:
        """Fit `names` from `parent`, which lacks `new`."""
        channel, columns = self.channel, self.channel.columns
        active = indices(channel, names)
        start = parent.vector.copy()
        if new.profiled is not None:
            assert new.values is not None
            return self._profile(start, active, new, new.values(channel))
        best: Fit | None = None
        for values in new.starts(channel):
            vector = start.copy()
            vector[[columns.index(column) for column in new.columns]] = values
            found = fit(channel, vector, active, self.extra, 2 if len(new.starts(channel)) > 1 else 12)
            best = found if best is None or found.cost < best.cost else best
        if best is None:
            return fit(channel, start, active, self.extra)
        return fit(channel, best.vector, active, self.extra) if len(new.starts(channel)) > 1 else best

    def _profile(self, start: Array, active: tuple[int, ...], new: Candidate, values: tuple[float, ...]) -> Fit:
        """Search the profiled entry over its values, then closer around the best, refitting the others."""
        channel = self.channel
        place = channel.columns.index(new.profiled or "")
        tried: dict[float, Fit] = {}

        def attempt(value: float, iterations: int) -> None:
            vector = start.copy()
            vector[place] = value
            tried[value] = fit(channel, vector, active, self.extra, iterations)

        for value in values:
            attempt(value, 1)
        if not tried:
            return fit(channel, start, active, self.extra)
        spacing = values[1] - values[0]
        while spacing > new.refine:
            spacing *= 0.5
            best = min(tried, key=lambda value: tried[value].cost)
            for value in (best - spacing, best + spacing):
                attempt(value, 1)
        best = min(tried, key=lambda value: tried[value].cost)
        return fit(channel, tried[best].vector, active, self.extra)

    def evidence(self, smaller: Names, larger: Names) -> Evidence:
        """Evidence for the larger set against the smaller one."""
        known = candidates_of(self.channel)
        parameters = sum(known[n].parameters for n in larger) - sum(known[n].parameters for n in smaller)
        return compare(self.fit(smaller), self.fit(larger), self.channel, parameters)

    def acceptable(self, smaller: Names, larger: Names) -> bool:
        """Whether what the larger set has more is accepted."""
        proof = self.evidence(smaller, larger)
        limits = self.thresholds
        return (
            proof.score > limits.score
            and proof.held_out > 0.0
            and proof.p_value < limits.p_value
            and self.moves(self.fit(smaller), self.fit(larger)) > limits.moves_m
        )

    def select(self) -> Names:
        """Forward, swap, backward, until nothing changes."""
        accepted: Names = ()
        visited = {frozenset(accepted)}
        known = candidates_of(self.channel)
        while len(accepted) < _MOST_EFFECTS:
            rest = [name for name in known if name not in accepted]
            ranked = sorted(rest, key=lambda name: -self.evidence(accepted, (*accepted, name)).score)
            new = next((name for name in ranked if self.acceptable(accepted, (*accepted, name))), None)
            if new is None:
                break
            larger = self._backward(self._swapped((*accepted, new)))
            if frozenset(larger) in visited:
                break
            visited.add(frozenset(larger))
            accepted = larger
        return accepted

    def _swapped(self, accepted: Names) -> Names:
        """Replace single effects as long as that fits better at no more parameters' worth."""
        known = candidates_of(self.channel)
        for _ in range(len(accepted)):
            best, score = accepted, 0.0
            for place, old in enumerate(accepted):
                for name in known:
                    if name in accepted:
                        continue
                    trial = (*accepted[:place], name, *accepted[place + 1 :])
                    change = 2.0 * (self.fit(accepted).cost - self.fit(trial).cost)
                    change -= (known[name].parameters - known[old].parameters) * np.log(self.channel.count)
                    if change > max(score, 2.0):
                        best, score = trial, change
            if best == accepted:
                break
            accepted = best
        return accepted

    def _backward(self, accepted: Names) -> Names:
        """Drop effects that the others have made unnecessary."""
        for name in accepted:
            rest = tuple(other for other in accepted if other != name)
            if len(accepted) > 1 and not self.acceptable(rest, accepted):
                return self._backward(rest)
        return accepted


