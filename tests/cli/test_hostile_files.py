"""Every file that a verb takes, replaced by what no file should be: one line that names it, exit code 2, at once."""

from __future__ import annotations

import os
import signal
import typing
from pathlib import Path

import pytest

from disco_hw.cli import app
from disco_hw.files import LOG
from tests.tables import thinned
from tools.check.verb_calls import CALLS, call, good_files, without_work, write_good

STUCK_S = 60
WRITTEN = {
    *((verb, "out") for verb in ("demo", "infer", "gap", "import", "log recover", "log export")),
    *(("run", "log_file"), ("drive", "log_file"), ("infer", "report")),
    *(("init", "out"), ("commission", "log_directory")),
    *(("view", "snapshot"), ("view", "video"), ("view", "export")),
    *(("sim", "truth"), ("sim", "inject"), ("sim", "bus_log")),
    *((f"experiment {name}", "out") for name in ("pendulum", "circle", "adapt", "gap", "fence")),
}
READ = {
    *((verb, "robot") for verb in ("run", "drive", "check", "ctl", "estop", "infer", "gap", "import", "view", "sim")),
    *((verb, "robot") for verb in ("experiment circle", "experiment adapt", "experiment gap", "bridge ros2")),
    ("bridge ros2-base", "robot"),
    *((verb, "model") for verb in ("run", "drive", "gap", "view", "sim", "bridge ros2")),
    *((verb, "log") for verb in ("import", "log info", "log recover", "log export", "log fence", "view", "replay")),
    *(("infer", "logs"), ("gap", "logs"), ("sim", "faults"), ("commission", "robot")),
}


def _too_large(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(LOG.most_bytes + 1)


KINDS = {
    "absent": lambda path: None,
    "a directory": Path.mkdir,
    "a pipe": os.mkfifo,
    "a device without an end": lambda path: path.symlink_to("/dev/zero"),
    "too large": _too_large,
    "no text": lambda path: path.write_bytes(b"\xff\xfe\0\0" * 50),
}
TOML_KINDS = {
    "nested": lambda path: path.write_bytes(b"a = " + b"[" * 100_000),
    "a long number": lambda path: path.write_bytes(b"a = " + b"1" * 5000),
    "a long key": lambda path: path.write_bytes(b".".join([b"a"] * 100_000) + b" = 1"),
}
CASES = [
    (one, name, kind)
    for one in CALLS
    for name in one.reads
    for kind in (*KINDS, *(TOML_KINDS if name.endswith(".toml") else ()))
]


@pytest.fixture(autouse=True)
def _no_call_gets_stuck():
    def stuck(*_):
        raise AssertionError(f"a call took over {STUCK_S} s")

    before = signal.signal(signal.SIGALRM, stuck)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module")
def calling():
    with without_work():
        yield call


def test_the_table_has_every_file_argument_of_every_verb():
    found = set()

    def walk(group_app, prefix):
        for one in group_app.registered_commands:
            verb = " ".join([*prefix, one.name or one.callback.__name__])
            hints = typing.get_type_hints(one.callback)
            found.update((verb, name) for name, hint in hints.items() if "Path" in str(hint))
        for group in group_app.registered_groups:
            walk(group.typer_instance, [*prefix, group.name])

    walk(app(), [])
    assert found == READ | WRITTEN
    assert not READ & WRITTEN
    assert {verb for verb, _ in READ} == {one.verb for one in CALLS}


@pytest.mark.parametrize("one", CALLS, ids=lambda one: f"{one.verb} {one.arguments}")
def test_good_files_get_as_far_as_the_work(tmp_path, calling, one):
    write_good(tmp_path)
    outcome = calling(one.argv(tmp_path))
    if one.verb == "experiment gap":
        assert "needs a circle" in outcome.errors
    elif one.verb == "log fence":
        # A log of a drive that does not go round.
        assert outcome.code == 2
        assert "run.mcap" in outcome.errors
    elif one.verb == "replay":
        assert outcome.code == 1
    else:
        assert outcome.code in (None, 0), outcome.errors


@thinned(
    ("one", "name", "kind"),
    CASES,
    quick=len(CASES) // 6,
    ids=lambda value: value if isinstance(value, str) else value.verb,
)
def test_what_is_no_file_is_refused_in_one_line_that_names_it(tmp_path, calling, one, name, kind):
    write_good(tmp_path)
    bad = tmp_path / name
    bad.unlink()
    (KINDS | TOML_KINDS)[kind](bad)
    signal.alarm(STUCK_S)
    outcome = calling(one.argv(tmp_path))
    assert outcome.code == 2, outcome
    assert len(outcome.errors.strip().splitlines()) == 1, outcome.errors
    assert name in outcome.errors


def test_the_good_files_are_of_every_kind_that_a_verb_reads():
    assert {name for one in CALLS for name in one.reads} == set(good_files())
