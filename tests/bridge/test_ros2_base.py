"""The bridge to a base on ROS 2: what it takes for wheels, when it lets the base drive, and who is let in."""

import itertools
import math
import os
import socket
import struct
import threading
import time
from contextlib import closing

import msgspec
import pytest

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: make venv")

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from disco_hw.bridge import ros2_base
from disco_hw.bridge import ros2_messages as msg
from disco_hw.bridge.ros2 import LATCHED, RELIABLE, join_domain
from disco_hw.bridge.ros2_base import BaseBridge, Clients, run_base_bridge
from disco_hw.bridge.ros2_inlets import WheelInlet
from disco_hw.config import load_robot_config
from disco_hw.config.robot import Ros2
from disco_hw.errors import InputError
from drivers.motor import find_driver
from drivers.motor import ros2_base_wire as wire
from drivers.motor.vendor_parts import Odometer
from drivers.types import Frame
from tests.first_use.miswired import robot_file

MS = 1_000_000
MONO_NS, WALL_NS = 50_000 * MS, 1_800_000_000_000 * MS
DOMAINS = itertools.count(10 + os.getpid() % 20 * 3)
JOINTS = {"left_joints": ("fl", "rl"), "right_joints": ("fr", "rr")}


def settings(**fields):
    return wire.Ros2BaseSettings(wheel_radius_m=0.1, track_m=0.5, max_speed_m_s=1.0, watchdog_s=0.5, **fields)


def joints(at_ms, angles=(1.0, 2.0), speeds=(0.5, 1.5), names=("fl", "fr", "rl", "rr", "arm"), stamp=True):
    left, right = angles
    position = {"fl": left - 0.1, "rl": left + 0.1, "fr": right, "rr": right, "arm": 9.0}
    velocity = {"fl": speeds[0], "rl": speeds[0], "fr": speeds[1], "rr": speeds[1], "arm": 9.0} if speeds else {}
    header = msg.Header(msg.stamp_of(WALL_NS + at_ms * MS) if stamp else msg.Time())
    return msg.JointState(header, list(names), [position[n] for n in names], [velocity[n] for n in names if velocity])


def odometry(at_ms, x, y, yaw, speed=0.0, turn=0.0):
    turned = msg.Quaternion(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    pose = msg.PoseWithCovariance(msg.RosPose(msg.Point(x, y, 0.0), turned))
    twist = msg.TwistWithCovariance(msg.Twist(msg.Vector3(speed, 0.0, 0.0), msg.Vector3(0.0, 0.0, turn)))
    return msg.Odometry(msg.Header(msg.stamp_of(WALL_NS + at_ms * MS), "odom"), "base_link", pose, twist)


def pass_wheels(inlet, message, now_ms=0):
    return inlet.wheels(message, WALL_NS + now_ms * MS, MONO_NS + now_ms * MS, WALL_NS + now_ms * MS)


@pytest.fixture
def inlet():
    return WheelInlet(settings(**JOINTS))


def test_joints_of_a_side_are_averaged_and_their_age_is_that_of_the_stamp_or_else_of_the_sending(inlet):
    wheels = pass_wheels(inlet, joints(-20))
    assert wheels.angles_rad == pytest.approx((1.0, 2.0))
    assert wheels.speeds_rad_s == pytest.approx((0.5, 1.5))
    assert wheels.age_s == pytest.approx(0.020)
    assert pass_wheels(inlet, joints(30)).age_s == 0.0, "a stamp a little ahead is now"
    later_ns = WALL_NS + 100 * MS
    wheels = inlet.wheels(joints(0, stamp=False), later_ns - 30 * MS, MONO_NS + 100 * MS, later_ns)
    assert wheels.age_s == pytest.approx(0.030)


def test_without_velocities_the_speeds_are_those_of_the_angles(inlet):
    assert pass_wheels(inlet, joints(0, speeds=None)).speeds_rad_s == (0.0, 0.0)
    assert pass_wheels(inlet, joints(20, (1.1, 1.9), None), 20).speeds_rad_s == pytest.approx((5.0, -5.0))


def test_velocities_that_are_not_measured_are_as_if_there_were_none(inlet):
    """joint_state_broadcaster writes NaN where a joint has no velocity interface."""
    assert pass_wheels(inlet, joints(0, speeds=(math.nan, math.nan))).speeds_rad_s == (0.0, 0.0)
    wheels = pass_wheels(inlet, joints(20, (1.1, 1.9), (0.5, math.nan)), 20)
    assert wheels.speeds_rad_s == pytest.approx((5.0, -5.0))
    others = joints(40, speeds=(0.5, 1.5))
    others.velocity[others.name.index("arm")] = math.nan
    assert pass_wheels(inlet, others, 40).speeds_rad_s == pytest.approx((0.5, 1.5))
    assert not inlet.refused


def test_joints_of_an_arm_alone_are_nothing_and_not_refused(inlet):
    assert pass_wheels(inlet, joints(0, names=("arm",))) is None
    assert not inlet.refused


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (joints(-600), "another clock"),
        (joints(200), "another clock"),
        (joints(0, names=("fl", "fr", "rl")), "link.right_joints, or their positions, are missing"),
        (joints(0, (math.nan, 0.0)), "not finite"),
        (joints(0, speeds=(0.0, math.inf)), "not finite"),
        (joints(0, speeds=(0.0, 21.0)), "faster than the base can"),
        (msg.JointState(joints(0).header, ["fl", "fr", "rl", "rr"], [], [0.0] * 4), "or their positions"),
    ],
)
def test_wheels_that_cannot_be_are_refused_by_reason(inlet, message, reason):
    assert pass_wheels(inlet, message) is None
    assert [reason in text for text in inlet.refused] == [True]
    assert reason in wire.REFUSALS[inlet.why(MONO_NS)]
    assert inlet.why(MONO_NS + 2000 * MS) == 0
    assert pass_wheels(inlet, joints(40), 40) is not None, "what comes after is taken"


