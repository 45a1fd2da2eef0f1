"""Which analyses have less than another one, in what order, and what is said to be left out of them."""

from types import SimpleNamespace

import pytest

from disco_hw.gap.search.analysis import GapAnalysis, lacking, lacking_one, least_evident_first, swapped_one
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


def analysis_of(wheels=None, body=None, pruned=()):
    return GapAnalysis(None, None, None, body, wheels, pruned)


def told(analysis):
    """The names and terms of both channels, and what was left out."""
    of = [analysis.wheels, analysis.body]
    return (
        *(None if one is None else (*one.names, *(term.form for term in one.unnamed)) for one in of),
        analysis.pruned,
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


def test_each_name_and_all_terms_of_a_channel_go_in_turn():
    plain = chosen()
    wheels = found(("motor_lag", "deadband"), given=("motor_lag",))
    body = found(("slope", "turn_slip"), [("v v", 45.0), ("v w", 25.0)], plain=plain)
    both = analysis_of(wheels, body, ("stiction",))
    without = [*lacking_one(both)]
    kept, terms = ("motor_lag", "deadband"), ("slope", "turn_slip", "v v", "v w")
    assert [told(one) for one in without] == [
        (("motor_lag",), terms, ("stiction", "deadband")),
        (kept, terms[1:], ("stiction", "slope")),
        (kept, ("slope", "v v", "v w"), ("stiction", "turn_slip")),
        (kept, ("slope", "turn_slip"), ("stiction", "v v", "v w")),
    ]
    # What is fitted without them has none.
    assert without[-1].body.selector is plain
    assert without[-1].body.plain is None
    assert without[-2].body.plain is plain
    assert [told(one)[1] for one in lacking_one(analysis_of(None, body))] == [told(one)[1] for one in without[1:]]
    assert [told(one) for one in lacking_one(analysis_of(wheels))] == [(("motor_lag",), None, ("deadband",))]


@pytest.mark.parametrize("which", ["wheels", "body"])
def test_what_lacks_something_is_the_channel_that_had_it(which):
    analysis = analysis_of(found(("deadband", "slope")), found(("deadband", "slope")))
    less = lacking(analysis, which, "slope")
    assert getattr(less, which).names == ("deadband",)
    other = "body" if which == "wheels" else "wheels"
    assert getattr(less, other) is getattr(analysis, other)
    assert less.pruned == ("slope",)
    # Without terms there is nothing to go back to.
    assert getattr(lacking(analysis, which, None), which).selector is getattr(analysis, which).selector


def test_what_would_do_as_well_takes_the_place_of_a_name():
    wheels = found(("motor_lag", "deadband"), deadband=("stiction",))
    body = found(("slope", "turn_slip"), given=("slope",), turn_slip=("side_slip", "lateral_icr"), slope=("no",))
    options = [told(one) for one in swapped_one(analysis_of(wheels, body))]
    assert options == [
        (("motor_lag", "stiction"), ("slope", "turn_slip"), ("deadband",)),
        (("motor_lag", "deadband"), ("slope", "side_slip"), ("turn_slip",)),
        (("motor_lag", "deadband"), ("slope", "lateral_icr"), ("turn_slip",)),
    ]
    assert len([*swapped_one(analysis_of(None, body))]) == 2
    assert len([*swapped_one(analysis_of(wheels))]) == 1
