"""Positions without heading: the motion finds it, and the covariance says how well."""

import math

import numpy as np
import pytest

from disco_hw.config import Estimation
from disco_hw.estimation import PoseFusion
from disco_hw.estimation.correction import PoseReason
from disco_hw.estimation.odometry import OdometryParameters
from drivers.types import PoseSample, WheelSample
from tests.estimation.test_consistency import NOMINAL, assert_consistent, follow, mean_bounds, squared_error
from tests.estimation.truth import POSE_EVERY, Geometry, drives
from tests.tables import thinned

MOST_SEEDS = 40
SEEDS = pytest.mark.parametrize("seeds", [12, pytest.param(MOST_SEEDS, marks=pytest.mark.thorough)])
EVERY_NS = 200_000_000
STD_M = 0.02
NAN = math.nan
LEVER = (0.25, -0.1)


def straight(t):
    """Half a metre a second, then bends."""
    bend = 1.2 if t > 3.5 else 0.0
    return 4.0 - bend, 4.0 + bend


@pytest.fixture(scope="module")
def driven():
    return drives(MOST_SEEDS, 6.5, speeds=straight, position_std=STD_M, rng_seed=5)


def position_only(drive, lever=(0.0, 0.0)):
    """Return what an antenna on the robot measures, `lever` ahead and to the left of the tracked point."""

    def sample(seed, index):
        x, y, _ = drive.measured[seed, index].tolist()
        yaw = drive.truth[seed, index * POSE_EVERY, 2]
        x += math.cos(yaw) * lever[0] - math.sin(yaw) * lever[1]
        y += math.sin(yaw) * lever[0] + math.cos(yaw) * lever[1]
        t_ns = drive.wheels[index * POSE_EVERY].t_ns
        return PoseSample(t_ns, t_ns + 150_000_000, x, y, NAN, STD_M, NAN, *lever)

    return sample


def arrivals(drive, delay_ns=150_000_000):
    step = EVERY_NS // 40_000_000
    return [(drive.wheels[i * POSE_EVERY].t_ns + delay_ns, i) for i in range(0, drive.measured.shape[1], step)]


@SEEDS
@thinned("lever", [LEVER, (0.0, 0.0)], quick=1)
def test_the_heading_found_is_as_uncertain_as_it_says(driven, lever, seeds):
    nees, found_at_m, yaw_errors = [], [], []
    for seed in range(seeds):
        estimates, updates = follow(driven, seed, arrivals(driven), sample=position_only(driven, lever))
        assert updates[0].reason is PoseReason.INITIALISED
        known = [(k, estimate) for k, estimate in estimates if estimate.heading_known]
        first, at_first = known[0]
        found_at_m.append(np.hypot(*(driven.truth[seed, first, :2] - driven.truth[seed, 0, :2])))
        error = math.remainder(at_first.yaw_rad - driven.truth[seed, first, 2], math.tau)
        yaw_errors.append(error / math.sqrt(at_first.covariance[2][2]))
        assert all(estimate.pose_ok for _, estimate in known)
        nees.append([squared_error(estimate, driven.truth[seed, k]) for k, estimate in estimates if k >= 300])
    assert max(found_at_m) < 1.0
    assert_consistent(np.array(nees))
    # At the very instant when it is said to be known it is as good as it is said to be.
    low, high = (bound / 3 for bound in mean_bounds(seeds))
    assert low < np.mean(np.square(yaw_errors)) < high * 1.3
    assert max(map(abs, yaw_errors)) < 4.0


def test_a_robot_that_stands_never_has_a_heading(driven):
    fusion = PoseFusion(Estimation(), NOMINAL, wheel_timeout_s=0.15)
    rng = np.random.default_rng(1)
    for k in range(1500):
        t_ns = 10**12 + k * 10_000_000
        fusion.add_wheels(WheelSample(t_ns, t_ns, 0.0, 0.0, 0.0, 0.0))
        if k % 20 == 0:
            x, y = rng.normal(0.0, STD_M, 2).tolist()
            fusion.add_pose(PoseSample(t_ns, t_ns, 3.0 + x, y, NAN, STD_M, NAN), t_ns)
    estimate = fusion.estimate(t_ns)
    assert estimate.initialised
    assert not estimate.heading_known
    assert not estimate.pose_ok
    assert (estimate.x_m, estimate.y_m) == pytest.approx((3.0, 0.0), abs=0.02)
    assert estimate.covariance[2][2] > 1.0


