"""Which failures of a test in real time are tried again: runs of pytest with a host that takes what it is told to."""

import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = """
import threading, time
from disco_hw import processes
processes.stolen_ms = lambda: {taken_ms} if time.monotonic() > BEGAN_S + 0.3 else 0
BEGAN_S = time.monotonic()
from tests.hil.conftest import pytest_runtest_protocol
"""
TEST = """
import time
from pathlib import Path

def test_in_real_time(tmp_path):
    tries = Path(__file__).with_name("tries")
    tries.write_text((tries.read_text() if tries.exists() else "") + "x")
    time.sleep(0.5)
    assert tries.read_text() == "x" * {passes_at}
"""


@pytest.mark.parametrize(
    ("taken_ms", "passes_at", "tries", "code"), [(120, 2, 2, 0), (120, 3, 2, 1), (90, 2, 1, 1), (120, 1, 1, 0)]
)
def test_a_failure_is_tried_once_more_where_the_host_took_the_processors(tmp_path, taken_ms, passes_at, tries, code):
    (tmp_path / "conftest.py").write_text(CONFTEST.format(taken_ms=taken_ms))
    (tmp_path / "test_it.py").write_text(TEST.format(passes_at=passes_at))
    command = [sys.executable, "-m", "pytest", "-c", "/dev/null", f"--rootdir={tmp_path}", "-p", "no:cacheprovider"]
    result = subprocess.run(
        [*command, str(tmp_path)], capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2]
    )
    assert result.returncode == code, result.stdout + result.stderr
    assert (tmp_path / "tries").read_text() == "x" * tries
    assert ("tried once more: the host took 120 ms" in result.stdout) is (tries == 2)
