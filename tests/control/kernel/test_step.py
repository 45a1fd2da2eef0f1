"""The compiled step: the shift by fractions, nothing taken from the heap, and what is no system refused by name."""

import math
from typing import Any, NamedTuple

import numpy as np
import pytest
from numba.core.errors import TypingError
from numba.core.runtime import _nrt_python, rtsys

from disco_hw.control.kernel import roll_block
from disco_hw.control.kernel.step import disco_step, shift
from disco_hw.control.pendulum import PAPER_SAMPLER, PendulumPlanner, PendulumPoints
from disco_hw.jit import kernel_function

STEPS = np.arange(10)[:, None]
PLAN = np.sin(np.hstack([STEPS, STEPS + 1.0])).astype(np.float32)


@kernel_function
def run_shift(nominal, scratch, steps, hold):
    shift(nominal, scratch, steps, hold)


@kernel_function
def empty(work, samplings, step, steps, gain, basis, limits, system, weights):
    return True


def shifted(steps, hold):
    nominal = PLAN.copy()
    run_shift(nominal, np.empty_like(nominal), steps, hold)
    return nominal


@pytest.mark.parametrize("steps", [0.0, 0.2, 1.0, 3.7, 9.0, 12.5])
def test_a_plan_is_shifted_by_fractions_and_holds_its_last_command(steps):
    expected = [np.interp(STEPS[:, 0] + steps, STEPS[:, 0], column) for column in PLAN.T]
    np.testing.assert_allclose(shifted(steps, True), np.transpose(expected), atol=1e-6)


def test_or_it_ends_in_zero():
    np.testing.assert_allclose(shifted(2.0, False), np.vstack([PLAN[2:], np.zeros((2, 2))]), atol=1e-6)


def allocations(arguments) -> tuple[int, int]:
    """What ten compiled steps take from the heap, and ten of a function that does nothing with their arguments."""
    counted = []
    _nrt_python.memsys_enable_stats()
    try:
        for function in (disco_step, empty):
            function(*arguments)
            before = rtsys.get_allocation_stats().alloc
            for _ in range(10):
                function(*arguments)
            counted.append(rtsys.get_allocation_stats().alloc - before)
    finally:
        _nrt_python.memsys_disable_stats()
    return counted[0], counted[1]


@pytest.mark.thorough
def test_the_step_allocates_nothing():
    planner = PendulumPlanner(PendulumPoints(np.ones((5, 2)), np.full(5, 0.2)), PAPER_SAMPLER)
    planner.plan(math.pi, 0.0)
    # Both make the same records of the arrays that they are handed, and nothing else.
    of_step, of_nothing = allocations(planner.optimiser.arguments)
    assert of_step == of_nothing > 0


class Nonsense(NamedTuple):
    """Terms that no file has overloaded the rollout for."""

    value: Any


@kernel_function
def rolled(system):
    roll_block(system, None, 1, 80, 0, 10, None, None)


def test_a_system_without_a_rollout_is_refused():
    with pytest.raises(TypeError, match="Nonsense cannot be rolled out"):
        roll_block(Nonsense(1.0), None, 1, 80, 0, 10, None, None)
    with pytest.raises(TypingError, match="No implementation of function"):
        rolled(Nonsense(1.0))
