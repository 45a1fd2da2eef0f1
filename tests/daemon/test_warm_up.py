"""The warm-up reaches every part of the tick that the first seconds of a real run reach."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from disco_hw.config import Estimation
from disco_hw.control import NoValidControl
from disco_hw.daemon.run import warm_up
from disco_hw.estimation import PoseFusion
from disco_hw.estimation.odometry import OdometryParameters
from disco_hw.fence import Fence, Footprint
from disco_hw.fence.clearance import Boundaries
from disco_hw.runtime.fence_guard import FenceGuard, StoppingSettings
from disco_hw.runtime.pipeline import Governor, Pipeline, WheelLimits
from tests.tables import thinned


class Refusing:
    """A planner that counts its calls and never finds anything."""

    def __init__(self) -> None:
        self.calls = 0

    def plan(self, now_ns, state):
        self.calls += 1
        raise NoValidControl("none")

    def reset(self) -> None:
        pass


def test_poses_are_accepted_gated_and_refused_and_the_planner_is_asked():
    planner = Refusing()
    fusion = PoseFusion(Estimation(), OdometryParameters(0.06, 0.4, 0.2), 0.05)
    governor = Governor(WheelLimits(8.0, 20.0, 20.0), 0.02)
    guard = FenceGuard(Boundaries(Footprint(0.5, 0.4, 0.1), Fence()), StoppingSettings(0.05, 0.1, 20.0, 0.02), 0.05)
    warm_up(Pipeline(fusion, planner, governor, 0.2, guard))
    assert planner.calls > 20
    assert fusion.stats.poses_accepted > 20
    assert fusion.stats.poses_gated == 1
    assert fusion.stats.poses_not_finite == 1


@thinned("uncertainty", ["ut", "mc"], quick=1)
def test_nothing_is_compiled_while_the_robot_is_driven(uncertainty):
    # In a process of its own: what another test has compiled would hide it.
    command = [sys.executable, "-m", "tests.runtime.driven_once", uncertainty]
    run = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    reported = json.loads(run.stdout)
    assert "disco_hw.model.step.run_states" in reported["before"]
    assert reported["after"] == reported["before"]
