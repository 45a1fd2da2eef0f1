"""What is said while numba compiles, and which process compiles, with numba."""

import os
import signal
import subprocess
import sys
import threading

import pytest
from numba import njit

from disco_hw.daemon.run import compile_progress

KERNEL = """
from drivers.kernel_cache import compiled

@compiled
def double(x):
    return 2.0 * x
"""
START = """
import os
from disco_hw.daemon.run import compiled_elsewhere
from kernel import double

print(os.getpid(), flush=True)
print(compiled_elsewhere(lambda: double(1.5), "a test", lambda text: print(os.getpid(), text, flush=True)))
"""


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


def ended(process, by):
    """End a program while another process compiles for it; what came until all who could write had ended."""
    with process:
        own = process.stdout.readline().split()[0]
        while process.stdout.readline().split()[0] == own:
            pass
        process.send_signal(by)
        return process.communicate(timeout=60)[0]


@pytest.fixture
def start(tmp_path):
    """Starts a program that needs a kernel; returns its process, the processes that compiled, and its result."""
    sources, kept = tmp_path / "sources", tmp_path / "kept"
    sources.mkdir(mode=0o700)
    kept.mkdir(mode=0o700)
    (sources / "kernel.py").write_text(KERNEL)
    environment = dict(os.environ, NUMBA_CACHE_DIR=str(kept), PYTHONPATH=os.pathsep.join([str(sources), *sys.path]))

    def run(program, ended_by=None):
        command = [sys.executable, "-c", program]
        if ended_by is not None:
            return ended(subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True), ended_by)
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=100, check=False)
        assert done.returncode == 0, done.stderr
        own, *said, result = done.stdout.splitlines()
        return own, {line.split()[0] for line in said if "compiled 1 functions" in line}, result

    return run


def test_a_first_start_compiles_in_another_process_and_the_next_one_not_at_all(start):
    own, compiled_by, result = start(START)
    assert len(compiled_by) == 1
    assert own not in compiled_by
    assert result == "3.0"
    assert start(START)[1:] == (set(), "3.0")


def test_what_cannot_be_kept_is_compiled_by_the_process_itself(start):
    # A function that is in no file has no place beside it for its kernel.
    own, compiled_by, result = start(START.replace("from kernel import double", KERNEL))
    assert (compiled_by, result) == ({own}, "3.0")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_who_compiles_ends_with_the_process_that_it_compiles_for(start, number):
    for_ever = "(double(1.5), time.sleep(3600))"
    start("import time\n" + START.replace("double(1.5)", for_ever), ended_by=number)
