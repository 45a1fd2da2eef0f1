"""Fence guard that scales or stops every wheel command whose stopping path would leave the fence.

Independent of planner and driver, without clock or I/O. In each tick it predicts, for a few scales of the requested
command, how the robot would stop after it: the last command goes on for the response time, the scaled command for the
driver's reaction time (as if the host died right then), and then the wheels slow down. The footprint must stay within
the fence at every point of that path, less three standard deviations of the pose. The largest scale whose path holds is
sent. So there is always a way to stop inside.

It fails closed: without a valid pose, with an obstacle whose reports have ceased, or with anything that is not a
number, the scale is zero.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw.estimation import PoseEstimate
from disco_hw.estimation.odometry import OdometryParameters
from disco_hw.fence.clearance import Boundaries, MovingCircle

Array = NDArray[np.float64]
SIGMAS = 3.0
"""Standard deviations of pose and geometry that the stopping path keeps away from the fence."""
SCALES = np.array([0.0, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0])
"""Parts of a command that are tried; the first is the stop itself."""
RELEASED_FROM = 3
"""A command that was stopped goes on once so large a scale (an index) is allowed, so that it does not flutter."""
# Chosen: points on each part of the stopping path; more see a clearance between two of them, and take longer in every
# tick.
_RESPONDING, _COASTED, _BRAKED = 3, 2, 3
# Less than any command that is meant as motion; what counts as stopped is held at zero.
STOPPED_RAD_S = 1e-3


class FenceVerdict(enum.Enum):
    """Verdicts of the guard on one command."""

    IDLE = "idle"
    FREE = "free"
    SCALED = "scaled"
    STOPPED = "stopped"
    NO_POSE = "no pose"
    OBSTACLE_LOST = "obstacle lost"
    OVERRIDDEN = "overridden"


STOPS_MOTION = frozenset({FenceVerdict.STOPPED, FenceVerdict.NO_POSE, FenceVerdict.OBSTACLE_LOST})
"""Verdicts that let no motion through."""


@dataclass(frozen=True, slots=True)
class StoppingSettings:
    """Settings of the predicted stop (s, rad/s^2).

    `response_s`: from a command to the wheels. `reaction_s`: how long the wheels are still driven once the host is
    silent, by the driver's safety card. `period_s`: of the control loop.
    """

    response_s: float
    reaction_s: float
    deceleration_rad_s2: float
    period_s: float

    def __post_init__(self) -> None:
        numbers = (self.response_s, self.reaction_s, self.deceleration_rad_s2, self.period_s)
        if not all(map(math.isfinite, numbers)) or min(numbers) < 0.0 or self.deceleration_rad_s2 == 0.0:
            raise ValueError(f"times must be 0 or more and the deceleration positive, all finite, not {numbers}")


class FenceState(msgspec.Struct, frozen=True, gc=False):
    """Result of the fence guard for one tick.

    `scale`: of the requested command that is let through. `clearance_m`: least on the stopping path after it, less the
    uncertainty; negative outside; at most the margin and twice the footprint's reach. `path`: that path, x, y (m),
    yaw (rad) of the tracked point.
    """

    verdict: FenceVerdict
    scale: float
    clearance_m: float
    path: tuple[tuple[float, float, float], ...] = ()
    reason: str = ""


IDLE = FenceState(FenceVerdict.IDLE, 1.0, math.inf)


class FenceGuard:
    """Decides in each tick which part of a command may be sent."""

    def __init__(self, boundaries: Boundaries, settings: StoppingSettings, margin_m: float) -> None:
        self.boundaries = boundaries
        """Boundaries that are kept away from."""
        self._settings = settings
        self._margin_m = margin_m
        self._obstacles: tuple[MovingCircle, ...] = ()
        self._missing: tuple[str, ...] = ()
        self._is_stopped = False

    @property
    def is_active(self) -> bool:
        """Whether there is a fence or an obstacle."""
        return self.boundaries.fence.is_set or bool(self._obstacles) or bool(self._missing)

    def set_boundaries(self, boundaries: Boundaries, margin_m: float) -> None:
        """Keep within another fence from the next step on."""
        boundaries.set_obstacles(self._obstacles)
        self.boundaries, self._margin_m = boundaries, margin_m

    def set_deceleration(self, deceleration_rad_s2: float) -> None:
        """Take the wheels to slow down so (rad/s^2), where the controller says less than robot.toml."""
        self._settings = replace(self._settings, deceleration_rad_s2=deceleration_rad_s2)

    def set_obstacles(self, obstacles: Sequence[MovingCircle], missing: Sequence[str] = ()) -> None:
        """Keep away from these circles, true now; `missing`: names of those whose reports have ceased."""
        self._obstacles, self._missing = tuple(obstacles), tuple(missing)
        self.boundaries.set_obstacles(self._obstacles)

    def step(
        self,
        estimate: PoseEstimate,
        geometry: OdometryParameters,
        last_sent: tuple[float, float],
        requested: tuple[float, float],
        overridden: bool = False,
    ) -> FenceState:
        """Judge the requested wheel speeds (rad/s, left and right); `last_sent` is what was commanded before.

        `overridden`: a person has asked to move in spite of the fence; nothing is scaled then.
        """
        if not self.is_active:
            return IDLE
        if overridden:
            return FenceState(FenceVerdict.OVERRIDDEN, 1.0, math.nan, reason="manual driving with the fence overridden")
        if self._missing:
            names = ", ".join(self._missing)
            text = f"obstacle {names} is no longer reported; report it again or remove it"
            return FenceState(FenceVerdict.OBSTACLE_LOST, 0.0, math.nan, reason=text)
        if not estimate.ok or not _are_finite(estimate, geometry, last_sent):
            text = "no valid pose while a fence is set; check the pose sensor"
            return FenceState(FenceVerdict.NO_POSE, 0.0, math.nan, reason=text)
        is_motion_requested = max(map(abs, requested)) > STOPPED_RAD_S if all(map(math.isfinite, requested)) else False
        desired = requested if is_motion_requested else (0.0, 0.0)
        # A path that overflows has no clearance, which stops the robot: a warning would say nothing more.
        with np.errstate(over="ignore", invalid="ignore"):
            poses, clearance, driven = self._stopping_paths(estimate, geometry, last_sent, desired)
        if not np.isfinite(clearance).all():
            return FenceState(FenceVerdict.NO_POSE, 0.0, math.nan, reason="the predicted stopping path is not finite")
        chosen = self._largest_scale(clearance, driven)
        if self._is_stopped and chosen < RELEASED_FROM:
            chosen = 0
        self._is_stopped = is_motion_requested and chosen == 0
        path = tuple(map(tuple, poses[chosen].tolist()))
        least = float(clearance[chosen].min())
        if not is_motion_requested:
            return FenceState(FenceVerdict.FREE, 1.0, least, path)
        if chosen == 0:
            x, y, _ = poses[-1][clearance[-1].min(axis=1).argmin()].tolist()
            where = f"the stopping path would leave the fence at ({x:.2f}, {y:.2f}); drive the robot away from there"
            return FenceState(FenceVerdict.STOPPED, 0.0, least, path, where)
        scale = float(SCALES[chosen])
        return FenceState(FenceVerdict.FREE if scale == 1.0 else FenceVerdict.SCALED, scale, least, path)

    def _largest_scale(self, clearance: Array, driven: Array) -> int:
        """Index of the largest scale whose stopping path is allowed; 0 if none is.

        `clearance` (S, K, M) to each shape along each path; `driven` (S, K): how far a corner moves to each point. A
        path may come as near to a shape as its part of the margin, or as near as stopping at once would, or lead away
        from the first point on; where stopping at once is too near already, the last alone will do.
        """
        # A clearance changes by no more than a corner moves, so this is the least between two points of the path.
        between = 0.5 * (clearance[:, 1:] + clearance[:, :-1] - driven[:, 1:, None])
        least = np.minimum(between.min(axis=1), clearance.min(axis=1))
        stopping = least[0]
        keeps_off = least >= np.minimum(SCALES[:, None] * self._margin_m, stopping)
        leads_away = (clearance >= clearance[:, :1]).all(axis=1) & (clearance[:, -1] > clearance[:, 0])
        allowed = (leads_away | (keeps_off & (stopping >= 0.0))).all(axis=1)
        return int(np.flatnonzero(allowed)[-1]) if allowed.any() else 0

    def _stopping_paths(
        self,
        estimate: PoseEstimate,
        geometry: OdometryParameters,
        last_sent: tuple[float, float],
        requested: tuple[float, float],
    ) -> tuple[Array, Array, Array]:
        """Poses (S, K, 3) after each scale of the command, clearances (S, K, M) less the uncertainty, steps (S, K).

        While the last command goes on the wheels turn as it says or as they are measured to, whichever path is nearer.
        """
        bounds, spread, count = self.boundaries, _spread(geometry), len(SCALES)
        reach_m = bounds.footprint.reach_m
        measured = (estimate.left_speed_rad_s, estimate.right_speed_rad_s)
        found = [self._paths(estimate, geometry, one, requested, spread) for one in (last_sent, measured)]
        poses, driven, time_s = (np.concatenate(each) for each in zip(*found, strict=True))
        clearance = bounds.clearances_m(
            poses.reshape(-1, 3), time_s.ravel(), within_m=self._margin_m + 2.0 * reach_m
        ).reshape(*poses.shape[:2], -1)
        turned = np.cumsum(np.abs(driven[..., 1]), axis=1)
        moved = np.cumsum(np.abs(driven[..., 0]), axis=1)
        unknown = spread.turn * turned * (reach_m + 0.5 * moved) + spread.x_icr_m * turned
        clearance -= (SIGMAS * corner_deviation_m(estimate, bounds) + unknown)[..., None]
        step = np.abs(driven[..., 0]) + reach_m * np.abs(driven[..., 1])
        nearer = np.minimum(clearance[:count], clearance[count:])
        return poses[:count], nearer, np.maximum(step[:count], step[count:])

    def _paths(
        self,
        estimate: PoseEstimate,
        geometry: OdometryParameters,
        wheels: tuple[float, float],
        requested: tuple[float, float],
        spread: _Spread,
    ) -> tuple[Array, Array, Array]:
        """Return the stopping paths (S, K, 3) for all scales.

        With them what is driven to each point (S, K, 2), m and rad; times (S, K), s.
        """
        settings, count = self._settings, len(SCALES)
        now, command = np.array(wheels), SCALES[:, None] * np.array(requested)
        reaction_s = settings.response_s + spread.distance * (estimate.pose_age_s or 0.0)
        tail_s = 1.5 * settings.period_s + settings.reaction_s
        # What of the present speed exceeds the command; all of it where the command is the other way.
        slowed = now - np.clip(command, np.minimum(now, 0.0), np.maximum(now, 0.0))
        turned = [
            np.zeros((count, 1, 2)),
            np.broadcast_to(now * (reaction_s / _RESPONDING), (count, _RESPONDING, 2)),
            self._braking(slowed, _COASTED),
            np.repeat(command[:, None, :] * (tail_s / _RESPONDING), _RESPONDING, axis=1),
            self._braking(command, _BRAKED),
        ]
        wheel_rad = np.concatenate(turned, axis=1)
        coast_s, brake_s = (np.abs(one).max(axis=1) / settings.deceleration_rad_s2 for one in (slowed, command))
        lasting_s = [
            np.zeros((count, 1)),
            np.full((count, _RESPONDING), reaction_s / _RESPONDING),
            coast_s[:, None] * _braking_parts(_COASTED),
            np.full((count, _RESPONDING), tail_s / _RESPONDING),
            brake_s[:, None] * _braking_parts(_BRAKED),
        ]
        radius, axle, x_icr = geometry.wheel_radius_m, geometry.axial_distance_m, geometry.x_icr_m
        moved = (1.0 + spread.distance) * 0.5 * radius * wheel_rad.sum(axis=2)
        yawed = (1.0 + spread.distance) * radius / axle * (wheel_rad[..., 1] - wheel_rad[..., 0])
        yaw = estimate.yaw_rad + np.cumsum(yawed, axis=1)
        middle = yaw - 0.5 * yawed
        # The chord of an arc: shorter than the arc by the sinc of half the angle.
        chord = moved * np.sinc(0.5 * yawed / math.pi)
        x = estimate.x_m + x_icr * math.cos(estimate.yaw_rad) + np.cumsum(chord * np.cos(middle), axis=1)
        y = estimate.y_m + x_icr * math.sin(estimate.yaw_rad) + np.cumsum(chord * np.sin(middle), axis=1)
        poses = np.stack([x - x_icr * np.cos(yaw), y - x_icr * np.sin(yaw), yaw], axis=2)
        # The tracked point moves sideways in a turn about a point ahead of it.
        moved = np.hypot(moved, x_icr * yawed)
        return poses, np.stack([moved, yawed], axis=2), np.cumsum(np.concatenate(lasting_s, axis=1), axis=1)

    def _braking(self, speeds: Array, steps: int) -> Array:
        """Return the wheel angles (S, steps, 2) turned in equal steps while braking from speeds (S, 2) to zero.

        The slower wheel takes as long as the faster one, so that the path keeps its curvature.
        """
        lasting_s = np.abs(speeds).max(axis=1, keepdims=True) / self._settings.deceleration_rad_s2
        distance = 0.5 * speeds * lasting_s
        return np.repeat(distance[:, None, :] / steps, steps, axis=1)


def _braking_parts(steps: int) -> Array:
    """Return which part of its braking time an evenly braked body takes for each of so many equal parts of its way."""
    return np.asarray(-np.diff(np.sqrt(np.linspace(1.0, 0.0, steps + 1))))


@dataclass(frozen=True, slots=True)
class _Spread:
    """Effect of three standard deviations of the belief: on a distance and a turn, as shares; on the turning centre."""

    distance: float
    turn: float
    x_icr_m: float


def _spread(geometry: OdometryParameters) -> _Spread:
    radius, axle = geometry.wheel_radius_m, geometry.axial_distance_m
    if geometry.covariance is None:
        return _Spread(0.0, 0.0, 0.0)
    covariance = geometry.covariance
    ratio = covariance[0][0] / radius**2 + covariance[1][1] / axle**2 - 2.0 * covariance[0][1] / (radius * axle)
    return _Spread(
        SIGMAS * math.sqrt(max(covariance[0][0], 0.0)) / radius,
        SIGMAS * math.sqrt(max(ratio, 0.0)),
        SIGMAS * math.sqrt(max(covariance[2][2], 0.0)),
    )


def corner_deviation_m(estimate: PoseEstimate, bounds: Boundaries) -> float:
    """Return the standard deviation (m) of the least known corner of the footprint, in its worst direction."""
    covariance = np.array(estimate.covariance)
    cos, sin = math.cos(estimate.yaw_rad), math.sin(estimate.yaw_rad)
    largest = 0.0
    for x, y in bounds.footprint.corners_m():
        jacobian = np.array([[1.0, 0.0, -sin * x - cos * y], [0.0, 1.0, cos * x - sin * y]])
        (xx, xy), (_, yy) = (jacobian @ covariance @ jacobian.T).tolist()
        largest = max(largest, 0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy))
    return math.sqrt(largest)


def _are_finite(estimate: PoseEstimate, geometry: OdometryParameters, last_sent: tuple[float, float]) -> bool:
    """Whether every number that the stopping path is made from is one."""
    numbers = (
        estimate.x_m, estimate.y_m, estimate.yaw_rad, estimate.left_speed_rad_s, estimate.right_speed_rad_s, *last_sent,
        geometry.wheel_radius_m, geometry.axial_distance_m, geometry.x_icr_m,
        *(value for row in (*estimate.covariance, *(geometry.covariance or ())) for value in row),
    )  # fmt: skip
    return all(map(math.isfinite, numbers))
