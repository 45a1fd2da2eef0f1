"""Adaptation in the real daemon: learnt, recorded, replayed; and an adapter that freezes or dies harms nothing."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from disco_hw.experiments.adapt import GROWTH, drive_through_change
from disco_hw.experiments.live_stack import FAST_START, FAST_TASK, running_stack
from disco_hw.log.reader import open_log

pytestmark = [pytest.mark.hil, pytest.mark.long]

LOADING_S = 90.0
SILENT_S = 9.0


def adapter_pid(daemon_pid: int) -> int:
    """The daemon's child that runs the adapter."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
            command = (stat.parent / "cmdline").read_bytes()
        except OSError:
            continue
        if parent == daemon_pid and b"disco_hw.adaptation.process" in command:
            return int(stat.parent.name)
    raise AssertionError("no adapter runs")


def test_an_adapter_that_freezes_and_dies_leaves_belief_and_loop(tmp_path):
    task, start = FAST_TASK.replace("0.45", "0.3"), FAST_START
    with running_stack(tmp_path, task=task, start=start, run_arguments=("--adapt",)) as stack:
        operator = stack.operator
        stack.start()
        operator.wait_until("adapting", lambda s: s["adaptation"]["belief"] == "adapted", LOADING_S)
        pid = adapter_pid(stack.daemon.process.pid)

        os.kill(pid, signal.SIGSTOP)
        frozen = operator.wait_until("told of the silence", lambda s: s["adaptation"]["silent"], SILENT_S)
        assert frozen["adaptation"]["belief"] == "adapted"
        os.kill(pid, signal.SIGCONT)
        operator.wait_until("heard again", lambda s: not s["adaptation"]["silent"], SILENT_S)

        os.kill(pid, signal.SIGKILL)
        dead = operator.wait_until("told of the death", lambda s: s["adaptation"]["link"]["deaths"] == 1, SILENT_S)
        assert (dead["adaptation"]["belief"], dead["state"], dead["running"]) == ("adapted", "ARMED", True)
        time.sleep(1.0)
        assert operator.status()["source"] == "plan"

        operator.tell("revert")
        operator.wait_until("the model's belief", lambda s: s["adaptation"]["belief"] == "model", 2.0)
        operator.tell("disarm")
        operator.wait_until("a new adapter", lambda s: s["adaptation"]["link"]["alive"], 15.0)
        operator.tell("quit")
        assert stack.daemon.process.wait(10.0) == 0

    with open_log(tmp_path / "run.mcap") as log:
        sources = list(log.columns("/belief")["source"])
        assert sources[0] == "adapted"
        assert sources[-1] == "model"
        assert "lost" in list(log.columns("/adapt")["outcome"])
    replayed = subprocess.run(
        [sys.executable, "-m", "disco_hw", "replay", "--json", str(tmp_path / "run.mcap")],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr
    assert json.loads(replayed.stdout)["ok"]


@pytest.mark.timeout(300)
@pytest.mark.parametrize(("changes", "most"), [("wheel radius", 1.2), ("axial distance", 1.15)])
def test_what_grows_on_the_way_is_learnt_and_the_circle_is_driven_again(tmp_path, changes, most):
    driven = drive_through_change(tmp_path, changes, adapt=True)
    assert driven.believed == pytest.approx(1.0 + GROWTH, rel=0.03)
    assert driven.published_s < 20.0
    assert driven.cost_after < most * driven.cost_before


@pytest.mark.timeout(300)
@pytest.mark.parametrize(("changes", "least"), [("wheel radius", 1.4), ("axial distance", 1.25)])
def test_what_grows_on_the_way_costs_more_where_nothing_is_learnt(tmp_path, changes, least):
    driven = drive_through_change(tmp_path, changes, adapt=False)
    assert driven.cost_after > least * driven.cost_before
