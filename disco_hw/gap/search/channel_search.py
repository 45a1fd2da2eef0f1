"""Search of one channel: learn its noise from a rich model, hold it, then select."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.data import BODY, DELAYED_BY, WHEEL, Layout
from disco_hw.gap.data.gridded_drive import GriddedDrive
from disco_hw.gap.noise import learn_body_noise, learn_wheel_noise
from disco_hw.gap.noise.body_noise import BodyNoise
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.noise.wheel_noise import WheelNoise, whiten_wheels
from disco_hw.gap.search.channel_result import ChannelResult, UnnamedTerm
from disco_hw.gap.search.evidence import compare
from disco_hw.gap.search.least_squares import Fit, fit, inverse
from disco_hw.gap.search.richest_model import (
    DELAY_COLUMNS,
    DELAY_NAMES,
    DELAY_STARTS_S,
    delay_columns,
    delays_of,
    indices,
    learn_saturated_body,
    learn_saturated_wheels,
    parameters_of,
    smooth_of,
    with_delay,
)
from disco_hw.gap.search.selection import Names, Selector, Thresholds, body_moves, wheel_moves
from disco_hw.gap.search.unnamed_terms import (
    ResidualChannel,
    Term,
    WithTerms,
    body_terms,
    places,
    places_near,
    wheel_terms,
)
from disco_hw.gap.settings import SelectionSettings

# Fourth moment of normal noise over its variance squared.
_GAUSSIAN_KURTOSIS = 3.0
Array = NDArray[np.float64]


def search_wheels(drive: GriddedDrive, geometry: Array, start: Array, given: Names = ()) -> ChannelResult:
    """Effects between command and wheel.

    `geometry` (3,) is how far they move the robot; `start` is the vector without what is missing, in which effects
    `given` are known already.
    """
    channel = WheelChannel.build(_on_own_clock(drive), WheelNoise(reading_rad=max(drive.quantum_rad, 2e-4)), geometry)
    moves = wheel_moves(channel, geometry)
    settings = drive.settings.selection
    # What is left of a rough fit becomes the noise of all that follow.
    seen = with_delay(channel, start)
    limits = Thresholds(settings.unnamed_score, 0.0, settings.unnamed_score)
    rough = Selector(channel, moves, limits, given=given, start=seen, closely=True)
    begin = tuple(dict.fromkeys((*given, *DELAY_NAMES)))
    responding(rough, begin)
    names = rough.greedy(begin, responding)
    rich = (*names, *(name for name in smooth_of(WHEEL) if name not in names))
    vector = fit(channel, rough.fit(names).vector, indices(channel, rich)).vector
    channel = channel.expecting(vector)
    plain = learn_wheel_noise(channel, channel.raw_residual(vector))
    sound, left, many = learn_saturated_wheels(plain, vector)

    def searched(channel: WheelChannel) -> ChannelResult:
        white = whiten_wheels(left, channel.gains)
        rolling = np.abs(drive.speed_rad_s[drive.encoder.node]).max(axis=1) > drive.settings.grid.rest_rad_s
        limits = _thresholds(white, channel.gains.use & rolling, settings)
        selector = timed(Selector(channel, moves, limits, given=given, start=rough.fit(given).vector))
        selector.fits[frozenset(names)] = fit(channel, rough.fit(names).vector, indices(channel, names))
        richest = (white * channel.weight).ravel()
        found = ChannelResult(selector, selector.select(names), channel, richest=richest, richest_parameters=many)
        return evaluated_channel(stamped(with_unnamed(found, _wheel_options), drive), given, start)

    found = searched(sound)
    # Where nothing known comes near, the noise is too little to compare what is all wrong: the family shows in the
    # noise that the best of it leaves, and what is left against the richest model.
    return searched(plain) if found.fit.cost > drive.settings.noise.poor_fit * 0.5 * sound.count else found


def _on_own_clock(drive: GriddedDrive) -> GriddedDrive:
    """Return the drive as if its commands and poses were stamped at the times to which they were moved.

    So a search is the same wherever their stamps are, to the last bit.
    """
    delay_s = drive.pose_delay_s - drive.poses_moved_s
    return replace(drive, commands_moved_s=0.0, poses_moved_s=0.0, pose_delay_s=delay_s)


def stamped(found: ChannelResult, drive: GriddedDrive) -> ChannelResult:
    """Return the result of an aligned drive with delays counted from the time stamps of commands or poses."""
    channel: WheelChannel | BodyChannel = replace(found.channel, drive=drive)
    moves = wheel_moves(channel, channel.geometry) if isinstance(channel, WheelChannel) else body_moves(channel)

    def from_stamps(vector: Array) -> Array:
        return _later(vector, drive, channel.layout, 1.0)

    def of(selector: Selector) -> Selector:
        terms = selector.channel.terms if isinstance(selector.channel, WithTerms) else ()
        inner = WithTerms.of(channel, terms) if terms else channel
        fits = {names: replace(one, vector=from_stamps(one.vector)) for names, one in selector.fits.items()}
        start = None if selector.start is None else from_stamps(selector.start)
        return replace(selector, channel=inner, moves=moves, start=start, fits=fits, proofs={})

    plain = None if found.plain is None else of(found.plain)
    return replace(found, selector=of(found.selector), channel=channel, plain=plain)


def _later(vector: Array, drive: GriddedDrive, layout: Layout, times: float) -> Array:
    """Return the vector with a delay longer by `times` the time by which commands or poses were moved."""
    moved, by_s = vector.copy(), drive.commands_moved_s if layout.of_wheels else drive.poses_moved_s
    moved[[layout.place[column] for column in delay_columns(layout)]] += times * by_s
    return moved


def timed(selector: Selector) -> Selector:
    """One without fits whose sets all have the delay of commands or poses, fitted from what is seen at first sight.

    Where a delay is missing other effects stand in for it, and what is chosen depends on how long it is.
    """
    channel, start = selector.channel, selector.channel.neutral if selector.start is None else selector.start
    given = tuple(dict.fromkeys((*selector.given, *delays_of(channel.layout))))
    return replace(selector, given=given, start=with_delay(channel, start), fits={}, proofs={})


def evaluated_channel(found: ChannelResult, given: Names, start: Array) -> ChannelResult:
    """Evaluate the result again with delays tested like all other effects: against a vector that has `given` alone.

    Other effects stay as they were found beside the delay: one that is too short for a name would change them too.
    """

    def against_none(selector: Selector, start: Array) -> Selector:
        delays = frozenset(delays_of(selector.channel.layout))
        fits = {names: one for names, one in selector.fits.items() if delays <= names}
        return replace(selector, given=given, start=start, fits=fits, proofs={})

    plain = None if found.plain is None else against_none(found.plain, start)
    if plain is not None:
        assert isinstance(found.selector.channel, WithTerms)
        start = _extended(plain, found.selector.channel)
    selector = against_none(found.selector, start)
    layout = selector.channel.layout
    delays, delay_names = delays_of(layout), DELAY_NAMES if layout.of_wheels else ()
    names = selector.needed(selector.swapped(selector.needed(found.names, delays), delay_names), delays)
    return _written(replace(found, selector=selector, plain=plain, names=names))


def responding(selector: Selector, names: Names) -> None:
    """Fit lag and delay together from slow and quick responses; on top of others that were accepted, from none.

    One at a time they may lose to effects that merely stop the wheels: on a slow robot neither is much without the
    other. And what stops the wheels looks slow until it is named: then the others are fitted without a response first.
    """
    channel, before = selector.channel, selector.fits.get(frozenset(names))
    others = tuple(name for name in names if name in selector.given or name not in DELAY_NAMES)
    active = indices(channel, names)
    places = [channel.layout.place[column] for column in DELAY_COLUMNS]
    plain = selector.fit(others).vector
    options = [] if before is None else [before, fit(channel, plain, active)]
    for response_s in DELAY_STARTS_S if before is None else ():
        vector = plain.copy()
        vector[places] = response_s
        vector += with_delay(channel, channel.layout.neutral) - channel.layout.neutral
        options.append(fit(channel, vector, active))
    selector.fits[frozenset(names)] = min(options, key=lambda option: option.cost)


def search_body(drive: GriddedDrive, start: Array, given: Names = ()) -> ChannelResult:
    """Effects between measured wheel angles and measured poses; `start` and `given` as for the wheels."""
    here, begin = _on_own_clock(drive), start.copy()
    begin[[BODY.place[column] for column in delay_columns(BODY)]] = here.pose_delay_s
    channel = BodyChannel.build(here, BodyNoise(), begin)
    nominal = fit(channel, _later(start, drive, BODY, -1.0), indices(channel, given))
    # Noise that is learnt from poses that are laid beside the wrong wheels hides that they are.
    delayed = fit(channel, with_delay(channel, start), indices(channel, given))
    errs = nominal.cost < drive.settings.noise.by_stamps_share * delayed.cost
    channel = learn_body_noise(channel, (nominal if errs else delayed).vector, iterations=4)
    settings = drive.settings.selection
    limits = Thresholds(settings.unnamed_score, 0.0, settings.unnamed_score)
    rough = Selector(channel, body_moves(channel), limits, given=given, start=delayed.vector, closely=True)
    names = rough.greedy(tuple(dict.fromkeys((*given, *delays_of(BODY)))))
    rich = (*names, *(name for name in smooth_of(BODY) if name not in names))
    vector = fit(channel, rough.fit(names).vector, indices(channel, rich)).vector
    channel = learn_body_noise(channel, vector)
    perturbations = _body_perturbations(channel, rich, vector)
    channel, fullest, extra, many = learn_saturated_body(channel, rich, vector, perturbations)
    limits = _thresholds(channel.whitened(fullest, extra), channel.use, settings)
    selector = timed(Selector(channel, body_moves(channel), limits, given=given, start=rough.fit(given).vector))
    richest = channel.residual(fullest, extra)
    found = ChannelResult(selector, selector.select(), channel, richest=richest, richest_parameters=many)
    return evaluated_channel(stamped(_time_or_place(found), drive), given, _later(nominal.vector, drive, BODY, 1.0))


def _time_or_place(found: ChannelResult) -> ChannelResult:
    """Add unnamed terms to the body's effects; replace a change of the floor by a patch of it, if that does as well.

    A patch that was left and not entered again looks like a change. No floor changes while one drives on it, so the
    patch is reported then, and the change is kept as an alternative.
    """
    named = with_unnamed(found, _body_options)
    alike = tuple(name for name in found.names if REGISTRY[name].like_a_patch and name not in found.selector.given)
    if not alike:
        return named
    rest = tuple(name for name in found.names if name not in alike)
    placed = with_unnamed(replace(found, names=rest), _body_options)
    if set(alike) & set(placed.names) or not any(one.term.disc for one in placed.unnamed):
        return named
    better = _priced(named) - _priced(placed)
    # A patch has a place and a size to be fitted at: twice the usual evidence tells the two apart.
    clearly = 2.0 * found.channel.settings.selection.telling_nats
    return replace(placed, either=alike if better < clearly else ()) if better > -clearly else named


def _priced(found: ChannelResult) -> float:
    """Misfit in nats with the price of all that was fitted, where and how large a patch is among it."""
    many = parameters_of(found.names) + sum(4 if one.term.disc else len(one.term.features) for one in found.unnamed)
    return found.fit.cost + 0.5 * many * math.log(max(found.channel.count, 2))


def _body_perturbations(channel: BodyChannel, names: Names, vector: Array) -> Iterator[Array]:
    """Pushes of all terms of the body, and of the disc of the floor that promises most."""
    rich = fit(channel, vector, indices(channel, names), 1)
    discs, _ = best_terms(rich, channel, places(channel, vector))
    yield from (feature for term in body_terms(channel, vector) for feature in term.features)
    yield from (disc.perturbation for disc in discs)


def _thresholds(white: Array, use: NDArray[np.bool_], settings: SelectionSettings) -> Thresholds:
    """Thresholds for a channel: the heavier the noise's tails, the more it takes.

    Noise that comes in bursts wanders too, more slowly than any block that could show it.
    """
    sound = white[use]
    sound = sound[np.abs(sound).max(axis=1) > settings.silent]
    times = 1.0
    if sound.size:
        sound = np.clip(sound / np.sqrt((sound**2).mean()), -settings.clipped_at, settings.clipped_at)
        times = min(max(float((sound**4).mean()) / _GAUSSIAN_KURTOSIS, 1.0), settings.heaviest)
    return Thresholds(times * settings.named_score, settings.least_moved_m, times * settings.unnamed_score)


def _wheel_options(found: ChannelResult) -> Iterator[Term]:
    assert isinstance(found.channel, WheelChannel)
    return wheel_terms(found.channel, WHEEL.at(found.fit.vector, DELAYED_BY))


def _body_options(found: ChannelResult) -> Iterator[Term]:
    assert isinstance(found.channel, BodyChannel)
    p = found.fit.vector
    return chain(body_terms(found.channel, p), places(found.channel, p))


def with_unnamed(found: ChannelResult, options: Callable[[ChannelResult], Iterator[Term]]) -> ChannelResult:
    """Add unnamed terms as long as one of the best is worth its price and that of the choice among all.

    After each, it is seen which names are still needed: one that only stood in for the term is not. A patch
    of the floor has to be worth it without the block of time that says most: around whatever happened once, a patch can
    be drawn.
    """
    patches = True
    while len(found.unnamed) < found.channel.settings.terms.most_terms:
        larger, patches = _with_one_more(found, options, patches)
        if larger is None:
            break
        found = larger
    return _written(found)


def _written(found: ChannelResult) -> ChannelResult:
    """Return the result with the reported coefficients in the forms of its terms."""
    if not found.unnamed:
        return found
    vector, ends = found.reported.vector, np.cumsum([len(one.term.features) for one in found.unnamed])
    coefficients = np.split(vector[vector.size - ends[-1] :], ends[:-1])
    written = zip(found.unnamed, coefficients, strict=True)
    return replace(found, unnamed=tuple(replace(one, form=one.term.written(values)) for one, values in written))


def that_models_hold(found: ChannelResult) -> ChannelResult:
    """Replace terms that no model can hold by others, and select names again."""
    if found.plain is None or all(one.term.model_name is not None for one in found.unnamed):
        return found
    options = _wheel_options if isinstance(found.channel, WheelChannel) else _body_options
    bare = replace(found, selector=found.plain, names=found.plain.select(found.names), unnamed=(), plain=None)
    return with_unnamed(bare, lambda of: (term for term in options(of) if term.model_name is not None))


def _with_one_more(
    found: ChannelResult, options: Callable[[ChannelResult], Iterator[Term]], patches: bool
) -> tuple[ChannelResult | None, bool]:
    """Add the first of the most promising terms that is accepted, or return None; and whether patches may follow."""
    offered = (term for term in options(found) if patches or term.disc is None)
    promising, tried = best_terms(found.fit, found.selector.channel, offered)
    for promised in promising:
        term, among = promised, tried
        if term.disc is not None and isinstance(found.channel, BodyChannel):
            near = places_near(found.channel, found.fit.vector, term.disc)
            (term, *_), closer = best_terms(found.fit, found.selector.channel, chain((term,), near))
            among += closer
        larger, happened_again = _with_term(found, term, among)
        if larger is not None:
            return larger, patches
        if not happened_again:
            return _with_one_more(found, options, False)
    return None, patches


def _with_term(found: ChannelResult, term: Term, tried: int) -> tuple[ChannelResult | None, bool]:
    """Add a term that was chosen among `tried`; None if its evidence is too small.

    The second value says, for a patch, whether its evidence holds without the most informative block.
    """
    plain, small = found.plain or found.selector, found.fit
    terms = (*(one.term for one in found.unnamed), term)
    channel = WithTerms.of(found.channel, terms)
    begin = np.append(small.vector, np.zeros(len(term.features)))
    moves, given, start = found.selector.moves, found.selector.given, _extended(plain, channel)
    selector = Selector(channel, moves, plain.thresholds, given=given, start=start)
    selector.fits[frozenset(found.names)] = big = fit(channel, begin, indices(channel, found.names))
    parameters = len(term.features) + 2.0 * math.log(tried) / math.log(channel.count)
    proof = compare(small, big, channel, parameters)
    moved = selector.moves(found.selector.channel.split(small.vector), channel.split(big.vector))
    limits = plain.thresholds
    if term.disc is not None and proof.score_without_best(parameters, channel.count) < limits.unnamed_score:
        return None, False
    # A patch that is driven over twice has been tried again.
    repeats = term.disc is not None or proof.holds_without_two_best(channel.count)
    if proof.score < limits.unnamed_score or not repeats or moved < limits.moves_m:
        return None, True
    names = selector.select(found.names)
    if set(names) != set(found.names):
        # What stood in for the term may have kept out what it is really about.
        names = min(names, selector.select(), key=selector.priced)
    proofs = (*(one.evidence for one in found.unnamed), proof)
    accepted = tuple(UnnamedTerm(each.form, evidence, each) for each, evidence in zip(terms, proofs, strict=True))
    return replace(found, selector=selector, names=names, unnamed=accepted, plain=plain), True


def _extended(plain: Selector, channel: WithTerms) -> Array:
    """Return the start of the fits of a channel with terms."""
    start = plain.fit(plain.given).vector
    return np.append(start, np.zeros(channel.neutral.size - start.size))


def best_terms(small: Fit, channel: ResidualChannel, options: Iterator[Term]) -> tuple[list[Term], int]:
    """Find the terms that gain most to first order on top of a fit; return them and how many were tried.

    Terms that are not worth a fit are left out. Of the discs of the floor, which are variations of one another, only
    the best is kept.
    """
    settings = channel.settings.terms
    promising: list[tuple[float, Term]] = []
    tried = 0
    core, fixed = channel.split(small.vector)
    inner = channel.inner
    base = inner.residual(core, fixed)
    solved, gradient = inverse(small.information()), small.gradient
    for term in options:
        tried += 1
        columns = []
        for feature in term.features:
            size = float(np.sqrt((feature**2).mean()))
            if size < 1e-9:
                continue
            epsilon = 1e-3 / size
            perturbation = epsilon * feature if fixed is None else fixed + epsilon * feature
            columns.append((inner.residual(core, perturbation) - base) / epsilon)
        if not columns:
            continue
        slope = np.column_stack(columns)
        across = small.jacobian.T @ slope
        information = slope.T @ slope - across.T @ solved @ across
        pull = slope.T @ small.residual - across.T @ solved @ gradient
        if np.trace(information) < settings.least_independent_share * float((slope**2).sum()):
            continue
        coefficients = -inverse(information) @ pull
        gain = -0.5 * float(pull @ coefficients) - 0.5 * (len(columns) - 1) * math.log(channel.count)
        if gain > settings.worth_trying_nats and coefficients.max() <= term.highest:
            promising.append((gain, term))
    best: list[Term] = []
    for _, term in sorted(promising, key=lambda one: -one[0]):
        if term.disc is None or all(other.disc is None for other in best):
            best.append(term)
    return best[: settings.most_tried], max(tried, 2)
