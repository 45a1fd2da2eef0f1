"""Compiled loops run side by side: they do not hold the interpreter's lock."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from disco_hw.jit import parallel_kernel

MOST_TURNS = 2_000_000_000


@parallel_kernel
def wait_for(flag, turns):
    """Count in place until somebody else raises the flag."""
    while flag[0] == 0 and turns[0] < MOST_TURNS:
        turns[0] += 1


@parallel_kernel
def sums_of_draws(seeds, out):
    for i in range(seeds.shape[0]):
        np.random.seed(seeds[i])
        out[i] = 0.0
        for _ in range(2000):
            out[i] += np.random.standard_normal()


def test_another_thread_goes_on_while_a_kernel_runs():
    flag, turns = np.ones(1, dtype=np.int64), np.zeros(1, dtype=np.int64)
    wait_for(flag, turns)
    flag[0] = 0
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(wait_for, flag, turns)
        while turns[0] == 0:
            pass
        flag[0] = 1
        running.result()
    assert 0 < turns[0] < MOST_TURNS


def test_threads_draw_what_one_thread_draws():
    seeds = np.arange(64, dtype=np.uint32)
    alone, shared = np.empty(64), np.empty(64)
    sums_of_draws(seeds, alone)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda k: sums_of_draws(seeds[k : k + 4], shared[k : k + 4]), range(0, 64, 4)))
    assert np.array_equal(alone, shared)
    assert np.unique(alone).size == 64
