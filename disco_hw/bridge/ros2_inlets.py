"""Poses and wheel data that the bridges receive: each ROS 2 message as data for the daemon, or why it is refused; pure.

A message's stamp is wall-clock time, the daemon's time is monotonic: an age says the same in both. An Odometry has been
through the base's own kinematics: its way and turn are taken back to wheels by the nominal geometry. Distances are
those between poses, so that a lost message loses nothing.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from disco_hw.bridge import ros2_messages as msg
from disco_hw.config import PoseInput
from disco_hw.log.drive import Edge, Motion, chain
from disco_hw.log.drive import poses as along
from drivers.motor.ros2_base_wire import REFUSALS, Ros2BaseSettings, Wheels
from drivers.pose import is_heading_measured
from drivers.pose.senders import SILENCE_S, SenderGate

TYPES = (msg.PoseStamped, msg.PoseWithCovarianceStamped, msg.Odometry)
PoseMessage = msg.PoseStamped | msg.PoseWithCovarianceStamped | msg.Odometry
# Clocks of two computers differ, and some transforms are dated ahead; further ahead the stamp is of another clock.
AHEAD_NS = 50_000_000
OLDEST_NS = 1_000_000_000
"""Age at which a pose, or a request that may move the robot, is too old."""
_SHORTEST_NS = 4_000_000
_UNIT_MARGIN = 0.02
TRANSFORMS = "tf"
"""What `pose.topic` is for poses by the transforms of /tf and /tf_static."""
_KEPT_NS = 3_000_000_000
_MOST_KEPT, _MOST_EDGES = 1000, 500
_REPEAT_NS, _REPEATED = 500_000_000, 3.0


class PoseInlet:
    """Judges poses and counts what it refuses, by reason."""

    def __init__(self, settings: PoseInput, silence_s: float = SILENCE_S) -> None:
        self.refused: Counter[str] = Counter()
        self.without_heading = 0
        """Poses passed on as positions only, as their covariance says that the heading is unknown."""
        self.passed = 0
        self.why = ""
        self._publishers = SenderGate(silence_s)
        self._settings = settings.in_source_units()
        self._newest_ns = self._passed_ns = -OLDEST_NS

    def datagram(
        self, message: PoseMessage, sent_ns: int, mono_ns: int, wall_ns: int, publisher: Hashable = None
    ) -> bytes | None:
        """Return the datagram to send for a message received now; None for what is not to be passed on.

        `sent_ns`: when it was sent, by the sender's wall clock, which counts where the message has no stamp. Of a flood
        one pose in 4 ms is passed on, as a daemon has no use for more. `publisher`: who sent it; of several on the
        topic the first counts, until it has been silent.
        """
        if not self._publishers.may_send(publisher, mono_ns):
            self.refused["of a second publisher on the topic"] += 1
            return None
        reason, pose = self._check(message, sent_ns, mono_ns, wall_ns)
        if pose is None:
            self.refused[reason] += 1
            self.why = reason
            return None
        self.passed += 1
        self.why = ""
        self._publishers.note_pose(publisher, mono_ns)
        return msgspec.msgpack.encode(pose)

    def new_messages(self) -> list[str]:
        """Return messages for the operator since the last call."""
        return self._publishers.new_messages()

    def _check(
        self, message: PoseMessage, sent_ns: int, mono_ns: int, wall_ns: int
    ) -> tuple[str, dict[str, float] | None]:
        settings = self._settings
        frame = message.header.frame_id.lstrip("/")
        if frame != settings.frame.lstrip("/"):
            return f'in frame "{frame[:40]}", not pose.frame "{settings.frame}"', None
        age_ns = wall_ns - (msg.time_of(message.header.stamp) or sent_ns)
        if not -AHEAD_NS <= age_ns <= OLDEST_NS:
            return "stamped by another clock, or too late; synchronise the clocks and leave use_sim_time off", None
        t_ns = mono_ns - max(0, age_ns)
        if t_ns <= self._newest_ns:
            return "not newer than the one before", None
        if mono_ns - self._passed_ns < _SHORTEST_NS:
            return "more than 250 a second", None
        pose = message.pose if isinstance(message.pose, msg.RosPose) else message.pose.pose
        spread = None if isinstance(message.pose, msg.RosPose) else message.pose.covariance
        place, turned = pose.position, pose.orientation
        norm = turned.x**2 + turned.y**2 + turned.z**2 + turned.w**2
        if not (math.isfinite(place.x + place.y + norm) and abs(norm - 1.0) < _UNIT_MARGIN):
            return "not finite, or without a heading", None
        xx, yy, tt = (0.0, 0.0, 0.0) if spread is None else (spread[0], spread[7], spread[35])
        if not (math.isfinite(xx + yy) and min(xx, yy) >= 0.0):
            return "with a covariance of the position that is unknown or impossible", None
        self._newest_ns, self._passed_ns = t_ns, mono_ns
        found = {
            "t_ns": t_ns,
            "x_m": place.x,
            "y_m": place.y,
            "position_std_m": math.sqrt(max(xx, yy)) or settings.position_std_m,
        }
        yaw = msg.yaw_of(turned)
        # Where no covariance says that the heading is unknown, the daemon sees whether it stands still.
        if spread is None or is_heading_measured(yaw, tt):
            found |= {"yaw_rad": yaw, "yaw_std_rad": math.sqrt(tt) or settings.yaw_std_rad}
        else:
            self.without_heading += 1
        return "", found


@dataclass(slots=True)
class _Followed:
    """Transforms of one edge: times (ns, wall clock) and position with quaternion, oldest first."""

    parent: str
    static: bool
    rows: deque[tuple[int, tuple[float, ...]]] = field(default_factory=lambda: deque(maxlen=_MOST_KEPT))


class TransformInlet:
    """Makes poses of the chain of transforms from the map to the robot, as a listener of tf would see it.

    One is made where the first moving edge, the localisation's correction, has come: at its own time, or at the newest
    of the edges after it where it is dated ahead. An edge that only repeats itself says that the localisation lives and
    has nothing new: twice a second, with three times the standard deviation.
    """

    def __init__(self, settings: PoseInput, base_frame: str, silence_s: float = SILENCE_S) -> None:
        self.refused: Counter[str] = Counter()
        self._silence_s = silence_s
        self._publishers: dict[str, SenderGate] = {}
        self._settings = settings.in_source_units()
        self._map, self._base = _frame(settings.frame), _frame(base_frame)
        self._edges: dict[str, _Followed] = {}
        self._chain: tuple[Edge, ...] | None = None
        self._received_ns = self._wall_offset_ns = 0

    def poses(
        self,
        message: msg.TFMessage,
        sent_ns: int,
        mono_ns: int,
        wall_ns: int,
        *,
        static: bool,
        publisher: Hashable = None,
    ) -> Iterator[msg.PoseWithCovarianceStamped]:
        """Yield the poses that the transforms of a message bring; `sent_ns` is the time of those without a stamp.

        `publisher`: who sent it; of several that move one edge the first counts, until it has been silent.
        """
        if wall_ns - mono_ns < self._wall_offset_ns - AHEAD_NS:
            # This computer's clock was set back: what comes now is newer than what came before.
            self._edges = {child: edge for child, edge in self._edges.items() if edge.static}
            self._chain = None
        self._wall_offset_ns = wall_ns - mono_ns
        for each in message.transforms:
            parent, child = _frame(each.header.frame_id), _frame(each.child_frame_id)
            place, turned = each.transform.translation, each.transform.rotation
            values = (place.x, place.y, place.z, turned.x, turned.y, turned.z, turned.w)
            t_ns = msg.time_of(each.header.stamp) or sent_ns
            before = self._edges.get(child)
            if not math.isfinite(sum(values)) or abs(sum(q * q for q in values[3:]) - 1.0) > _UNIT_MARGIN:
                self.refused["transforms that are not finite, or no rotation"] += 1
            elif before is None and len(self._edges) >= _MOST_EDGES:
                self.refused["transforms of too many frames"] += 1
            elif not static and not self._publishers_of(child).may_send(publisher, mono_ns):
                self.refused["transforms of a second publisher of the same edge"] += 1
            elif self._keep(parent, child, t_ns, values, static=static):
                self._publishers_of(child).note_pose(publisher, mono_ns)
                pose = self._pose_by(child, wall_ns)
                if pose is not None:
                    yield pose

    def new_messages(self) -> list[str]:
        """Return messages for the operator since the last call, of all transforms."""
        return [text for one in self._publishers.values() for text in one.new_messages()]

    def _publishers_of(self, child: str) -> SenderGate:
        """Return the gate of the publishers that move the edge to this frame; there are no more than edges are kept."""
        return self._publishers.setdefault(child, SenderGate(self._silence_s))

    def _keep(self, parent: str, child: str, t_ns: int, values: tuple[float, ...], *, static: bool) -> bool:
        """Whether this is a new transform of the edge."""
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent or edge.static is not static:
            edge = self._edges[child] = _Followed(parent, static)
            self._chain = chain(((one.parent, name) for name, one in self._edges.items()), self._map, self._base)
        if edge.rows and t_ns < edge.rows[-1][0] - _KEPT_NS:
            # The sender's clock was set back, or its bag begins anew.
            edge.rows.clear()
        if edge.rows and t_ns <= edge.rows[-1][0] and not static:
            self.refused["transforms not newer than the one before"] += 1
            return False
        edge.rows.append((t_ns, values))
        while edge.rows[0][0] < t_ns - _KEPT_NS:
            edge.rows.popleft()
        return True

    def _pose_by(self, child: str, wall_ns: int) -> msg.PoseWithCovarianceStamped | None:
        """Return the chain's end now that `child` has moved; None unless that is the first edge that moves."""
        if self._chain is None:
            self.refused[f'transforms without a chain from "{self._map[:40]}" to "{self._base[:40]}"'] += 1
            return None
        moving = [name for _, name in self._chain if not self._edges[name].static]
        if not moving or moving[0] != child:
            return None
        leading = self._edges[child].rows
        after = [self._edges[name].rows for name in moving[1:]]
        t_ns = min(leading[-1][0], wall_ns, *(rows[-1][0] for rows in after))
        if any(t_ns < rows[0][0] for rows in after):
            self.refused["transforms that the ones after them in the chain do not reach"] += 1
            return None
        repeated = bool(after) and len(leading) > 1 and leading[-1][1] == leading[-2][1]
        # A time before that of the pose before is of a clock that was set back.
        if repeated and 0 <= t_ns - self._received_ns < _REPEAT_NS:
            return None
        self._received_ns = t_ns
        motions = [self._motion(name, t_ns if name == child else None) for _, name in self._chain]
        x, y, yaw = along(motions)[1][0].tolist()
        position, heading = self._settings.position_std_m, self._settings.yaw_std_rad
        scale = _REPEATED if repeated else 1.0
        covariance = [0.0] * 36
        covariance[0] = covariance[7] = (scale * position) ** 2
        covariance[35] = (scale * heading) ** 2
        pose = msg.PoseWithCovariance(msg.RosPose(msg.Point(x, y, 0.0), msg.about_z(yaw)), covariance)
        return msg.PoseWithCovarianceStamped(msg.Header(msg.stamp_of(t_ns), self._settings.frame), pose)

    def _motion(self, child: str, only_ns: int | None) -> Motion:
        """Return the transforms of an edge for the chain; of the first, the newest alone, at the time of the pose."""
        edge = self._edges[child]
        rows = list(edge.rows) if only_ns is None else [(only_ns, edge.rows[-1][1])]
        return Motion(np.array([t for t, _ in rows]), np.array([values for _, values in rows]), edge.static)


