"""Another geometry in the middle of a drive: nothing jumps, what follows is by the new one."""

import numpy as np
import pytest

from disco_hw.config import Estimation
from disco_hw.estimation import PoseFusion
from disco_hw.estimation.odometry import OdometryParameters
from drivers.types import PoseSample, WheelSample

TICK_NS = 20_000_000
OLD = OdometryParameters(0.06, 0.4, 0.1, ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4)))
NEW = OdometryParameters(0.07, 0.4, 0.1, ((1e-8, 0.0, 0.0), (0.0, 1e-6, 0.0), (0.0, 0.0, 1e-6)))


def wheels(tick, speed=4.0):
    t_ns = tick * TICK_NS
    return WheelSample(t_ns, t_ns, 0.02 * speed * tick, 0.02 * speed * tick, speed, speed)


def pose(tick, came_tick, x_m=0.0, y_m=0.0):
    return PoseSample(tick * TICK_NS, came_tick * TICK_NS, x_m, y_m, 0.0, 0.005, 0.01)


def drive(fusion, first, last):
    for tick in range(first, last):
        fusion.add_wheels(wheels(tick))
        if tick == 5:
            fusion.add_pose(pose(tick, tick), tick * TICK_NS)
    return fusion


def driven():
    return drive(PoseFusion(Estimation(), OLD, 0.05), 0, 100)


def test_the_estimate_does_not_jump():
    fusion = driven()
    now_ns = 99 * TICK_NS
    before = fusion.estimate(now_ns)
    fusion.set_parameters(NEW)
    after = fusion.estimate(now_ns)
    assert after.pose == before.pose
    assert np.array(after.covariance) == pytest.approx(np.array(before.covariance), rel=1e-9)


def test_the_way_from_there_on_is_by_the_new_geometry():
    fusion = driven()
    x_m = fusion.estimate(99 * TICK_NS).x_m
    fusion.set_parameters(NEW)
    later = drive(fusion, 100, 150).estimate(149 * TICK_NS)
    assert later.x_m - x_m == pytest.approx(0.07 * 4.0, rel=1e-6)
    assert later.speed_m_s == pytest.approx(0.28)


def test_uncertainty_grows_by_the_new_one():
    old, new = driven(), driven()
    new.set_parameters(NEW)
    grown = []
    for fusion in (old, new):
        before = fusion.estimate(99 * TICK_NS).covariance[0][0]
        grown.append(drive(fusion, 100, 150).estimate(149 * TICK_NS).covariance[0][0] - before)
    assert grown[1] < 0.2 * grown[0]


def test_a_pose_from_before_the_change_is_still_taken_in():
    fusion = driven()
    fusion.set_parameters(NEW)
    assert fusion.add_pose(pose(80, 99, 0.36), 99 * TICK_NS).accepted


def test_adopting_late_is_adopting_at_once_bit_for_bit():
    """States are adopted when they are gone on from; the same poses, late ones and after trimming, give the same."""

    def found(immediately):
        fusion, estimates = driven(), []
        for tick in range(100, 240):
            if tick in {100, 110, 180}:
                fusion.set_parameters(OLD if tick == 110 else NEW)
                if immediately:
                    buffer = fusion._buffer
                    buffer._states, buffer._before = [buffer._filter.adopt(state) for state in buffer._states], 0
            fusion.add_wheels(wheels(tick))
            if tick % 3 == 0:
                fusion.add_pose(pose(tick - 15, tick, 0.004 * tick, 0.01), tick * TICK_NS)
            estimates.append(fusion.estimate(tick * TICK_NS))
        return estimates

    assert found(immediately=False) == found(immediately=True)
