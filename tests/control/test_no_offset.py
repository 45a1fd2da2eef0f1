"""Tests that the robot drives without offset: with true parameters at any speed, rate and radius, and on a slope."""

import math

import numpy as np
import pytest

from disco_hw.control import CommandLimits, Disco, DiscoSettings, PlannerState, SentCommand
from disco_hw.experiments.circle import KinematicPlant
from disco_hw.model import Gaussian, Model
from disco_hw.model.model import EffectSetting
from disco_hw.tasks.circle import CircleCost
from tests.tables import thinned
from tools.foreign_plant import robots
from tools.tracking import disco, drive, tracks

THETA = {"wheel_radius_m": 0.061, "axial_distance_m": 0.415, "x_icr_m": 0.238}
MEAN = np.array(list(THETA.values()))
LAG_S = 0.1
MODEL = Model(
    *MEAN.tolist(),
    effects=(EffectSetting("motor_lag", {"tau_s": LAG_S}),),
    belief=Gaussian(tuple(THETA), MEAN, np.diag((0.004 * MEAN) ** 2)),
)


def mean_distance_m(settings, rate_hz, speed_m_s, radius_m):
    """Mean signed distance over 3.6 m, after 2.4 m; positive outside."""
    task = CircleCost(radius_m=radius_m, speed_m_s=speed_m_s)
    planner = Disco(MODEL, task, settings, CommandLimits(25.0, 40.0))
    inwards = math.asin(THETA["x_icr_m"] / radius_m)
    plant = KinematicPlant(THETA, (radius_m, 0.0, 0.5 * math.pi + inwards), LAG_S, 0.0, 1)
    distance, sent = [], []
    for tick in range(round(6.0 / speed_m_s * rate_hz)):
        now_ns = round(tick / rate_hz * 1e9)
        state = PlannerState(now_ns, plant.x_m, plant.y_m, plant.yaw_rad, *plant.wheels, sent=tuple(sent[-50:]))
        left, right = planner.plan(now_ns, state).at(now_ns)
        sent.append(SentCommand(now_ns, left, right))
        plant.advance(left, right, 1.0 / rate_hz)
        distance.append(math.hypot(plant.x_m, plant.y_m) - radius_m)
    return float(np.mean(distance[len(distance) * 2 // 5 :]))


@thinned("rate_hz", [50.0, 25.0, 10.0], quick=1)
@thinned("speed_m_s", [0.6, 0.4, 0.2, 0.1], quick=0)
def test_the_circle_is_driven_without_an_offset(rate_hz, speed_m_s):
    settings = DiscoSettings.for_speed(speed_m_s, rate_hz)
    for radius_m in (0.3, 0.75, 3.0):
        # At ten plans a second the robot turns by a third of a radian between two plans on the smallest at 0.6 m/s.
        limit_m = 0.003 if (rate_hz, speed_m_s, radius_m) == (10.0, 0.6, 0.3) else 0.002
        assert abs(mean_distance_m(settings, rate_hz, speed_m_s, radius_m)) < limit_m, radius_m


@pytest.mark.thorough
@pytest.mark.parametrize("way", ["circle", "eight"])
def test_a_slope_whose_pull_is_learnt_leaves_no_offset(way):
    """A slope that carries the robot by 15 % of its speed; what is not learnt of it leaves 40 to 60 mm."""
    robot = robots(3000, 1, slope_m_s=0.03)[0]
    settings = DiscoSettings.for_speed(0.2, 50.0)
    off_mm = [
        drive(disco(settings, knows=not learns, learns=learns), robot, tracks()[way]).after(18.0).rms_mm
        for learns in (True, False)
    ]
    assert off_mm[0] < 4.0
    assert off_mm[1] > 30.0
