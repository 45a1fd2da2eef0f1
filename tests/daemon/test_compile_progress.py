"""What is said while numba compiles, with numba."""

import threading

from numba import njit

from disco_hw.daemon.warm_up import compile_progress


def test_a_compilation_says_what_it_is_for_how_far_it_is_and_how_long_it_took():
    @njit
    def inner(x):
        return x + 1.0

    @njit
    def outer(x):
        return inner(x) * inner(2.0 * x)

    said = []
    with compile_progress("the planner for a test", said.append, every_s=0.005):
        outer(1.0)
    assert said[0].startswith("compiling the planner for a test: ")
    assert len(said) > 2
    assert all(line.startswith("compiling: ") and " functions, " in line for line in said[1:-1])
    assert said[-1].startswith("compiled 2 functions, ")
    assert not [thread for thread in threading.enumerate() if thread.name == "compile progress"]
    before = list(said)
    with compile_progress("the planner for a test", said.append):
        outer(2.0)
    assert said == before, "what is compiled already needs no words"
