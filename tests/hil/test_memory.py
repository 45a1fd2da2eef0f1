"""Tests of the memory that the daemon locks, and of its message where it may not have enough."""

import re
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from disco_hw.processes import can_lock_memory
from tools.stack import running_stack, write_robot_file

pytestmark = pytest.mark.hil
MOST_LOCKED_BYTES = 400_000_000


def locked_bytes(pid):
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    return 1024 * int(re.search(r"VmLck:\s+(\d+) kB", status)[1])


@pytest.mark.skipif(not can_lock_memory(), reason="this user may not lock memory")
@pytest.mark.parametrize(
    "compiles", [pytest.param(False, marks=pytest.mark.thorough), pytest.param(True, marks=pytest.mark.long)]
)
def test_a_daemon_that_drives_has_locked_no_more_than_it_says(tmp_path, monkeypatch, compiles):
    if compiles:
        kept = tmp_path / "kept"
        kept.mkdir(mode=0o700)
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(kept))
    directory = tmp_path / "run"
    directory.mkdir(mode=0o700)
    with running_stack(directory) as stack:
        stack.drive()
        locked = locked_bytes(stack.daemon.process.pid)
        output = stack.daemon.output.read_text(encoding="utf-8")
    assert "memory: locked" in output
    assert "compiled" in output or not compiles
    assert 50_000_000 < locked <= MOST_LOCKED_BYTES


def test_too_little_address_space_is_one_line(tmp_path):
    limit = 600 * 1024 * 1024

    def confine():
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))

    done = subprocess.run(
        [sys.executable, "-m", "disco_hw", "run", str(write_robot_file(tmp_path))],
        preexec_fn=confine, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("disco-hw: address space: limited to 629 MB")
    assert "ulimit -v" in line
