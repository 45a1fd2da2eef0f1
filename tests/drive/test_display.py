"""Tests of the display's contents, and that it ends with the daemon."""

from __future__ import annotations

import io
import threading
from contextlib import closing
from types import SimpleNamespace

import pytest
from rich.console import Console

from disco_hw.drive import drive_command
from disco_hw.drive.coverage import Coverage
from disco_hw.drive.terminal import line, show, table
from disco_hw.errors import InputError, WorkError
from tests.daemon.control_daemon import ControlDaemon
from tests.drivers.waiting import wait_until

COVERAGE = Coverage(8.0)
for _tick in range(251):
    COVERAGE.add(_tick * 20_000_000, 2.0, 2.0)
STATUS = {
    "ok": True,
    "state": "ARMED",
    "detail": "running the task",
    "wheels": [1.0, -2.0],
    "command": [1.5, -2.5],
    "drive": {
        "driving": True,
        "words": "hold [this] key",
        "task": "straight: radius",
        "messages": ["deadman pressed: arming"],
        "coverage": COVERAGE.as_dict(),
        "coverage_words": COVERAGE.describe(),
    },
}


def printed(renderable):
    console = Console(file=io.StringIO(), width=160)
    console.print(renderable)
    return console.file.getvalue()


def test_the_table_shows_all_there_is():
    text = printed(table(STATUS))
    for fragment in ("ARMED", "command +1.5 -2.5", "wheels +1.0 -2.0", "hold [this] key", "deadman pressed", "radius"):
        assert fragment in text
    assert "done     straight slow" in text
    assert "missing  reverse fast" in text


def test_the_table_does_without_wheels():
    assert "wheels none" in printed(table(STATUS | {"wheels": None}))


def test_the_line_is_one_line():
    text = line(STATUS)
    assert "\n" not in text
    assert text.startswith("ARMED: hold [this] key | 5 s driven, 1 of 17 motions; missing: straight fast 0/2 s")


@pytest.mark.parametrize("terminal", [False, True])
def test_it_shows_the_daemon_and_ends_with_it(tmp_path, terminal):
    console = Console(file=io.StringIO(), force_terminal=terminal, width=160)
    with closing(ControlDaemon(tmp_path / "control.sock", lambda _: STATUS)) as daemon:
        shown = threading.Thread(target=show, args=(daemon.server.path, console))
        shown.start()
        wait_until(lambda: len(daemon.received) >= 3, 60.0)
    shown.join(10.0)
    assert not shown.is_alive()
    assert "5 s driven" in console.file.getvalue()


@pytest.mark.parametrize(("error", "killed"), [(InputError("a key"), True), (WorkError("the link"), False)])
def test_what_shows_a_drive_is_not_waited_for_where_nothing_was_driven(monkeypatch, tmp_path, error, killed):
    done = []
    shows = SimpleNamespace(kill=lambda: done.append("killed"), wait=lambda timeout_s: done.append("waited"))
    monkeypatch.setattr(drive_command.subprocess, "Popen", lambda *_args, **_options: shows)
    with pytest.raises(type(error)), drive_command._display(tmp_path / "control.sock", shown=True):
        raise error
    assert done == ["killed"] * killed + ["waited"]
