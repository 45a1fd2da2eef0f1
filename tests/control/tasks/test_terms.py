"""The seam to a task: what is none is refused by name, in Python and in compiled code."""

from typing import Any, NamedTuple

import pytest
from numba import njit
from numba.core.errors import TypingError

from disco_hw.control import Circle
from disco_hw.control.tasks.terms import follow, has_memory, looks_up, row_of, stage_cost, table_of, terminal_cost


class Nonsense(NamedTuple):
    """Terms that no file has overloaded the costs for."""

    value: Any


@njit
def staged(task):
    return stage_cost(task, 0.0, 0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, None)[0]


@njit
def ended(task):
    return terminal_cost(task, 0.0, 1.0, 0.0, 1.0, 0.0, None)


@njit
def remembers(task):
    return has_memory(task)


@njit
def looks(task):
    return looks_up(task)


@njit
def held(task):
    return table_of(task)


@njit
def followed(task):
    return follow(task, 0.0, 1.0, 0.0, 0.0, None)


@njit
def looked_up(task):
    return row_of(task, 0.0)


@pytest.mark.parametrize(
    ("compiled", "plain", "count", "said"),
    [
        (staged, stage_cost, 10, "has no stage cost"),
        (ended, terminal_cost, 6, "has no terminal cost"),
        (remembers, has_memory, 0, "does not say whether it has a memory"),
        (looks, looks_up, 0, "does not say whether it has a table"),
        (held, table_of, 0, "has no table"),
        (followed, follow, 5, "has no table to follow"),
        (looked_up, row_of, 1, "has no table"),
    ],
)
def test_a_task_without_costs_is_refused(compiled, plain, count, said):
    with pytest.raises(TypeError, match=f"Nonsense {said}"):
        plain(Nonsense(1.0), *[0.0] * count)
    with pytest.raises(TypingError, match="No implementation of function"):
        compiled(Nonsense(1.0))


def test_a_circle_has_costs_and_remembers_the_angle_only_where_it_pays_for_progress():
    prepared = Circle(terminal_s=2.0).prepare(0.0, 0.0, 0.0, None, 0.1, 50)
    terms = prepared.terms
    assert (prepared.begin, prepared.memory) == (0.0, 0.0)
    # At 1 m from the centre, at rest, after a whole turn: nothing of the progress is missing.
    assert staged(terms) == pytest.approx((0.25**2 + 0.2**2) ** 0.5, rel=1e-5)
    lost = 0.8 * 0.2 * 50
    assert ended(terms) == pytest.approx(20.0 * 0.25 + lost, rel=1e-5)
    paper = Circle().paper().prepare(0.0, 0.0, 0.0, None, 0.1, 50).terms
    assert ended(paper) == 0.0
    assert (remembers(terms), remembers(paper)) == (True, False)
    assert looks(terms) is None
