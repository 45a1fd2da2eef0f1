"""A little of the campaign, and proof that it would report."""

import os
import random
import subprocess
import sys
from pathlib import Path

import pytest

from tools.check import fuzz

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def _in_temporary_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.long
def test_every_verb_reads_or_refuses_hostile_files(tmp_path):
    # In a process of its own: what other tests have loaded would count as memory that a verb took.
    call = "print(fuzz.attack(150, 1, pathlib.Path(sys.argv[1])))"
    program = f"import sys, pathlib\nfrom tools.check import fuzz\n{call}"
    command = [sys.executable, "-c", program, str(tmp_path / "verbs")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("fails", "expected_text"),
    [
        (lambda argv: 1 / 0, "ZeroDivisionError"),
        (lambda argv: fuzz.time.sleep(30), "TooSlowError"),
        (lambda argv: fuzz.verb_calls.CallOutcome(2, "first\nsecond"), "not one line"),
        (lambda argv: bytearray(1_200_000_000) and fuzz.verb_calls.CallOutcome(0, ""), "MB"),
        (lambda argv: os._exit(3), "no answer"),
    ],
)
def test_what_a_verb_lets_through_is_reported_and_the_file_kept(tmp_path, monkeypatch, fails, expected_text):
    monkeypatch.setattr(fuzz, "CALL_S", 1 if expected_text == "TooSlowError" else 60)
    monkeypatch.setattr(fuzz.verb_calls, "CALLS", fuzz.verb_calls.CALLS[:1])
    parent, call = os.getpid(), fuzz.verb_calls.call
    monkeypatch.setattr(fuzz.verb_calls, "call", lambda argv: call(argv) if os.getpid() == parent else fails(argv))
    (wrong,) = fuzz.attack(1, 1, tmp_path / "verbs")
    assert expected_text in wrong
    assert (tmp_path / wrong.partition(":")[0]).exists()


def test_a_hostile_log_is_a_sound_container():
    good = fuzz.verb_calls.good_files()["run.mcap"]
    logs = [fuzz.mutated_log(good, random.Random(seed)) for seed in range(5)]
    assert all(log.startswith(b"\x89MCAP0\r\n") and log.endswith(b"\x89MCAP0\r\n") for log in logs)
    assert len(set(logs)) == 5


def test_most_mutants_differ_and_the_same_seed_makes_the_same():
    good = fuzz.verb_calls.good_files()["faults.toml"]
    mutants = [fuzz.mutated(good, random.Random(seed)) for seed in range(100)]
    assert sum(mutant != good for mutant in mutants) > 90
    assert mutants == [fuzz.mutated(good, random.Random(seed)) for seed in range(100)]
