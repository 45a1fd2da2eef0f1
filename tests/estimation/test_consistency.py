"""The filter against an independent truth: consistency over many seeds, late poses, a kidnapped robot, outliers."""

import numpy as np
import pytest
from scipy.stats import chi2

from disco_hw.config import Estimation
from disco_hw.estimation import PoseFusion
from disco_hw.estimation.correction import PoseReason
from disco_hw.estimation.odometry import OdometryParameters
from drivers.types import PoseSample
from tests.estimation.truth import POSE_EVERY, WHEEL_PERIOD_NS, Geometry, Slip, drives, pose_error
from tests.tables import thinned

# Half as many seeds have bounds 1.4 times as wide.
SEEDS = [pytest.param(50, marks=pytest.mark.thorough), pytest.param(100, marks=pytest.mark.long)]
NOMINAL = OdometryParameters(0.061, 0.415, 0.238)


def mean_bounds(samples):
    """95 % interval of the mean of so many chi-square variables with three degrees of freedom."""
    return chi2.ppf([0.025, 0.975], 3 * samples) / samples


def squared_error(estimate, truth):
    """Normalised estimation error squared."""
    error = pose_error(estimate, truth)
    return float(error @ np.linalg.solve(np.array(estimate.covariance), error))


def arrivals_in_order(drive, every=1):
    return [(drive.wheels[i * POSE_EVERY].t_ns, i) for i in range(0, drive.measured.shape[1], every)]


def follow(drive, seed, arrivals, parameters=NOMINAL, config=None, sample=None, looks=10):
    """Feed one drive with poses (arrival time, index); every `looks`-th (wheel index, estimate), and all updates."""
    fusion = PoseFusion(config or Estimation(), parameters, wheel_timeout_s=0.15)
    arrivals, estimates, updates = sorted(arrivals), [], []
    for k, wheels in enumerate(drive.wheels):
        fusion.add_wheels(wheels)
        while arrivals and arrivals[0][0] <= wheels.t_ns:
            _, index = arrivals.pop(0)
            pose = (sample or drive.pose_sample)(seed, index)
            updates.append(fusion.add_pose(pose, wheels.t_ns))
        if k % looks == looks - 1:
            estimates.append((k, fusion.estimate(wheels.t_ns)))
    return estimates, updates


def assert_consistent(nees):
    """`nees`: (seeds, times). The mean over the seeds is inside its 95 % bounds at 95 % of the times, give or take."""
    low, high = mean_bounds(len(nees))
    means = nees.mean(axis=0)
    inside = np.mean((means > low) & (means < high))
    assert inside >= 0.85, f"inside at {inside:.0%} of the times, overall mean {nees.mean():.2f}"
    assert low < means[-1] < high
    assert low < nees.mean() < high


@pytest.fixture(scope="module")
def slipping():
    return drives(100, 8.0)


@pytest.mark.parametrize("seeds", [10, *SEEDS])
def test_nees_and_nis_are_inside_their_bounds(slipping, seeds):
    nees, nis = [], []
    for seed in range(seeds):
        estimates, updates = follow(slipping, seed, arrivals_in_order(slipping))
        nees.append([squared_error(estimate, slipping.truth[seed, k]) for k, estimate in estimates])
        nis.append([update.distance2 for update in updates[1:]])
    assert_consistent(np.array(nees))
    nis = np.array(nis)
    low, high = mean_bounds(nis.size)
    assert low < nis.mean() < high
    low, high = mean_bounds(seeds)
    assert np.mean((nis.mean(axis=0) > low) & (nis.mean(axis=0) < high)) >= 0.9
    # Of right poses the gate rejects as many as it says.
    assert np.mean(nis > chi2.ppf(0.999, 3)) == pytest.approx(0.001, abs=0.0007)


@pytest.mark.parametrize("seeds", SEEDS)
def test_late_lossy_unordered_poses_leave_the_filter_consistent(slipping, seeds):
    nees = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        delayed = [
            (t + int(rng.integers(120, 280)) * 10**6, i) for t, i in arrivals_in_order(slipping) if rng.random() > 0.2
        ]
        estimates, _ = follow(slipping, seed, delayed)
        nees.append([squared_error(estimate, slipping.truth[seed, k]) for k, estimate in estimates if k > 40])
    assert_consistent(np.array(nees))


@pytest.mark.thorough
@pytest.mark.parametrize("seeds", SEEDS)
def test_uncertain_geometry_stays_consistent_only_if_the_filter_is_told(seeds):
    rng = np.random.default_rng(7)
    covariance = np.diag([0.2 * 0.061, 0.1 * 0.415, 0.05]) ** 2
    geometry = np.clip(rng.multivariate_normal([0.061, 0.415, 0.238], covariance, seeds), 0.01, None)
    drive = drives(seeds, 6.0, Geometry(*geometry.T))
    informed = OdometryParameters(0.061, 0.415, 0.238, tuple(map(tuple, covariance.tolist())))
    nees = {}
    for name, parameters in (("informed", informed), ("uninformed", NOMINAL)):
        # Poses at 5 Hz without a gate: what is tested is the covariance.
        runs = [
            follow(
                drive, seed, arrivals_in_order(drive, 5), parameters, Estimation(gate_probability=1 - 1e-12), looks=30
            )
            for seed in range(seeds)
        ]
        nees[name] = np.array(
            [[squared_error(e, drive.truth[seed, k]) for k, e in estimates] for seed, (estimates, _) in enumerate(runs)]
        )
    assert nees["informed"].mean() == pytest.approx(3.0, rel=0.15)
    assert nees["uninformed"].mean() > 3 * nees["informed"].mean()


