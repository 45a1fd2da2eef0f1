"""The demonstration begins in the heading in which the robot goes round, so that it does not swing off its circle."""

import math
from types import SimpleNamespace

import pytest

from disco_hw.errors import WorkError
from disco_hw.experiments.demo import start_pose
from disco_hw.experiments.live_stack import Operator
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.runtime.supervisor import UserRequest
from sim.body_dynamics import BodyPose
from tests.runtime.simulated import ROBOT_FILE, simulated_stack

QUARTER_S = 0.5 * math.pi * 0.75 / 0.2


def test_the_robot_keeps_to_its_circle_from_the_start():
    x_m, y_m, yaw_rad = start_pose(load_setup(ROBOT_FILE))
    assert (x_m, y_m) == (0.75, 0.0)
    stack = simulated_stack(start=BodyPose(x_m, y_m, yaw_rad))
    stack.run(1.5)
    stack.run(0.5, UserRequest.ARM)
    stack.run(0.02, UserRequest.START)
    off_m = []
    for _ in range(round(QUARTER_S / 0.1)):
        stack.run(0.1)
        off_m.append(abs(math.hypot(stack.robot.truth.x_m, stack.robot.truth.y_m) - 0.75))
    assert stack.core.progress.laps > 0.2
    assert max(off_m) < 0.03


class Compiling:
    """A daemon that compiles for so many looks at it, and then says nothing."""

    def __init__(self, looks):
        self.name, self.process, self.looks = "daemon", SimpleNamespace(poll=lambda: None), looks

    def last_words(self):
        self.looks -= 1
        return "compiling: 7 functions, 3 s" if self.looks > 0 else "waiting"


def test_the_time_in_which_a_first_start_compiles_does_not_count(tmp_path):
    daemon = Compiling(looks=20)
    with pytest.raises(WorkError, match=r"not READY within 0.2 s \(compiling: 7 functions, 3 s\)"):
        Operator(tmp_path / "none", (daemon,)).wait_for("READY", 0.2)
    assert daemon.looks <= 0
