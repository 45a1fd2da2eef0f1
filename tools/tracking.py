"""Drives of controllers on foreign robots, in simulated time, through the project's own estimator, governor and tick.

Nobody is told a robot's wheel radius, axle and centre of rotation; its motor lag and dead band are known to all.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from disco_hw.adaptation import NoAdaptation
from disco_hw.adaptation.fast import FastAdaptation
from disco_hw.adaptation.guard import believed_geometry
from disco_hw.config import Estimation
from disco_hw.control import CommandLimits, Disco, DiscoSettings
from disco_hw.control.baselines import Follower, Law, Reference
from disco_hw.control.kernel.guide import SteeredChassis
from disco_hw.control.plan import ROTATION
from disco_hw.estimation import PoseFusion
from disco_hw.estimation.odometry import OdometryParameters
from disco_hw.fence import Fence, Footprint
from disco_hw.fence.clearance import Boundaries
from disco_hw.model import Gaussian, Model
from disco_hw.model.model import EffectSetting
from disco_hw.runtime.assembly import apply_geometry
from disco_hw.runtime.fence_guard import FenceGuard, StoppingSettings
from disco_hw.runtime.pipeline import FollowTask, Governor, Pipeline, Planner, WheelLimits
from disco_hw.tasks import PlannedTask
from disco_hw.tasks.circle import CircleCost, CircleCourse
from disco_hw.tasks.lemniscate import LemniscateTask
from disco_hw.tasks.line import Waypoints, planned_table
from disco_hw.tasks.line.cost import PathCost
from disco_hw.tasks.line.course import LineCourse, line_course
from disco_hw.tasks.timed_path import TimedPathCost
from drivers.types import Readings
from tools.foreign_plant import NOMINAL, ForeignPlant, ForeignRobot

Array = NDArray[np.float64]

NAMES = ("wheel_radius_m", "axial_distance_m", "x_icr_m")
LIMITS = CommandLimits(8.0, 20.0)
SPREAD, KNOWN_SPREAD = 0.15, 0.004
TICK_MS = 20
SETTLED_S, DURATION_S = 5.0, 30.0


@dataclass(frozen=True, eq=False)
class Track:
    """A way to drive: its line, its cost, its way-points, where to start.

    `sampled`: the cost where plans are not refined; None where it is the same.
    """

    course: LineCourse | CircleCourse
    task: PlannedTask
    points_m: Array
    sampled: PlannedTask | None = None

    @property
    def start(self) -> tuple[float, float, float]:
        """On the line, along it."""
        return self.course.start


def line_track(points: tuple[tuple[float, float], ...], speed_m_s: float) -> Track:
    """A line of way-points."""
    refined, sampled = (PathCost(planned_table(points, mode), speed_m_s) for mode in ("default", "sampled"))
    return Track(line_course(points, "line"), refined, np.array(points), sampled)


def circle_track(radius_m: float, speed_m_s: float) -> Track:
    """A circle round the origin."""
    angle = np.linspace(0.0, 2.0 * math.pi, 721)
    points = radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
    points[-1] = points[0]
    cost = CircleCost(radius_m=radius_m, speed_m_s=speed_m_s)
    return Track(CircleCourse(0.0, 0.0, radius_m), cost, points)


def tracks(speed_m_s: float = 0.2) -> dict[str, Track]:
    """The ways of the table."""
    x = np.linspace(0.0, 8.0, 401)
    slalom = tuple(zip(x.tolist(), (0.25 * np.sin(2.0 * math.pi * x / 1.8)).tolist(), strict=True))
    return {
        "circle": circle_track(0.75, speed_m_s),
        "eight": line_track(LemniscateTask(size_m=1.5).points(), speed_m_s),
        "square": line_track(((0.0, 0.0), (1.5, 0.0), (1.5, 1.5), (0.0, 1.5), (0.0, 0.0)), speed_m_s),
        "slalom": line_track(slalom, speed_m_s),
    }


def timed(track: Track, speed_m_s: float) -> Track:
    """The same way as way-points by time; a closed one is gone round until the drive ends."""
    ways = [track.points_m]
    length_m = float(np.hypot(*np.diff(track.points_m, axis=0).T).sum())
    if np.hypot(*(track.points_m[-1] - track.points_m[0])) < 1e-6:
        ways += [track.points_m[1:]] * math.ceil(DURATION_S * speed_m_s / length_m)
    places_m = np.concatenate(ways)
    times_s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(places_m, axis=0).T))]) / speed_m_s
    return replace(track, task=TimedPathCost(Waypoints(places_m, times_s)))


def belief(mean: tuple[float, ...] = NOMINAL, spread: float = SPREAD) -> Gaussian:
    """Return the belief over a robot's geometry before it drives."""
    values = np.array(mean)
    return Gaussian(NAMES, values, np.diag((spread / math.sqrt(3.0) * values) ** 2))


def model(robot: ForeignRobot, known: bool = False) -> Model:
    """The robot's lag and dead band with the nominal geometry; `known`: with its own."""
    mean = _geometry(robot, known)
    effects = [EffectSetting("motor_lag", {"tau_s": robot.lag_s})]
    if robot.dead_rad_s:
        effects.insert(0, EffectSetting("deadband", {"width_rad_s": robot.dead_rad_s}))
    return Model(*mean, tuple(effects), belief(mean, KNOWN_SPREAD if known else SPREAD), "foreign")


def _geometry(robot: ForeignRobot, known: bool) -> tuple[float, float, float]:
    """Wheel radius, axle and x_icr that a controller is given."""
    return (robot.radius_m, robot.axle_m, robot.x_icr_m) if known else robot.believed


