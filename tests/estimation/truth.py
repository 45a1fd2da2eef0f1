"""An independent truth for the filter's tests: a skid-steer body with slip, integrated in small steps."""

from dataclasses import dataclass

import numpy as np

from drivers.types import PoseSample, WheelSample

WHEEL_PERIOD_NS = 10_000_000
POSE_EVERY = 4
SUBSTEPS = 10


@dataclass(frozen=True)
class Geometry:
    radius: float = 0.061
    axial: float = 0.415
    x_icr: float = 0.238


@dataclass(frozen=True)
class Slip:
    """Standard deviations per square root of path or turn; the same numbers as the filter's defaults."""

    position_per_m: float = 0.02
    yaw_per_m: float = 0.02
    yaw_per_rad: float = 0.05


@dataclass(frozen=True)
class Drives:
    """`seeds` drives with the same wheel motion and different slip and sensor noise.

    wheels: samples at 100 Hz; truth: (seeds, wheels, 3) at their stamps; poses: (seeds, wheels // 4 + 1, 3) measured.
    """

    wheels: list[WheelSample]
    truth: np.ndarray
    measured: np.ndarray
    position_std: float
    yaw_std: float

    def pose_sample(self, seed, index, delay_ns=0):
        x, y, yaw = self.measured[seed, index].tolist()
        t_ns = self.wheels[index * POSE_EVERY].t_ns
        return PoseSample(t_ns, t_ns + delay_ns, x, y, yaw, self.position_std, self.yaw_std)


def weaving(t):
    """Wheel speeds (rad/s) of a drive with bends of both signs, a spin in place and a reversal."""
    if 6.0 <= t < 7.0:
        return -1.5, 1.5
    if 7.0 <= t < 7.5:
        return -2.0, -2.5
    return 3.3 + 0.8 * np.sin(1.7 * t), 3.3 - 0.8 * np.sin(1.7 * t) + 0.4 * np.cos(0.6 * t)


def from_start(steps, start=0.0):
    """Sums of steps (n, ...) from the start on, (n + 1, ...)."""
    return np.cumsum(np.concatenate([np.full((1, *steps.shape[1:]), start), steps]), axis=0)


def drives(seeds, duration_s, geometry=None, slip=None, speeds=weaving, position_std=0.01, yaw_std=0.02, rng_seed=1):
    """Simulate; `geometry` may hold arrays with one value per seed."""
    geometry, slip = geometry or Geometry(), slip or Slip()
    rng = np.random.default_rng(rng_seed)
    count = round(duration_s * 1e9 / WHEEL_PERIOD_NS) + 1
    period_s = WHEEL_PERIOD_NS * 1e-9
    h = period_s / SUBSTEPS
    held = np.array([speeds(k * period_s) for k in range(count)])
    left, right = np.repeat(held, SUBSTEPS, axis=0).T[:, :, None]
    # Each step draws the noise of the yaw, of x and of y.
    noise = rng.standard_normal((count * SUBSTEPS, 3, seeds))
    rolled = geometry.radius * (abs(left) + abs(right)) / 2 * h
    forward = geometry.radius * (left + right) / 2 * h
    turn = geometry.radius * (right - left) / geometry.axial * h
    turn = turn + np.sqrt(slip.yaw_per_m**2 * rolled + slip.yaw_per_rad**2 * abs(turn)) * noise[:, 0]
    yaw = from_start(turn, 0.4)
    middle = yaw[:-1] + turn / 2
    step_std = slip.position_per_m * np.sqrt(rolled)
    slide = turn * geometry.x_icr
    x = from_start(forward * np.cos(middle) + slide * np.sin(middle) + step_std * noise[:, 1])
    y = from_start(forward * np.sin(middle) - slide * np.cos(middle) + step_std * noise[:, 2])
    truth = np.stack([x, y, yaw], axis=2)[:-1:SUBSTEPS].transpose(1, 0, 2)
    angles = from_start(held * period_s)[:-1].tolist()
    wheels = [
        WheelSample(t_ns, t_ns, *angle, *speed)
        for t_ns, angle, speed in zip(
            range(10**12, 10**12 + count * WHEEL_PERIOD_NS, WHEEL_PERIOD_NS), angles, held.tolist(), strict=True
        )
    ]
    at_poses = truth[:, ::POSE_EVERY]
    noise = rng.standard_normal(at_poses.shape) * (position_std, position_std, yaw_std)
    return Drives(wheels, truth, at_poses + noise, position_std, yaw_std)


def pose_error(estimate, truth):
    """Estimated minus true (x, y, yaw), yaw wrapped."""
    error = np.array([estimate.x_m, estimate.y_m, estimate.yaw_rad]) - truth
    error[2] = np.angle(np.exp(1j * error[2]))
    return error
