"""Which topics of a bag are the commands, the wheels and the poses, and why: guessed by type, content and name."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from disco_hw.config import Ros2
from disco_hw.errors import LogError
from disco_hw.log.drive import BASE_FRAMES, MAP_FRAMES, ODOM_FRAMES, Edge, chain
from disco_hw.log.importing.rosbag_file import Bag, BagMessage, BagTopic

TF = "tf"
"""What stands for a chain of transforms where a topic's name is asked for."""

COMMANDS, WHEELS, POSES = "commands", "wheels", "poses"
ROLES = (COMMANDS, WHEELS, POSES)

TWIST = frozenset({"geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"})
JOINTS = "sensor_msgs/msg/JointState"
ARRAY = "std_msgs/msg/Float64MultiArray"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = frozenset({"geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"})
TRANSFORMS = frozenset({"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"})
DRIVERS = re.compile(r".*_msgs/msg/Drive")
WHEEL_SPEEDS = re.compile(r".*_msgs/msg/WheelVels")

# Chosen: enough messages to see what a topic holds, without reading the bag.
_PEEKED = 20
# Chosen: a slower topic says too little of a drive and is taken last.
_FEWEST_HZ = 2.0
# Chosen: /tf mixes many transforms, so that rare ones need more messages to be seen.
_PEEKED_TRANSFORMS = 2000
_LEFT = re.compile(r"(^|[_\W])(left|l|fl|lf|rl|lr|bl|ml)([_\W]|$)|left")
_RIGHT = re.compile(r"(^|[_\W])(right|r|fr|rf|rr|br|mr)([_\W]|$)|right")
_NO_WHEEL = re.compile(r"caster|steer|gripper|arm|finger|flipper|susp|rocker")
_OF_A_CONTROLLER = re.compile(r"controller|base|velocity|platform")
_NOT_THE_ROBOT = re.compile(r"goal|initial|target|set_?point|desired|plan|waypoint|tag|marker|camera")
_SLAM = re.compile(r"slam|amcl|locali[sz]ation|lidar|lio|laser|icp|vslam|visual|vio|rtabmap|zed|mocap|vicon|optitrack|"
                   r"natnet|mapping|ground_?truth")  # fmt: skip
_FUSED = re.compile(r"filtered|ekf|ukf|fused")


@dataclass(frozen=True, slots=True)
class TopicCandidate:
    """A topic that could serve in a role: of the best `rank` (the lowest) the one with most messages is taken."""

    role: str
    topic: str
    type: str
    count: int
    rank: int
    why: str
    used: bool = False


@dataclass(frozen=True, slots=True)
class Choice:
    """Choice of the topics to read; an empty topic is a role that nothing serves.

    `edges` lead from the map to the robot, if by tf.
    """

    table: tuple[TopicCandidate, ...]
    edges: tuple[Edge, ...]
    left_joints: tuple[str, ...]
    right_joints: tuple[str, ...]

    def used(self, role: str) -> TopicCandidate | None:
        """Return the topic that is used in this role."""
        return next((one for one in self.table if one.role == role and one.used), None)

    def as_text(self) -> str:
        """Return the table of topics as text."""
        head = ("", "role", "topic", "type", "messages", "why")
        rows = [("*" if one.used else "", one.role, one.topic, one.type, str(one.count), one.why) for one in self.table]
        widths = [max(len(row[at]) for row in (head, *rows)) for at in range(len(head))]
        lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in (head, *rows)]
        return "\n".join(["topics; * is read, `--topic ROLE=NAME` takes another", *(line.rstrip() for line in lines)])


# Above all ranks of topics that can be read.
_UNREADABLE_RANK = 200


def choose(bag: Bag, settings: Ros2) -> Choice:
    """Choose for each role; `settings` override. Raises LogError for what they name and the bag has not."""
    edges = _edges(bag)
    route = _route(bag, edges, settings)
    left, right = _wheel_joints(bag, settings)
    candidates: list[TopicCandidate] = []
    configured = {COMMANDS: settings.command_topic, WHEELS: settings.wheel_topic, POSES: settings.pose_topic}
    for role in ROLES:
        found = [*_of_role(bag, role, left, right, settings), *(_by_tf(bag, route, edges) if role == POSES else ())]
        candidates += _one_used(bag, role, found, configured[role])
    if not any(one.used for one in candidates):
        why = {one.topic: f", {one.why}" for one in candidates if one.rank >= _UNREADABLE_RANK}
        some = (
            ", ".join(f"{one.name} ({one.type}{why.get(one.name, '')})" for one in [*bag.topics.values()][:8]) or "none"
        )
        raise LogError(
            f"{bag.path}: no topic with commands, wheels or poses; it has {some}; name one with --topic ROLE=NAME"
        )
    return Choice(tuple(candidates), route or (), left, right)


