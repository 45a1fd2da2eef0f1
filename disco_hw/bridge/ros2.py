"""Bridge of `disco-hw bridge ros2` over DDS, beside the daemon: poses and commands in, odometry and state out."""

from __future__ import annotations

import contextlib
import gc
import json
import os
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from cyclonedds.core import DDSException, InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from disco_hw.bridge import ros2_commands, ros2_inlets, ros2_obstacles
from disco_hw.bridge import ros2_messages as msg
from disco_hw.bridge import ros2_outgoing as out
from disco_hw.config import RobotConfig
from disco_hw.daemon import send_request, socket_path
from disco_hw.daemon.page_feed import FeedSubscriber, tick_feed_path
from disco_hw.daemon.process import StopSignals
from disco_hw.errors import InputError, WorkError
from disco_hw.estimation.filter import TAKE_OVER_TIMEOUTS
from disco_hw.processes import SWITCH_INTERVAL_S
from disco_hw.runtime.assembly import odometry_parameters
from disco_hw.runtime.robot_setup import Setup, load_setup
from drivers.motor.ros2_base_wire import Ros2BaseSettings
from drivers.pose.ros2 import SOURCE, bridge_address

CMD_VEL, CTL, REPLY, ESTOP = "cmd_vel", "disco_hw/ctl", "disco_hw/reply", "disco_hw/estop"
TF_STATIC = "/tf_static"
# Diagnostics come once a second; a feed that is silent for longer is no connection.
_SECOND_NS = 1_000_000_000
# Chosen: how late an end is noticed, and a diagnosis made.
_WAIT_S = 0.05
# Chosen: a flood on one topic must not hold up the others.
_MAX_BATCH = 20
# Chosen: what a publisher sent before it was found arrives one by one, without such a pause.
_HISTORY_NS = 100_000_000

_ACKNOWLEDGED = Policy.Reliability.Reliable(duration(milliseconds=5))
SENSOR = Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(5))
RELIABLE = Qos(_ACKNOWLEDGED, Policy.Durability.Volatile, Policy.History.KeepLast(10))
NEWEST = Qos(_ACKNOWLEDGED, Policy.Durability.Volatile, Policy.History.KeepLast(1))
_NEWEST_LATCHED = Qos(_ACKNOWLEDGED, Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
_TRANSFORMS = Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(100))
LATCHED = Qos(_ACKNOWLEDGED, Policy.Durability.TransientLocal, Policy.History.KeepLast(100))

_PUBLISHED: tuple[tuple[str, type, Qos], ...] = (
    (out.ODOM, msg.Odometry, RELIABLE),
    (out.JOINT_STATES, msg.JointState, RELIABLE),
    (out.TF, msg.TFMessage, RELIABLE),
    (out.PLAN, msg.RosPath, RELIABLE),
    (out.POSE, msg.PoseWithCovarianceStamped, RELIABLE),
    (out.STATE, msg.String, _NEWEST_LATCHED),
    (out.DIAGNOSTICS, msg.DiagnosticArray, RELIABLE),
    (REPLY, msg.String, RELIABLE),
)
_OF_THE_BASE = (out.ODOM, out.JOINT_STATES, out.TF)
_Handler = Callable[[Any, int], None]  # Any: a message of the reader's type.


def run_ros2_bridge(robot: Path, model: Path | None = None, link: str | None = None) -> int:
    """Run until SIGTERM or SIGINT; returns the exit code. The daemon may come and go.

    Raises InputError for a bad file, and WorkError where DDS cannot be had.
    """
    setup = load_setup(robot, model, link)
    with StopSignals() as signals, closing(Bridge(setup, link)) as bridge:
        print(f"bridge: {bridge.where}", flush=True)
        bridge.run(lambda: signals.received is not None)
    return 0


def wire_name(topic: str, namespace: str) -> str:
    """Return the name on the wire of a topic, which is in the namespace unless it begins with a slash."""
    return (
        "rt" + topic
        if topic.startswith("/")
        else "/".join(("rt", *namespace.strip("/").split("/"), topic)).replace("//", "/")
    )


