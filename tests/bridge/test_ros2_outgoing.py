"""Tests of what the bridge publishes of wheels, estimates and states: frames, signs, covariances and times."""

import math

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: make venv")

from disco_hw.bridge import ros2_messages as msg
from disco_hw.bridge import ros2_outgoing as out
from disco_hw.bridge.ros2 import wire_name
from disco_hw.config import PoseInput, Robot, RobotConfig
from disco_hw.estimation.odometry import OdometryParameters
from disco_hw.log import records
from drivers.types import WheelSample

OFFSET_NS = 1_800_000_000_000_000_000
PARAMETERS = OdometryParameters(0.1, 0.5, 0.05)
ROBOT = Robot(
    name="r",
    wheel_radius_m=0.1,
    axial_distance_m=0.5,
    max_wheel_speed_rad_s=10.0,
    max_wheel_acceleration_rad_s2=10.0,
    ticks_per_rev=1000,
)


def outgoing(source="robot"):
    return out.Outgoing(RobotConfig(robot=ROBOT, pose=PoseInput(source=source)), PARAMETERS)


def wheels(t_s, left, right, left_speed=0.0, right_speed=0.0):
    t_ns = round(t_s * 1e9)
    return t_ns, WheelSample(t_ns, t_ns, left, right, left_speed, right_speed)


def estimate(t_s, x, y, yaw, healthy=True):
    spread = (0.01, 0.001, 0.0, 0.001, 0.02, 0.0, 0.0, 0.0, 0.003)
    return round(t_s * 1e9), records.Estimate(round(t_s * 1e9), x, y, yaw, spread, 0.0, 0.0, 0.0, 0.0, True, healthy)


def driven(converter):
    """Two wheels that turn differently for five seconds from angles that are not zero."""
    for step in range(251):
        t = 0.02 * step
        newest = dict(converter.messages([wheels(t, 7.0 + 2.0 * t, -3.0 + 3.0 * t, 2.0, 3.0)], OFFSET_NS))
    return newest


def yaw_of(rotation):
    return 2.0 * math.atan2(rotation.z, rotation.w)


def test_odometry_follows_the_wheels_from_zero_on_in_base_and_odom_frame():
    newest = driven(outgoing())
    odometry = newest["odom"]
    turn, chord = 0.2 * 5.0, 0.25
    # The point 5 cm ahead moves as a unicycle of 0.25 m/s and 0.2 rad/s.
    x, y = 0.05 + chord / 0.2 * math.sin(turn), chord / 0.2 * (1 - math.cos(turn))
    x, y = x - 0.05 * math.cos(turn), y - 0.05 * math.sin(turn)
    place = odometry.pose.pose.position
    assert (place.x, place.y, yaw_of(odometry.pose.pose.orientation)) == pytest.approx((x, y, turn), abs=1e-9)
    twist = odometry.twist.twist
    assert (twist.linear.x, twist.linear.y, twist.angular.z) == pytest.approx((0.25, -0.01, 0.2))
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
    assert msg.time_of(odometry.header.stamp) == OFFSET_NS + 5_000_000_000
    (transform,) = newest["/tf"].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "base_link")
    assert (transform.transform.translation.x, transform.transform.translation.y) == (place.x, place.y)
    joints = newest["joint_states"]
    assert joints.name == ["left_wheel_joint", "right_wheel_joint"]
    assert (joints.position, joints.velocity) == ([17.0, 12.0], [2.0, 3.0])


def test_its_covariance_is_one_and_grows_with_the_way():
    converter = outgoing()
    first = dict(converter.messages([wheels(0.0, 7.0, -3.0)], OFFSET_NS))["odom"]
    last = driven(outgoing())["odom"]
    for matrix in (first.pose.covariance, last.pose.covariance, last.twist.covariance):
        full = np.array(matrix).reshape(6, 6)
        assert (full == full.T).all()
        assert np.linalg.eigvalsh(full)[0] > 0.0
    for entry in (0, 7, 35):
        assert last.pose.covariance[entry] > 10.0 * first.pose.covariance[entry]


def test_wheels_that_cannot_be_are_not_said():
    converter = outgoing()
    driven(converter)
    assert list(converter.messages([wheels(6.0, math.nan, 0.0)], OFFSET_NS)) == []
    assert list(converter.messages([wheels(4.0, 17.0, 12.0)], OFFSET_NS)) == []


