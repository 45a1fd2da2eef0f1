"""Counting instructions: as many every time, more for more work."""

import pytest

from tools.bench.step_instructions import instructions_of

pytestmark = pytest.mark.thorough

try:
    instructions_of(lambda: None)
except OSError:
    pytest.skip("no process can be traced here", allow_module_level=True)


def test_more_work_is_more_instructions_and_the_same_work_is_as_many():
    few, many = (instructions_of(lambda count=count: sum(range(count))) for count in (10, 100))
    assert 0 < few < many
    assert instructions_of(lambda: sum(range(100))) == pytest.approx(many, rel=0.2)


def test_a_call_that_fails_is_an_error():
    with pytest.raises(OSError, match="failed"):
        instructions_of(lambda: 1 / 0)
