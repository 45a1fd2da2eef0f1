"""Cost of the estimator: per tick, per tick with a pose, and of a rewind through nearly the whole buffer."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter_ns

import numpy as np

from disco_hw.config import Estimation
from disco_hw.estimation import PoseFusion
from disco_hw.estimation.odometry import OdometryParameters, Pose, advance
from drivers.types import PoseSample, WheelSample
from tools.bench.step_times import percentiles

PERIOD_NS = 10_000_000
POSE_EVERY = 4
SPEEDS = (2.8, 3.9)
# The paper's posterior, reordered to wheel radius, axial distance, x_icr.
GEOMETRY = OdometryParameters(0.061, 0.415, 0.238, ((1.5e-4, 3e-5, -3e-5), (3e-5, 9e-5, -4e-5), (-3e-5, -4e-5, 1.3e-4)))


def run(ticks: int = 20_000) -> dict[str, float]:
    """Wheels at 100 Hz and one estimate each, poses at 25 Hz and 100 ms late; microseconds.

    The rewinds are those of one pose in 25 that comes 950 ms late, among others that are on time: all that came after
    it, 95 wheel samples and 23 poses, is run again.
    """
    plain, with_pose = _drive(ticks, lambda index: 10)
    _, mixed = _drive(ticks // 4, lambda index: 95 if index % 25 == 0 else 0)
    figures = percentiles("estimation.tick_us", np.concatenate([plain, with_pose]))
    figures |= percentiles("estimation.tick_with_pose_us", with_pose)
    rewinds = np.sort(mixed)[-len(mixed) // 25 :]
    figures |= {
        "estimation.rewind_950ms_us.p50": float(np.median(rewinds)),
        "estimation.rewind_950ms_us.max": float(rewinds[-1]),
    }
    return figures


def _drive(ticks: int, delay_ticks: Callable[[int], int]) -> tuple[np.ndarray, np.ndarray]:
    """Times of the ticks without and with a pose, in microseconds; `delay_ticks` is of the pose's number."""
    rng = np.random.default_rng(1)
    fusion = PoseFusion(Estimation(), GEOMETRY, wheel_timeout_s=0.05)
    pose = Pose(0.0, 0.0, 0.0)
    under_way: list[tuple[int, PoseSample]] = []
    plain, with_pose = [], []
    for k in range(ticks):
        now_ns = k * PERIOD_NS
        angle = k * PERIOD_NS * 1e-9
        wheels = WheelSample(now_ns, now_ns, SPEEDS[0] * angle, SPEEDS[1] * angle, *SPEEDS)
        if k % POSE_EVERY == 0:
            dx, dy, dyaw = (rng.standard_normal(3) * (0.005, 0.005, 0.01)).tolist()
            sample = PoseSample(now_ns, now_ns, pose.x_m + dx, pose.y_m + dy, pose.yaw_rad + dyaw, 0.005, 0.01)
            under_way.append((k + delay_ticks(k // POSE_EVERY), sample))
        pose = advance(GEOMETRY, pose, [(*SPEEDS, PERIOD_NS * 1e-9)])
        arrived = [sample for arrival, sample in under_way if arrival == k]
        start = perf_counter_ns()
        fusion.add_wheels(wheels)
        for sample in arrived:
            fusion.add_pose(sample, now_ns)
        fusion.estimate(now_ns + PERIOD_NS // 2)
        (with_pose if arrived else plain).append((perf_counter_ns() - start) * 1e-3)
        under_way = [item for item in under_way if item[0] > k]
    stats = fusion.stats
    if stats.poses_accepted < 0.95 * (ticks // POSE_EVERY) - 25 or stats.poses_too_old:
        raise RuntimeError(f"the benchmark does not fuse its poses: {stats}")
    return np.array(plain), np.array(with_pose)
