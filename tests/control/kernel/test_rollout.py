"""The seam to a system: what is none is refused by name, in Python and in compiled code."""

from typing import Any, NamedTuple

import pytest
from numba.core.errors import TypingError

from disco_hw.control.kernel import roll_block
from disco_hw.jit import kernel_function


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
