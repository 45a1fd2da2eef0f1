"""The lemniscate from robot.toml on: planned, driven, shown, changed, recorded and replayed, in simulated time."""

from __future__ import annotations

import numpy as np
import pytest

from disco_hw.daemon.control_socket import loop_figures, status
from disco_hw.daemon.loop import LoopStats
from disco_hw.log import records
from disco_hw.log.recorder import RecorderStats
from disco_hw.runtime import State
from disco_hw.runtime.robot_setup import TaskRefused, changed_task, load_setup
from disco_hw.runtime.supervisor import UserRequest
from disco_hw.viewer import curves
from disco_hw.viewer.recording import Recording
from sim.body_dynamics import BodyPose
from tests.runtime.path_robot import task_robot
from tests.runtime.simulated import replayed, simulated_stack, write_run

FIGURE = 'kind = "lemniscate"\nsize_m = 0.9\nspeed_m_s = 0.25\n'


def test_a_lemniscate_is_driven_changed_recorded_and_replayed_bit_for_bit(tmp_path):
    robot_file = task_robot(tmp_path, FIGURE)
    setup = load_setup(robot_file)
    stack = simulated_stack(robot_file=robot_file, start=BodyPose(*setup.config.task.course().start))
    stack.run(1.5)
    for speed_m_s, hint in ((0.45, r"at most .* m/s, or a larger size$"), (3.0, r"at most [\d.]+ m/s$")):
        with pytest.raises(TaskRefused, match=hint):
            changed_task(stack.core.task, {"speed_m_s": speed_m_s}, stack.core.task_config, State.READY)
    with pytest.raises(TaskRefused, match=r"size_m: not within 0\.572 and 50"):
        changed_task(stack.core.task, {"size_m": 0.57}, stack.core.task_config, State.READY)
    changed = changed_task(stack.core.task, {"size_m": 0.6, "speed_m_s": 0.26}, stack.core.task_config, State.READY)
    stack.core.set_task(changed)
    stack.run(0.5, UserRequest.ARM)
    stack.run(0.02, UserRequest.START)
    places = []
    for _ in range(480):
        stack.run(0.02)
        places.append((stack.robot.truth.x_m, stack.robot.truth.y_m))
    # 9.6 s at 0.26 m/s, of 3.15 m: round one lobe, through the crossing, and to the far end of the other.
    assert stack.core.progress.laps > 0.72
    off_m = changed.course().off_m(np.array(places))
    assert np.sqrt(np.mean(off_m[100:] ** 2)) < 0.06
    assert np.array(places)[:, 0].min() < -0.5
    shown = status(stack.core, loop_figures(LoopStats()), RecorderStats())["task"]
    assert shown["asked"]["kind"] == "lemniscate"
    assert shown["labels"]["size_m"] == "Size (m)"
    assert shown["limits"]["size_m"][0] == 0.572
    assert set(shown["limits"]) == {"size_m", "speed_m_s", "center_x_m", "center_y_m"}
    reported = [record for _, tick in stack.recorder.ticks for record in tick if isinstance(record, records.Task)]
    assert [(record.kind, record.settings["size_m"]) for record in reported] == [("lemniscate", 0.6)]
    log = write_run(stack, tmp_path / "run.mcap")
    replayed(log)
    with Recording(log) as recording:
        timeline, stage = recording.timeline, recording.stage
        task = stage.task_at(timeline.tasks.last(timeline.last_ns))
        assert task == changed
        away = curves.distance(task, timeline, timeline.first_ns, timeline.last_ns)
        speed = curves.speed(task, timeline, timeline.first_ns, timeline.last_ns)
    assert np.nanmax(np.abs(away.values["distance (m)"])) < 0.2
    assert set(speed.values["reference"]) == {0.26}
