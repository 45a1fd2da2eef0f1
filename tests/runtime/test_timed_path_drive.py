"""Way-points by time as the robot's task in simulated time: met, ended, begun anew, replayed without their file."""

from __future__ import annotations

import numpy as np
import pytest

from disco_hw.daemon.control_socket import loop_figures, status
from disco_hw.daemon.loop import LoopStats
from disco_hw.log.recorder import RecorderStats
from disco_hw.log.records import Event
from disco_hw.runtime import State
from disco_hw.runtime.pipeline import Source
from disco_hw.runtime.supervisor import UserRequest
from disco_hw.tasks.timed_path import TimedPathTask
from disco_hw.viewer.recording import Recording
from tests.runtime.path_robot import timed_path_robot
from tests.runtime.simulated import recorded, replayed, write_run
from tests.runtime.test_path_drive import drive, started
from tests.tasks.costs import instant_cost

# Half a minute of compiling; tests/tasks/test_timed_path.py drives such a path in every `make test`.
pytestmark = pytest.mark.long

# Straight, a rest of 2 s, and round a corner.
CSV = "t_s,x_m,y_m\n1,0,0\n4,0.9,0\n6,0.9,0\n8,1.4,0\n11,1.4,0.7\n"


def test_way_points_are_met_at_their_times_to_the_end_and_replayed_and_shown_without_their_file(tmp_path):
    robot_file = timed_path_robot(tmp_path, CSV)
    setup, stack = started(robot_file)
    assert isinstance(setup.config.task, TimedPathTask)
    task = setup.config.task.planned("default")
    places, _ = drive(stack, lambda: not stack.core.last.output.running, 20.0)
    off_m = [instant_cost(task, x_m, y_m, 0.0, 0.02 * (k + 2)) for k, (x_m, y_m) in enumerate(places)]
    assert np.sqrt(np.mean(np.square(off_m))) < 0.06
    assert np.max(off_m) < 0.2
    # It rests where and when it should, and ends when the last time is over, not before.
    assert np.hypot(*(places[240:290] - (0.9, 0.0)).T).max() < 0.1
    assert 11.0 < 0.02 * len(places) < 14.0
    assert np.hypot(*(places[-1] - (1.4, 0.7))) < 0.08
    assert "task stopped: the end of the path is reached" in [event.text for event in recorded(stack, Event)]
    stack.run(0.5)
    assert stack.core.last.output.state is State.ARMED
    assert stack.core.last.pipeline.source is Source.HOLD
    shown = status(stack.core, loop_figures(LoopStats()), RecorderStats())["task"]
    assert shown["laps"] == pytest.approx(1.0)
    assert (shown["asked"]["kind"], shown["limits"]) == ("timed_path", {})
    log = write_run(stack, tmp_path / "run.mcap")
    (tmp_path / "path.csv").unlink()
    robot_file.unlink()
    replayed(log)
    with Recording(log) as recording:
        shown_task = recording.stage.task_at(recording.at(3.0).task)
    assert shown_task == setup.config.task


def test_another_start_begins_with_the_first_way_point(tmp_path):
    _, stack = started(timed_path_robot(tmp_path, "t_s,x_m,y_m\n0,0,0\n4,1.2,0\n60,1.2,0.5\n"))
    stack.run(3.0)
    assert stack.robot.truth.x_m > 0.6
    stack.run(0.5, UserRequest.STOP)
    stack.run(6.0, UserRequest.START)
    # It went back to meet the way's beginning, and has come forward again since.
    xs = [r.x_m for _, tick in stack.recorder.ticks[-300:] for r in tick if type(r).__name__ == "Estimate"]
    assert min(xs) < xs[0] - 0.3
    assert stack.robot.truth.x_m == pytest.approx(1.2, abs=0.1)
