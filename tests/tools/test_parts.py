"""How `make test` shares the tests between its workers."""

import fcntl
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.conftest import PARTS, WITH_KERNELS, WITHOUT_KERNELS, KernelsFirst, is_in_part, is_within

TESTS = Path(__file__).parents[1]


@cache
def coming_to(path):
    """Numbers of the workers that come to a file or folder, through all folders on the way to it."""
    before = range(len(PARTS) + 1) if path == TESTS else coming_to(path.parent)
    return [part for part in before if is_in_part(path, part)]


def test_every_file_is_read_by_one_worker():
    found = {str(path.relative_to(TESTS)): coming_to(path) for path in TESTS.rglob("test_*.py")}
    assert {path: workers for path, workers in found.items() if len(workers) != 1} == {}
    assert coming_to(TESTS / "hil" / "test_estop.py") == [0]
    assert coming_to(TESTS / "firmware_protocol" / "emulated" / "test_board.py") == [0]
    assert coming_to(TESTS / "firmware_protocol" / "test_codec.py") == [len(PARTS)]
    assert coming_to(TESTS / "gap" / "search" / "test_needed.py") == [1]


def test_every_part_names_folders_that_there_are():
    assert all((TESTS / folder).is_dir() for part in PARTS for folder in part)
    assert all((TESTS / one).exists() for one in WITHOUT_KERNELS)
    assert all((TESTS / one).is_file() and is_within(TESTS / one, WITHOUT_KERNELS) for one in WITH_KERNELS)


def test_a_test_that_needs_kernels_waits_until_they_are_compiled(tmp_path, monkeypatch):
    def waits(_lock, how):
        raise BlockingIOError(how)

    def begin(path):
        next(kernels.pytest_runtest_protocol(SimpleNamespace(path=TESTS / path)))

    (tmp_path / "lock").touch()
    kernels = KernelsFirst(tmp_path / "lock")
    monkeypatch.setattr(fcntl, "flock", waits)
    begin("firmware_protocol/test_codec.py")
    begin("daemon/test_check.py")
    for path in ("control/test_disco.py", "daemon/test_warm_up.py"):
        with pytest.raises(BlockingIOError, match=str(fcntl.LOCK_SH)):
            begin(path)
    monkeypatch.undo()
    begin("control/test_disco.py")
    monkeypatch.setattr(fcntl, "flock", waits)
    begin("control/test_disco.py")
