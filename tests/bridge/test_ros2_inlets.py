"""Poses from ROS: what is passed on to the daemon, and what is refused for which reason."""

import math
import os
import threading
import time

import pytest

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: make venv")


from disco_hw.bridge import ros2_messages as msg
from disco_hw.bridge.ros2 import Bridge
from disco_hw.bridge.ros2_inlets import PoseInlet, TransformInlet
from disco_hw.config import PoseInput
from disco_hw.runtime.robot_setup import load_setup
from drivers.pose.ros2 import create_pose_source
from drivers.pose.udp import pose_of
from tests.first_use.miswired import robot_file

MONO_NS, WALL_NS = 50_000_000_000, 1_800_000_000_000_000_000
MS = 1_000_000


def transform(parent, child, stamp_ns, x, y=0.0, yaw=0.0):
    turned = msg.Quaternion(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    header = msg.Header(msg.stamp_of(stamp_ns), parent)
    return msg.TFMessage([msg.TransformStamped(header, child, msg.Transform(msg.Vector3(x, y, 0.0), turned))])


def pose_message(age_ns=20 * MS, frame="map", x=1.0, yaw=2.5, kind=msg.PoseStamped, covariance=None):
    pose = msg.RosPose(msg.Point(x, -2.0, 0.3), msg.Quaternion(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)))
    header = msg.Header(msg.stamp_of(WALL_NS - age_ns), frame)
    if kind is msg.PoseStamped:
        return kind(header, pose)
    spread = msg.PoseWithCovariance(pose, covariance or [0.0] * 36)
    return kind(header, spread) if kind is msg.PoseWithCovarianceStamped else kind(header, "base_link", spread)


@pytest.fixture
def poses():
    return PoseInlet(PoseInput())


def covariance(xx, yy, tt):
    full = [0.0] * 36
    full[0], full[7], full[35] = xx, yy, tt
    return full


@pytest.mark.parametrize("kind", [msg.PoseStamped, msg.PoseWithCovarianceStamped, msg.Odometry])
def test_a_pose_reaches_the_daemon_at_its_own_time(kind):
    inlet = PoseInlet(PoseInput(position_std_m=0.03, yaw_std_rad=0.04))
    datagram = inlet.datagram(pose_message(kind=kind), 0, MONO_NS, WALL_NS)
    pose = pose_of(datagram, MONO_NS + MS)
    assert pose.t_ns == MONO_NS - 20 * MS
    assert (pose.x_m, pose.y_m) == (1.0, -2.0)
    assert pose.yaw_rad == pytest.approx(2.5)
    assert (pose.position_std_m, pose.yaw_std_rad) == (0.03, 0.04)


def test_deviations_of_robot_toml_are_metres_and_radians_whatever_the_units_of_the_poses():
    settings = PoseInput(position_unit="mm", yaw_unit="deg", position_std_m=0.03, yaw_std_rad=0.04)
    pose = pose_of(PoseInlet(settings).datagram(pose_message(), 0, MONO_NS, WALL_NS), MONO_NS)
    found = settings.convention().converted(pose)
    assert (found.position_std_m, found.yaw_std_rad) == pytest.approx((0.03, 0.04))
    inlet = TransformInlet(settings, "base_link")
    (message,) = inlet.poses(transform("map", "base_link", WALL_NS, 1.0), 0, MONO_NS, WALL_NS, static=False)
    assert message.pose.covariance[0] == pytest.approx(30.0**2)
    assert message.pose.covariance[35] == pytest.approx(math.degrees(0.04) ** 2)


def test_a_covariance_becomes_standard_deviations_the_larger_of_the_position(poses):
    message = pose_message(kind=msg.Odometry, covariance=covariance(0.01, 0.04, 0.0009))
    pose = pose_of(poses.datagram(message, 0, MONO_NS, WALL_NS), MONO_NS)
    assert (pose.position_std_m, pose.yaw_std_rad) == (pytest.approx(0.2), pytest.approx(0.03))


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (pose_message(frame="odom"), "frame"),
        (pose_message(frame=""), "frame"),
        (pose_message(x=math.nan), "finite"),
        (pose_message(x=math.inf), "finite"),
        (pose_message(yaw=math.nan), "finite"),
        (pose_message(age_ns=1100 * MS), "clock"),
        (pose_message(age_ns=-60 * MS), "clock"),
        (pose_message(age_ns=WALL_NS - 5_000_000_000), "clock"),
        (pose_message(kind=msg.Odometry, covariance=covariance(-1.0, 1.0, 1.0)), "covariance"),
        (pose_message(kind=msg.Odometry, covariance=covariance(1.0, math.nan, 1.0)), "covariance"),
        (
            msg.PoseStamped(msg.Header(msg.stamp_of(WALL_NS), "map"), msg.RosPose(msg.Point(), msg.Quaternion(w=0.0))),
            "heading",
        ),
    ],
)
def test_what_is_no_pose_is_refused_by_its_reason(poses, message, expected):
    assert poses.datagram(message, WALL_NS, MONO_NS, WALL_NS) is None
    assert [expected in reason for reason in poses.refused] == [True]
    assert expected in poses.why
    # One that is well is still taken after it.
    assert poses.datagram(pose_message(age_ns=10 * MS), 0, MONO_NS, WALL_NS) is not None
    assert poses.why == ""


