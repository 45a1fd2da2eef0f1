"""A path as the robot's task in simulated time: followed, recorded, replayed and shown without its file."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from disco_hw.daemon.control_socket import loop_figures, status
from disco_hw.daemon.loop import LoopStats
from disco_hw.log.recorder import RecorderStats
from disco_hw.log.records import Event
from disco_hw.runtime import State
from disco_hw.runtime.pipeline import Source
from disco_hw.runtime.replay import replay
from disco_hw.runtime.robot_setup import kept_files, load_setup
from disco_hw.runtime.supervisor import UserRequest
from disco_hw.tasks.path import PathTask
from disco_hw.viewer.commands import snapshot_log
from disco_hw.viewer.recording import Recording
from sim.body_dynamics import BodyPose
from tests.runtime.path_robot import path_robot
from tests.runtime.simulated import recorded, replayed, simulated_stack, start, write_run, write_ticks

CORNER = "x_m,y_m\n0,0\n1,0\n1,0.5\n"


def started(robot_file):
    setup = load_setup(robot_file)
    stack = simulated_stack(robot_file=robot_file, start=BodyPose(*setup.config.task.course().start))
    start(stack, 0.02)
    return setup, stack


def drive(stack, done, limit_s=60.0):
    """True positions (N, 2) and speeds (N,) until it is done."""
    rows = []
    end_us = stack.now_us + round(limit_s * 1e6)
    while not done() and stack.now_us < end_us:
        stack.run(0.02)
        truth = stack.robot.truth
        rows.append((truth.x_m, truth.y_m, truth.speed_m_s))
    rows = np.array(rows)
    return rows[:, :2], rows[:, 2]


@pytest.mark.thorough
def test_the_shipped_eight_is_followed_once_round(tmp_path):
    setup, stack = started(path_robot(tmp_path))
    places, speeds = drive(stack, lambda: stack.core.progress.laps >= 1.0)
    assert stack.core.progress.laps >= 1.0
    off_m = setup.config.task.course().off_m(places)
    assert np.sqrt(np.mean(off_m[100:] ** 2)) < 0.05
    assert np.abs(off_m).max() < 0.15
    assert speeds[100:].mean() == pytest.approx(0.3, abs=0.05)


@pytest.mark.thorough
def test_the_shipped_eight_is_followed_backwards_recorded_and_replayed(tmp_path):
    robot_file = path_robot(tmp_path, speed_m_s=0.2)
    text = robot_file.read_text()
    assert text.count("[control]\n") == 1
    robot_file.write_text(text.replace("[control]\n", '[control]\nfacing = "backwards"\n'))
    setup = load_setup(robot_file)
    stack = simulated_stack(robot_file=robot_file, start=BodyPose(*setup.config.task_start))
    start(stack, 0.02)
    places, speeds = drive(stack, lambda: stack.core.progress.laps >= 1.0)
    assert stack.core.progress.laps >= 1.0
    off_m = setup.config.task.course().off_m(places)
    assert np.sqrt(np.mean(off_m[100:] ** 2)) < 0.02
    assert speeds[100:].max() < 0.0
    replayed(write_run(stack, tmp_path / "run.mcap"))


@pytest.mark.parametrize("is_drawn", [False, pytest.param(True, marks=pytest.mark.thorough)])
def test_an_open_path_ends_with_the_robot_standing_and_is_replayed_and_shown_without_its_file(tmp_path, is_drawn):
    robot_file = path_robot(tmp_path, CORNER)
    setup, stack = started(robot_file)
    places, _ = drive(stack, lambda: not stack.core.last.output.running, 20.0)
    stack.run(0.5)
    assert "task stopped: the end of the path is reached" in [event.text for event in recorded(stack, Event)]
    assert stack.core.last.output.state is State.ARMED
    assert stack.core.last.pipeline.source is Source.HOLD
    assert abs(stack.robot.truth.left_speed_rad_s) < 0.05
    assert np.hypot(*(places[-1] - (1.0, 0.5))) < 0.12
    assert np.abs(setup.config.task.course().off_m(places)).max() < 0.12
    shown = status(stack.core, loop_figures(LoopStats()), RecorderStats())["task"]
    assert shown["laps"] == pytest.approx(1.0, abs=0.03)
    assert shown["length_m"] == pytest.approx(1.5)
    assert "points" not in shown["asked"]
    log = write_run(stack, tmp_path / "run.mcap")
    (tmp_path / "path.csv").unlink()
    robot_file.unlink()
    replayed(log)
    with Recording(log) as recording:
        task = recording.stage.task_at(recording.at(3.0).task)
        assert isinstance(task, PathTask)
        assert task.points == ((0.0, 0.0), (1.0, 0.0), (1.0, 0.5))
    if is_drawn:
        snapshot_log(log, tmp_path / "end.png")
        assert (tmp_path / "end.png").stat().st_size > 10_000


def test_a_start_beyond_the_end_of_a_path_is_reported_as_no_drive(tmp_path):
    stack = simulated_stack(robot_file=path_robot(tmp_path, CORNER), start=BodyPose(1.0, 2.5, 1.57))
    start(stack, 0.02)
    stack.run(0.1)
    assert not stack.core.last.output.running
    texts = [event.text for event in recorded(stack, Event) if event.text.startswith("task stopped")]
    assert len(texts) == 1
    assert "its end, 2.0" in texts[0]


@pytest.mark.thorough
def test_another_speed_is_recorded_and_replayed(tmp_path):
    robot_file = path_robot(tmp_path, CORNER)
    setup = load_setup(robot_file)
    stack = simulated_stack(robot_file=robot_file, start=BodyPose(0.0, 0.0, 0.0))
    stack.run(1.5)
    stack.core.set_task(PathTask(path="path.csv", speed_m_s=0.15, points=setup.config.task.points))
    stack.run(0.5, UserRequest.ARM)
    stack.run(3.0, UserRequest.START)
    assert stack.robot.truth.speed_m_s == pytest.approx(0.15, abs=0.04)
    log = write_run(stack, tmp_path / "run.mcap")
    replayed(log)
    with Recording(log) as recording:
        assert recording.stage.task.speed_m_s == 0.3
        assert recording.stage.task_at(recording.at(3.0).task).speed_m_s == 0.15


def test_other_way_points_give_other_plans(tmp_path):
    setup, stack = started(path_robot(tmp_path, CORNER))
    stack.run(1.0)
    other = CORNER.replace("1,0\n", "1,0.2\n").encode()
    files = [replace(each, data=other) if each.name == "path.csv" else each for each in kept_files(setup)]
    assert not replay(write_ticks(tmp_path / "run.mcap", stack.recorder.ticks, files)).ok
