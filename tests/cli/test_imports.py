"""Tests of what a command imports: a stop, a question and a wrong file load none of the large libraries.

Seconds are for a benchmark (tools/bench/start.py); what makes them is counted here.
"""

import subprocess
import sys

import pytest

from disco_hw.config import SHIPPED_ROBOT
from tests.hil.stack import disco_here
from tests.tables import thinned

SHIPPED = SHIPPED_ROBOT.parent
HEAVY = ("scipy", "torch", "matplotlib", "numba", "cantools", "filterpy", "viser", "zmq", "mcap", "cryptography",
         "pydantic", "rich")  # fmt: skip
COUNT = """
import contextlib, sys
from disco_hw.cli import main
sys.argv[0] = "disco-hw"
code = 0
try:
    main()
except SystemExit as end:
    code = end.code
print("CODE", code, "LOADED", *sorted({name.split(".")[0] for name in sys.modules}), file=sys.stderr)
"""
IMPORTED = "import {module}\nimport sys\nprint(*sorted(sys.modules))"


def loaded_by(*arguments):
    """Exit code, the top packages loaded, and what was said, of a command in a process of its own."""
    command = [sys.executable, "-c", COUNT, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    output, _, counted = done.stderr.rpartition("CODE ")
    code, _, names = counted.partition(" LOADED ")
    return int(code), set(names.split()), done.stdout + output


@pytest.fixture
def robot(tmp_path):
    text = (SHIPPED / "wombot.toml").read_text(encoding="utf-8")
    path = tmp_path / "robot.toml"
    assert "/tmp/disco-hw-wombot" in text
    path.write_text(
        text.replace("/tmp/disco-hw-wombot", f"{tmp_path}/nowhere")
        + f'\n[daemon]\ncontrol_socket = "{tmp_path}/run/none.sock"\n'
    )
    (tmp_path / "wombot_model.toml").write_bytes((SHIPPED / "wombot_model.toml").read_bytes())
    return path


@pytest.mark.parametrize(
    "verb",
    [
        ["ctl", "{robot}", "status"],
        ["estop", "{robot}"],
        pytest.param(["estop", "{robot}", "--json"], marks=pytest.mark.thorough),
    ],
)
def test_a_question_and_a_stop_load_no_large_library(robot, verb):
    code, loaded, output = loaded_by(*(argument.format(robot=robot) for argument in verb))
    assert code == 1, output
    assert not loaded & {*HEAVY, "numpy"}
    # A stop does without the command-line library too.
    assert (verb[0] == "estop") == (not loaded & {"typer", "click"})


def test_a_daemon_is_asked_whatever_has_become_of_the_task_in_the_file_but_not_with_another_section_wrong(robot):
    text = robot.read_text(encoding="utf-8")
    robot.write_text(text.replace('kind = "circle"', 'kind = "none such"'))
    code, loaded, output = loaded_by("ctl", robot, "stop")
    assert (code, "no daemon listens there" in output, "numpy" in loaded) == (1, True, False)
    robot.write_text(text + "rate_hz = 50\n")  # in [daemon]
    code, output = disco_here("ctl", str(robot), "stop")
    assert (code, "rate_hz" in output) == (2, True)


@thinned(
    "verb",
    [
        ["ctl", "{none}", "status"], ["run", "{none}"], ["drive", "{none}"], ["check", "{none}"], ["sim", "{none}"],
        ["run", "{robot}", "--model", "{none}"], ["drive", "{robot}", "--model", "{none}"],
        ["sim", "{robot}", "--model", "{none}"], ["run", "{pathless}"], ["check", "{pathless}"],
        ["replay", "{none}"], ["view", "{none}"], ["view", "--live", "--robot", "{none}"],
        ["infer", "{none}", "--robot", "{robot}"], ["gap", "{none}", "--robot", "{robot}", "-o", "out"],
        ["log", "info", "{none}"], ["log", "recover", "{none}", "-o", "out"], ["log", "export", "{none}", "-o", "out"],
        ["import", "{none}", "--robot", "{robot}", "-o", "out"],
    ], quick=2,
    ids=" ".join,
)  # fmt: skip
def test_a_missing_file_is_refused_before_anything_heavy_is_loaded(robot, tmp_path, verb):
    pathless = tmp_path / "pathless.toml"
    text, _, rest = robot.read_text(encoding="utf-8").partition("[task]")
    others = rest.partition("\n[")
    pathless.write_text(f'{text}[task]\nkind = "path"\npath = "none.csv"\nspeed_m_s = 0.2\n[{others[2]}')
    none = tmp_path / "none.mcap"
    code, loaded, output = loaded_by(*(argument.format(robot=robot, none=none, pathless=pathless) for argument in verb))
    assert code == 2, output
    assert "none" in output
    assert not loaded & set(HEAVY)


def test_a_model_that_is_no_toml_is_refused_before_anything_heavy_is_loaded(robot):
    robot.with_name("wombot_model.toml").write_text("[[[")
    code, loaded, output = loaded_by("run", robot)
    assert code == 2, output
    assert "wombot_model.toml" in output
    assert not loaded & set(HEAVY)


@thinned("module", ["disco_hw.daemon.run", "disco_hw.daemon.check"], quick=1)
def test_what_drives_loads_nothing_that_it_does_not_use(module):
    command = [sys.executable, "-c", IMPORTED.format(module=module)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    loaded = set(done.stdout.split())
    unused = {"torch", "matplotlib", "cantools", "viser", "google", "mcap", "scipy.stats", "scipy.interpolate",
              "scipy.special", "scipy.optimize", "scipy.sparse", "scipy.ndimage", "scipy.signal",
              "scipy.spatial"}  # fmt: skip
    assert not loaded & unused
    assert "filterpy.kalman" in loaded or module != "disco_hw.daemon.run"


@pytest.mark.thorough
def test_filterpys_statistics_are_there_for_who_asks_for_them():
    text = "import disco_hw.estimation, filterpy.stats\nprint(filterpy.stats.logpdf([1.0], [0.0], [[1.0]]))"
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=120, check=True)
    assert float(done.stdout) == pytest.approx(-1.4189385332)
