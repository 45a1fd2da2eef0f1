"""Which analyses have less than another one, in what order, and what is said to be left out of them."""

from types import SimpleNamespace

import pytest

from disco_hw.gap.search.analysis import GapAnalysis, lacking, least_evident_first
from disco_hw.gap.search.channel_result import ChannelResult, UnnamedTerm

SCORES = {
    "motor_lag": 90.0, "deadband": 40.0, "stiction": 60.0, "turn_slip": 50.0, "slope": 30.0, "side_slip": 5.0,
    "pose_latency": 10.0, "heading_bias": 15.0, "pose_offset": 12.0,
}  # fmt: skip


def chosen(given=(), **rivals):
    """A selector whose evidence for a name is its score; what would do as well in the place of each."""

    def evidence(rest, names):
        (name,) = set(names) - set(rest)
        return SimpleNamespace(score=SCORES[name])

    def alike(names, name):
        assert name in names
        return rivals.get(name, ())

    return SimpleNamespace(given=given, evidence=evidence, rivals=alike)


def found(names, terms=(), given=(), plain=None, **rivals):
    unnamed = tuple(UnnamedTerm(form, SimpleNamespace(score=score), None) for form, score in terms)
    return ChannelResult(chosen(given, **rivals), names, None, unnamed, plain)


def analysis_of(wheels=None, body=None, left_out=()):
    return GapAnalysis(None, None, None, body, wheels, left_out)


def told(analysis):
    """The names and terms of both channels, and what was left out."""
    of = [analysis.wheels, analysis.body]
    return (
        *(None if one is None else (*one.names, *(term.form for term in one.unnamed)) for one in of),
        analysis.left_out,
    )


def test_the_least_evident_comes_first_whatever_its_channel_and_lateness_and_what_was_given_not_at_all():
    wheels = found(("motor_lag", "deadband", "stiction"), [("u |u|", 35.0), ("u u", 55.0)], given=("stiction",))
    body = found(("slope", "turn_slip", "side_slip"), [("v v", 45.0)])
    expected = [
        ("body", "side_slip"), ("body", "slope"), ("wheels", "deadband"), ("body", None), ("body", "turn_slip"),
        ("wheels", None),
    ]  # fmt: skip
    assert least_evident_first(analysis_of(wheels, body)) == expected
    # Terms go together, and count as much as the best of them.
    assert least_evident_first(analysis_of(wheels)) == [("wheels", "deadband"), ("wheels", None)]
    assert least_evident_first(analysis_of(None, body))[0] == ("body", "side_slip")
    assert least_evident_first(analysis_of()) == []


def test_without_its_terms_a_channel_is_the_one_that_was_searched_before():
    plain = chosen()
    body = found(("slope", "turn_slip"), [("v v", 45.0), ("v w", 25.0)], plain=plain)
    both = analysis_of(found(("motor_lag", "deadband")), body, ("stiction",))
    bare, fewer = lacking(both, "body", None), lacking(both, "body", "turn_slip")
    kept = ("motor_lag", "deadband")
    assert told(bare) == (kept, ("slope", "turn_slip"), ("stiction", "v v", "v w"))
    assert told(fewer) == (kept, ("slope", "v v", "v w"), ("stiction", "turn_slip"))
    # What is fitted without them has none.
    assert bare.body.selector is plain
    assert bare.body.plain is None
    assert fewer.body.plain is plain


@pytest.mark.parametrize("which", ["wheels", "body"])
def test_what_lacks_something_is_the_channel_that_had_it(which):
    analysis = analysis_of(found(("deadband", "slope")), found(("deadband", "slope")))
    less = lacking(analysis, which, "slope")
    assert getattr(less, which).names == ("deadband",)
    other = "body" if which == "wheels" else "wheels"
    assert getattr(less, other) is getattr(analysis, other)
    assert less.left_out == ("slope",)
    # Without terms there is nothing to go back to.
    assert getattr(lacking(analysis, which, None), which).selector is getattr(analysis, which).selector
