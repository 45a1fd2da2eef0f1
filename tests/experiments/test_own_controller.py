"""A law of one's own on the virtual robot, in simulated time; the programs of docs/my-controller.md as they stand."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

import disco_hw
from disco_hw import drive_virtual
from disco_hw.errors import InputError, WorkError
from disco_hw.experiments import with_device
from disco_hw.log.reader import open_log
from disco_hw.log.records import BeliefChange
from tests.runtime.path_robot import task_robot
from tests.runtime.simulated import ROBOT_TEXT
from tests.tables import thinned

ROOT = Path(disco_hw.__file__).parents[1]
PAGE = ROOT / "docs" / "my-controller.md"
ROBOT = ROOT / "disco_hw" / "robots" / "wombot.toml"


def block(kind, number):
    """One of the page's blocks of code of a kind."""
    return re.findall(rf"^```{kind}\n(.*?)^```", PAGE.read_text("utf-8"), re.DOTALL | re.MULTILINE)[number]


def run(text, directory):
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{directory}"}
    command = [sys.executable, "-c", text]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def figures(text):
    """Laps and millimetres of each line."""
    return [(float(laps), float(mm)) for laps, mm in re.findall(r"([\d.]+) laps, (\d+) mm", text)]


def agree(documented, measured):
    """Rounding differs from one processor to the next, so the last digit may."""
    assert len(documented) == len(measured) > 0
    np.testing.assert_allclose(measured, documented, rtol=0.1, atol=2.0)


def test_the_pages_law_keeps_to_its_circle():
    scope = {"__name__": "my_controller"}
    exec(block("python", 0), scope)
    drive = drive_virtual(ROBOT, scope["steer"], 6.0)
    x, y = drive.poses[:, 0], drive.poses[:, 1]
    away = np.abs(np.hypot(x, y) - 0.75)
    # It swings off at first.
    assert away[-1] < 0.5 * away.max() < 0.05
    assert drive.laps == pytest.approx(np.ptp(np.unwrap(np.arctan2(y, x))) / (2.0 * math.pi), abs=0.02)
    assert drive.speeds[-1] == pytest.approx(0.2, rel=0.1)


@pytest.mark.thorough
def test_the_pages_law_drives_the_circle_as_the_page_says():
    output = StringIO()
    with redirect_stdout(output):
        exec(compile(block("python", 0), PAGE, "exec"), {"__name__": "__main__"})
    agree(figures(block("text", 0)), figures(output.getvalue()))


@pytest.mark.long
@pytest.mark.timeout(900)
def test_the_pages_comparison_with_disco_is_as_it_says(tmp_path):
    (tmp_path / "my_controller.py").write_text(block("python", 0), encoding="utf-8")
    agree(figures(block("text", 1)), figures(run(block("python", 1), tmp_path)))


@thinned("rate_hz", [20, 33, 60, 100], quick=2)
def test_the_robot_starts_at_every_control_rate(tmp_path, rate_hz):
    robot = tmp_path / "robot.toml"
    robot.write_text(ROBOT_TEXT.replace("rate_hz = 50.0", f"rate_hz = {rate_hz}.0"), encoding="utf-8")
    drive = drive_virtual(robot, lambda _state, _task, _model: (2.0, 2.0), 1.0)
    assert abs(drive.commands.shape[0] - rate_hz) <= 1
    assert drive.speeds[-1] == pytest.approx(2.0 * 0.061, rel=0.1)


def test_a_law_that_has_no_answer_for_a_while_stops_the_robot_until_it_has_one(tmp_path):
    begun_ns = []

    def law(state, _task, _model):
        begun_ns.append(state.t_ns)
        return (math.nan, 2.0) if 1e9 < state.t_ns - begun_ns[0] < 2.8e9 else (2.0, 2.0)

    drive = drive_virtual(ROBOT, law, 4.5, log=tmp_path / "mine.mcap")
    moving = np.abs(np.nan_to_num(drive.commands)).max(axis=1) > 0.1
    spans = [moving[(begin < drive.t_s) & (drive.t_s < end)] for begin, end in ((0.6, 1.0), (2.4, 2.8), (4.2, 4.5))]
    assert [(span.all(), span.any()) for span in spans] == [(True, True), (False, False), (True, True)]
    assert any("two finite wheel speeds" in event for event in drive.events)
    with open_log(tmp_path / "mine.mcap") as log:
        assert log.summary().missing_ticks == 0


@pytest.mark.parametrize(("control", "adapts"), [("", True), ('adaptation = "off"', False)], ids=["auto", "off"])
def test_the_geometry_is_learnt_where_the_real_robot_would_learn_it(tmp_path, control, adapts):
    robot, log = tmp_path / "robot.toml", tmp_path / "log.mcap"
    robot.write_text(ROBOT_TEXT.replace("[control]\n", f"[control]\n{control}\n"), encoding="utf-8")
    drive_virtual(robot, lambda *_: (2.0, 4.0), 2.0, log=log)
    with open_log(log) as opened:
        sources = {record.source for *_, record in opened.records() if isinstance(record, BeliefChange)}
    assert ("adapted" in sources) == adapts


def test_a_robot_with_another_controller_and_other_poses_is_played_too(tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text(with_device(ROBOT_TEXT, "odrive"), encoding="utf-8")
    drive = drive_virtual(mine, lambda *_: (2.0, 2.0), 1.0)
    assert drive.speeds[-1] > 0.05


def test_the_pages_law_is_asked_nothing_of_a_circle_that_is_smaller_than_it_can_be(tmp_path):
    scope = {"__name__": "my_controller"}
    exec(block("python", 0), scope)
    robot = task_robot(tmp_path, 'kind = "circle"\nradius_m = 0.2\nspeed_m_s = 0.1\n')
    with pytest.raises(WorkError, match=r"armed: task\.radius_m: 0\.2 m is too small: .*; write at least 0\.251"):
        drive_virtual(robot, scope["steer"], 1.0)


def test_an_effect_that_does_not_exist_is_refused_in_one_line():
    with pytest.raises(InputError, match=r"^hide: .*rust") as refused:
        drive_virtual(ROBOT, lambda *_: (0.0, 0.0), 1.0, hide={"rust": 1.0})
    assert "\n" not in str(refused.value)