def test_wheels_announced_before_their_tick_is_recorded_are_said_once():
    converter = outgoing()
    first = list(converter.messages([wheels(0.0, 7.0, -3.0)], OFFSET_NS))
    later = list(converter.messages([wheels(0.0, 7.0, -3.0), estimate(0.0, 1.0, 0.0, 0.0)], OFFSET_NS))
    assert [topic for topic, _ in first] == ["odom", "joint_states", "/tf"]
    assert [topic for topic, _ in later] == ["disco_hw/pose", "/tf"]


def test_the_map_is_where_the_estimate_and_the_odometry_agree():
    converter = outgoing()
    driven(converter)
    newest = list(converter.messages([estimate(5.0, 4.0, -1.0, 2.0)], OFFSET_NS))
    (pose,) = [one for topic, one in newest if topic == "disco_hw/pose"]
    assert (pose.header.frame_id, pose.pose.covariance[1], pose.pose.covariance[35]) == ("map", 0.001, 0.003)
    (transform,) = [one for topic, message in newest if topic == "/tf" for one in message.transforms]
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")
    odometry = driven(outgoing())["odom"].pose.pose
    yaw, at = yaw_of(transform.transform.rotation), transform.transform.translation
    x = at.x + math.cos(yaw) * odometry.position.x - math.sin(yaw) * odometry.position.y
    y = at.y + math.sin(yaw) * odometry.position.x + math.cos(yaw) * odometry.position.y
    assert (x, y, yaw + yaw_of(odometry.orientation)) == pytest.approx((4.0, -1.0, 2.0))


def test_who_gives_poses_over_ros_says_where_the_map_is():
    converter = outgoing("ros2")
    driven(converter)
    assert [topic for topic, _ in converter.messages([estimate(5.0, 4.0, -1.0, 2.0)], OFFSET_NS)] == ["disco_hw/pose"]
    assert list(converter.messages([estimate(5.0, 4.0, -1.0, 2.0, healthy=False)], OFFSET_NS)) == []


def test_a_plan_is_a_path_in_the_map():
    plan = records.Plan(7, 7, 0.1, (), (), path_x_m=(1.0, 2.0), path_y_m=(0.0, 0.5), path_yaw_rad=(0.0, 1.0))
    ((topic, path),) = outgoing().messages([(7, plan)], OFFSET_NS)
    assert (topic, path.header.frame_id) == ("plan", "map")
    assert [(one.pose.position.x, one.pose.position.y) for one in path.poses] == [(1.0, 0.0), (2.0, 0.5)]


def test_diagnostics_say_how_the_daemon_is_and_when_it_is_silent():
    converter = outgoing()

    def levels(is_connected=True, wrong=""):
        _, message = converter.diagnostics(OFFSET_NS, is_connected, {"poses": "3"}, wrong)
        return [one.level for one in message.status], [one.message for one in message.status]

    assert levels(is_connected=False)[0] == [3, 0]
    ((topic, text),) = converter.messages([(1, records.DaemonState(1, "ARMED", "READY", "armed", True))], OFFSET_NS)
    assert (topic, text.data) == ("disco_hw/state", "ARMED running: armed")
    assert levels(wrong="poses refused: not finite") == ([0, 1], ["ARMED: armed", "poses refused: not finite"])
    converter.messages([(1, records.DaemonState(1, "FAULT", "ARMED", "e-stop", False, True))], OFFSET_NS)
    assert levels()[0] == [2, 0]
    assert levels(is_connected=False)[0] == [3, 0]


@pytest.mark.parametrize(
    ("topic", "namespace", "wire"),
    [("odom", "", "rt/odom"), ("odom", "/a/b/", "rt/a/b/odom"), ("/tf", "a", "rt/tf"), ("x/y", "a", "rt/a/x/y")],
)
def test_topics_are_named_as_ros_does(topic, namespace, wire):
    assert wire_name(topic, namespace) == wire


def test_odometry_is_said_before_a_plan_is_even_looked_at():
    """A plan takes longer than all others together, and odometry is what a controller waits for."""
    broken = records.Plan(7, 7, 0.1, (), (), path_x_m=(1.0,), path_y_m=(), path_yaw_rad=())
    messages = outgoing().messages([wheels(0.0, 7.0, -3.0), (7, broken)], OFFSET_NS)
    assert [next(messages)[0] for _ in range(3)] == ["odom", "joint_states", "/tf"]
    with pytest.raises(ValueError, match="shorter"):
        next(messages)
