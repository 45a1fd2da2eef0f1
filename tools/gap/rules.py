"""The decision rules of the search for missing effects, each with what is answered where it is switched off.

A rule is a function of `disco_hw.gap`, or one condition in it. `counting` runs each beside what would be answered
without it, and counts how often the two differ; `without` leaves one out. A log on which they never differ is answered
alike without the rule: nothing has to be searched anew to know that.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any

from disco_hw.gap import search
from disco_hw.gap.report import judge, misspecification
from disco_hw.gap.search import (
    analysis,
    channel_result,
    channel_search,
    selection,
)
from disco_hw.gap.search.evidence import EffectEvidence
from disco_hw.gap.search.selection import Selector

Answer = Callable[..., Any]


@dataclass(frozen=True)
class Rule:
    """A rule: its name, the function of `owner` that it is or is part of, and the answer where it is switched off.

    `off` is given the function with the rule, and its arguments. `same`: whether two answers are one.
    """

    name: str
    owner: Any
    attribute: str
    off: Answer
    same: Callable[[Any, Any], bool] = lambda one, other: bool(one == other)


def _says(answer: Any) -> Answer:
    return lambda original, *args, **named: answer


def _first(original: Answer, first: Any, *args: Any, **named: Any) -> Any:
    return first


def _second(original: Answer, first: Any, second: Any, *args: Any, **named: Any) -> Any:
    return second


def _with(owner: Any, attribute: str, answer: Any) -> Answer:
    """What a function answers while another one that it asks gives one answer only."""

    def off(original: Answer, *args: Any, **named: Any) -> Any:
        usual = getattr(owner, attribute)
        setattr(owner, attribute, lambda *_args, **_named: answer)
        try:
            return original(*args, **named)
        finally:
            setattr(owner, attribute, usual)

    return off


def _moves_any(original: Answer, selector: Selector, smaller: Any, larger: Any) -> bool:
    """Accept an effect however little it moves predictions."""
    limits = selector.thresholds
    selector.thresholds = replace(limits, moves_m=-1.0)
    try:
        return bool(original(selector, smaller, larger))
    finally:
        selector.thresholds = limits


def _lags_move(original: Answer, selector: Selector, smaller: Any, larger: Any) -> bool:
    """A lag beside a delay has to move predictions as anything else."""
    moved = selector.moves(selector.split(smaller), selector.split(larger)) > selector.thresholds.moves_m
    return bool(original(selector, smaller, larger)) and moved


def _delays_repeat(original: Answer, selector: Selector, smaller: Any, larger: Any) -> bool:
    """A delay of commands has to show in more than two blocks as anything else."""
    return bool(original(selector, smaller, larger)) and selector.evidence(smaller, larger).holds_without_two_best(
        selector.channel.count
    )


def _named(one: Any, other: Any) -> bool:
    def answer(found: Any) -> Any:
        parts = [found] if hasattr(found, "names") else [found.body, found.wheels]
        return [(each.names, [term.form for term in each.unnamed]) for each in parts if each is not None]

    return bool(answer(one) == answer(other))


def _is(one: Any, other: Any) -> bool:
    return one is other


def _plain(white: Any, use: Any, settings: Any) -> Any:
    return selection.Thresholds(settings.named_score, settings.least_moved_m, settings.unnamed_score)


RULES: tuple[Rule, ...] = (
    Rule(
        "a poor fit takes what is a large part of what it lacks",
        Selector,
        "acceptable",
        _with(Selector, "_dominant", False),
    ),
    Rule(
        "a gain holds without the two best blocks",
        Selector,
        "acceptable",
        _with(EffectEvidence, "holds_without_two_best", True),
    ),
    Rule(
        "what begins at some time pays without the best block",
        Selector,
        "acceptable",
        _with(EffectEvidence, "score_without_best", math.inf),
    ),
    Rule("an effect moves predictions", Selector, "acceptable", _moves_any),
    Rule("a lag beside a delay need not", Selector, "acceptable", _lags_move),
    Rule("a delay of commands may show in two blocks only", Selector, "acceptable", _delays_repeat),
    Rule(
        "scores are raised where tails are heavy",
        channel_search,
        "_thresholds",
        lambda original, *args: _plain(*args),
        lambda one, other: one.score <= 1.0001 * other.score,
    ),
    Rule("accepted effects are swapped", Selector, "swapped", _second),
    Rule("accepted effects are dropped again", Selector, "needed", _second),
    Rule("a delay is tested against none", channel_search, "evaluated_channel", _first, _named),
    Rule(
        "a patch of the floor or a change of all",
        channel_search,
        "_time_or_place",
        lambda original, found: channel_search.with_unnamed(found, channel_search._body_options),
        _named,
    ),
    Rule("effects of the pose source that no other log shares are left out", search, "of_every_log", _first, _is),
    Rule("a second start of the whole chain", search._Candidate, "_begins_far", _says(False)),
    Rule(
        "other weights of the wheels' errors", channel_result, "_reported_fit", lambda original, found: found.fit, _is
    ),
    Rule("an encoder is the cause of both", analysis, "one_encoder", _says((False, False))),
    Rule("rivals of a name", Selector, "rivals", _says(())),
    Rule("a value that is hardly known", judge, "is_weakly_known", _says(False)),
    Rule("an interval that includes no effect", judge, "includes_no_effect", _says(False)),
    Rule("a limit that was exceeded", judge, "_exceeded", _says(None)),
    Rule("wheels answer otherwise than by delay and lag", misspecification, "_answers_otherwise", _says(None)),
    Rule("a name takes little of what is missing", misspecification, "_takes_little", _says(None)),
    Rule("a value changes with the regime", misspecification, "_changes_with_regime", _says(None)),
    Rule("regimes still disagree", misspecification, "loud_regimes", _says([])),
)


@contextmanager
def _replaced(rule: Rule, by: Answer) -> Iterator[None]:
    """Put a function in the place of a rule's, wherever it was imported to."""
    original = getattr(rule.owner, rule.attribute)
    homes = [rule.owner]
    homes += [
        module for name, module in sys.modules.items()
        if name.startswith("disco_hw.gap") and module is not rule.owner and vars(module).get(rule.attribute) is original
    ]  # fmt: skip
    for home in homes:
        setattr(home, rule.attribute, by)
    try:
        yield
    finally:
        for home in homes:
            setattr(home, rule.attribute, original)