def test_what_comes_out_of_order_is_refused(inlet):
    assert pass_wheels(inlet, joints(0))
    assert pass_wheels(inlet, joints(-10), 10) is None
    assert pass_wheels(inlet, joints(0), 10) is None
    assert list(inlet.refused) == ["its messages come out of order"]


def test_odometry_is_turned_back_into_wheels_whatever_was_lost_between():
    """An arc of 1.5 m to the left by 3 rad: the wheels of an ideal base with a track of 0.5 m."""
    inlet, radius = WheelInlet(settings()), 0.5
    pass_wheels(inlet, odometry(0, 3.0, -1.0, 3.0))
    for step in range(3, 31, 3):
        yaw = 3.0 + 0.1 * step
        x = 3.0 + radius * (math.sin(yaw) - math.sin(3.0))
        y = -1.0 - radius * (math.cos(yaw) - math.cos(3.0))
        wheels = pass_wheels(inlet, odometry(20 * step, x, y, yaw, 0.5, 1.0), 20 * step)
    assert wheels.angles_rad == pytest.approx(((1.5 - 0.75) / 0.1, (1.5 + 0.75) / 0.1), rel=0.01)
    assert wheels.speeds_rad_s == pytest.approx((2.5, 7.5))


def test_odometry_with_a_pose_that_is_none_is_refused_and_forgotten():
    inlet = WheelInlet(settings())
    before = pass_wheels(inlet, odometry(0, 0.0, 0.0, 0.0))
    for x, yaw in ((math.nan, 0.0), (math.inf, 0.0), (0.0, math.nan), (1e308, 1.0)):
        wheels = pass_wheels(inlet, odometry(20, x, 0.0, yaw), 20)
        assert wheels is None or x == 1e308
    assert before.angles_rad == (0.0, 0.0)


def test_frames_carry_the_wheels_over_the_wrap_of_their_count():
    for angles in ((-3.0, 5.0), (214_748.3647, -214_748.3), (1e6, -1e6)):
        one, two = (wire.Wheels((angles[0] + more, angles[1] - more), (-2.0, 65.0), 0.0123) for more in (0.0, 1.5))
        first, second = wire.wheel_frames(one), wire.wheel_frames(two)
        turned = []
        for before, now in zip(*(wire.unpack_angles(frames[0].data) for frames in (first, second)), strict=True):
            side = Odometer()
            assert side.add_wrapping(before, 0, 0, 1e5, 0.0)
            assert side.add_wrapping(now, 10**9, 0, 1e5, 0.0)
            turned.append(wire.ANGLE_RAD * side.total)
        assert turned == pytest.approx((1.5, -1.5), abs=2e-4)
        speeds, age_s = wire.unpack_wheels(first[1].data)
        assert speeds == pytest.approx((-2.0, 65.0), abs=2e-3)
        assert age_s == pytest.approx(0.0123)