def rmse(drive, runs):
    errors = np.array(
        [[pose_error(e, drive.truth[seed, k]) for k, e in estimates if k > 100] for seed, estimates in enumerate(runs)]
    )
    return np.sqrt(np.mean(np.sum(errors[..., :2] ** 2, axis=-1))), np.sqrt(np.mean(errors[..., 2] ** 2))


@pytest.mark.thorough
def test_late_lossy_unordered_poses_cost_less_than_three_percent_of_accuracy():
    # Wheels that do not slip: slip of the last 200 ms cannot be known to anyone, and would be added to the error.
    drive = drives(15, 8.0, slip=Slip(0.0, 0.0, 0.0))
    ordered, unordered, stamped_on_arrival = [], [], []
    for seed in range(15):
        rng = np.random.default_rng(seed)
        survivors = [(t, i) for t, i in arrivals_in_order(drive) if rng.random() > 0.2]
        delayed = [(t + int(rng.integers(120, 280)) * 10**6, i) for t, i in survivors]
        assert [i for _, i in sorted(delayed)] != [i for _, i in survivors]
        arrival = {i: t for t, i in delayed}

        def restamped(seed, index, arrival=arrival):
            pose = drive.pose_sample(seed, index)
            on = arrival[index]
            return PoseSample(on, on, pose.x_m, pose.y_m, pose.yaw_rad, pose.position_std_m, pose.yaw_std_rad)

        ordered.append(follow(drive, seed, survivors)[0])
        unordered.append(follow(drive, seed, delayed)[0])
        stamped_on_arrival.append(follow(drive, seed, delayed, sample=restamped)[0])
    position, yaw = rmse(drive, ordered)
    unordered_position, unordered_yaw = rmse(drive, unordered)
    assert unordered_position < 1.03 * position
    assert unordered_yaw < 1.03 * yaw
    # What the time stamps are worth: the same poses taken as of their arrival.
    assert rmse(drive, stamped_on_arrival)[0] > 3 * position


def test_once_all_poses_are_in_the_late_run_equals_the_ordered_run_to_the_bit(slipping):
    rng = np.random.default_rng(0)
    survivors = [(t, i) for t, i in arrivals_in_order(slipping) if rng.random() > 0.2 and i < 170]
    delayed = [(t + int(rng.integers(120, 280)) * 10**6, i) for t, i in survivors]
    assert follow(slipping, 0, survivors)[0][-1] == follow(slipping, 0, delayed)[0][-1]


@thinned("delay_ns", [200_000_000, 0], quick=1)
def test_a_robot_moved_by_half_a_metre_is_found_again(slipping, delay_ns):
    moved_at = 100
    shift = np.array([0.3, -0.4, 0.0])

    def sample(seed, index):
        pose = slipping.pose_sample(seed, index)
        if index < moved_at:
            return pose
        return PoseSample(pose.t_ns, pose.t_ns, pose.x_m + shift[0], pose.y_m + shift[1], pose.yaw_rad, *[0.01, 0.02])

    arrivals = [(t + delay_ns, i) for t, i in arrivals_in_order(slipping)]
    for seed in range(4):
        estimates, updates = follow(slipping, seed, arrivals, sample=sample, looks=1)
        reasons = [update.reason for update in updates]
        assert reasons[moved_at : moved_at + 10] == [PoseReason.GATED] * 9 + [PoseReason.REINITIALISED]
        assert reasons.count(PoseReason.REINITIALISED) == 1
        found_again = (moved_at + 9) * POSE_EVERY + delay_ns // WHEEL_PERIOD_NS
        for k, estimate in estimates[found_again:]:
            assert np.hypot(*pose_error(estimate, slipping.truth[seed, k] + shift)[:2]) < 0.06
            assert estimate.reinitialisations == 1


def test_lone_outliers_and_three_in_a_row_leave_no_trace(slipping):
    # Left out are the poses that the other run gets as outliers: both must end in the same bits.
    rng = np.random.default_rng(3)
    struck = {50, 51, 52, 70, 90, 91, 120}
    jumps = {i: rng.normal(size=3) * (2.0, 2.0, 1.0) + (1.0, 1.0, 0.0) for i in struck}

    def sample(seed, index):
        pose = slipping.pose_sample(seed, index)
        if index not in jumps:
            return pose
        x, y, yaw = jumps[index]
        return PoseSample(pose.t_ns, pose.t_ns, pose.x_m + x, pose.y_m + y, pose.yaw_rad + yaw, 0.01, 0.02)

    arrivals = arrivals_in_order(slipping)
    with_outliers, updates = follow(slipping, 4, arrivals, sample=sample)
    without, _ = follow(slipping, 4, [a for a in arrivals if a[1] not in struck])
    assert [i for i, update in enumerate(updates) if update.reason is PoseReason.GATED] == sorted(struck)
    assert with_outliers[-1] == without[-1]
