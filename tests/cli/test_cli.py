"""The command: every verb explains itself, mistakes exit with 2 and one line, the e-stop needs little to start."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from importlib import metadata
from unittest import mock

import click
import pytest
import typer.main
from click.testing import CliRunner
from rich.markup import render
from typer.main import get_command

from disco_hw import cli
from disco_hw.cli import app, plain_stop
from disco_hw.daemon import emergency
from disco_hw.errors import InputError
from tests.hil.stack import disco_here
from tests.tables import thinned

VERBS = [
    *("demo", "run", "sim", "drive", "ctl", "check", "replay", "estop"),
    *("infer", "gap", "view", "import", "experiment", "log"),
]


@pytest.fixture(scope="module", autouse=True)
def _made_once():
    # Of a call's time the command's own making is nine tenths, and the same each time.
    with (
        mock.patch.object(cli, "app", cache(cli.app)),
        mock.patch("typer.main.get_command", cache(typer.main.get_command)),
    ):
        yield


def disco(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "disco_hw", *arguments]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False, env={**os.environ, **environment}
    )


def test_help_lists_every_verb():
    code, output = disco_here("--help")
    assert code == 0
    for verb in VERBS:
        assert f" {verb} " in output


def help_texts(command: click.Command) -> Iterator[str]:
    """Yield the help of a command, of its options and of the commands below it."""
    yield command.help or ""
    for option in command.params:
        yield getattr(option, "help", None) or ""
    for below in getattr(command, "commands", {}).values():
        yield from help_texts(below)


def test_no_help_text_loses_a_bracketed_word():
    texts = list(help_texts(typer.main.get_command(cli.app())))
    assert len(texts) > 100
    for text in texts:
        assert render(text).plain == text


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
    code, output = disco_here(*arguments)
    assert code == 2
    assert len(output.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "ignored"),
    [
        (("--live", "--robot", "/nowhere.toml", "--snapshot", "picture.png"), "--snapshot"),
        (("/nowhere.mcap", "--model", "model.toml"), "--model"),
    ],
)
def test_what_view_would_ignore_is_refused(arguments, ignored):
    code, output = disco_here("view", *arguments)
    assert code == 2
    assert ignored in output


def number_options():
    """Every option of every verb that takes numbers: the command, the option and how many it takes."""

    def walk(command, name):
        for one in command.params:
            if isinstance(one.type, click.types.FloatParamType | click.types.Tuple):
                yield pytest.param(command, one.opts[0], one.nargs, id=f"{name} {one.opts[0]}")
        for sub_name, sub in getattr(command, "commands", {}).items():
            yield from walk(sub, f"{name} {sub_name}".strip())

    return list(walk(get_command(app()), ""))


@pytest.mark.parametrize(("command", "option", "count"), number_options())
def test_an_option_that_is_not_a_number_is_refused(command, option, count):
    required = [
        [one.opts[0], "x"] if isinstance(one, click.Option) else ["x"] for one in command.params if one.required
    ]
    arguments = [*(word for words in required for word in words), option, *["1.0"] * (count - 1), "nan"]
    with pytest.raises(InputError, match=f"^{option} nan: not a finite number; write one$"):
        command.make_context("", arguments)


def test_an_infinite_option_is_refused_unless_it_is_the_default():
    assert disco_here("experiment", "fence", "--seconds", "inf") == (
        2, "disco-hw: --seconds inf: not a finite number; write one\n"
    )  # fmt: skip
    circle = typer.main.get_command(cli.app()).commands["experiment"].commands["circle"]
    for arguments in ([], ["--largest-rot-s2", "inf"]):
        assert circle.make_context("", arguments).params["largest_rot_s2"] == math.inf


def test_wrong_usage_exits_with_2():
    assert disco_here("run")[0] == 2
    assert disco_here("fly")[0] == 2


def test_the_estop_loads_neither_planner_nor_estimator():
    script = (
        "import sys, disco_hw.daemon.emergency; "
        "heavy = {'numba', 'torch', 'scipy', 'matplotlib', 'disco_hw.control', 'disco_hw.estimation'}; "
        "print(sorted(heavy & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert result.stdout.strip() == "[]"


def test_the_version_is_the_packages():
    result = disco("--version")
    assert (result.returncode, result.stdout.strip()) == (0, f"disco-hw {metadata.version('disco-hw')}")


@thinned("shell", ["bash", "zsh", "fish"], quick=1)
def test_a_shell_gets_its_completion(shell):
    result = disco("--show-completion", shell, _TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION="1")
    assert result.returncode == 0, result.stderr
    assert "_DISCO_HW_COMPLETE" in result.stdout


def test_verbs_and_options_are_completed_and_nothing_heavy_is_loaded_for_it():
    script = (
        "import sys\nfrom disco_hw import cli\n"
        "try:\n    cli.main()\nexcept SystemExit:\n    pass\n"
        "heavy = {'numba', 'torch', 'scipy', 'matplotlib', 'numpy', 'can'}\n"
        "print('heavy', sorted(heavy & set(sys.modules)))"
    )

    def completed(*arguments: str) -> list[str]:
        completion = {
            "_DISCO_HW_COMPLETE": "complete_bash",
            "COMP_WORDS": " ".join(arguments),
            "COMP_CWORD": str(len(arguments) - 1),
        }
        command = [sys.executable, "-c", script.replace("cli.main()", "sys.argv = ['disco-hw']; cli.main()")]
        result = subprocess.run(
            command, capture_output=True, text=True, timeout=60, check=True, env={**os.environ, **completion}
        )
        return result.stdout.split("\n")

    assert {"run", "replay"} <= set(completed("disco-hw", "r"))
    options = completed("disco-hw", "run", "--")
    assert {"--model", "--link", "--adapt"} <= set(options)
    assert "heavy []" in options


@pytest.mark.parametrize(
    "arguments",
    ["R", "R --json", "--json R", "R --link can", "--link serial:/dev/ttyUSB0 R --json", "R --link=can:socketcan:can0",
     "--link= R", "R --link --json", "R --link a --link b", "", "R --link", "R more", "R --jso", "R --json=1", "--help",
     "R -x", "R -- --json", "-- R"],
)  # fmt: skip
def test_a_stop_that_goes_past_the_library_is_read_as_the_library_reads_it(monkeypatch, arguments):
    calls = []
    monkeypatch.setattr(emergency, "stop_and_report", lambda *given: calls.append(given) or 0)
    result = CliRunner().invoke(typer.main.get_command(cli.app()), ["estop", *arguments.split()])
    plain = plain_stop(["estop", *arguments.split()])
    assert plain is None or calls == [plain]
    # What the library refuses, explains or reads in a way of its own is left to it.
    assert (plain is None) == (result.exit_code != 0 or not calls or "--" in arguments.split())


def test_no_other_verb_is_taken_for_a_stop():
    assert plain_stop([]) is None
    assert plain_stop(["ctl", "robot.toml", "estop"]) is None
    assert plain_stop(["--version"]) is None