class Bridge:
    """Bridge between ROS 2 and the daemon, both ways.

    A thread of its own receives, so that it never waits for what is sent.
    """

    def __init__(self, setup: Setup, link: str | None = None) -> None:
        config = setup.config
        parameters = odometry_parameters(setup.model)
        self._setup, self._link, self._config = setup, link, config
        self._domain, self._participant = join_domain(config)
        self._outgoing = out.Outgoing(config, parameters)
        self._feed = FeedSubscriber(tick_feed_path(socket_path(config)))
        self._pose = config.pose.of(SOURCE)
        pose = self._pose or config.pose
        silence_s = TAKE_OVER_TIMEOUTS * config.estimation.pose_timeout_s
        self._poses = ros2_inlets.PoseInlet(pose, silence_s)
        self._transforms = ros2_inlets.TransformInlet(pose, config.ros2.base_frame or out.BASE_FRAME, silence_s)
        self._speeds = ros2_commands.SpeedInlet(config.robot, config.drive, parameters)
        self._pad = ros2_commands.DaemonPad(socket_path(config))
        self._obstacles = ros2_obstacles.ObstacleInlet((self._pose or config.pose).frame)
        self._obstacle_link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._obstacle_link.setblocking(False)
        self._to_daemon = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._to_daemon.setblocking(False)
        self._unsent = self._obstacles_unsent = self._unwritten = 0
        self._unread = UnreadCounts()
        self._latched_estops: dict[str | None, tuple[msg.Bool, int, int]] = {}
        """Newest latched message of each publisher, and when it was sent and received."""
        self._received_ns = self._next_diagnosis_ns = 0
        self._failure: BaseException | None = None
        self._ended = threading.Event()
        # An e-stop must not wait behind a request that the daemon is slow to answer.
        self._asking, self._stopping = ros2_commands.Errands(), ros2_commands.Errands()
        namespace = config.ros2.namespace
        # A base on ROS 2 says its own odometry, and takes /cmd_vel itself.
        self._base_on_ros = isinstance(config.link.settings(), Ros2BaseSettings)
        self._writers = {
            # A topic without qualities of its own, as one that is said may be heard too.
            name: DataWriter(self._participant, Topic(self._participant, wire_name(name, namespace), kind), qos)
            for name, kind, qos in _PUBLISHED
            if not (self._base_on_ros and name in _OF_THE_BASE)
        }
        self._readers = list(self._create_readers(namespace))

    @property
    def where(self) -> str:
        """Text that says in which domain and namespace the bridge is, and what it receives."""
        ros2 = self._config.ros2
        poses_text = "" if self._pose is None else f"; poses from {self._pose.topic}"
        if self._config.fence.obstacles_port is not None:
            poses_text += f"; obstacles from {ros2_obstacles.TOPIC}"
        reach = "this computer only" if ros2.localhost_only else "the network"
        return f"ROS 2 domain {_domain(self._config)}, {reach}, namespace /{ros2.namespace.strip('/')}{poses_text}"

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Carry both ways until requested to stop; what fails on the way in is raised here."""
        # Neither thread waits long for the other's Python, and what was imported is not looked through for garbage.
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        gc.freeze()
        self._take_over_obstacles()
        inward = threading.Thread(target=self._receive, name="in", daemon=True)
        inward.start()
        try:
            while not should_stop() and self._failure is None:
                received = self._feed.receive(_WAIT_S)
                mono_ns, wall_ns = time.monotonic_ns(), time.time_ns()
                if received:
                    self._received_ns = mono_ns
                    for topic, message in self._outgoing.messages(received, wall_ns - mono_ns):
                        self._publish(topic, message)
                if mono_ns >= self._next_diagnosis_ns:
                    self._next_diagnosis_ns = mono_ns + _SECOND_NS
                    self._publish(*self._diagnosis(mono_ns, wall_ns))
        finally:
            self._ended.set()
            inward.join(2.0)
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Leave the ROS 2 domain and close all connections; safe to call twice."""
        self._ended.set()
        self._asking.close()
        self._stopping.close()
        self._feed.close()
        self._pad.close()
        self._to_daemon.close()
        self._obstacle_link.close()

    def _create_readers(self, namespace: str) -> Iterator[tuple[TopicReaders, _Handler]]:
        """Yield the readers of each topic with the method that handles their messages."""
        # One for each type that a topic may have: only the one that the sender has is ever matched.
        if self._pose is not None and self._pose.topic == ros2_inlets.TRANSFORMS:
            yield self._reader(namespace, out.TF, msg.TFMessage, _TRANSFORMS), self._handle_transforms
            yield self._reader(namespace, TF_STATIC, msg.TFMessage, LATCHED), self._handle_static_transforms
        elif self._pose is not None:
            for pose in ros2_inlets.TYPES:
                yield self._reader(namespace, self._pose.topic, pose, SENSOR), self._handle_pose
        for speed in () if self._base_on_ros else ros2_commands.TYPES:
            yield self._reader(namespace, CMD_VEL, speed, SENSOR), self._handle_speed
        for obstacles in () if self._config.fence.obstacles_port is None else ros2_obstacles.TYPES:
            yield self._reader(namespace, ros2_obstacles.TOPIC, obstacles, SENSOR), self._handle_obstacles
        yield self._reader(namespace, CTL, msg.String, RELIABLE, SENSOR), self._handle_request
        # Each by itself: an e-stop that counts twice does no harm, and it must not wait for what was lost before it.
        for qos in (RELIABLE, SENSOR):
            yield self._reader(namespace, ESTOP, msg.Bool, qos), self._handle_estop
        # Latched, too: one that was pressed before this process began is in force, unlike a request of then.
        yield self._reader(namespace, ESTOP, msg.Bool, LATCHED), self._keep_latched_estop

    def _reader(self, namespace: str, topic: str, kind: Any, *qualities: Qos) -> TopicReaders:
        return TopicReaders(self._participant, Topic(self._participant, wire_name(topic, namespace), kind), qualities)

    def _receive(self) -> None:
        try:
            waiting = WaitSet(self._participant)
            for readers, _ in self._readers:
                for reader in readers.readers:
                    waiting.attach(ReadCondition(reader, ViewState.Any | InstanceState.Any | SampleState.NotRead))
            while not self._ended.is_set():
                waiting.wait(duration(milliseconds=50))
                for readers, handle in self._readers:
                    for message, sent_ns in readers.take(_MAX_BATCH, self._unread):
                        handle(message, sent_ns)
                self._handle_latched_estops()
        except BaseException as failure:
            self._failure = failure

    def _handle_transforms(self, message: msg.TFMessage, sent_ns: int, *, static: bool = False) -> None:
        publisher = _publisher_of(message)
        now_ns = time.monotonic_ns(), time.time_ns()
        for pose in self._transforms.poses(message, sent_ns, *now_ns, static=static, publisher=publisher):
            self._handle_pose(pose, sent_ns)

    def _handle_static_transforms(self, message: msg.TFMessage, sent_ns: int) -> None:
        self._handle_transforms(message, sent_ns, static=True)

    def _handle_pose(self, message: ros2_inlets.PoseMessage, sent_ns: int) -> None:
        publisher = _publisher_of(message)
        datagram = self._poses.datagram(message, sent_ns, time.monotonic_ns(), time.time_ns(), publisher)
        for text in (*self._poses.new_messages(), *self._transforms.new_messages()):
            self._send_to_daemon(json.dumps({"said": text}).encode())
        if datagram is not None:
            self._send_to_daemon(datagram)

    def _send_to_daemon(self, datagram: bytes) -> None:
        if self._pose is None:
            return
        try:
            self._to_daemon.sendto(datagram, bridge_address(self._pose.port))
        except OSError:
            # No daemon, or one that does not keep up: the next pose is worth more than this one.
            self._unsent += 1

    def _handle_obstacles(self, message: msg.ObstacleArrayMsg | msg.String, sent_ns: int) -> None:
        fence = self._config.fence
        now_ns = time.monotonic_ns(), time.time_ns()
        for datagram in self._obstacles.datagrams(message, sent_ns, *now_ns, _publisher_of(message)):
            try:
                self._obstacle_link.sendto(datagram, (fence.obstacles_address, fence.obstacles_port))
            except OSError:
                # As with poses: the next report is worth more.
                self._obstacles_unsent += 1

    def _take_over_obstacles(self) -> None:
        """Take over what a bridge before this one reported, as only a bridge can say when it is gone."""
        known = self._request_status().get("area", {}).get("obstacles", ())
        self._obstacles.take_over({one["name"]: one["age_s"] for one in known}, time.monotonic_ns())

    def _handle_speed(self, message: msg.Twist | msg.TwistStamped, sent_ns: int) -> None:
        now_ns = time.monotonic_ns()
        request = self._speeds.request(message, sent_ns, now_ns, time.time_ns())
        if request is not None:
            self._pad.send(now_ns, request)

    def _handle_request(self, message: msg.String, sent_ns: int) -> None:
        request = message.data.strip()
        errands = self._stopping if request == "estop" else self._asking
        errands.add(partial(self._reply_to, sent_ns), request)

    def _handle_estop(self, message: msg.Bool, sent_ns: int) -> None:
        if message.data:
            self._stopping.add(partial(self._reply_to, sent_ns), "estop")

    def _keep_latched_estop(self, message: msg.Bool, sent_ns: int) -> None:
        self._latched_estops[_publisher_of(message)] = message, sent_ns, time.monotonic_ns()

    def _handle_latched_estops(self) -> None:
        """Handle the newest latched e-stop of each publisher: one that was released before is in force no more."""
        now_ns = time.monotonic_ns()
        for publisher, (message, sent_ns, received_ns) in list(self._latched_estops.items()):
            if now_ns - received_ns > _HISTORY_NS:
                del self._latched_estops[publisher]
                self._handle_estop(message, sent_ns)

    def _reply_to(self, sent_ns: int, request: str) -> None:
        """Carry out a request and publish the reply; where the daemon is driven by hand, arming only permits speeds."""
        reply: dict[str, Any]
        # Here, as it may also have waited for its turn.
        age_ns = time.time_ns() - sent_ns
        refused = ros2_commands.refusal(request, self._config.ros2.may_move, age_ns)
        if refused is not None:
            reply = {"do": request, "ok": False, "error": refused}
        elif request == "arm" and "drive" in (status := self._request_status()):
            if status["state"] in {"READY", "ARMED"}:
                refusal = self._speeds.permit(time.monotonic_ns())
            else:
                refusal = f"the robot is in state {status['state']}: {status['detail']}"
            reply = {"do": request, "ok": refusal is None, "text": "cmd_vel drives"}
            if refusal is not None:
                reply = {"do": request, "ok": False, "error": refusal}
        else:
            if request != "status":
                self._speeds.forbid()
            reply = ros2_commands.request_daemon(self._setup.robot_file, request, self._link)
        self._publish(REPLY, msg.String(json.dumps(reply)))

    def _request_status(self) -> dict[str, Any]:
        """Return the daemon's status, empty if it does not answer."""
        with contextlib.suppress(WorkError):
            return send_request(socket_path(self._config), {"do": "status"})
        return {}

    def _diagnosis(self, mono_ns: int, wall_ns: int) -> out.Message:
        """Return the topic and the message of the bridge's diagnostics."""
        poses, obstacles, speeds = self._poses, self._obstacles, self._speeds
        figures = {
            "poses passed on": poses.passed,
            "poses not taken by the daemon": self._unsent,
            **_refused("poses", poses.refused + self._transforms.refused),
            "poses without a heading": poses.without_heading,
            "obstacles passed on": obstacles.passed,
            "obstacles not sent": self._obstacles_unsent,
            **_refused("obstacles", obstacles.refused),
            "speeds passed on": speeds.passed,
            **_refused("speeds", speeds.refused),
            "requests refused, too many": self._asking.refused + self._stopping.refused,
            "messages that were none": self._unread.malformed,
            "readers that failed": self._unread.failed,
            "messages not sent": self._unwritten,
            "batches of the daemon missed": self._feed.missed,
        }
        wrong = f"poses refused: {self._poses.why}" if self._poses.why else self._pad.refusal
        is_connected = mono_ns - self._received_ns < _SECOND_NS
        return self._outgoing.diagnostics(
            wall_ns, is_connected, {name: str(count) for name, count in figures.items()}, wrong
        )

    def _publish(self, topic: str, message: object) -> None:
        try:
            if topic in self._writers:
                self._writers[topic].write(message)
        except DDSException:
            self._unwritten += 1