class TestBaseEnd:
    """When speeds go out, and when zeros."""

    @pytest.fixture
    def end(self):
        return wire.BaseEnd(settings())

    @pytest.fixture
    def enabled(self, end):
        end.receive(0, wire.enable(True))
        return end

    def test_speeds_are_said_only_after_it_was_enabled(self, end):
        assert end.receive(0, wire.speeds(0.5, 0.1)) is None
        assert end.refused_speeds == 1
        end.receive(0, wire.enable(True))
        assert end.receive(0, wire.speeds(0.5, -0.25)) == (0.5, -0.25)

    def test_only_speeds_feed_it_and_its_silence_needs_a_new_enabling(self, enabled):
        enabled.receive(0, wire.speeds(0.5, 0.0))
        for now_ms in range(20, 240, 20):
            enabled.receive(now_ms * MS, wire.enable(True))
            published = enabled.step(now_ms * MS)
            assert published == (None if now_ms <= 200 else (0.0, 0.0))
        assert not enabled.driving
        assert wire.unpack_state(enabled.state().data)[0] & wire.FELL_SILENT
        assert enabled.receive(300 * MS, wire.speeds(0.5, 0.0)) is None

    def test_speeds_in_time_keep_it_driving_and_a_new_enabling_forgets_the_silence(self, enabled):
        for now_ms in range(0, 2000, 190):
            assert enabled.receive(now_ms * MS, wire.speeds(0.5, 0.0)) == (0.5, 0.0)
        enabled.step(3000 * MS)
        assert wire.unpack_state(enabled.state().data)[0] & wire.FELL_SILENT
        enabled.receive(3000 * MS, wire.enable(True))
        assert not wire.unpack_state(enabled.state().data)[0] & wire.FELL_SILENT

    @pytest.mark.parametrize(
        ("now_ms", "speeds"), [(201, (0.5, 0.0)), (0, (math.nan, 0.0)), (0, (0.0, -math.inf))], ids=str
    )
    def test_speeds_that_are_none_or_come_after_a_silence_are_not_said(self, enabled, now_ms, speeds):
        """Even before the next step."""
        assert enabled.receive(now_ms * MS, wire.speeds(*speeds)) is None

    def test_after_standing_by_it_leaves_the_topic_to_others(self, enabled):
        assert enabled.receive(0, wire.enable(False)) == (0.0, 0.0)
        assert enabled.step(400 * MS) == (0.0, 0.0)
        assert enabled.step(600 * MS) is None

    def test_an_estop_is_held_with_zeros_until_it_is_reset(self, enabled):
        assert enabled.receive(0, Frame(wire.STOP, b"")) == (0.0, 0.0)
        for now_ms in (1000, 100_000):
            enabled.receive(now_ms * MS, wire.enable(True))
            assert enabled.receive(now_ms * MS, wire.speeds(0.5, 0.0)) is None
            assert enabled.step(now_ms * MS) == (0.0, 0.0)
        enabled.receive(100_001 * MS, Frame(wire.RESET, b""))
        assert not enabled.driving
        assert enabled.step(100_700 * MS) is None

    def test_a_button_of_the_base_stops_it_and_keeps_it_from_being_enabled(self, enabled):
        enabled.button = True
        assert enabled.step(20 * MS) == (0.0, 0.0)
        enabled.receive(40 * MS, wire.enable(True))
        assert not enabled.driving

    def test_a_button_that_nobody_speaks_for_any_more_stops_it_and_leaves_the_topic_to_others(self, enabled):
        enabled.receives_button = False
        assert enabled.step(20 * MS) == (0.0, 0.0)
        assert enabled.step(1000 * MS) is None
        enabled.receive(1000 * MS, wire.enable(True))
        assert not enabled.driving


def packet(frame):
    return struct.pack("=IB3x8s", frame.can_id, len(frame.data), frame.data)


@pytest.fixture
def clients(tmp_path):
    with closing(Clients(tmp_path / "base")) as listening:
        yield listening


def connected(path):
    client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    client.connect(str(path))
    client.settimeout(5.0)
    return client


