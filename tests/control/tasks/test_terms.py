"""The seam to a task: what is none is refused by name, in Python and in compiled code."""

from typing import Any, NamedTuple

import pytest
from numba import njit
from numba.core.errors import TypingError

from disco_hw.control import Circle
from disco_hw.control.tasks.terms import has_memory, stage_cost, terminal_cost


class Nonsense(NamedTuple):
    """Terms that no file has overloaded the costs for."""

    value: Any


@njit
def staged(task):
    return stage_cost(task, 0.0, 0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0)[0]


@njit
def ended(task):
    return terminal_cost(task, 0.0, 1.0, 0.0, 1.0, 0.0)


@njit
def remembers(task):
    return has_memory(task)


@pytest.mark.parametrize(
    ("compiled", "plain", "count", "said"),
    [
        (staged, stage_cost, 9, "has no stage cost"),
        (ended, terminal_cost, 5, "has no terminal cost"),
        (remembers, has_memory, 0, "does not say whether it has a memory"),
    ],
)
def test_a_task_without_costs_is_refused(compiled, plain, count, said):
    with pytest.raises(TypeError, match=f"Nonsense {said}"):
        plain(Nonsense(1.0), *[0.0] * count)
    with pytest.raises(TypingError, match="No implementation of function"):
        compiled(Nonsense(1.0))


def test_a_circle_has_costs_and_remembers_the_angle_only_where_it_pays_for_progress():
    terms, memory = Circle(terminal_s=2.0).terms(0.0, 0.0, 0.0, None, 0.1, 50)
    assert memory == 0.0
    # At 1 m from the centre, at rest, after a whole turn: nothing of the progress is missing.
    assert staged(terms) == pytest.approx((0.25**2 + 0.2**2) ** 0.5, rel=1e-5)
    lost = 0.8 * 0.2 * 50
    assert ended(terms) == pytest.approx(20.0 * 0.25 + lost, rel=1e-5)
    paper, _ = Circle().paper().terms(0.0, 0.0, 0.0, None, 0.1, 50)
    assert ended(paper) == 0.0
    assert (remembers(terms), remembers(paper)) == (True, False)