def _refused(what: str, counts: Mapping[str, int]) -> dict[str, int]:
    """Return counts by reason under their names in the diagnostics."""
    return {f"{what} refused: {why}": count for why, count in counts.items()}


@dataclass(slots=True)
class UnreadCounts:
    """Counts of failed reads: bytes that are no message of the reader's type, and failures of the reader itself."""

    malformed: int = 0
    failed: int = 0


def take_samples(reader: DataReader[Any], most: int, unread: UnreadCounts) -> Iterator[tuple[Any, int]]:
    """Yield a reader's valid samples with their source time stamps; count those that cannot be read."""
    try:
        samples = reader.take(most)
    except DDSException:
        unread.failed += 1
        return
    except Exception:
        # Whatever bytes a stranger sends under this type's name.
        unread.malformed += 1
        return
    for sample in samples:
        if sample.sample_info.valid_data:
            yield sample, sample.sample_info.source_timestamp


class TopicReaders:
    """Readers of one topic that differ in quality of service, so that publishers of any are heard.

    A publisher is heard by the first reader that matches it: its messages keep their order, and none counts twice.
    `qualities`: of each reader, the strictest first; the last matches all publishers that any of them matches.
    """

    def __init__(self, participant: DomainParticipant, topic: Topic[Any], qualities: Sequence[Qos]) -> None:
        self.readers = [DataReader(participant, topic, qos) for qos in qualities]
        # Publishers that each reader had messages of, as one that has gone is matched no more.
        self._heard: list[deque[int]] = [deque(maxlen=_MAX_BATCH) for _ in qualities]

    def take(self, most: int, unread: UnreadCounts) -> Iterator[tuple[Any, int]]:
        """Yield samples with their source time stamps, at most so many of each reader; count unreadable ones."""
        heard_before: set[int] = set()
        for reader, heard in zip(self.readers, self._heard, strict=True):
            for message, sent_ns in take_samples(reader, most, unread):
                publisher = message.sample_info.publication_handle
                if publisher not in heard_before:
                    heard.append(publisher)
                    yield message, sent_ns
            heard_before |= _matched(reader).union(heard)

    def has_publisher(self) -> bool:
        """Whether any publisher of the topic can be heard."""
        return bool(_matched(self.readers[-1]))