def _one_used(bag: Bag, role: str, found: list[TopicCandidate], configured: str) -> list[TopicCandidate]:
    found.sort(key=lambda one: (one.rank, -one.count, one.topic))
    if configured:
        named = next((one for one in found if one.topic == configured and one.rank < _UNREADABLE_RANK), None) or _named(
            bag, role, configured
        )
        others = [one for one in found if one.topic != configured]
        return [replace(named, used=True, why=f"requested; {named.why}"), *others]
    # What ranks 100 and more is never taken unasked, 200 cannot be read.
    return [replace(one, used=at == 0 and one.rank < 100) for at, one in enumerate(found)]


def _named(bag: Bag, role: str, name: str) -> TopicCandidate:
    topic = bag.topics.get(name)
    if name == TF:
        frames = "docs/ros2.md says how to name the frames"
        raise LogError(f"{bag.path}: {role}: no chain of transforms from a map to the robot; {frames}")
    if topic is None:
        near = ", ".join(list(bag.topics)[:8]) or "none"
        raise LogError(f"{bag.path}: {role}: no topic {name}; it has {near}")
    if why := bag.why_unreadable(name):
        raise LogError(f"{bag.path}: {role}: {name}: {why}; record as MCAP, or name another topic")
    if not topic.count:
        raise LogError(f"{bag.path}: {role}: {name} has no message; name another topic")
    if not _serves(topic, role):
        raise LogError(f"{bag.path}: {role}: {name} is of type {topic.type}, which holds no {role}; name another topic")
    return TopicCandidate(role, name, topic.type, topic.count, 0, "")


def _serves(topic: BagTopic, role: str) -> bool:
    kind = topic.type
    if role == COMMANDS:
        by_wheel = kind in {JOINTS, ARRAY} or bool(DRIVERS.fullmatch(kind) or WHEEL_SPEEDS.fullmatch(kind))
        return kind in TWIST or by_wheel
    return kind in ({JOINTS, ODOMETRY} if role == WHEELS else {ODOMETRY, *POSE})


def _of_role(
    bag: Bag, role: str, left: tuple[str, ...], right: tuple[str, ...], settings: Ros2
) -> Iterable[TopicCandidate]:
    for topic in bag.topics.values():
        if not (topic.count and _serves(topic, role)):
            continue
        if why := bag.why_unreadable(topic.name):
            yield TopicCandidate(role, topic.name, topic.type, topic.count, _UNREADABLE_RANK, why)
            continue
        evaluated = {COMMANDS: _as_command, WHEELS: _as_wheels, POSES: _as_pose}[role](
            bag, topic, left, right, settings
        )
        if evaluated is not None:
            yield TopicCandidate(role, topic.name, topic.type, topic.count, *evaluated)


Evaluated = tuple[int, str] | None


def _as_command(bag: Bag, topic: BagTopic, left: tuple[str, ...], right: tuple[str, ...], settings: Ros2) -> Evaluated:
    name = topic.name.lower()
    is_command = re.search(r"cmd|command", name) is not None
    if topic.type == JOINTS:
        return (
            (0, "speeds of the wheels, as commanded") if is_command and _has_joints(bag, topic, left, right) else None
        )
    if topic.type == ARRAY:
        if not (is_command or settings.command_topic == topic.name):
            return None
        sizes = {len(one.value.data) for one in _first(bag, topic.name)}
        if sizes == {2} or (settings.command_joints and sizes == {len(settings.command_joints)}):
            return 1, "speeds of the wheels, as commanded"
        return 100, f"{'/'.join(map(str, sorted(sizes)))} numbers; ros2.command_joints says whose they are"
    if topic.type not in TWIST:
        return (0, "speeds of the wheels, as commanded") if is_command else None
    through = "through robot.toml's wheel_radius_m and axial_distance_m"
    if name.endswith("cmd_vel_out"):
        return 2, f"what the controller made of its commands, {through}"
    if is_command and _OF_A_CONTROLLER.search(name.rpartition("/")[0]):
        return 3, f"what the controller was given, {through}"
    if re.fullmatch(r".*/cmd_vel(_unstamped)?", name):
        return 4, f"what the robot was given, {through}"
    return (5, f"a Twist by name a command, {through}") if is_command else None


def _as_wheels(bag: Bag, topic: BagTopic, left: tuple[str, ...], right: tuple[str, ...], settings: Ros2) -> Evaluated:
    name = topic.name.lower()
    if topic.type == JOINTS:
        if re.search(r"cmd|command", name) or not _has_joints(bag, topic, left, right):
            return None
        return 0, f"left: {', '.join(left)}; right: {', '.join(right)}"
    if _SLAM.search(name) or _FUSED.search(name) or _NOT_THE_ROBOT.search(name):
        return None
    return 10, "no JointState of wheels is as good: its twist, back through wheel_radius_m and axial_distance_m"


