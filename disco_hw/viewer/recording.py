"""Data for the page: a robot (task, size, model), a log opened for looking at, and one instant of it.

A log's timeline is in memory; its plans are read when one is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from disco_hw.adaptation.guard import geometry_of, with_geometry
from disco_hw.control.parameter_points import unscented_points
from disco_hw.effects.registry import DELAY
from disco_hw.errors import InputError
from disco_hw.fence import Fence, Footprint
from disco_hw.log import records
from disco_hw.log.reader import Log
from disco_hw.log.records import TOPICS, BeliefChange, FrameIn, FrameOut, Plan, Task
from disco_hw.model import Model
from disco_hw.model.plain import RobotState, delayed, settled_means, step, theta_of
from disco_hw.runtime.pipeline import Source
from disco_hw.runtime.robot_setup import Setup, geometry, load_setup, setup_of_log, task_of
from disco_hw.tasks import RobotTask
from disco_hw.viewer.timeline import COVARIANCE, ESTIMATE, Timeline
from drivers.types import MotorSample, RobotLinkHealth, RobotStatus

Array = NDArray[np.float64]

_Timed = TypeVar("_Timed", records.Plan, records.Fan, records.GuardVerdict)
# Chosen: an older plan, rollout or pose says nothing of now; rollouts come once a second, with some delay.
PLAN_AGE_NS = 500_000_000
FAN_AGE_NS = 1_100_000_000
POSES_NS = 3_000_000_000
# Chosen: more would slow the browser down.
TRAIL_POINTS = 1500
# Chosen: more would cover one another.
_POSES = 100
# Chosen: lines of the list on the page.
_EVENTS = 8


@dataclass(frozen=True, eq=False, slots=True)
class Snapshot:
    """State of the robot as known at `t_ns`; unknown fields are None, NaN or empty.

    `pose` (x, y, yaw) m and rad, its `covariance` (3, 3); `speed_m_s`, `yaw_rate_rad_s`; `wheel_angles`,
    `wheel_speeds`, `command` (left, right) rad and rad/s; `plan` not older than half a second; `poses` (N, 3) measured
    in the last 3 s; `trail` (N, 2) of estimated positions; `fan` not older than 1.1 s; `task` where it is not the
    robot.toml's (`ShownRobot.task_at` makes one of both), `belief` where it is another than the model file's;
    `guard`: what the fence guard found not over half a second ago, `fence` where it is not the robot.toml's.
    """

    t_ns: int
    pose: tuple[float, float, float] | None
    covariance: Array
    speed_m_s: float
    yaw_rate_rad_s: float
    pose_healthy: bool
    wheel_angles: tuple[float, float]
    wheel_speeds: tuple[float, float] | None
    command: tuple[float, float] | None
    in_force: bool
    source: str
    plan: records.Plan | None
    poses: Array
    trail: Array
    state: records.DaemonState | None
    status: RobotStatus | None
    link: RobotLinkHealth | None
    lateness_us: float
    overruns: int
    skipped: int
    voltage_v: float
    current_a: float
    battery_c: float
    events: tuple[tuple[int, records.Event], ...]
    fan: records.Fan | None
    task: records.Task | None
    belief: records.BeliefChange | None
    adaptation: records.Adaptation | None
    guard: records.GuardVerdict | None = None
    fence: records.FenceChange | None = None


def snapshot_at(timeline: Timeline, t_ns: int, plan: records.Plan | None) -> Snapshot:
    """Cut the timeline at `t_ns`, with the plan of that time."""
    estimate, wheels, command = (series.last(t_ns) for series in (timeline.estimate, timeline.wheels, timeline.command))
    loop, power = timeline.loop.last(t_ns), timeline.power.last(t_ns)
    values = None if estimate is None else dict(zip(ESTIMATE, estimate[1].tolist(), strict=False))
    covariance = np.full((3, 3), np.nan) if estimate is None else estimate[1][-len(COVARIANCE) :].reshape(3, 3)
    return Snapshot(
        t_ns=t_ns,
        pose=None if values is None else (values["x_m"], values["y_m"], values["yaw_rad"]),
        covariance=covariance,
        speed_m_s=np.nan if values is None else values["speed_m_s"],
        yaw_rate_rad_s=np.nan if values is None else values["yaw_rate_rad_s"],
        pose_healthy=values is not None and bool(values["pose_healthy"]),
        wheel_angles=(0.0, 0.0) if wheels is None else (float(wheels[1][0]), float(wheels[1][1])),
        wheel_speeds=None if wheels is None else (float(wheels[1][2]), float(wheels[1][3])),
        command=None if command is None else (float(command[1][0]), float(command[1][1])),
        in_force=command is not None and bool(command[1][2]),
        source=timeline.source.last(t_ns) or "",
        plan=_fresh(plan, t_ns, PLAN_AGE_NS),
        poses=timeline.pose.rows(t_ns - POSES_NS, t_ns)[1][-_POSES:],
        trail=thinned(_positions(timeline, t_ns), TRAIL_POINTS),
        state=timeline.state.last(t_ns),
        status=timeline.status.last(t_ns),
        link=timeline.link.last(t_ns),
        lateness_us=np.nan if loop is None else float(loop[1][0]) * 1e-3,
        overruns=0 if loop is None else int(loop[1][1]),
        skipped=0 if loop is None else int(loop[1][2]),
        voltage_v=np.nan if power is None else float(power[1][0]),
        current_a=np.nan if power is None else float(power[1][1]),
        battery_c=np.nan if power is None else float(power[1][2]),
        events=tuple(timeline.events.latest(t_ns, _EVENTS)),
        fan=_fresh(timeline.fans.last(t_ns), t_ns, FAN_AGE_NS),
        task=timeline.tasks.last(t_ns),
        belief=timeline.beliefs.last(t_ns),
        adaptation=timeline.adaptations.last(t_ns),
        guard=_fresh(timeline.guards.last(t_ns), t_ns, PLAN_AGE_NS),
        fence=timeline.fences.last(t_ns),
    )


def _fresh(record: _Timed | None, t_ns: int, age_ns: int) -> _Timed | None:
    """Return the record if it is not older than `age_ns` at `t_ns`, and not newer."""
    return record if record is not None and 0 <= t_ns - record.t_ns <= age_ns else None


def _positions(timeline: Timeline, t_ns: int) -> Array:
    """Estimated positions (N, 2) up to `t_ns`, without those before there was a pose."""
    rows = timeline.estimate.rows(0, t_ns)[1]
    return np.asarray(rows[rows[:, ESTIMATE.index("pose_healthy")] > 0.0, :2])


def thinned(rows: Array, count: int) -> Array:
    """At most about `count` of the rows, evenly spread, always with the last one.

    The spacing doubles from time to time instead of creeping, so that a growing trail keeps the points it has.
    """
    if len(rows) <= count:
        return rows
    step = 1 << (int(np.ceil(len(rows) / count)) - 1).bit_length()
    return np.concatenate((rows[:-1:step], rows[-1:]))


class ParameterPoints:
    """The sigma points of a model's belief, ready to roll plans out; the mean alone if nothing is believed."""

    def __init__(self, model: Model) -> None:
        points, _ = unscented_points(model, 1.0)
        self._names = model.parameter_names
        self._points = points

    def trajectories(self, plan: Plan, wheel_speeds: tuple[float, float]) -> Array:
        """Positions (L, T + 1, 2) m of L sigma points from the plan's start, under its commands; (0, 0, 2) without.

        `wheel_speeds` (left, right) rad/s at the start. Commands sent before the plan are taken as its first, and what
        terms remember as that and these speeds for ever.
        """
        if not plan.path_x_m or not plan.left_rad_s:
            return np.empty((0, 0, 2))
        commands = np.column_stack((plan.left_rad_s, plan.right_rad_s))
        paths = [self._path(point, plan, commands, wheel_speeds) for point in self._delay_groups()]
        return np.concatenate(paths)

    def _delay_groups(self) -> list[Array]:
        """Points that can be stepped together: a delay shifts whole rows of commands."""
        if DELAY.columns[0] not in self._names:
            return [self._points]
        return [point[None] for point in self._points]

    def _path(self, points: Array, plan: Plan, commands: Array, wheel_speeds: tuple[float, float]) -> Array:
        theta = theta_of(self._names, points)
        if len(points) == 1:
            single = theta_of(self._names, points[0])
            commands = delayed(np.vstack((commands[:1], commands)), 1, single, plan.step_s)
        ones = np.ones(len(points))
        state = RobotState(
            plan.path_x_m[0] * ones,
            plan.path_y_m[0] * ones,
            plan.path_yaw_rad[0] * ones,
            wheel_speeds[0] * ones,
            wheel_speeds[1] * ones,
            settled_means(theta, commands[0, 0], commands[0, 1], *wheel_speeds),
        )
        path = np.empty((len(points), len(commands) + 1, 2))
        path[:, 0] = np.stack((state.x, state.y), axis=-1)
        for index, (left, right) in enumerate(commands):
            state, _, _ = step(theta, state, left, right, plan.step_s, index * plan.step_s)
            path[:, index + 1] = np.stack((state.x, state.y), axis=-1)
        return path


