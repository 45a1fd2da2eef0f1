"""docs/add-a-task.md: its example, one file, makes a kind of task that everything takes."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import disco_hw.tasks
from disco_hw.control import CommandLimits, Disco, DiscoSettings, PlannerState
from disco_hw.errors import InputError
from disco_hw.log import records
from disco_hw.log.encoding import JsonDecoder, encode_json
from disco_hw.runtime import State
from disco_hw.runtime.robot_setup import changed_task, load_setup, record_of, requested_task, task_in_status, task_of
from disco_hw.tasks import RobotTask, kinds
from disco_hw.viewer import curves
from disco_hw.viewer.timeline import Timeline
from tests.runtime.path_robot import task_robot

DOCUMENT = Path(__file__).parents[2] / "docs/add-a-task.md"
EXAMPLE = DOCUMENT.parent / "examples/square.py"


@pytest.fixture
def square(tmp_path):
    """The robot with the task of the page, whose file lies beside those of the package."""
    folder = tmp_path / "kinds"
    folder.mkdir()
    shutil.copy(EXAMPLE, folder)
    disco_hw.tasks.__path__.append(str(folder))
    yield task_robot(tmp_path, 'kind = "square"\nside_m = 1.2\n')
    disco_hw.tasks.__path__.remove(str(folder))
    del sys.modules["disco_hw.tasks.square"], disco_hw.tasks.square


def test_the_page_names_every_member_of_a_task():
    table = DOCUMENT.read_text("utf-8")
    members = {name for name in vars(RobotTask) if not name.startswith("_")} - {"speed_m_s"}
    members |= {name for name in RobotTask.__annotations__ if not name.startswith("_")}
    assert {name for name in members if f"`{name}`" not in table} == set()


def test_its_file_is_a_kind_from_robot_toml_to_the_log(square):
    assert "square" in kinds()
    setup = load_setup(square)
    task = setup.config.task
    assert (task.side_m, task.speed_m_s) == (1.2, 0.2)
    changed = changed_task(task, {"side_m": 2.0}, setup.config, State.READY)
    assert changed.side_m == 2.0
    record = record_of(7, changed)
    assert record == records.Task(7, "square", {"side_m": 2.0, "speed_m_s": 0.2})
    assert task_of(JsonDecoder().decode("/task", encode_json(record)), task) == changed
    assert task_in_status(requested_task(changed), task) == changed
    assert task.course().noun == "square"
    away = curves.distance(task, Timeline(), 0, 0)
    assert list(away.values) == ["distance (m)"]
    progress = task.progress()
    for x_m in np.arange(0.0, 1.21, 0.02):
        progress.add(0, x_m, 0.0, 0.0)
    assert progress.laps == pytest.approx(0.25, abs=0.01)


def test_its_task_is_planned(square):
    setup = load_setup(square)
    task = setup.config.task
    disco = Disco(setup.model, task.planned("default"), DiscoSettings(), CommandLimits(8.0, 20.0))
    plan = disco.plan(0, PlannerState(0, *task.course().start, 0.0, 0.0))
    assert np.hypot(*plan.trajectory[-1, :2]) > 0.9 * task.speed_m_s * plan.step_s * len(plan.wheel_speeds)
    assert np.abs(task.course().off_m(plan.trajectory[:, :2])).max() < 0.1


def test_a_wrong_field_of_it_gets_one_line(square):
    square.write_text(square.read_text().replace("side_m = 1.2", "side_m = -1.2"))
    with pytest.raises(InputError, match=r"task.side_m: expected `float` > 0.0; correct the value"):
        load_setup(square)