def _as_pose(bag: Bag, topic: BagTopic, left: tuple[str, ...], right: tuple[str, ...], settings: Ros2) -> Evaluated:
    name = topic.name.lower()
    first = next(_first(bag, topic.name), None)
    frame = first.value.header.frame_id.lstrip("/") if first is not None else ""
    rate_hz = topic.count / max((bag.end_ns - bag.start_ns) * 1e-9, 1e-9)
    why = f"in frame {frame or '(none)'}, {rate_hz:.1f} Hz"
    if _NOT_THE_ROBOT.search(name):
        return 101, f"{why}; by its name not where the robot is"
    if topic.type == ODOMETRY:
        if _FUSED.search(name):
            return 102, f"{why}; by its name fused with the wheels, which it is to judge"
        if not _SLAM.search(name) and (frame in ODOM_FRAMES or frame not in MAP_FRAMES):
            return 103, f"{why}; by frame and name the odometry of the wheels, which it is to judge"
        rank = 30
    else:
        rank = 10 if _SLAM.search(name) else 20
    if rate_hz < _FEWEST_HZ:
        return rank + 50, f"{why}; few"
    return rank, why


def _by_tf(bag: Bag, route: tuple[Edge, ...] | None, edges: Sequence[Edge]) -> Iterable[TopicCandidate]:
    if route is None:
        return
    frames = " - ".join([route[0][0], *(child for _, child in route)])
    count = sum(topic.count for topic in bag.topics.values() if topic.type in TRANSFORMS)
    why = f"{frames}, where its first moving part changes"
    for used in route:
        others = [parent for parent, child in edges if child == used[1] and parent != used[0]]
        if others:
            why += f"; {used[1]} has another parent too, which is left out: {', '.join(others[:3])}"
    yield TopicCandidate(POSES, TF, "tf2_msgs/msg/TFMessage", count, 25, why)


def _first(bag: Bag, topic: str) -> Iterator[BagMessage]:
    for at, message in enumerate(bag.messages([topic])):
        if at >= _PEEKED:
            return
        yield message


def _has_joints(bag: Bag, topic: BagTopic, left: Sequence[str], right: Sequence[str]) -> bool:
    expected = {*left, *right}
    return bool(left and right) and any(expected <= set(one.value.name) for one in _first(bag, topic.name))


def _wheel_joints(bag: Bag, settings: Ros2) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the wheels' joints, as set or as guessed from all that the bag's joint states name."""
    if settings.left_joints and settings.right_joints:
        return tuple(settings.left_joints), tuple(settings.right_joints)
    names: list[str] = []
    for topic in bag.topics.values():
        if topic.type == JOINTS and topic.count and not bag.why_unreadable(topic.name):
            names += [name for one in _first(bag, topic.name) for name in one.value.name]
    wheels = [name for name in dict.fromkeys(names) if _is_wheel(name)]
    left = tuple(name for name in wheels if _LEFT.search(name.lower()))
    right = tuple(name for name in wheels if _RIGHT.search(name.lower()) and name not in left)
    return left, right


def _is_wheel(name: str) -> bool:
    return "wheel" in name.lower() and _NO_WHEEL.search(name.lower()) is None


def _edges(bag: Bag) -> tuple[Edge, ...]:
    """Edges of the transforms at the bag's beginning and from its middle on, in the order in which they came."""
    topics = [topic.name for topic in bag.topics.values() if topic.type in TRANSFORMS]
    static = [name for name in topics if name.endswith("static")]
    found: dict[Edge, None] = {}
    middle_ns = bag.start_ns + (bag.end_ns - bag.start_ns) // 2
    for names, start_ns, most in (
        (static, None, math.inf),
        (topics, None, _PEEKED_TRANSFORMS),
        (topics, middle_ns, _PEEKED_TRANSFORMS),
    ):
        for at, message in enumerate(bag.messages(names, start_ns)):
            if at >= most:
                break
            edges = ((_frame(one.header.frame_id), _frame(one.child_frame_id)) for one in message.value.transforms)
            found |= dict.fromkeys(edges)
    return tuple(found)


def _frame(name: str) -> str:
    """ROS 1 wrote frames with a slash."""
    return name.lstrip("/")


def _route(bag: Bag, edges: Sequence[Edge], settings: Ros2) -> tuple[Edge, ...] | None:
    maps = [settings.map_frame] if settings.map_frame else list(MAP_FRAMES)
    bases = [settings.base_frame] if settings.base_frame else list(BASE_FRAMES)
    for map_frame in maps:
        for base_frame in bases:
            route = chain(edges, map_frame, base_frame)
            if route:
                return route
    if settings.pose_topic == TF:
        known = ", ".join(sorted({frame for edge in edges for frame in edge})[:12]) or "none"
        raise LogError(
            f"{bag.path}: no transforms lead from {' or '.join(maps)} to {' or '.join(bases)}; frames are {known}; "
            "set ros2.map_frame and ros2.base_frame"
        )
    return None
