"""The seam to a task: what is none is refused by name, in Python and in compiled code; costs also run as they stand."""

from typing import NamedTuple

import numpy as np
import pytest
from numba.core.errors import TypingError

from disco_hw import tasks as task
from disco_hw.control.kernel import follow, looks_up, row_of, stage_cost, terminal_cost
from disco_hw.jit import kernel_function
from disco_hw.tasks.circle import CircleCost, CircleTask
from disco_hw.tasks.path import PathTask

ZERO, ONE = np.float32(0.0), np.float32(1.0)
NOTHING = (ZERO,) * 5


class Nonsense(NamedTuple):
    """Terms without a cost."""

    value: float


@kernel_function
def staged(task):
    return stage_cost(task, ZERO, 0, ZERO, ZERO, ONE, ZERO, ONE, ZERO, ZERO, NOTHING)


@kernel_function
def ended(task):
    return terminal_cost(task, ZERO, ONE, ZERO, ONE, ZERO, NOTHING)


@kernel_function
def looks(task):
    return looks_up(task)


@kernel_function
def followed(task):
    return follow(task, ZERO, ONE, ZERO, ZERO, (ZERO, ZERO, ZERO, ONE, ZERO))


@kernel_function
def looked_up(task):
    return row_of(task, ZERO)


@pytest.mark.parametrize(
    ("compiled", "plain", "count", "expected_error"),
    [
        (staged, stage_cost, 10, "has no stage cost"),
        (ended, terminal_cost, 6, "has no terminal cost"),
        (followed, follow, 5, "has no table to follow"),
        (looked_up, row_of, 1, "has no table"),
    ],
)
def test_terms_without_a_cost_are_refused(compiled, plain, count, expected_error):
    with pytest.raises(TypeError, match=f"Nonsense {expected_error}"):
        plain(Nonsense(1.0), *[0.0] * count)
    with pytest.raises(TypingError, match="No implementation of function"):
        compiled(Nonsense(1.0))


def test_what_is_no_named_tuple_is_no_terms():
    with pytest.raises(TypeError, match="float is no named tuple of terms"):
        looks_up(1.0)
    with pytest.raises(TypingError, match="No implementation of function"):
        looks(1.0)


def test_a_circle_has_costs():
    prepared = CircleCost(terminal_m=0.4).prepare(0.0, 0.0, 0.0, 0.0, None, 0.1, 50)
    terms = prepared.terms
    assert (prepared.begin, prepared.memory) == (0.0, 0.0)
    # At 1 m from the centre, at rest, after a whole turn: nothing of the progress is missing.
    assert staged(terms)[0] == pytest.approx((0.25**2 + 0.2**2) ** 0.5, rel=1e-5)
    missing_progress = 0.8 * 0.2 * 50
    assert ended(terms) == pytest.approx(20.0 * 0.25 + missing_progress, rel=1e-5)
    paper = CircleCost().paper().prepare(0.0, 0.0, 0.0, 0.0, None, 0.1, 50).terms
    assert ended(paper) == 0.0
    assert looks(terms) is None


@pytest.mark.parametrize(
    "task", [CircleTask(), PathTask(path="p.csv", points=((0.0, 0.0), (2.0, 0.5)))], ids=["circle", "path"]
)
def test_a_cost_gives_as_it_stands_what_it_gives_compiled(task):
    terms = task.planned("default").prepare(0.0, 0.9, 0.2, 0.3, None, 0.1, 50).terms
    if hasattr(terms, "table"):
        at = 4 * int(terms.row_of(ZERO))
        found = (ZERO, *terms.table[at : at + 4])
        assert looks(terms)
        row = (ZERO, ZERO, ZERO, ONE, ZERO)
        np.testing.assert_allclose(followed(terms), terms.follow(ZERO, ONE, ZERO, ZERO, row), rtol=1e-6)
        assert looked_up(terms) == terms.row_of(ZERO)
    else:
        found = NOTHING
        uncompiled = terms.stage(ZERO, 0, ZERO, ZERO, ONE, ZERO, ONE, ZERO, ZERO, NOTHING)
        np.testing.assert_allclose(staged(terms), uncompiled, rtol=1e-6)
    assert terms.terminal(ZERO, ONE, ZERO, ONE, ZERO, found) > 0.0


def test_what_costs_are_written_in_is_a_length():
    assert task.norm(3.0, 4.0) == 5.0
    assert task.norm_and_inverse(3.0, 4.0) == (5.0, 0.2)
    assert task.norm_and_inverse(0.0, 0.0) == pytest.approx((1e-15, 1e15))
    assert task.norm_of_three(2.0, 3.0, 6.0) == 7.0
