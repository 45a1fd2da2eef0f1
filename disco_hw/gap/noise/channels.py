"""The two channels that are cut where they are measured: command to wheel, and wheel to pose.

Each gives whitened residuals of a free run for any parameter vector; the pose sensor's effects live in the second one's
data.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.data import BASE_COUNT, BODY, WHEEL, Layout, carried
from disco_hw.gap.data.free_runs import pose_residual, read_angles, run_body, run_wheels
from disco_hw.gap.data.gridded_drive import GriddedDrive, GridSamples
from disco_hw.gap.data.stamp_clock import picked
from disco_hw.gap.noise.body_noise import BodyGains, BodyMotion, BodyNoise, body_gains, whiten_body
from disco_hw.gap.noise.wheel_noise import WheelGains, WheelMotion, WheelNoise, mean_speeds, wheel_gains, whiten_wheels
from disco_hw.gap.settings import GapSettings

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

# A noise parameter that is as good as zero; the logarithm of it is taken.
_NEGLIGIBLE = 1e-5


@dataclass(frozen=True)
class WheelChannel:
    """Commands in, wheel angles out; `weight` (E, 2) tames stretches that are noisier than the rest.

    `layout` of its parameter vectors; `neutral`: the one without any effect; `free`: places that every fit frees.
    """

    layout: ClassVar[Layout] = WHEEL
    neutral: ClassVar[Array] = WHEEL.neutral
    free: ClassVar[tuple[int, ...]] = ()
    drive: GriddedDrive
    motion: WheelMotion
    gains: WheelGains
    weight: Array
    noise: WheelNoise
    geometry: Array

    @property
    def settings(self) -> GapSettings:
        """The settings of the analysis."""
        return self.drive.settings

    @property
    def inner(self) -> WheelChannel:
        """Channel without unnamed terms: this one."""
        return self

    def split(self, p: Array) -> tuple[Array, Array | None]:
        """Return the vector and None: this channel has no unnamed terms."""
        return p, None

    @classmethod
    def build(cls, drive: GriddedDrive, noise: WheelNoise, geometry: Array) -> WheelChannel:
        """Build the channel with a noise model; samples without a known command are not used.

        `geometry` (3,): wheel radius, axial distance, x_icr, for effects that speak of the robot's motion.
        """
        place = drive.encoder
        known = np.isfinite(drive.command_rad_s[:, 0])
        # One known cell before is not enough: the run begins anew after unknown commands.
        followed = known[place.node] & known[np.maximum(place.node - 1, 0)]
        dt = np.diff(place.t_s, prepend=place.t_s[0])
        first_of_run = np.zeros(place.t_s.size, dtype=bool)
        starts = np.flatnonzero(drive.first)
        first_of_run[np.searchsorted(place.node, starts)] = True
        resumed = followed & ~np.concatenate([[False], followed[:-1]])
        jumps = np.concatenate([[0.0], np.cumsum(drive.command_change)])
        between = np.diff(jumps[place.node + 1], prepend=0.0)
        speed = drive.speed_rad_s[place.node]
        dt = np.maximum(dt, 0.0)
        settings = drive.settings.noise
        # An error that acted on the measured speed itself would scale the very noise it is measured by, and look like a
        # gain.
        calm = mean_speeds(dt, speed, settings.calm_s)
        steady = mean_speeds(dt, speed, settings.steady_s, settings.fewest_steady)
        motion = WheelMotion(dt, calm, steady, np.maximum(between, 0.0), first_of_run | resumed, followed)
        return cls(drive, motion, wheel_gains(noise, motion), np.ones((place.t_s.size, 2)), noise, geometry)

    def with_noise(self, noise: WheelNoise, use: Mask | None = None) -> WheelChannel:
        """Return the channel with another noise model and weights of 1; `use` (E,) leaves samples out."""
        motion = self.motion if use is None else replace(self.motion, use=self.motion.use & use)
        return replace(
            self, motion=motion, gains=wheel_gains(noise, motion), weight=np.ones(self.weight.shape), noise=noise
        )

    def expecting(self, p: Array) -> WheelChannel:
        """Return the channel whose slow wheel error acts on the speed predicted by a vector; weights are 1."""
        turned = np.diff(self._predicted(p), axis=0, prepend=np.nan)
        moving = (self.motion.dt_s > 0.0) & ~self.motion.restart
        expected = np.where(moving[:, None], turned / np.maximum(self.motion.dt_s, 1e-9)[:, None], 0.0)
        return replace(self, motion=replace(self.motion, expected_rad_s=expected)).with_noise(self.noise)

    def evenly(self, p: Array, extra: Array | None = None) -> WheelChannel:
        """Return the channel with wheel errors of equal size at every speed, and with Huber weights.

        Errors far above the root mean square of the residuals at `p` count less (Huber, 1964).
        """
        settings, samples = self.settings.noise, self.drive.encoder
        raw = self.raw_residual(p, extra)
        apart = max(round(settings.steady_s / max(float(np.median(np.diff(samples.t_s))), 1e-3)), 1)
        moving = np.abs(self.drive.speed_rad_s[samples.node]).max(axis=1) > self.settings.grid.rest_rad_s
        counted = self.gains.use & moving
        grown = (raw[apart:] - raw[:-apart])[counted[apart:] & counted[:-apart]]
        off_rad = float(np.sqrt((grown**2).mean())) if grown.size else 0.0
        # Readings and time stamps err as they do.
        noise = replace(
            self.noise,
            relative=_NEGLIGIBLE,
            drift_std=_NEGLIGIBLE,
            drift_rad_sqrt_s=max(off_rad, _NEGLIGIBLE) / settings.steady_s**0.5,
        )
        even = self.with_noise(noise)
        white = even.whitened(p, extra)
        size = float(np.sqrt((white[counted] ** 2).mean())) if counted.any() else 1.0
        weight = np.minimum(1.0, settings.even_huber * size / np.maximum(np.abs(white), 1e-9)) / size
        return replace(even, weight=weight)

    @property
    def samples(self) -> GridSamples:
        """Samples of the encoders."""
        return self.drive.encoder

    @property
    def use(self) -> Mask:
        """Which samples are used, (E,)."""
        return self.gains.use

    @property
    def block(self) -> Index:
        """Block of time of each residual, (2 E,)."""
        return np.repeat(self.samples.block, 2)

    @property
    def count(self) -> int:
        """Number of residuals that are used."""
        return 2 * int(self.gains.use.sum())

    @property
    def trusted_blocks(self) -> float:
        """Weight of the noise model, as a number of blocks of time that agree with it."""
        return self.settings.noise.trusted_wheel_blocks

    def angles(self, p: Array, extra: Array | None = None) -> Array:
        """Free-running wheel angles at the nodes, (M, 2)."""
        drive = self.drive
        perturbation = total_perturbation(drive, 2, drive.known_command, extra)
        return run_wheels(
            p, self.geometry, drive.command_rad_s, perturbation, drive.first, drive.t_s, drive.speed_rad_s,
            drive.commands_moved_s,
        )  # fmt: skip

    def raw_residual(self, p: Array, extra: Array | None = None) -> Array:
        """Measured minus predicted wheel angles at the samples, (E, 2)."""
        return self.drive.encoder_angle_rad - self._predicted(p, extra)

    def _predicted(self, p: Array, extra: Array | None = None) -> Array:
        place = self.drive.encoder
        predicted = np.empty((place.t_s.size, 2))
        read_angles(self.angles(p, extra), place.node, place.fraction, predicted)
        return predicted

    def whitened(self, p: Array, extra: Array | None = None) -> Array:
        """Residuals of unit variance, not weighted, (E, 2)."""
        return whiten_wheels(self.raw_residual(p, extra), self.gains)

    def residual(self, p: Array, extra: Array | None = None) -> Array:
        """Whitened residuals, (2 E,)."""
        return (self.whitened(p, extra) * self.weight).ravel()


@dataclass(frozen=True)
class BodyChannel:
    """Channel from measured wheel angles to poses, in windows of time whose start pose is unknown.

    `layout` of its parameter vectors; `free`: places that every fit frees, those of the geometry.
    """

    layout: ClassVar[Layout] = BODY
    free: ClassVar[tuple[int, ...]] = tuple(range(BASE_COUNT))
    drive: GriddedDrive
    samples: GridSamples
    measured: Array
    window: Index
    first_node: Index
    last_node: Index
    use: Mask
    gains: BodyGains
    weight: Array
    noise: BodyNoise
    geometry: Array

    @property
    def settings(self) -> GapSettings:
        """The settings of the analysis."""
        return self.drive.settings

    @property
    def inner(self) -> BodyChannel:
        """Channel without unnamed terms: this one."""
        return self

    def split(self, p: Array) -> tuple[Array, Array | None]:
        """Return the vector and None: this channel has no unnamed terms."""
        return p, None

    @classmethod
    def build(cls, drive: GriddedDrive, noise: BodyNoise, geometry: Array, use: Mask | None = None) -> BodyChannel:
        """Build the channel with a noise model; the parameter vector `geometry` describes the motion roughly.

        `use` (P,) leaves single poses of the drive out.
        """
        window, keep = _windows(drive)
        samples = picked(drive.pose, keep)
        measured = _turned_as_the_wheels(drive, samples, drive.pose_values[keep], geometry)
        chosen = np.ones(samples.t_s.size, dtype=bool) if use is None else use[keep]
        starts = np.flatnonzero(drive.first)
        ends = np.append(starts[1:], drive.t_s.size) - 1
        run = np.searchsorted(starts, samples.node, side="right") - 1
        # Gains and weights come with the noise.
        nothing, none = np.empty(0), np.empty(0, dtype=bool)
        gains = BodyGains(nothing, nothing, nothing, none, none)
        channel = cls(drive, samples, measured, window, starts[run], ends[run], chosen, gains, nothing, noise, geometry)
        return channel.with_noise(noise)

    def motion(self) -> BodyMotion:
        """Return the robot's motion between the pose samples, from the wheels and the rough geometry."""
        drive, samples, p = self.drive, self.samples, self.geometry
        speeds = drive.speed_rad_s[samples.node]
        v = 0.5 * p[0] * (speeds[:, 0] + speeds[:, 1])
        omega = p[0] / p[1] * (speeds[:, 1] - speeds[:, 0])
        restart = np.concatenate([[True], np.diff(self.window) != 0])
        predicted = self.measured - self.raw_residual(p)
        step = np.diff(predicted, axis=0, prepend=predicted[:1])
        step[restart] = 0.0
        dt = np.diff(samples.t_s, prepend=samples.t_s[0])
        dt[restart] = 0.0
        rim_m_s = np.abs(speeds).max(axis=1) * p[0]
        moving = np.minimum(rim_m_s / self.settings.noise.slip_onset_m_s, 1.0)
        return BodyMotion(dt, step[:, 0], step[:, 1], predicted[:, 2], moving, v, omega, restart, self.use)

    def with_noise(self, noise: BodyNoise, use: Mask | None = None) -> BodyChannel:
        """Return the channel with another noise model and weights of 1; `use` is over this channel's samples."""
        changed = replace(self, noise=noise, use=self.use if use is None else use)
        gains, weight = body_gains(noise, changed.motion()), np.ones((self.samples.t_s.size, 3))
        return replace(changed, gains=gains, weight=weight)

    @property
    def neutral(self) -> Array:
        """The parameter vector without any effect, at the given geometry."""
        return np.concatenate([self.geometry[:BASE_COUNT], BODY.neutral[BASE_COUNT:]])

    @property
    def block(self) -> Index:
        """Block of time of each residual, (3 P,)."""
        return np.repeat(self.samples.block, 3)

    @property
    def count(self) -> int:
        """Number of residuals that are used, less the unknown starts."""
        return 3 * int(self.use.sum()) - 3 * int(self.window[-1] + 1)

    @property
    def trusted_blocks(self) -> float:
        """Weight of the noise model, as a number of blocks of time that agree with it."""
        return self.settings.noise.trusted_body_blocks

    def track(self, p: Array, extra: Array | None = None) -> Array:
        """Path at the nodes from the measured wheel angles, (M, 3)."""
        drive = self.drive
        perturbation = total_perturbation(drive, 3, drive.known_motion, extra)
        return run_body(p, drive.angle_rad, drive.speed_rad_s, perturbation, drive.first, drive.t_s)

    def carried(self, p: Array) -> Array:
        """Return how far the ground has carried the robot by each node, (M, 2), m in the world frame."""
        return carried(p, self.drive.speed_rad_s, self.drive.t_s)

    def raw_residual(self, p: Array, extra: Array | None = None) -> Array:
        """Measured minus predicted poses (P, 3) in the world, each window laid on its measurements."""
        return pose_residual(
            p,
            self.track(p, extra),
            self.carried(p),
            self.samples.node,
            self.samples.fraction,
            self.window,
            self.first_node,
            self.last_node,
            self.use,
            self.measured,
            self.drive.poses_moved_s,
        )

    def whitened(self, p: Array, extra: Array | None = None) -> Array:
        """Residuals of unit variance, not weighted, (P, 3)."""
        return whiten_body(self.raw_residual(p, extra), self.gains)

    def residual(self, p: Array, extra: Array | None = None) -> Array:
        """Whitened residuals, (3 P,)."""
        return (self.whitened(p, extra) * self.weight).ravel()