def _frame(name: str) -> str:
    return name.lstrip("/")


# Chosen: longer than any delay on a network that could be driven over; older is another clock.
_OLDEST_WHEELS_NS = 500_000_000
# How long a refusal is reported after its message.
_SECOND_NS = 1_000_000_000
_NOTHING, _CLOCK, _JOINTS, _VALUES, _ORDER = range(len(REFUSALS))
# Chosen: above an overshoot; larger is another unit or a wrong radius.
_FASTER = 2.0
Both = tuple[float, float]


class WheelInlet:
    """Judges what is heard of the wheels, and counts what it refuses, by reason."""

    def __init__(self, settings: Ros2BaseSettings) -> None:
        self.refused: Counter[str] = Counter()
        self._settings = settings
        self._joints = {*settings.left_joints, *settings.right_joints}
        self._newest_ns = -_SECOND_NS
        self._before: Wheels | None = None
        self._pose: tuple[float, float, float] | None = None
        self._why, self._why_ns = _NOTHING, -_SECOND_NS

    def wheels(self, message: msg.JointState | msg.Odometry, sent_ns: int, mono_ns: int, wall_ns: int) -> Wheels | None:
        """Return the wheels by a message received now; None for what is refused, or says nothing of them.

        `sent_ns`: when it was sent, by the sender's wall clock, which counts where the message has no stamp.
        """
        age_ns = wall_ns - (msg.time_of(message.header.stamp) or sent_ns)
        if isinstance(message, msg.JointState) and not self._joints & set(message.name):
            return None
        if not -AHEAD_NS <= age_ns <= _OLDEST_WHEELS_NS:
            self._refuse(_CLOCK, mono_ns)
            return None
        true_ns = mono_ns - max(0, age_ns)
        if true_ns <= self._newest_ns:
            self._refuse(_ORDER, mono_ns)
            return None
        elapsed_s = (true_ns - self._newest_ns) * 1e-9
        found = self._of_joints(message, elapsed_s) if isinstance(message, msg.JointState) else self._of_pose(message)
        if found is None:
            self._refuse(_JOINTS, mono_ns)
            return None
        angles, speeds = found
        if not math.isfinite(sum(angles + speeds)) or max(map(abs, speeds)) > _FASTER * self._settings.fastest_rad_s:
            self._refuse(_VALUES, mono_ns)
            return None
        self._newest_ns = true_ns
        self._before = Wheels(angles, speeds, (mono_ns - true_ns) * 1e-9)
        if isinstance(message, msg.Odometry):
            self._pose = _planar(message)
        return self._before

    def why(self, now_ns: int) -> int:
        """Return why nothing usable was received, as one of REFUSALS."""
        return self._why if now_ns - self._why_ns < _SECOND_NS else _NOTHING

    def _refuse(self, why: int, mono_ns: int) -> None:
        self.refused[REFUSALS[why]] += 1
        self._why, self._why_ns = why, mono_ns

    def _of_joints(self, message: msg.JointState, elapsed_s: float) -> tuple[Both, Both] | None:
        """Return the mean of each side; speeds from the angles where there are none. None where a joint is missing."""
        at = {name: place for place, name in enumerate(message.name)}
        sides = (self._settings.left_joints, self._settings.right_joints)
        if not at.keys() >= self._joints or len(message.position) < len(message.name):
            return None
        angles = _means(sides, at, message.position)
        # joint_state_broadcaster writes NaN where a joint has no velocity interface.
        is_measured = len(message.velocity) == len(message.name) and not any(
            math.isnan(message.velocity[at[name]]) for name in self._joints
        )
        if is_measured:
            return angles, _means(sides, at, message.velocity)
        if self._before is None:
            return angles, (0.0, 0.0)
        before = self._before.angles_rad
        return angles, ((angles[0] - before[0]) / elapsed_s, (angles[1] - before[1]) / elapsed_s)

    def _of_pose(self, message: msg.Odometry) -> tuple[Both, Both]:
        """Return the wheel angles and speeds of an ideal base with this geometry that drove this odometry."""
        pose = _planar(message)
        angles = (0.0, 0.0) if self._before is None else self._before.angles_rad
        if self._pose is not None:
            turn = math.remainder(pose[2] - self._pose[2], math.tau) if math.isfinite(pose[2]) else math.nan
            middle = self._pose[2] + 0.5 * turn
            way = (pose[0] - self._pose[0]) * math.cos(middle) + (pose[1] - self._pose[1]) * math.sin(middle)
            left, right = self._turned(way, turn)
            angles = (angles[0] + left, angles[1] + right)
        speed = message.twist.twist
        return angles, self._turned(speed.linear.x, speed.angular.z)

    def _turned(self, way: float, turn: float) -> Both:
        half, radius = 0.5 * self._settings.track_m * turn, self._settings.wheel_radius_m
        return (way - half) / radius, (way + half) / radius


def _means(sides: tuple[tuple[str, ...], tuple[str, ...]], at: dict[str, int], values: Sequence[float]) -> Both:
    left, right = (sum(values[at[name]] for name in side) / len(side) for side in sides)
    return left, right


def _planar(message: msg.Odometry) -> tuple[float, float, float]:
    pose = message.pose.pose
    return pose.position.x, pose.position.y, msg.yaw_of(pose.orientation)