@dataclass(frozen=True, slots=True)
class ShownRobot:
    """The robot's name, its task, nominal size (m) and model.

    `x_icr_m` is the model's, `drive_top_rad_s` the fastest that a wheel is driven by hand; `fence` and `footprint` are
    robot.toml's. `drives_backwards`: along the task's line.
    """

    name: str
    task: RobotTask
    wheel_radius_m: float
    axial_distance_m: float
    x_icr_m: float
    drive_top_rad_s: float
    model: Model
    fence: Fence = Fence()  # noqa: RUF009 - it is frozen
    footprint: Footprint = Footprint(0.5, 0.4)  # noqa: RUF009 - it is frozen
    drives_backwards: bool = False

    def task_at(self, record: Task | None) -> RobotTask:
        """Return the task that is in force where this record of it is the newest; robot.toml's without one."""
        return self.task if record is None else task_of(record, self.task)


def model_in_force(model: Model, change: BeliefChange | None) -> Model:
    """Return the model with the belief that was put in force while driving; itself without one."""
    estimated = None if change is None else geometry_of(change)
    return model if estimated is None else with_geometry(model, estimated)


def stage_of_robot(robot_file: Path, model_file: Path | None = None) -> ShownRobot:
    """Create the stage from robot.toml and the model it names; raises InputError."""
    return _stage(load_setup(robot_file, model_file))


