"""The joint-sampling form of the control law, asked for in robot.toml, drives the circle in simulated time."""

from __future__ import annotations

import numpy as np
import pytest

from disco_hw.runtime.assembly import create_planner
from disco_hw.runtime.robot_setup import load_setup
from tests.runtime.simulated import ROBOT_TEXT, replayed, simulated_stack, start, write_run

# A kernel to compile; tests/control/test_disco.py drives with joint sampling in every `make test`.
pytestmark = pytest.mark.long


def test_robot_toml_asks_for_joint_sampling_and_it_drives_and_replays(tmp_path):
    robot_file = tmp_path / "robot.toml"
    robot_file.write_text(ROBOT_TEXT.replace("[control]\n", '[control]\nuncertainty = "joint"\n'))
    setup = load_setup(robot_file)
    planner = create_planner(setup.config, setup.model)
    assert planner.settings.uncertainty == "joint"
    stack = simulated_stack(planner, robot_file=robot_file)
    start(stack, 0.02)
    off_m = []
    for _ in range(150):
        stack.run(0.1)
        truth = stack.robot.truth
        off_m.append(np.hypot(truth.x_m, truth.y_m) - 0.75)
    assert np.abs(off_m[50:]).max() < 0.06
    assert stack.core.progress.laps > 0.4
    replayed(write_run(stack, tmp_path / "run.mcap"))