def test_a_pose_without_a_stamp_has_the_time_at_which_it_was_sent(poses):
    message = pose_message()
    message.header.stamp = msg.Time()
    sent = poses.datagram(message, WALL_NS - 70 * MS, MONO_NS, WALL_NS)
    assert pose_of(sent, MONO_NS).t_ns == MONO_NS - 70 * MS
    assert PoseInlet(PoseInput()).datagram(message, WALL_NS - 2000 * MS, MONO_NS, WALL_NS) is None


def test_of_a_flood_and_of_repetitions_little_is_passed_on(poses):
    now = range(0, 100 * MS, MS // 10)
    passed = [poses.datagram(pose_message(20 * MS - t), 0, MONO_NS + t, WALL_NS + t) for t in now]
    assert 20 <= sum(one is not None for one in passed) <= 26
    assert poses.datagram(pose_message(20 * MS), 0, MONO_NS + 200 * MS, WALL_NS + 200 * MS) is None


class TestTransforms:
    """map - odom by a localisation, odom - base_footprint by the wheels, base_footprint - base_link fixed."""

    @pytest.fixture
    def inlet(self):
        inlet = TransformInlet(PoseInput(position_std_m=0.03, yaw_std_rad=0.04), "base_link")
        assert not self.poses_of(inlet, 0, "base_footprint", "base_link", (0.1, 0.0, 0.0), static=True)
        return inlet

    def poses_of(self, inlet, at_ms, parent, child, place, static=False, now_ms=None):
        """The poses that a transform at a time brings."""
        now_ns = WALL_NS + (at_ms if now_ms is None else now_ms) * MS
        message = transform(parent, child, WALL_NS + at_ms * MS, *place)
        return list(inlet.poses(message, now_ns, now_ns - WALL_NS + MONO_NS, now_ns, static=static))

    @staticmethod
    def place(pose):
        turned = pose.pose.pose.orientation
        at = pose.pose.pose.position
        return at.x, at.y, 2.0 * math.atan2(turned.z, turned.w)

    def test_the_chain_is_followed_at_the_corrections_own_time(self, inlet):
        self.poses_of(inlet, 0, "odom", "base_footprint", (1.0, 0.0, 0.0))
        self.poses_of(inlet, 100, "odom", "/base_footprint", (2.0, 0.0, 0.2))
        (pose,) = self.poses_of(inlet, 50, "map", "odom", (10.0, 5.0, math.pi / 2), now_ms=100)
        assert msg.time_of(pose.header.stamp) == WALL_NS + 50 * MS
        assert pose.header.frame_id == "map"
        # Half way: 1.5 m and 0.1 rad in odom, and 0.1 m further to base_link.
        x, y = 1.5 + 0.1 * math.cos(0.1), 0.1 * math.sin(0.1)
        assert self.place(pose) == pytest.approx((10.0 - y, 5.0 + x, math.pi / 2 + 0.1))
        assert pose.pose.covariance[0] == pytest.approx(0.03**2)
        assert pose.pose.covariance[35] == pytest.approx(0.04**2)

    def test_a_correction_dated_ahead_counts_from_the_newest_odometry_and_reaches_the_daemon(self, inlet):
        self.poses_of(inlet, 0, "odom", "base_footprint", (1.0, 0.0, 0.0))
        (pose,) = self.poses_of(inlet, 1000, "map", "odom", (1.0, 0.0, 0.0), now_ms=10)
        assert msg.time_of(pose.header.stamp) == WALL_NS
        datagram = PoseInlet(PoseInput()).datagram(pose, 0, MONO_NS, WALL_NS + 10 * MS)
        passed = pose_of(datagram, MONO_NS)
        assert (passed.t_ns, passed.x_m) == (MONO_NS - 10 * MS, pytest.approx(2.1))

    def test_the_wheels_alone_bring_none(self, inlet):
        self.poses_of(inlet, 0, "odom", "base_footprint", (1.0, 0.0, 0.0))
        self.poses_of(inlet, 10, "map", "odom", (1.0, 0.0, 0.0))
        assert not self.poses_of(inlet, 20, "odom", "base_footprint", (1.1, 0.0, 0.0))

    def test_a_correction_that_repeats_itself_brings_two_a_second_and_weaker_ones(self, inlet):
        poses = []
        for at_ms in range(0, 3000, 20):
            self.poses_of(inlet, at_ms, "odom", "base_footprint", (1.0, 0.0, 0.0))
            poses += self.poses_of(inlet, at_ms + 5, "map", "odom", (1.0 if at_ms < 2000 else 2.0, 0.0, 0.0))
        assert [round(math.sqrt(pose.pose.covariance[0]) / 0.03) for pose in poses] == [1, 3, 3, 3, 1, 3]

    def test_a_single_edge_that_moves_brings_each_and_a_static_one_none(self):
        inlet = TransformInlet(PoseInput(), "base_link")
        assert not self.poses_of(inlet, 0, "map", "base_link", (1.0, 0.0, 0.0), static=True)
        inlet = TransformInlet(PoseInput(), "base_link")
        poses = [self.poses_of(inlet, 20 * k, "map", "base_link", (1.0, 0.0, 0.0)) for k in range(5)]
        assert [len(each) for each in poses] == [1] * 5

    @pytest.mark.parametrize(
        ("at_ms", "place", "reason"),
        [(100, (math.nan, 0.0, 0.0), "not finite"), (-500, (0.0, 0.0, 0.0), "do not reach")],
    )
    def test_transforms_that_make_no_pose_are_counted_by_reason(self, inlet, at_ms, place, reason):
        self.poses_of(inlet, 0, "odom", "base_footprint", (1.0, 0.0, 0.0))
        before = sum(inlet.refused.values())
        assert not self.poses_of(inlet, at_ms, "map", "odom", place)
        assert sum(inlet.refused.values()) == before + 1
        assert reason in list(inlet.refused)[-1]

    def test_a_missing_chain_and_a_circle_are_named_and_a_flood_of_frames_is_bounded(self, inlet):
        assert not self.poses_of(inlet, 0, "odom", "base_footprint", (1.0, 0.0, 0.0))
        assert not self.poses_of(inlet, 0, "base_link", "odom", (1.0, 0.0, 0.0))
        assert any('without a chain from "map" to "base_link"' in why for why in inlet.refused)
        for number in range(1000):
            self.poses_of(inlet, 0, "map", f"frame{number}", (0.0, 0.0, 0.0))
        assert inlet.refused["transforms of too many frames"] > 400

    def test_of_two_publishers_of_one_edge_the_first_counts_and_the_other_is_named(self, inlet):
        def poses_by(at_ms, x, publisher):
            now_ns = WALL_NS + at_ms * MS
            message = transform("map", "odom", now_ns, x)
            return list(inlet.poses(message, 0, MONO_NS + at_ms * MS, now_ns, static=False, publisher=publisher))

        for at_ms in range(0, 500, 50):
            self.poses_of(inlet, at_ms, "odom", "base_link", (1.0, 0.0, 0.0))
            poses_by(at_ms, 3.0, "slam")
            assert not poses_by(at_ms + 10, 9.0, "amcl")
        assert inlet.refused["transforms of a second publisher of the same edge"] == 10
        (warning,) = inlet.new_messages()
        assert warning.startswith("amcl sends poses while slam does: not used")

    def test_a_clock_that_was_set_back_begins_anew(self, inlet):
        self.poses_of(inlet, 60_000, "odom", "base_footprint", (1.0, 0.0, 0.0))
        self.poses_of(inlet, 60_000, "map", "odom", (1.0, 0.0, 0.0))
        self.poses_of(inlet, 0, "odom", "base_footprint", (1.0, 0.0, 0.0))
        assert self.poses_of(inlet, 0, "map", "odom", (3.0, 0.0, 0.0))

    @pytest.mark.parametrize(("step_ms", "set_back_ms"), [(2000, 1000), (2960, 3_600_000)])
    def test_after_the_clock_was_set_back_poses_come_at_once_and_a_second_publisher_takes_over(
        self, inlet, step_ms, set_back_ms
    ):
        def passes(at_ms, publisher):
            mono_ns, now_ns = MONO_NS + at_ms * MS, WALL_NS + (at_ms - (at_ms > step_ms) * set_back_ms) * MS
            list(inlet.poses(transform("odom", "base_link", now_ns, at_ms), 0, mono_ns, now_ns, static=False))
            message = transform("map", "odom", now_ns, at_ms)
            return len(list(inlet.poses(message, 0, mono_ns, now_ns, static=False, publisher=publisher)))

        assert all(passes(at_ms, "slam") for at_ms in range(0, 3000, 50))
        assert [passes(3000 + at_ms, "restarted") for at_ms in (0, 1000, 1900, 1950)] == [0, 0, 0, 1]
        assert "poses now come from restarted; slam has sent nothing for 2.0 s" in inlet.new_messages()[0]

    @pytest.mark.parametrize("correction_first", [True, False])
    def test_a_robot_that_stands_still_has_poses_again_after_a_clock_was_set_back(self, inlet, correction_first):
        edges = [("map", "odom"), ("odom", "base_footprint")]
        poses = []
        for begin_ms in (3_600_000, 0):
            for at_ms in range(begin_ms, begin_ms + 2000, 100):
                for parent, child in edges if correction_first else reversed(edges):
                    poses += self.poses_of(inlet, at_ms, parent, child, (1.0, 0.0, 0.0))
        stamps_ms = [(msg.time_of(pose.header.stamp) - WALL_NS) // MS for pose in poses]
        assert len([at_ms for at_ms in stamps_ms if at_ms < 2000]) == 4


def test_over_dds_the_bridges_own_odometry_and_a_localisation_make_poses_for_the_daemon(tmp_path):
    file = robot_file(tmp_path)
    port = 5300 + os.getpid() % 200
    text = file.read_text(encoding="utf-8").split("[pose]")[0]
    text += f'[pose]\nsource = "ros2"\ntopic = "tf"\nport = {port}\n[ros2]\ndomain = {12 + os.getpid() % 20 * 3}\n'
    file.write_text(f'{text}[daemon]\ncontrol_socket = "{tmp_path / "control"}"\n', encoding="utf-8")
    daemon, bridge, ended = create_pose_source(port=port), Bridge(load_setup(file)), []
    thread = threading.Thread(target=bridge.run, args=(lambda: bool(ended),))
    thread.start()
    received, deadline = [], time.monotonic() + 100.0
    while not received and time.monotonic() < deadline:
        now_ns = time.time_ns()
        moved = 1e-12 * (now_ns % 1000)
        bridge._publish("/tf", transform("odom", "base_link", now_ns, 2.0 + moved))
        bridge._publish("/tf", transform("map", "odom", now_ns + 200 * MS, 3.0 + moved))
        received = daemon.receive(time.monotonic_ns(), ())
        time.sleep(0.01)
    ended.append(True)
    thread.join()
    bridge.close()
    daemon.close()
    assert received[0].x_m == pytest.approx(5.0)


@pytest.mark.parametrize(
    ("yaw", "variance", "has_heading"),
    [(0.0, 0.0, False), (0.0, 99999.0, False), (2.5, 1e3, False), (2.5, -1.0, False), (2.5, math.nan, False),
     (2.5, 0.0, True), (0.0, 0.01, True), (2.5, 3.0, True)],
)  # fmt: skip
@pytest.mark.parametrize("kind", [msg.PoseWithCovarianceStamped, msg.Odometry])
def test_a_heading_whose_covariance_says_unknown_is_left_out_and_the_position_is_passed_on(
    poses, kind, yaw, variance, has_heading
):
    message = pose_message(yaw=yaw, kind=kind, covariance=covariance(0.01, 0.01, variance))
    pose = pose_of(poses.datagram(message, 0, MONO_NS, WALL_NS), MONO_NS)
    assert (pose.x_m, pose.y_m, pose.has_heading) == (1.0, -2.0, has_heading)
    assert poses.without_heading == (not has_heading)


def test_of_two_publishers_on_the_topic_the_first_counts_until_it_is_silent_and_the_other_is_named(poses):
    def passes(at_ms, publisher):
        t = at_ms * MS
        return poses.datagram(pose_message(20 * MS - t), 0, MONO_NS + t, WALL_NS + t, publisher) is not None

    assert [passes(40 * k, "publisher a") for k in range(3)] == [True] * 3
    assert [passes(90 + k, "publisher b") for k in range(5)] == [False] * 5
    assert poses.refused["of a second publisher on the topic"] == 5
    (warning,) = poses.new_messages()
    assert warning.startswith("publisher b sends poses while publisher a does: not used")
    assert "is used until it has sent nothing for 2 s" in warning
    assert passes(120, "publisher a")
    assert passes(2200, "publisher b")
    assert poses.new_messages() == ["poses now come from publisher b; publisher a has sent nothing for 2.1 s"]
