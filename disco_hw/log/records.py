"""Record types of a log: one frozen type for each topic, the one source of its content and of its schema.

Every record carries `t_ns`, the monotonic host time at which it was true. Left before right, x forward, y left, yaw
counter-clockwise; SI units. Fields are plain on purpose (numbers, text, flat tuples, string-keyed counts): viewers
read the schema made from them without a plug-in. Adding a field with a default keeps old logs readable.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite, nan
from types import MappingProxyType
from typing import Literal

import msgspec

from drivers.types import MotorSample, PoseSample, PowerSample, RobotLinkHealth, RobotStatus, WheelSample

Level = Literal["debug", "info", "warning", "error", "fatal"]


class FrameIn(msgspec.Struct, frozen=True, gc=False):
    """A frame as it came in at `t_ns`; bit 31 of `can_id` marks 29-bit identifiers, as in Linux."""

    t_ns: int
    can_id: int
    data: bytes


class FrameOut(msgspec.Struct, frozen=True, gc=False):
    """A frame handed to the link at `t_ns`; `sent` is False if the link refused it or it was too late to send."""

    t_ns: int
    can_id: int
    data: bytes
    deadline_ns: int
    sent: bool = True


class Estimate(msgspec.Struct, frozen=True, gc=False):
    """Fused pose and motion in the world frame; `covariance` is 3 x 3 of (x, y, yaw), row-major, in m and rad."""

    t_ns: int
    x_m: float
    y_m: float
    yaw_rad: float
    covariance: tuple[float, ...]
    speed_m_s: float
    yaw_rate_rad_s: float
    left_speed_rad_s: float
    right_speed_rad_s: float
    wheels_healthy: bool = True
    pose_healthy: bool = True


class Innovation(msgspec.Struct, frozen=True, gc=False):
    """Result of fusing one measured pose.

    `innovation` is measured minus predicted (x, y, yaw), `variance` the diagonal of its covariance S, `test_ratio` the
    squared Mahalanobis distance over the gate (accepted at or below 1), `reason` why the pose was not used.
    """

    t_ns: int
    innovation: tuple[float, ...]
    variance: tuple[float, ...]
    test_ratio: float
    accepted: bool
    reason: str = ""


class Plan(msgspec.Struct, frozen=True, gc=False):
    """A plan made at `t_ns`: wheel speeds from `t0_ns` on, each held for `step_s`; the predicted path may be empty."""

    t_ns: int
    t0_ns: int
    step_s: float
    left_rad_s: tuple[float, ...]
    right_rad_s: tuple[float, ...]
    effective_samples: float = nan
    temperature: float = nan
    min_cost: float = nan
    mean_cost: float = nan
    path_x_m: tuple[float, ...] = ()
    path_y_m: tuple[float, ...] = ()
    path_yaw_rad: tuple[float, ...] = ()


class PlanFigures(msgspec.Struct, frozen=True, gc=False):
    """The figures of a recorded plan without its steps and its path, which are most of a log; never recorded itself."""

    t_ns: int
    effective_samples: float = nan
    temperature: float = nan
    min_cost: float = nan
    mean_cost: float = nan


class Command(msgspec.Struct, frozen=True, gc=False):
    """The wheel command of one tick as it was asked for and as it was sent.

    `source` says who asked (plan, tail of an old plan, ramp, manual, ...), `limits` what changed it on the way, and
    `in_force` is False while the robot is not armed, when nothing is commanded. `plan_age_ns` is -1 without a plan.
    """

    t_ns: int
    requested_left_rad_s: float
    requested_right_rad_s: float
    left_rad_s: float
    right_rad_s: float
    valid_for_s: float
    in_force: bool
    source: str = ""
    limits: tuple[str, ...] = ()
    plan_age_ns: int = -1


class LoopTiming(msgspec.Struct, frozen=True, gc=False):
    """Timing of one tick: `t_ns` is the planned wake-up; overruns and skipped periods are totals since the start."""

    t_ns: int
    tick: int
    woke_ns: int
    lateness_ns: int
    stages_ns: dict[str, int]
    overruns: int = 0
    skipped: int = 0


class DaemonState(msgspec.Struct, frozen=True, gc=False):
    """A change of the daemon's state or of what it says of it, which is `reason`; `previous` is then the same state.

    `running`: the task; `estop`: to be shown as such.
    """

    t_ns: int
    state: str
    previous: str
    reason: str = ""
    running: bool = False
    estop: bool = False


class Event(msgspec.Struct, frozen=True, gc=False):
    """Event that the operator should know; `code` is stable for machines, `text` is one sentence."""

    t_ns: int
    level: Level
    code: str
    text: str


class Counters(msgspec.Struct, frozen=True, gc=False):
    """Counters of the whole stack, about once a second: totals since the start by name, grouped by who counts.

    `entered`: how often the daemon has come into each of its states. `plausibility`: what the robot did against its
    commands, and the rest of the stack tolerated. `poses`: of each source, where there are several.
    """

    t_ns: int
    transport: dict[str, int] = {}
    driver: dict[str, int] = {}
    fusion: dict[str, int] = {}
    recorder: dict[str, int] = {}
    loop: dict[str, int] = {}
    adaptation: dict[str, int] = {}
    entered: dict[str, int] = {}
    plausibility: dict[str, int] = {}
    poses: dict[str, int] = {}


class BeliefChange(msgspec.Struct, frozen=True, gc=False):
    """The belief over parameters that planner and estimator use from this tick on.

    `source` is "adapted" for one learnt from the running drive, or "model" for the model file's again, with empty
    arrays. `covariance` is row-major in the order of `names`, SI units. `drift_x_m_s`, `drift_y_m_s`: how fast the
    ground carries the moving robot in the world frame, as on a slope. `lateral_lag_s`: how long the body's sideways
    speed lags behind its turning.
    """

    t_ns: int
    source: str
    names: tuple[str, ...] = ()
    mean: tuple[float, ...] = ()
    covariance: tuple[float, ...] = ()
    reason: str = ""
    drift_x_m_s: float = 0.0
    drift_y_m_s: float = 0.0
    lateral_lag_s: float = 0.0


class Adaptation(msgspec.Struct, frozen=True, gc=False):
    """Result of one step of adaptation: `outcome` for machines, `text` for the operator.

    refused: an estimate that failed a check; reverted: the model file's belief is in force again. Logs up to version
    0.1 also hold published, confirming, agrees, idle, lost, audit and taken_over, of estimators that no longer exist;
    `mean`, `std` (order of `names`) and `data_s` of driving belong to these.
    """

    t_ns: int
    outcome: str
    text: str
    estimator: str = ""
    names: tuple[str, ...] = ()
    mean: tuple[float, ...] = ()
    std: tuple[float, ...] = ()
    data_s: float = 0.0


class Fan(msgspec.Struct, frozen=True, gc=False):
    """Sampled sequences that the plan made at `t_ns` was weighted from, rolled out under the mean parameters.

    One path for each of `weights`, which are shares of all samples' total, the largest first. `x_m` and `y_m` hold the
    paths one after the other, of equally many points each, to the millimetre.
    """

    t_ns: int
    weights: tuple[float, ...]
    x_m: tuple[float, ...]
    y_m: tuple[float, ...]


class Task(msgspec.Struct, frozen=True, gc=False):
    """The task from `t_ns` on, where it is another than robot.toml's: its kind, and what a person can change of it.

    `settings`: fields of [task] in robot.toml, m and m/s. The last four are how logs were written before those.
    """

    t_ns: int
    kind: str = ""
    settings: dict[str, float] = {}
    center_x_m: float = nan
    center_y_m: float = nan
    radius_m: float = nan
    speed_m_s: float = nan

    def values(self) -> dict[str, float]:
        """Return the settings, of old and new logs."""
        old = (self.center_x_m, self.center_y_m, self.radius_m, self.speed_m_s)
        names = ("center_x_m", "center_y_m", "radius_m", "speed_m_s")
        kept = {name: value for name, value in zip(names, old, strict=True) if isfinite(value)}
        return kept | self.settings


class Controller(msgspec.Struct, frozen=True, gc=False):
    """Motor controller that answers from `t_ns` on, and its limits.

    `said_by`: who says kind and firmware, "device" or "robot.toml". Limits by name, with their units: what the
    controller reports of itself, what cannot be set otherwise, and what robot.toml declares.
    """

    t_ns: int
    controller: str
    firmware: str
    details: str
    said_by: str
    told: dict[str, float] = {}
    fixed: dict[str, float] = {}
    declared: dict[str, float] = {}


class GuardVerdict(msgspec.Struct, frozen=True, gc=False):
    """Verdict of the fence guard on the command of one tick, while there is a fence or an obstacle.

    `scale`: of the requested command that was let through. `clearance_m`: least along the stopping path after it, less
    the uncertainty of the pose. The rest in every fifth tick: that path of the tracked point, and the obstacles as x, y
    and radius of one after the other (m).
    """

    t_ns: int
    verdict: str
    scale: float
    clearance_m: float
    overridden: bool = False
    reason: str = ""
    path_x_m: tuple[float, ...] = ()
    path_y_m: tuple[float, ...] = ()
    path_yaw_rad: tuple[float, ...] = ()
    obstacles: tuple[float, ...] = ()


class FenceChange(msgspec.Struct, frozen=True, gc=False):
    """The fence from `t_ns` on, where it is another than robot.toml's: [fence] as JSON."""

    t_ns: int
    fence: str