def fusion(mean: tuple[float, ...], spread: float = SPREAD) -> PoseFusion:
    """The estimator with this geometry."""
    rows = belief(mean, spread).covariance().tolist()
    return PoseFusion(Estimation(), OdometryParameters(*mean, tuple(map(tuple, rows))), 0.1)


@dataclass(frozen=True)
class Contender:
    """A planner for a robot and a track; whether it knows the geometry and whether it learns it."""

    planner: Callable[[ForeignRobot, Track], Planner]
    knows: bool = False
    learns: bool = False


def classical(law: Law, speed_m_s: float = 0.2, knows: bool = False) -> Contender:
    """A follower with this law."""

    def made(robot: ForeignRobot, track: Track) -> Planner:
        geometry = _geometry(robot, knows)
        chassis = SteeredChassis(*geometry, robot.lag_s, robot.dead_rad_s)
        return Follower(Reference(track.points_m, speed_m_s, geometry[2]), law, chassis, LIMITS)

    return Contender(made, knows)


def disco(settings: DiscoSettings, knows: bool = False, learns: bool = False, seed: int = 1) -> Contender:
    """DISCO with these settings."""

    def made(robot: ForeignRobot, track: Track) -> Planner:
        task = track.task if settings.refine or track.sampled is None else track.sampled
        return Disco(model(robot, knows), task, settings, LIMITS, seed)

    return Contender(made, knows, learns)


@dataclass(frozen=True, eq=False)
class Drive:
    """Record of N ticks of a drive.

    Time (s), true pose (N, 3), forward speed (m/s), commands (N, 2) rad/s, distance to the right (m).
    """

    t_s: Array
    pose: Array
    forward_m_s: Array
    commands: Array
    off_m: Array

    def after(self, settled_s: float = SETTLED_S) -> Drive:
        """The drive from a time on."""
        part = self.t_s >= settled_s
        return Drive(self.t_s[part], self.pose[part], self.forward_m_s[part], self.commands[part], self.off_m[part])

    @property
    def rms_mm(self) -> float:
        """Root mean square of the distance, mm."""
        return 1e3 * float(np.sqrt(np.mean(self.off_m**2)))

    @property
    def signed_mm(self) -> float:
        """Mean distance, positive to the right: outside of a circle."""
        return 1e3 * float(self.off_m.mean())

    @property
    def speed_m_s(self) -> float:
        """Length of the way over the time."""
        length = np.hypot(*np.diff(self.pose[:, :2], axis=0).T).sum()
        return float(length / (self.t_s[-1] - self.t_s[0]))

    @property
    def travel_rot_s2(self) -> float:
        """Mean change of a command in a second, rotations/s^2."""
        span_s = self.t_s[-1] - self.t_s[0]
        return float(np.abs(np.diff(self.commands, axis=0)).sum() / 2.0 / span_s / ROTATION)


def drive(
    contender: Contender, robot: ForeignRobot, track: Track, *, rate_hz: float = 50.0, duration_s: float = DURATION_S,
    seed: int = 1, start: tuple[float, float, float] | None = None,
    listen: Callable[[Readings], object] = lambda readings: None,
    plant_of: Callable[[ForeignRobot, tuple[float, float, float], int], ForeignPlant] = ForeignPlant,
) -> Drive:  # fmt: skip
    """One drive from rest; `listen` gets what the sensors say, `plant_of` makes the robot that is driven."""
    plant = plant_of(robot, start or track.start, seed)
    mean, spread = _geometry(robot, contender.knows), KNOWN_SPREAD if contender.knows else SPREAD
    period_s = 1.0 / rate_hz
    governor = Governor(WheelLimits(LIMITS.speed_rad_s, *[LIMITS.acceleration_rad_s2] * 2), period_s)
    planner = contender.planner(robot, track)
    no_fence = FenceGuard(
        Boundaries(Footprint(0.5, 0.4, 0.0), Fence()), StoppingSettings(0.1, 0.1, 20.0, period_s), 0.0
    )
    pipeline = Pipeline(fusion(mean, spread), planner, governor, 0.2, no_fence)
    adaptation = _learner(robot, pipeline) if contender.learns else NoAdaptation()
    every_ms = round(1e3 * period_s)
    rows: list[tuple[float, ...]] = []
    wheels, poses = [], []
    command = (0.0, 0.0)
    while plant.now_ms < 1e3 * duration_s:
        readings = plant.readings()
        listen(readings)
        wheels += readings.wheels
        poses += readings.poses
        if plant.now_ms % every_ms == 0:
            adaptation.step(plant.now_ns)
            gathered = Readings(wheels=tuple(wheels), poses=tuple(poses))
            tick = pipeline.step(plant.now_ns, gathered, FollowTask())
            adaptation.feed(plant.now_ns, gathered)
            wheels, poses = [], []
            if tick.estimate.initialised:
                command = (tick.command.left_rad_s, tick.command.right_rad_s)
            rows.append((plant.now_ms * 1e-3, *plant.pose, plant.forward_m_s, *command))
        plant.advance(*command, TICK_MS)
    table = np.array(rows)
    return Drive(table[:, 0], table[:, 1:4], table[:, 4], table[:, 5:7], track.course.off_m(table[:, 1:3]))


def _learner(robot: ForeignRobot, pipeline: Pipeline) -> FastAdaptation:
    """The filter beside this pipeline."""
    believed = model(robot)
    mean = believed_geometry(believed)
    low, high = np.sort([0.5 * mean.mean, 1.5 * mean.mean], axis=0)
    return FastAdaptation(mean, low, high, lambda geometry: apply_geometry(pipeline, believed, geometry))