@contextmanager
def without(name: str) -> Iterator[None]:
    """Switch one rule off."""
    rule = {one.name: one for one in RULES}[name]
    original = getattr(rule.owner, rule.attribute)

    @wraps(original)
    def off(*args: Any, **named: Any) -> Any:
        return rule.off(original, *args, **named)

    with _replaced(rule, off):
        yield


@contextmanager
def counting() -> Iterator[dict[str, list[int]]]:
    """Count for each rule how often it was asked, and how often its answer was another than without it."""
    counts = {rule.name: [0, 0] for rule in RULES}
    active: list[str] = []

    def counted(rule: Rule, original: Answer) -> Answer:
        @wraps(original)
        def by(*args: Any, **named: Any) -> Any:
            answer = original(*args, **named)
            # What is asked only to know what would be said otherwise does not count.
            if active:
                return answer
            active.append(rule.name)
            try:
                other = rule.off(original, *args, **named)
            finally:
                active.pop()
            counts[rule.name][0] += 1
            counts[rule.name][1] += not rule.same(answer, other)
            return answer

        return by

    entered = []
    try:
        for rule in RULES:
            manager = _replaced(rule, counted(rule, getattr(rule.owner, rule.attribute)))
            manager.__enter__()
            entered.append(manager)
        yield counts
    finally:
        for manager in reversed(entered):
            manager.__exit__(None, None, None)
