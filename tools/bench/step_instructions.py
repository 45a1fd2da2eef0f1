"""Counts what a compiled planner step executes and holds, beside its time: `python -m tools.bench.step_instructions`.

A step is run one instruction at a time, by ptrace: load changes the times, not the count. Linux on x86-64 or aarch64,
not under an emulator.
"""

from __future__ import annotations

import ctypes
import gc
import os
import signal
import sys
from collections.abc import Callable
from functools import partial

import msgspec

from disco_hw.control import Disco
from disco_hw.runtime.assembly import create_planner
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.tasks import task_from
from tools.bench.control import ROBOTS, moving
from tools.bench.step_times import times_ms, undisturbed

TRACE_ME, CONTINUE, SINGLE_STEP = 0, 7, 9
MARK = signal.SIGUSR1
# Each sample has its own. The other buffers are the plan's, or used again by every block of samples.
PER_SAMPLE = ("noise", "commands", "point_costs", "costs", "weights")


def _nothing() -> None:
    pass


def _ptrace(request: int, process: int = 0) -> None:
    of_library = ctypes.CDLL(None, use_errno=True).ptrace
    of_library.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
    of_library.restype = ctypes.c_long
    if of_library(request, process, None, None) < 0:
        raise OSError(ctypes.get_errno(), "no process can be traced here")


def _between_marks(calls: tuple[Callable[[], object], ...]) -> None:
    """Make calls, each between two marks for whoever traces this process, which ends here."""
    status = 1
    try:
        gc.disable()
        _ptrace(TRACE_ME)
        pid = os.getpid()
        for call in calls:
            os.kill(pid, MARK)
            call()
            os.kill(pid, MARK)
        status = 0
    finally:
        os._exit(status)


def _stopped_by(process: int) -> int:
    _, status = os.waitpid(process, 0)
    if not os.WIFSTOPPED(status):
        raise OSError("no process can be traced here, or the call that was counted failed")
    return os.WSTOPSIG(status)


def instructions_of(call: Callable[[], object]) -> int:
    """Instructions that a call executes beyond those of a call that does nothing, made in a process of its own.

    Raises OSError where processes cannot be traced, or the call fails.
    """
    calls = (call, _nothing)
    child = os.fork()
    if child == 0:
        _between_marks(calls)
    counts = []
    for _ in calls:
        while _stopped_by(child) != MARK:
            _ptrace(CONTINUE, child)
        count = 0
        _ptrace(SINGLE_STEP, child)
        while _stopped_by(child) != MARK:
            count += 1
            _ptrace(SINGLE_STEP, child)
        counts.append(count)
        _ptrace(CONTINUE, child)
    os.waitpid(child, 0)
    return counts[0] - counts[1]


def figures_of(planner: Disco, calls: int = 2000) -> dict[str, float]:
    """Return a step's instructions and bytes per sample, and the least milliseconds of it, and of `plan` without it."""
    states = [moving(number) for number in range(200)]
    for one in states[:20]:
        planner.plan(*one)
    optimiser = planner.optimiser
    step, work = optimiser._replan, optimiser.work
    assert step is not None
    samples = planner.settings.sampler.samples
    again = partial(step, *optimiser.arguments)
    buffer_bytes = sum(getattr(work, name).nbytes for name in PER_SAMPLE)
    figures = {
        "instructions_per_sample": instructions_of(again) / samples,
        "bytes_per_sample": buffer_bytes / samples,
    }
    with undisturbed():
        figures["compiled_ms"] = float(times_ms(lambda _: again(), calls).min())
        figures["plan_ms"] = float(times_ms(lambda n: planner.plan(*states[n % len(states)]), calls).min())
        optimiser._replan = lambda *_: True
        figures["python_ms"] = float(times_ms(lambda n: planner.plan(*states[n % len(states)]), calls).min())
        optimiser._replan = step
    return figures


def shipped_planner(kind: str) -> Disco:
    """The shipped robot's planner for a kind of task, compiled."""
    setup = load_setup(ROBOTS / "wombot.toml")
    return create_planner(msgspec.structs.replace(setup.config, task=task_from({"kind": kind})), setup.model)


COLUMNS = {
    "instructions_per_sample": ("instructions per sample", "{:.0f}"),
    "bytes_per_sample": ("bytes per sample", "{:.0f}"),
    "compiled_ms": ("compiled step, ms", "{:.4f}"),
    "plan_ms": ("whole plan, ms", "{:.4f}"),
    "python_ms": ("plan without the step, ms", "{:.4f}"),
}


def main() -> int:
    print(f"| task | {' | '.join(title for title, _ in COLUMNS.values())} |")
    print("|---" * (len(COLUMNS) + 1) + "|")
    for kind in ("circle", "lemniscate"):
        figures = figures_of(shipped_planner(kind))
        cells = " | ".join(form.format(figures[name]) for name, (_, form) in COLUMNS.items())
        print(f"| {kind} | {cells} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