class Obstacle(msgspec.Struct, frozen=True, gc=False):
    """A report of an obstacle taken in at `t_ns`, or its removal; fields as in `runtime.obstacles.ObstacleReport`."""

    t_ns: int
    name: str
    x_m: float = nan
    y_m: float = nan
    radius_m: float = nan
    vx_m_s: float = 0.0
    vy_m_s: float = 0.0
    age_s: float = 0.0
    age_limit_s: float = 0.0
    removed: bool = False


Record = (
    FrameIn
    | FrameOut
    | WheelSample
    | PoseSample
    | MotorSample
    | PowerSample
    | RobotStatus
    | RobotLinkHealth
    | Estimate
    | Innovation
    | Plan
    | Command
    | LoopTiming
    | DaemonState
    | Event
    | Counters
    | BeliefChange
    | Adaptation
    | Task
    | Fan
    | Controller
    | GuardVerdict
    | FenceChange
    | Obstacle
)


@dataclass(frozen=True, slots=True)
class Topic:
    """A name in the log and the one record type found under it."""

    name: str
    record: type[Record]


TOPICS: tuple[Topic, ...] = (
    Topic("/can/rx", FrameIn),
    Topic("/can/tx", FrameOut),
    Topic("/wheels", WheelSample),
    Topic("/pose", PoseSample),
    Topic("/motor", MotorSample),
    Topic("/power", PowerSample),
    Topic("/robot/status", RobotStatus),
    Topic("/robot/link", RobotLinkHealth),
    Topic("/estimate", Estimate),
    Topic("/estimate/innovation", Innovation),
    Topic("/plan", Plan),
    Topic("/command", Command),
    Topic("/loop", LoopTiming),
    Topic("/daemon/state", DaemonState),
    Topic("/event", Event),
    Topic("/counters", Counters),
    Topic("/task", Task),
    Topic("/plan/rollouts", Fan),
    Topic("/belief", BeliefChange),
    Topic("/adapt", Adaptation),
    Topic("/controller", Controller),
    Topic("/fence/guard", GuardVerdict),
    Topic("/fence", FenceChange),
    Topic("/obstacle", Obstacle),
)

STATES: frozenset[type] = frozenset({DaemonState, Task, BeliefChange, Controller, FenceChange})
"""Types of the records that hold until the next of the same type; each file of a log begins with those in force."""

TOPIC_INDEX: Mapping[type, int] = MappingProxyType({topic.record: index for index, topic in enumerate(TOPICS)})
TOPIC_BY_NAME: Mapping[str, Topic] = MappingProxyType({topic.name: topic for topic in TOPICS})


def topic_of(record_type: type[Record]) -> str:
    """Return the topic under which records of this type are found; KeyError if the type is none of ours."""
    return TOPICS[TOPIC_INDEX[record_type]].name
