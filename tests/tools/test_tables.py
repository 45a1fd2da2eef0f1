"""Which cases of a table `make test` runs."""

from types import SimpleNamespace

import pytest
from hypothesis import strategies as st

from tests.tables import examples, thinned


def split(decorator):
    """The values of the quick cases and of the thorough ones."""
    cases = decorator.mark.args[1]
    marked = [case for case in cases if hasattr(case, "marks") and any(mark.name == "thorough" for mark in case.marks)]
    return [case for case in cases if case not in marked], [case.values for case in marked]


@pytest.mark.parametrize(
    ("keep", "expected"), [(1, [0]), (2, [0, 4]), (3, [0, 2, 4]), (5, [0, 1, 2, 3, 4]), (9, [0, 1, 2, 3, 4])]
)
def test_the_quick_cases_are_spread_from_the_first_to_the_last_and_none_is_lost(keep, expected):
    kept, thorough = split(thinned("number", range(5), quick=keep))
    assert kept == expected
    assert [values for (values,) in thorough] == [number for number in range(5) if number not in expected]


def test_a_tuple_is_one_value_of_one_argument_and_the_values_of_several():
    cases = [(1, 2), (3, 4)]
    assert split(thinned("span", cases, quick=1))[1] == [((3, 4),)]
    assert split(thinned(("low", "high"), cases, quick=1))[1] == [(3, 4)]
    assert split(thinned("low, high", cases, quick=1))[1] == [(3, 4)]


def test_a_case_keeps_its_name_and_its_marks():
    cases = [1, pytest.param(2, marks=pytest.mark.long, id="two")]
    case = thinned("number", cases, quick=1).mark.args[1][1]
    assert case.id == "two"
    assert {mark.name for mark in case.marks} == {"long", "thorough"}


def test_a_property_is_tried_on_few_examples_at_first_and_fails_where_it_is_false():
    tried = []

    @examples(quick=3, every=30, number=st.integers(0, 10**6))
    def test_it(number):
        tried.append(number)
        assert number < 10**7

    (mark,) = test_it.pytestmark
    assert split(SimpleNamespace(mark=mark)) == ([3], [(30,)])
    test_it(3)
    assert 1 <= len(tried) <= 3
    test_it(30)
    assert len(tried) > 10

    @examples(quick=3, every=30, number=st.integers())
    def test_false(number):
        assert number is None

    with pytest.raises(AssertionError):
        test_false(3)