def _stage(setup: Setup) -> ShownRobot:
    robot = setup.config.robot
    return ShownRobot(
        name=robot.name,
        task=setup.config.task,
        wheel_radius_m=robot.wheel_radius_m,
        axial_distance_m=robot.axial_distance_m,
        x_icr_m=geometry(setup.model)[0][2],
        drive_top_rad_s=setup.config.drive.speed_share * robot.max_wheel_speed_rad_s,
        model=setup.model,
        fence=setup.config.fence,
        footprint=robot.footprint,
        drives_backwards=bool(setup.config.turned_rad),
    )


_UNSEEN = (FrameIn, FrameOut, MotorSample)
_DRIVING = frozenset({Source.PLAN.value, Source.FALLBACK.value, Source.MANUAL.value})
_SHOWN = tuple(topic.name for topic in TOPICS if topic.record not in _UNSEEN)


class Recording:
    """An open log with its robot; `ticks` (N,) are the times of its ticks, ns. Close it, or use it in `with`."""

    def __init__(self, path: Path, robot_file: Path | None = None) -> None:
        self._log = Log(path)
        try:
            if "/estimate" not in self._log.counts:
                raise InputError(f"{path}: holds no estimates, so there is nothing to show; give a log of `run`")
            setup = load_setup(robot_file) if robot_file else setup_of_log(self._log, "name the robot with --robot")
            self.stage: ShownRobot = _stage(setup)
            self.timeline = Timeline()
            for now_ns, record in self._log.brief_records(_SHOWN):
                self.timeline.add(now_ns, record)
            self.ticks: NDArray[np.int64] = self.timeline.estimate.rows(0, np.iinfo(np.int64).max)[0]
        except BaseException:
            self._log.close()
            raise

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the recording's file; safe to call twice."""
        self._log.close()

    @property
    def first_ns(self) -> int:
        """Time of the first tick."""
        return int(self.ticks[0])

    @property
    def duration_s(self) -> float:
        """Duration from the first tick to the last, s."""
        return float(self.ticks[-1] - self.ticks[0]) * 1e-9

    @property
    def task_start_s(self) -> float:
        """Seconds from the first tick to the first that drives: by the task's plan, or by hand; 0 if none does."""
        driven = (t_ns for t_ns, source in self.timeline.source if source in _DRIVING)
        return (next(driven, self.first_ns) - self.first_ns) * 1e-9

    def at(self, t_s: float) -> Snapshot:
        """Return the instant of the last tick at or before `t_s` seconds from the first; the ends beyond them."""
        t_ns = int(self.ticks[self.tick_at(t_s)])
        return snapshot_at(self.timeline, t_ns, self._plan_at(t_ns))

    def tick_at(self, t_s: float) -> int:
        """Return the number of the last tick at or before `t_s`, from 0 on."""
        t_ns = self.first_ns + round(t_s * 1e9)
        return min(max(int(np.searchsorted(self.ticks, t_ns, "right")) - 1, 0), len(self.ticks) - 1)

    def seconds_of(self, tick: int) -> float:
        """Seconds from the first tick to this one."""
        return float(self.ticks[min(max(tick, 0), len(self.ticks) - 1)] - self.first_ns) * 1e-9

    def _plan_at(self, t_ns: int) -> Plan | None:
        newest = None
        for entry in self._log.records(("/plan",), t_ns - PLAN_AGE_NS, t_ns + 1):
            newest = entry.record
        return newest if isinstance(newest, Plan) else None