def test_clients_hear_the_bridge_and_each_other_and_a_hang_up_is_reported(clients):
    path = clients._path
    one, other = connected(path), connected(path)
    for _ in range(3):
        list(clients.receive(0.05))
    one.send(packet(wire.enable(True)))
    one.send(b"no frame")
    ((_, frame),) = clients.receive(5.0)
    assert frame == wire.enable(True)
    assert other.recv(100) == packet(wire.enable(True)), "as on a bus"
    clients.send(Frame(wire.STATE, bytes(8)))
    assert one.recv(100) == other.recv(100) == packet(Frame(wire.STATE, bytes(8)))
    one.close()
    ((_, gone),) = clients.receive(5.0)
    assert gone is None
    clients.close()
    other.close()
    assert not path.exists()


def test_who_does_not_read_holds_up_nobody(clients):
    with connected(clients._path):
        list(clients.receive(0.05))
        for _ in range(5000):
            clients.send(Frame(wire.STATE, bytes(8)))
        assert clients.dropped > 1000


def test_the_socket_of_a_bridge_that_was_killed_is_taken_over_and_a_living_ones_is_not(tmp_path):
    path = tmp_path / "base"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as killed:
        killed.bind(str(path))
    with closing(Clients(path)):
        assert path.stat().st_mode & 0o777 == 0o600
        with pytest.raises(InputError, match="listens there; stop it first"):
            Clients(path)


class OverDds:
    """A bridge in this process, and a base beside it on the same domain; the daemon is a client."""

    def __init__(self, tmp_path, clients, stop_topic=""):
        number, self.clients = next(DOMAINS), clients
        config = msgspec.structs.replace(load_robot_config(robot_file(tmp_path, "ros2_base")), ros2=Ros2(domain=number))
        bridge = BaseBridge(config, settings(stop_topic=stop_topic, **JOINTS), clients)
        self.participant = DomainParticipant(number)
        self.speeds = DataReader(self.participant, Topic(self.participant, "rt/cmd_vel", msg.Twist))
        self.joints = self.writer("joint_states", msg.JointState)
        self.daemon = connected(clients._path)
        self.ended = False
        self.thread = threading.Thread(target=bridge.run, args=(lambda: self.ended,))
        self.thread.start()

    def writer(self, topic, kind, qos=None):
        return DataWriter(self.participant, Topic(self.participant, f"rt/{topic}", kind), qos)

    def end(self):
        self.ended = True
        self.thread.join()
        self.daemon.close()

    def send(self, *frames):
        for frame in frames:
            self.daemon.send(packet(frame))

    def flags(self):
        """Return the flags of the next STATE."""
        while True:
            received = self.daemon.recv(16)
            if struct.unpack("=I", received[:4])[0] == wire.STATE:
                return wire.unpack_state(received[8:])[0]

    def until(self, condition, also=lambda: None):
        """Say joints, and whatever `also` does, until the flags fulfil a condition; the speeds heard on the way."""
        received, deadline = [], time.monotonic() + 100.0
        while not condition(self.flags()):
            assert time.monotonic() < deadline
            now = msg.Header(msg.stamp_of(time.time_ns()))
            self.joints.write(msg.JointState(now, ["fl", "rl", "fr", "rr"], [0.0] * 4, [0.0] * 4))
            also()
            received += [(each.linear.x, each.angular.z) for each in self.speeds.take(100)]
        return received


@pytest.fixture(params=[""])
def over_dds(tmp_path, clients, request):
    made = OverDds(tmp_path, clients, request.param)
    yield made
    made.end()


def test_over_dds_a_base_is_found_and_driven_until_another_node_speaks(over_dds):
    over_dds.until(lambda flags: flags & wire.RECEIVED and flags & wire.ODOMETRY and not flags & wire.OTHERS)
    over_dds.send(wire.enable(True))
    over_dds.until(lambda flags: flags & wire.DRIVING)
    received = over_dds.until(
        lambda flags: (0.25, -0.5) in [(one.linear.x, one.angular.z) for one in over_dds.speeds.take(10)],
        lambda: over_dds.send(wire.speeds(0.25, -0.5)),
    )
    assert set(received) <= {(0.25, -0.5), (0.0, 0.0)}
    other = DataWriter(over_dds.participant, Topic(over_dds.participant, "rt/cmd_vel", msg.Twist))
    over_dds.until(lambda flags: flags & wire.OTHERS, lambda: other.write(msg.Twist()))


