"""Times single calls as they would take in the control loop: real-time scheduling where allowed, collector off."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

PRIORITY = 50
# Calls in a row before the processor is given back: the kernel cuts a real-time process that takes all of a second.
IN_A_ROW = 100
REST_S = 0.02


@contextmanager
def undisturbed() -> Iterator[bool]:
    """Run under SCHED_FIFO if the system allows it (the value), with the garbage collector off; undone at the end."""
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        allowed = True
    except PermissionError:
        allowed = False
    gc.collect()
    gc.disable()
    try:
        yield allowed
    finally:
        gc.enable()
        os.sched_setscheduler(0, policy, parameters)


def times_ms(call: Callable[[int], object], count: int, left_out: int = 20) -> np.ndarray:
    """Milliseconds that each of `count` calls takes, after `left_out` more; a call is given its number."""
    durations_ns = np.empty(count + left_out)
    for number in range(count + left_out):
        if number % IN_A_ROW == IN_A_ROW - 1:
            time.sleep(REST_S)
        began_ns = time.perf_counter_ns()
        call(number)
        durations_ns[number] = time.perf_counter_ns() - began_ns
    return np.asarray(durations_ns[left_out:] * 1e-6)


def summary(key: str, durations_ms: np.ndarray) -> dict[str, float]:
    """Least, p50, p99, p99.9 and largest under `key`."""
    quantiles = {"min": 0.0, "p50": 50.0, "p99": 99.0, "p99_9": 99.9, "max": 100.0}
    return {f"{key}.{name}": float(np.percentile(durations_ms, at)) for name, at in quantiles.items()}


def percentiles(key: str, durations: np.ndarray) -> dict[str, float]:
    """p50, p99 and p99.9 under `key`, in the unit of the durations."""
    return {f"{key}.p{at:g}": float(np.percentile(durations, at)) for at in (50.0, 99.0, 99.9)}