def _matched(reader: DataReader[Any]) -> set[int]:
    """Return the handles of the publishers that a reader matches, as samples have them."""
    while True:
        # The binding asks for their number first, and fails where another has come since.
        with contextlib.suppress(IndexError):
            return {handle % (1 << 64) for handle in reader.get_matched_publications()}


def _publisher_of(message: Any) -> str | None:
    """Return text that identifies the DDS writer of a message; None for a message made here."""
    info = getattr(message, "sample_info", None)
    return None if info is None else f"publisher {info.publication_handle:x}"


def _domain(config: RobotConfig) -> int:
    if config.ros2.domain is not None:
        return config.ros2.domain
    given = os.environ.get("ROS_DOMAIN_ID", "0")
    if not (given.isascii() and given.isdigit() and int(given) <= 232):
        raise InputError(f"ROS_DOMAIN_ID: {given} is not a domain; set it to a number from 0 to 232")
    return int(given)


def join_domain(config: RobotConfig) -> tuple[Domain | None, DomainParticipant]:
    """Join the ROS 2 domain; return the domain, None unless it is for this computer only, and the participant.

    Beyond this computer others are found as $CYCLONEDDS_URI says, or by multicast. Raises WorkError.
    """
    number = _domain(config)
    try:
        domain = Domain(number, msg.LOOPBACK) if config.ros2.localhost_only else None
        return domain, DomainParticipant(number)
    except DDSException as error:
        raise WorkError(f"ROS 2 domain {number} cannot be joined ({error.msg}); see ros2.domain") from None
