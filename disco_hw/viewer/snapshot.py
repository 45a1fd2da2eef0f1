"""One instant of a run as the page shows it, cut from a timeline; the live page cuts at its end, a replay anywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.parameter_points import unscented_points
from disco_hw.effects.registry import DELAY
from disco_hw.log import records
from disco_hw.log.records import Plan
from disco_hw.model import Model
from disco_hw.model.plain import RobotState, delayed, step, theta_of
from disco_hw.viewer.timeline import COVARIANCE, ESTIMATE, Timeline
from drivers.types import RobotLinkHealth, RobotStatus

Array = NDArray[np.float64]

PLAN_AGE_NS = 500_000_000
FAN_AGE_NS = 1_100_000_000
POSES_NS = 3_000_000_000
TRAIL_POINTS = 1500
_POSES = 100
_EVENTS = 8


@dataclass(frozen=True, eq=False, slots=True)
class Snapshot:
    """What was known at `t_ns`; a thing of which nothing was known is None, NaN or empty.

    `pose` (x, y, yaw) m and rad, its `covariance` (3, 3); `speed_m_s`, `yaw_rate_rad_s`; `wheel_angles`,
    `wheel_speeds`, `command` (left, right) rad and rad/s; `plan` not older than half a second; `poses` (N, 3) measured
    in the last 3 s; `trail` (N, 2) of estimated positions; `fan` not older than 1.1 s; `task` where it is not the
    robot.toml's (`ShownRobot.task_at` makes one of both), `belief` where it is another than the model file's.
    """

    t_ns: int
    pose: tuple[float, float, float] | None
    covariance: Array
    speed_m_s: float
    yaw_rate_rad_s: float
    wheels_healthy: bool
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
    counters: records.Counters | None
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


def snapshot_at(timeline: Timeline, t_ns: int, plan: records.Plan | None) -> Snapshot:
    """Cut the timeline at `t_ns`, with the plan of that time."""
    estimate, wheels, command = (series.last(t_ns) for series in (timeline.estimate, timeline.wheels, timeline.command))
    loop, power = timeline.loop.last(t_ns), timeline.power.last(t_ns)
    values = None if estimate is None else dict(zip(ESTIMATE, estimate[1].tolist(), strict=False))
    covariance = np.full((3, 3), np.nan) if estimate is None else estimate[1][-len(COVARIANCE) :].reshape(3, 3)
    fresh = plan is not None and 0 <= t_ns - plan.t_ns <= PLAN_AGE_NS
    return Snapshot(
        t_ns=t_ns,
        pose=None if values is None else (values["x_m"], values["y_m"], values["yaw_rad"]),
        covariance=covariance,
        speed_m_s=np.nan if values is None else values["speed_m_s"],
        yaw_rate_rad_s=np.nan if values is None else values["yaw_rate_rad_s"],
        wheels_healthy=values is not None and bool(values["wheels_healthy"]),
        pose_healthy=values is not None and bool(values["pose_healthy"]),
        wheel_angles=(0.0, 0.0) if wheels is None else (float(wheels[1][0]), float(wheels[1][1])),
        wheel_speeds=None if wheels is None else (float(wheels[1][2]), float(wheels[1][3])),
        command=None if command is None else (float(command[1][2]), float(command[1][3])),
        in_force=command is not None and bool(command[1][4]),
        source=timeline.source.last(t_ns) or "",
        plan=plan if fresh else None,
        poses=timeline.pose.rows(t_ns - POSES_NS, t_ns)[1][-_POSES:],
        trail=thinned(_positions(timeline, t_ns), TRAIL_POINTS),
        state=timeline.state.last(t_ns),
        status=timeline.status.last(t_ns),
        link=timeline.link.last(t_ns),
        counters=timeline.counters.last(t_ns),
        lateness_us=np.nan if loop is None else float(loop[1][0]) * 1e-3,
        overruns=0 if loop is None else int(loop[1][1]),
        skipped=0 if loop is None else int(loop[1][2]),
        voltage_v=np.nan if power is None else float(power[1][0]),
        current_a=np.nan if power is None else float(power[1][1]),
        battery_c=np.nan if power is None else float(power[1][2]),
        events=tuple(timeline.events.latest(t_ns, _EVENTS)),
        fan=_fresh_fan(timeline, t_ns),
        task=timeline.tasks.last(t_ns),
        belief=timeline.beliefs.last(t_ns),
        adaptation=timeline.adaptations.last(t_ns),
    )


def _fresh_fan(timeline: Timeline, t_ns: int) -> records.Fan | None:
    fan = timeline.fans.last(t_ns)
    return fan if fan is not None and t_ns - fan.t_ns <= FAN_AGE_NS else None


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

    def __init__(self, model: Model, alpha: float = 1.0) -> None:
        points, _ = unscented_points(model, alpha)
        self._names = model.parameter_names
        self._points = points

    def trajectories(self, plan: Plan, wheel_speeds: tuple[float, float]) -> Array:
        """Positions (L, T + 1, 2) m of L sigma points from the plan's start, under its commands; (0, 0, 2) without.

        `wheel_speeds` (left, right) rad/s at the start. Commands sent before the plan are taken as its first.
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
        )
        path = np.empty((len(points), len(commands) + 1, 2))
        path[:, 0] = np.stack((state.x, state.y), axis=-1)
        for index, (left, right) in enumerate(commands):
            state, _, _ = step(theta, state, left, right, plan.step_s, index * plan.step_s)
            path[:, index + 1] = np.stack((state.x, state.y), axis=-1)
        return path
