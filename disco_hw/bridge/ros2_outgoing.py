"""Conversion of the daemon's records into the ROS 2 messages that the bridge publishes; pure.

`odom` is dead reckoning by the wheels alone, so that it never jumps (REP 105); what the estimator makes of wheels and
poses together goes out as `disco_hw/pose` in the map's frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from disco_hw.bridge import ros2_messages as msg
from disco_hw.config import RobotConfig
from disco_hw.estimation.odometry import (
    Matrix3,
    OdometryParameters,
    Pose,
    PoseBelief,
    WheelReading,
    WheelTracker,
    arc,
    belief_at,
    motion_model,
    predict,
)
from disco_hw.log import records
from drivers.pose.ros2 import SOURCE as ROS2_POSES
from drivers.types import WheelSample

BASE_FRAME, ODOM_FRAME = "base_link", "odom"
JOINTS = ("left_wheel_joint", "right_wheel_joint")
ODOM, JOINT_STATES, TF, PLAN, POSE = "odom", "joint_states", "/tf", "plan", "disco_hw/pose"
STATE, DIAGNOSTICS = "disco_hw/state", "/diagnostics"
# Of what a plane cannot move in, as drivers of ground robots say it.
_UNMEASURED_VARIANCE = 1e6
_START_VARIANCE = 1e-6
_WELL, _WARNING, _ERROR, _SILENT = range(4)
_LEVELS = {"FAULT": _ERROR, "DISCONNECTED": _ERROR, "HANDSHAKE": _WARNING}

Message = tuple[str, object]
"""A topic, without namespace unless it begins with a slash, and what is said on it."""


@dataclass(frozen=True, slots=True)
class _Reckoned:
    """Dead reckoning at one wheel reading."""

    reading: WheelReading
    belief: PoseBelief


class Outgoing:
    """Turns the records of ticks into messages, stamped with wall-clock time."""

    def __init__(self, config: RobotConfig, parameters: OdometryParameters) -> None:
        self._config = config
        self._base = config.ros2.base_frame or BASE_FRAME
        by_ros = config.pose.of(ROS2_POSES)
        self._map = (by_ros or config.pose).frame
        # Who gives poses over ROS says where the map is; of others nobody there knows.
        self._gives_map = by_ros is None
        self._parameters = parameters
        self._model = motion_model(config.estimation, parameters)
        self._tracker = WheelTracker()
        self._reckoned: _Reckoned | None = None
        self._state: records.DaemonState | None = None
        self._counters: records.Counters | None = None

    def messages(self, received: Sequence[tuple[int, records.Record]], wall_offset_ns: int) -> Iterator[Message]:
        """Yield the messages for these records; of wheels, estimates and plans only the newest.

        `wall_offset_ns`: wall minus monotonic time. Odometry comes first, and each is made when it is asked for: a plan
        takes longer than all others together.
        """
        states: list[Message] = []
        wheels: WheelSample | None = None
        newest: dict[type, records.Record] = {}
        for _, record in received:
            newest[type(record)] = record
            if isinstance(record, WheelSample):
                wheels = self._reckon(record) or wheels
            elif isinstance(record, records.DaemonState):
                self._state = record
                text = f"{record.state}{' running' if record.running else ''}{' e-stop' if record.estop else ''}"
                states.append((STATE, msg.String(f"{text}: {record.reason}")))
            elif isinstance(record, records.Counters):
                self._counters = record
        return self._made(wheels, states, newest, wall_offset_ns)

    def _made(
        self, wheels: WheelSample | None, states: list[Message], newest: dict[type, records.Record], wall_offset_ns: int
    ) -> Iterator[Message]:
        if wheels is not None and self._reckoned is not None:
            yield from self._of_wheels(wheels, self._reckoned.belief, wheels.t_ns + wall_offset_ns)
        yield from states
        estimate = newest.get(records.Estimate)
        if isinstance(estimate, records.Estimate):
            yield from self._of_estimate(estimate, estimate.t_ns + wall_offset_ns)
        plan = newest.get(records.Plan)
        if isinstance(plan, records.Plan) and plan.path_x_m:
            yield PLAN, self._path(plan, plan.t_ns + wall_offset_ns)

    def diagnostics(self, now_wall_ns: int, is_connected: bool, bridge: Mapping[str, str], wrong: str) -> Message:
        """Return the diagnostics of daemon and bridge.

        `is_connected`: whether the daemon has published lately; `wrong`: what is wrong with the bridge, or empty.
        """
        state = self._state
        if not is_connected or state is None:
            daemon = msg.DiagnosticStatus(_SILENT, "disco-hw: daemon", "no daemon found; start it with disco-hw run")
        else:
            level = _ERROR if state.estop else _LEVELS.get(state.state, _WELL)
            daemon = msg.DiagnosticStatus(level, "disco-hw: daemon", f"{state.state}: {state.reason}")
            daemon.values = [msg.KeyValue(name, str(value)) for name, value in _figures(self._counters)]
        daemon.hardware_id = self._config.robot.name
        values = [msg.KeyValue(name, text) for name, text in bridge.items()]
        status = msg.DiagnosticStatus(_WARNING if wrong else _WELL, "disco-hw: bridge", wrong or "well", "", values)
        return DIAGNOSTICS, msg.DiagnosticArray(msg.Header(msg.stamp_of(now_wall_ns)), [daemon, status])

    def _reckon(self, sample: WheelSample) -> WheelSample | None:
        """Follow the wheels to a sample; None for one that cannot be."""
        reading = self._tracker.add_sample(sample)
        if not isinstance(reading, WheelReading):
            return None
        before = self._reckoned
        if before is None:
            belief = belief_at(Pose(0.0, 0.0, 0.0), _START_VARIANCE, _START_VARIANCE, self._model)
        else:
            left = reading.left_rad - before.reading.left_rad
            right = reading.right_rad - before.reading.right_rad
            belief = predict(before.belief, self._model, arc(self._parameters, left, right))
        self._reckoned = _Reckoned(reading, belief)
        return sample

    def _of_wheels(self, sample: WheelSample, belief: PoseBelief, wall_ns: int) -> Iterator[Message]:
        header = msg.Header(msg.stamp_of(wall_ns), ODOM_FRAME)
        moving = arc(self._parameters, sample.left_speed_rad_s, sample.right_speed_rad_s)
        speeds = msg.Twist(
            msg.Vector3(moving.distance_m, -self._parameters.x_icr_m * moving.turn_rad, 0.0),
            msg.Vector3(0.0, 0.0, moving.turn_rad),
        )
        # Slip per metre and per radian is a variance that grows with the way: this is a second of it.
        slip = self._model
        along = max(_START_VARIANCE, slip.position_m2_per_m * moving.rolled_m)
        turning = slip.yaw_rad2_per_m * moving.rolled_m + slip.yaw_rad2_per_rad * abs(moving.turn_rad)
        spread = ((along, 0.0, 0.0), (0.0, along, 0.0), (0.0, 0.0, max(_START_VARIANCE, turning)))
        odometry = msg.Odometry(
            header,
            self._base,
            msg.PoseWithCovariance(_pose(belief.x_m, belief.y_m, belief.yaw_rad), _six(belief.covariance)),
            msg.TwistWithCovariance(speeds, _six(spread)),
        )
        yield ODOM, odometry
        joints = msg.JointState(
            msg.Header(header.stamp),
            list(JOINTS),
            [sample.left_angle_rad, sample.right_angle_rad],
            [sample.left_speed_rad_s, sample.right_speed_rad_s],
        )
        yield JOINT_STATES, joints
        transform = self._transform(ODOM_FRAME, self._base, (belief.x_m, belief.y_m, belief.yaw_rad), wall_ns)
        yield TF, msg.TFMessage([transform])

    def _of_estimate(self, estimate: records.Estimate, wall_ns: int) -> Iterable[Message]:
        if not estimate.pose_healthy:
            return
        (xx, xy, xt, _, yy, yt, _, _, tt) = estimate.covariance
        spread = ((xx, xy, xt), (xy, yy, yt), (xt, yt, tt))
        fused = msg.PoseWithCovariance(_pose(estimate.x_m, estimate.y_m, estimate.yaw_rad), _six(spread))
        yield POSE, msg.PoseWithCovarianceStamped(msg.Header(msg.stamp_of(wall_ns), self._map), fused)
        if self._gives_map and self._reckoned is not None:
            belief = self._reckoned.belief
            yaw = estimate.yaw_rad - belief.yaw_rad
            x = estimate.x_m - (math.cos(yaw) * belief.x_m - math.sin(yaw) * belief.y_m)
            y = estimate.y_m - (math.sin(yaw) * belief.x_m + math.cos(yaw) * belief.y_m)
            yield TF, msg.TFMessage([self._transform(self._map, ODOM_FRAME, (x, y, yaw), wall_ns)])

    def _path(self, plan: records.Plan, wall_ns: int) -> msg.RosPath:
        header = msg.Header(msg.stamp_of(wall_ns), self._map)
        points = zip(plan.path_x_m, plan.path_y_m, plan.path_yaw_rad, strict=True)
        return msg.RosPath(header, [msg.PoseStamped(header, _pose(*point)) for point in points])

    def _transform(self, parent: str, child: str, at: tuple[float, float, float], wall_ns: int) -> msg.TransformStamped:
        place = msg.Transform(msg.Vector3(at[0], at[1], 0.0), msg.about_z(at[2]))
        return msg.TransformStamped(msg.Header(msg.stamp_of(wall_ns), parent), child, place)


def _pose(x_m: float, y_m: float, yaw_rad: float) -> msg.RosPose:
    return msg.RosPose(msg.Point(x_m, y_m, 0.0), msg.about_z(yaw_rad))


def _six(covariance: Matrix3) -> list[float]:
    """Return the 6 x 6 matrix of x, y, z and the rotations about them."""
    full = [0.0] * 36
    for one, row in zip((0, 1, 5), covariance, strict=True):
        for other, value in zip((0, 1, 5), row, strict=True):
            full[6 * one + other] = value
    for unmeasured in (2, 3, 4):
        full[7 * unmeasured] = _UNMEASURED_VARIANCE
    return full


def _figures(counters: records.Counters | None) -> Iterable[tuple[str, int]]:
    """Yield the counters that a person at a robot asks for first."""
    if counters is not None:
        yield "loop overruns", counters.loop.get("overruns", 0)
        yield "ticks skipped", counters.loop.get("skipped", 0)
        yield from ((f"poses {name}", value) for name, value in counters.fusion.items() if name.startswith("pose"))