def total_perturbation(drive: GriddedDrive, width: int, *perturbations: Array | None) -> Array:
    """Sum (M, width) of what is added at the nodes by those that are there; not to be written to."""
    given = [perturbation for perturbation in perturbations if perturbation is not None]
    return sum(given[1:], given[0]) if given else np.zeros((drive.t_s.size, width))


def _windows(drive: GriddedDrive) -> tuple[Index, Mask]:
    """Window of each kept pose, numbered from 0, and which poses are kept (those in windows that are too thin are not).

    A window ends after a block of time, with its run, and where poses fail to come for long.
    """
    t, node, settings, block_s = drive.pose.t_s, drive.pose.node, drive.settings.noise, drive.settings.grid.block_s
    run = np.searchsorted(np.flatnonzero(drive.first), node, side="right")
    number = np.zeros(t.size, dtype=np.int64)
    current, begin = 0, 0
    for k in range(1, t.size):
        if run[k] != run[k - 1] or t[k] - t[begin] > block_s or t[k] - t[k - 1] > drive.settings.grid.longest_silence_s:
            current, begin = current + 1, k
        number[k] = current
    sizes = np.bincount(number, minlength=current + 1)
    keep = sizes[number] >= min(settings.shortest_window, int(np.median(sizes)))
    _, renumbered = np.unique(number[keep], return_inverse=True)
    return renumbered.astype(np.int64), keep


def _turned_as_the_wheels(drive: GriddedDrive, samples: GridSamples, measured: Array, geometry: Array) -> Array:
    """Poses (P, 3) with whole turns as the wheels make them: while no pose comes, it may be more than half of one."""
    perturbation = total_perturbation(drive, 3, drive.known_motion)
    track = run_body(geometry, drive.angle_rad, drive.speed_rad_s, perturbation, drive.first, drive.t_s)
    expected = np.empty(measured.shape)
    read_angles(track, samples.node, samples.fraction, expected)
    yaw = expected[:, 2] + np.unwrap(measured[:, 2] - expected[:, 2])
    return np.column_stack([measured[:, :2], yaw])
