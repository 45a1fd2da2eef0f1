"""Tests of the report on a clone: its counts, what failed, and the conditions that it ran under."""

import re
import sys

from tools.check.clones import run


def test_a_failed_run_names_what_failed_and_under_what_conditions(tmp_path):
    script = "print('noise\\nFAILED tests/test_a.py::test_b - boom\\n1 failed, 20 passed, 3 skipped in 1.0s'); exit(2)"
    text = run([sys.executable, "-c", f"sum(range(10**6)); {script}"], tmp_path).describe()
    first, second = text.splitlines()
    assert re.match(r"rc 2, \d+ s wall, \d+ s CPU, 1 failed, 20 passed, 3 skipped, load [\d.]+ before", first)
    assert "the host stole " in first
    assert second.strip() == "FAILED tests/test_a.py::test_b - boom"


def test_a_run_that_ends_before_its_tests_shows_its_last_words(tmp_path):
    text = run([sys.executable, "-c", "print('setting up'); exit('no compiler')"], tmp_path).describe()
    assert "rc 1" in text
    assert text.endswith("setting up\n  no compiler") or text.endswith("no compiler\n  setting up")
    assert "no counts" in text


def test_a_clone_uses_neither_this_checkouts_modules_nor_its_kernels(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "/here")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/here")
    script = "import os; print(sorted({'PYTHONPATH', 'NUMBA_CACHE_DIR'} & set(os.environ)))"
    assert run([sys.executable, "-c", script], tmp_path).output == "[]\n"