def test_outliers_do_not_make_a_heading(driven):
    good = position_only(driven)
    rng = np.random.default_rng(2)

    def sample(seed, index):
        pose = good(seed, index)
        if (index // 5) % 4 == 1:
            x, y = rng.uniform(-3.0, 3.0, 2).tolist()
            return PoseSample(pose.t_ns, pose.received_ns, x, y, NAN, STD_M, NAN)
        return pose

    for seed in range(8):
        estimates, updates = follow(driven, seed, arrivals(driven), sample=sample)
        assert sum(update.reason is PoseReason.GATED for update in updates) >= 6
        last = estimates[-1][1]
        assert last.heading_known
        assert squared_error(last, driven.truth[seed, estimates[-1][0]]) < 25.0


def test_a_robot_that_is_turned_by_hand_loses_its_heading_before_it_finds_the_new_one(driven):
    good, moved_at, turned = position_only(driven), 60, 2.0

    def sample(seed, index):
        """From `moved_at` on the world is turned about where the robot is then, and shifted."""
        pose = good(seed, index)
        if index < moved_at:
            return pose
        x0, y0 = driven.truth[seed, moved_at * POSE_EVERY, :2]
        dx, dy = pose.x_m - x0, pose.y_m - y0
        x = x0 + 0.5 + math.cos(turned) * dx - math.sin(turned) * dy
        y = y0 + math.sin(turned) * dx + math.cos(turned) * dy
        return PoseSample(pose.t_ns, pose.received_ns, x, y, NAN, STD_M, NAN)

    for seed in range(5):
        estimates, updates = follow(driven, seed, arrivals(driven), sample=sample)
        reasons = [update.reason for update in updates]
        assert reasons.count(PoseReason.REINITIALISED) == 1
        after = reasons.index(PoseReason.REINITIALISED)
        assert reasons[after - 9 : after] == [PoseReason.GATED] * 9
        k, last = estimates[-1]
        assert last.heading_known
        error = math.remainder(last.yaw_rad - driven.truth[seed, k, 2] - turned, math.tau)
        assert abs(error) < 4.0 * math.sqrt(last.covariance[2][2])


def test_a_robot_carried_off_while_it_stands_is_not_driven_on_its_old_heading():
    fusion = PoseFusion(Estimation(), NOMINAL, wheel_timeout_s=0.15)
    known = []
    for k in range(1200):
        t_ns = 10**12 + k * 10_000_000
        # Two metres straight on, then it stands; from 8 s on it is two metres further.
        angle = min(k, 500) * 0.01 * 6.5
        speed = 6.5 if k < 500 else 0.0
        fusion.add_wheels(WheelSample(t_ns, t_ns, angle, angle, speed, speed))
        x_m = 0.061 * angle + (2.0 if k > 800 else 0.0)
        if k % 20 == 0:
            fusion.add_pose(PoseSample(t_ns, t_ns, x_m, 0.0, NAN, STD_M, NAN), t_ns)
        known.append(fusion.estimate(t_ns).pose_ok)
    assert known[790]
    # One second without an accepted pose, and from the tenth that agrees on no heading is known.
    assert not any(known[910:])
    assert fusion.estimate(t_ns).x_m == pytest.approx(x_m, abs=0.03)


def test_a_heading_that_comes_now_and_then_is_taken(driven):
    """As of two antennas, or a compass that is right once in a while."""
    fusion = PoseFusion(Estimation(), NOMINAL, wheel_timeout_s=0.15)
    t_ns = 10**12
    fusion.add_wheels(WheelSample(t_ns, t_ns, 0.0, 0.0, 0.0, 0.0))
    fusion.add_pose(PoseSample(t_ns, t_ns, 1.0, 2.0, NAN, STD_M, NAN), t_ns)
    assert not fusion.estimate(t_ns).heading_known
    t_ns += 10_000_000
    fusion.add_wheels(WheelSample(t_ns, t_ns, 0.0, 0.0, 0.0, 0.0))
    fusion.add_pose(PoseSample(t_ns, t_ns, 1.0, 2.0, 2.9, STD_M, 0.03), t_ns)
    estimate = fusion.estimate(t_ns)
    assert estimate.heading_known
    assert estimate.yaw_rad == pytest.approx(2.9, abs=0.02)
    assert estimate.covariance[2][2] == pytest.approx(0.03**2, rel=0.1)


def test_half_a_heading_is_no_heading():
    fusion = PoseFusion(Estimation(), NOMINAL, wheel_timeout_s=0.15)
    fusion.add_wheels(WheelSample(10**12, 10**12, 0.0, 0.0, 0.0, 0.0))
    for yaw, std in ((NAN, 0.1), (0.1, NAN), (math.inf, NAN)):
        update = fusion.add_pose(PoseSample(10**12, 10**12, 0.0, 0.0, yaw, STD_M, std), 10**12)
        assert update.reason is PoseReason.NOT_FINITE


@SEEDS
def test_a_geometry_that_is_uncertain_is_in_the_headings_uncertainty(seeds):
    uncertain = OdometryParameters(0.061, 0.415, 0.238, ((1e-6, 0.0, 0.0), (0.0, 4e-4, 0.0), (0.0, 0.0, 1e-4)))
    rng = np.random.default_rng(7)
    geometry = Geometry(
        0.061 + 1e-3 * rng.standard_normal(MOST_SEEDS),
        0.415 + 0.02 * rng.standard_normal(MOST_SEEDS),
        0.238 + 0.01 * rng.standard_normal(MOST_SEEDS),
    )
    drive = drives(MOST_SEEDS, 5.5, geometry=geometry, speeds=straight, position_std=STD_M, rng_seed=8)
    nees = []
    for seed in range(seeds):
        estimates, _ = follow(drive, seed, arrivals(drive), parameters=uncertain, sample=position_only(drive))
        nees.append([squared_error(estimate, drive.truth[seed, k]) for k, estimate in estimates if k >= 300])
    assert_consistent(np.array(nees))
