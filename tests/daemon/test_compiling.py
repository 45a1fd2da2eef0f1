"""Tests of what is reported while numba compiles, and which process compiles, with numba."""

import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace

import pytest
from numba import njit

from disco_hw.cli import robot
from disco_hw.config import SHIPPED_ROBOT
from disco_hw.daemon import check, run
from disco_hw.daemon.run import compile_beforehand, compile_progress
from disco_hw.model import EffectSetting, load_model, save_model
from tests.tables import thinned

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

    messages = []
    with compile_progress("the planner for a test", messages.append, every_s=0.005):
        outer(1.0)
    assert messages[0].startswith("compiling the planner for a test: ")
    assert len(messages) > 2
    assert all(line.startswith("compiling: ") and " functions, " in line for line in messages[1:-1])
    assert messages[-1].startswith("compiled 2 functions, ")
    assert not [thread for thread in threading.enumerate() if thread.name == "compile progress"]
    before = list(messages)
    with compile_progress("the planner for a test", messages.append):
        outer(2.0)
    assert messages == before, "what is compiled already needs no words"


def ended(process, by):
    """End a program while another process compiles for it; what came until all who could write had ended."""
    with process:
        pid = process.stdout.readline().split()[0]
        while process.stdout.readline().split()[0] == pid:
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
        pid, *lines, result = done.stdout.splitlines()
        return pid, {line.split()[0] for line in lines if "compiled 1 functions" in line}, result

    return run


@pytest.mark.thorough
def test_a_first_start_compiles_in_another_process_and_the_next_one_not_at_all(start):
    pid, compiled_by, result = start(START)
    assert len(compiled_by) == 1
    assert pid not in compiled_by
    assert result == "3.0"
    assert start(START)[1:] == (set(), "3.0")


@pytest.mark.thorough
def test_what_cannot_be_kept_is_compiled_by_the_process_itself(start):
    # A function that is in no file has no place beside it for its kernel.
    pid, compiled_by, result = start(START.replace("from kernel import double", KERNEL))
    assert (compiled_by, result) == ({pid}, "3.0")


@thinned("number", [signal.SIGTERM, signal.SIGKILL], quick=1)
def test_who_compiles_ends_with_the_process_that_it_compiles_for(start, number):
    for_ever = "(double(1.5), time.sleep(3600))"
    start("import time\n" + START.replace("double(1.5)", for_ever), ended_by=number)


def test_what_a_start_will_need_is_compiled_beforehand_with_words_and_nothing_for_files_that_it_refuses(
    tmp_path, monkeypatch
):
    made, messages = [], []

    def create(setup, _law):
        made.append([effect.name for effect in setup.model.effects])
        njit(lambda x: x + 1.0)(2.0)

    monkeypatch.setattr(run, "planner_of", create)
    monkeypatch.setattr(run, "create_pipeline", lambda *_: None)
    monkeypatch.setattr(run, "warm_up", lambda _: None)
    shipped = load_model(SHIPPED_ROBOT.parent / "wombot_model.toml")
    with_deadband = replace(shipped, effects=(EffectSetting("deadband", {"width_rad_s": 0.5}),))
    save_model(with_deadband, tmp_path / "model.toml")
    compile_beforehand(SHIPPED_ROBOT, tmp_path / "model.toml", messages.append)
    # One planner to drive with, and one that is used up in the rehearsal.
    assert made == [["deadband"]] * 2
    assert messages[0].startswith("compiling the planner for this task and a model with deadband")
    save_model(replace(shipped, missing_effects=("motor_lag",)), tmp_path / "marked.toml")
    for refused in (tmp_path / "marked.toml", tmp_path / "none.toml"):
        compile_beforehand(SHIPPED_ROBOT, refused, messages.append)
    assert len(made) == 2


class Result:
    ok = True

    def as_dict(self):
        return {}

    def as_text(self):
        return ""


# What `gap` and `infer` write is compiled for too, as is tested beside their other tests.
def test_check_compiles_for_the_model_that_it_read(monkeypatch):
    models = []
    monkeypatch.setattr(check, "run_check", lambda *_: Result())
    monkeypatch.setattr(run, "compile_beforehand", lambda robot_file, model, report: models.append(model))
    robot.check(SHIPPED_ROBOT)
    assert models == [None]