@pytest.mark.parametrize("over_dds", ["/button"], indirect=True)
def test_over_dds_the_button_and_the_daemons_end_stop_the_base(over_dds):
    over_dds.until(lambda flags: flags & wire.RECEIVED and flags & wire.ODOMETRY and flags & wire.BUTTON)
    over_dds.send(wire.enable(True))
    over_dds.until(lambda flags: not flags & wire.DRIVING and flags & wire.BUTTON)
    button = DataWriter(over_dds.participant, Topic(over_dds.participant, "rt/button", msg.Bool), RELIABLE)
    over_dds.until(lambda flags: not flags & wire.BUTTON, lambda: button.write(msg.Bool(False)))
    over_dds.send(wire.enable(True), wire.speeds(0.25, 0.0))
    over_dds.until(lambda flags: flags & wire.BUTTON and not flags & wire.DRIVING, lambda: button.write(msg.Bool(True)))
    over_dds.until(lambda flags: not flags & wire.BUTTON, lambda: button.write(msg.Bool(False)))
    over_dds.send(wire.enable(True))
    over_dds.until(lambda flags: flags & wire.DRIVING)
    watcher = connected(over_dds.clients._path)
    over_dds.daemon.close()
    over_dds.daemon = watcher
    over_dds.until(lambda flags: not flags & (wire.DRIVING | wire.FELL_SILENT))


@pytest.mark.parametrize("over_dds", ["/button"], indirect=True)
def test_over_dds_a_button_that_speaks_best_effort_is_heard(over_dds):
    button = over_dds.writer("button", msg.Bool, Qos(Policy.Reliability.BestEffort))
    over_dds.until(lambda flags: not flags & wire.BUTTON, lambda: button.write(msg.Bool(False)))
    over_dds.until(lambda flags: flags & wire.BUTTON, lambda: button.write(msg.Bool(True)))


def test_over_dds_a_button_that_spoke_once_before_the_bridge_was_there_is_heard_if_it_is_latched(
    tmp_path, clients, monkeypatch
):
    latched = []

    def join_second(config):
        domain, participant = join_domain(config)
        latched.append(DataWriter(participant, Topic(participant, "rt/button", msg.Bool), LATCHED))
        latched[0].write(msg.Bool(False))
        return domain, participant

    monkeypatch.setattr(ros2_base, "join_domain", join_second)
    over_dds = OverDds(tmp_path, clients, "/button")
    try:
        over_dds.until(lambda flags: not flags & wire.BUTTON)
        latched[0].write(msg.Bool(True))
        over_dds.until(lambda flags: flags & wire.BUTTON)
    finally:
        over_dds.end()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("watchdog_s = 0.5\n", "", "watchdog_s: missing; add it"),
        ("watchdog_s = 0.5", "watchdog_s = 0.0", r"link\.watchdog_s"),
        ("watchdog_s = 0.5", "watchdog_s = 1.5", r"link\.watchdog_s"),
        ("watchdog_s = 0.5", 'watchdog_s = 0.5\nleft_joints = ["l"]', r"link\.right_joints: empty, .*both sides"),
        ("watchdog_s = 0.5", 'watchdog_s = 0.5\nleft_joints = ["l"]\nright_joints = ["l"]', "a joint is listed twice"),
        ("watchdog_s = 0.5", "watchdog_s = 0.5\nnodes = [3, 5]", r'link\.nodes: belongs to the driver "odrive" or'),
        ('interface = "unixcan"', 'interface = "socketcan"', r'link\.interface: .*; write "unixcan"'),
        ("ros2_base", "agilex", "watchdog_s"),
        ("CHANNEL", "OPEN", r"link\.channel: .*others can write to it; write a path"),
    ],
)
def test_what_robot_toml_lacks_and_a_socket_that_others_could_have_placed_are_refused_in_one_line(
    tmp_path, old, new, message
):
    file, open_folder = robot_file(tmp_path, find_driver("ros2_base").name), tmp_path / "open"
    open_folder.mkdir()
    open_folder.chmod(0o777)
    text = file.read_text(encoding="utf-8")
    old = old.replace("CHANNEL", load_robot_config(file).link.channel)
    assert old in text
    file.write_text(text.replace(old, new.replace("OPEN", str(open_folder / "base"))), encoding="utf-8")
    with pytest.raises(InputError, match=message) as caught:
        run_base_bridge(file)
    assert str(caught.value).startswith(str(file))
    assert "\n" not in str(caught.value)
