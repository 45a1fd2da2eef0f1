"""The command: every verb explains itself, mistakes exit with 2 and one line, the e-stop needs little to start."""

from __future__ import annotations

import subprocess
import sys

import pytest

VERBS = [
    *("demo", "run", "sim", "drive", "ctl", "check", "replay", "estop"),
    *("infer", "gap", "view", "import", "experiment", "log"),
]


def disco(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "disco_hw", *arguments], capture_output=True, text=True, timeout=60, check=False
    )


def test_help_lists_every_verb():
    result = disco("--help")
    assert result.returncode == 0
    for verb in VERBS:
        assert f" {verb} " in result.stdout


@pytest.mark.parametrize(
    "arguments",
    [
        ("replay", "/nowhere.mcap"),
        ("log", "info", "/nowhere.mcap"),
        ("check", "/nowhere.toml"),
        ("demo", "--link", "radio"),
        ("demo", "--uncertainty", "some"),
        ("estop", "/nowhere.toml"),
        ("view",),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(arguments):
    result = disco(*arguments)
    assert result.returncode == 2
    assert len(result.stderr.strip().splitlines()) == 1
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(
    ("arguments", "ignored"),
    [
        (("--live", "--robot", "/nowhere.toml", "--snapshot", "picture.png"), "--snapshot"),
        (("/nowhere.mcap", "--model", "model.toml"), "--model"),
    ],
)
def test_what_view_would_ignore_is_refused(arguments, ignored):
    result = disco("view", *arguments)
    assert result.returncode == 2
    assert ignored in result.stderr


def test_wrong_usage_exits_with_2():
    assert disco("run").returncode == 2
    assert disco("fly").returncode == 2


def test_the_estop_loads_neither_planner_nor_estimator():
    script = (
        "import sys, disco_hw.daemon.emergency; "
        "heavy = {'numba', 'torch', 'scipy', 'matplotlib', 'disco_hw.control', 'disco_hw.estimation'}; "
        "print(sorted(heavy & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert result.stdout.strip() == "[]"
