"""Machine code gives what the Python source says."""

import math

from sim.compiled import compiled


def _hypotenuse(a, b):
    return math.sqrt(a * a + b * b)


def test_a_compiled_function_computes_what_its_source_says_and_is_compiled():
    fast = compiled(_hypotenuse)
    assert fast(3.0, 4.0) == 5.0
    assert fast.py_func is _hypotenuse
    assert len(fast.signatures) == 1
