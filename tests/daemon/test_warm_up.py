"""The warm-up reaches every part of the tick that the first seconds of a real run reach."""

from __future__ import annotations

from disco_hw.config import Estimation
from disco_hw.control import NoValidControl
from disco_hw.daemon.governor import Governor, WheelLimits
from disco_hw.daemon.warm_up import warm_up
from disco_hw.estimation import OdometryParameters, PoseFusion
from disco_hw.pipeline import Pipeline


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
    warm_up(Pipeline(fusion, planner, governor, 0.2))
    assert planner.calls > 20
    assert fusion.stats.poses_accepted > 20
    assert fusion.stats.poses_gated == 1
    assert fusion.stats.poses_not_finite == 1
