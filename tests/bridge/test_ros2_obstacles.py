"""Obstacles from ROS 2: what reaches the daemon's source of obstacles, and what is refused for which reason."""

import math
import os
import socket
import threading
import time

import pytest

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: make venv")

from disco_hw.bridge import ros2
from disco_hw.bridge import ros2_messages as msg
from disco_hw.bridge.ros2 import Bridge
from disco_hw.bridge.ros2_obstacles import TOPIC, ObstacleInlet
from disco_hw.runtime.obstacles import MOST_OBSTACLES, ObstacleReport, Obstacles, obstacle_source_of, reports_in
from disco_hw.runtime.robot_setup import load_setup
from tests.drivers.waiting import free_port
from tests.first_use.miswired import robot_file

WALL_NS = 1_800_000_000_000_000_000
MS = 1_000_000


def obstacle(*points, number=7, radius=0.3, velocity=(0.0, 0.0), frame="", age_ns: int | None = None):
    stamp = msg.Time() if age_ns is None else msg.stamp_of(WALL_NS - age_ns)
    twist = msg.Twist(msg.Vector3(*velocity, 0.0), msg.Vector3())
    return msg.ObstacleMsg(
        msg.Header(stamp, frame), msg.Polygon([msg.Point32(x, y, 0.0) for x, y in points or ((1.25, -0.5),)]), radius,
        number, msg.Quaternion(), msg.TwistWithCovariance(twist),
    )  # fmt: skip


def array(*obstacles, frame="map", age_ns=20 * MS):
    return msg.ObstacleArrayMsg(msg.Header(msg.stamp_of(WALL_NS - age_ns), frame), list(obstacles))


def received(message, inlet=None, sent_ns=WALL_NS):
    datagrams = (inlet or ObstacleInlet("map")).datagrams(message, sent_ns, 0, WALL_NS)
    return [one for datagram in datagrams for one in reports_in(datagram)]


def test_a_circle_with_a_velocity_reaches_the_daemon_with_its_age():
    inlet = ObstacleInlet("/map")
    (found,) = received(array(obstacle(velocity=(-0.5, 0.25))), inlet)
    assert found.name == "ros2.7"
    assert (found.x_m, found.y_m, found.radius_m, found.vx_m_s, found.vy_m_s) == (1.25, -0.5, 0.3, -0.5, 0.25)
    assert found.age_s == pytest.approx(0.02)
    assert found.age_limit_s == 1.0
    assert inlet.passed == 1
    assert not inlet.refused


def test_of_two_stamps_and_frames_the_obstacles_own_counts_and_the_time_of_sending_where_there_is_none():
    (found,) = received(array(obstacle(age_ns=70 * MS, frame="map"), frame="laser"))
    assert found.age_s == pytest.approx(0.07)
    bare = msg.ObstacleArrayMsg(msg.Header(msg.Time(), "map"), [obstacle()])
    assert received(bare, sent_ns=WALL_NS - 300 * MS)[0].age_s == pytest.approx(0.3)
    # Clocks of two computers differ a little.
    assert received(array(obstacle(), age_ns=-40 * MS))[0].age_s == 0.0


def test_a_polygon_becomes_a_circle_that_holds_all_of_it():
    corners = ((0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.5, 1.0))
    (found,) = received(array(obstacle(*corners, radius=0.125)))
    assert (found.x_m, found.y_m) == (1.0, 0.5)
    assert all(math.dist(corner, (found.x_m, found.y_m)) <= found.radius_m - 0.125 + 1e-12 for corner in corners)
    assert found.radius_m == pytest.approx(0.125 + math.hypot(1.0, 0.5))
    # A radius that cannot be makes no obstacle smaller.
    assert received(array(obstacle(*corners, radius=-3.0)))[0].radius_m == pytest.approx(math.hypot(1.0, 0.5))
    assert received(array(obstacle(radius=0.0)))[0].radius_m == 1e-3


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (array(obstacle(), frame="odom"), 'in frame "odom", not "map"'),
        (array(obstacle(), frame=""), "in frame"),
        (array(obstacle(frame="odom")), "in frame"),
        (array(obstacle(), age_ns=1001 * MS), "another clock"),
        (array(obstacle(), age_ns=-51 * MS), "another clock"),
        (array(obstacle(age_ns=WALL_NS - 5)), "another clock"),
        (array(obstacle((math.nan, 0.0))), "not finite"),
        (array(obstacle((1e9, 0.0))), "too large"),
        (array(obstacle(velocity=(math.inf, 0.0))), "not finite"),
        (array(obstacle(velocity=(25.0, 0.0))), "too fast"),
        (array(obstacle(radius=math.nan)), "not finite"),
        (msg.String("person at the door"), "JSON"),
        (msg.String('{"name": "a b", "x_m": 0, "y_m": 0, "radius_m": 1}'), "JSON"),
    ],
)
def test_what_is_no_obstacle_is_refused_by_its_reason_and_others_are_still_taken(message, expected):
    inlet = ObstacleInlet("map")
    assert received(message, inlet) == []
    assert [expected in reason for reason in inlet.refused] == [True]
    assert list(inlet.refused.values()) == [1]
    assert len(received(array(obstacle()), inlet)) == 1


def names(message, inlet, **how):
    """Return the names that a message reports, and those that it removes."""
    found = received(message, inlet, **how)
    return [one.name for one in found if not one.removed], [one.name for one in found if one.removed]


def test_obstacles_with_equal_ids_are_all_kept_and_those_of_the_array_before_removed():
    """costmap_converter leaves the id 0, or writes -1: each array holds all that its sender sees."""
    inlet = ObstacleInlet("map")
    three = [obstacle((float(k), 0.0), number=0) for k in range(3)]
    found = received(array(*three, obstacle(number=-1), obstacle(number=-1)), inlet)
    assert [one.name for one in found] == ["ros2.0", "ros2.0.2", "ros2.0.3", "ros2.-1", "ros2.-1.2"]
    assert [one.x_m for one in found[:3]] == [0.0, 1.0, 2.0]
    assert names(array(*three[:2], obstacle(number=-1)), inlet) == (
        ["ros2.0", "ros2.0.2", "ros2.-1"],
        ["ros2.0.3", "ros2.-1.2"],
    )
    reported, removed = names(array(), inlet)
    assert reported == []
    # Removals are repeated, as a datagram can be lost, and the one that is missing again is among them.
    assert removed == ["ros2.0", "ros2.0.2", "ros2.0.3", "ros2.-1", "ros2.-1.2"]
    assert inlet.passed == 8
    late_ns = WALL_NS + 3_000_000_000
    later = msg.ObstacleArrayMsg(msg.Header(msg.stamp_of(late_ns), "map"), [])
    assert len(inlet.datagrams(later, late_ns, late_ns - WALL_NS, late_ns)) == 5
    assert inlet.datagrams(later, late_ns, late_ns - WALL_NS, late_ns) == []


def test_a_track_that_is_missing_from_an_array_is_not_removed():
    """Its sender says which obstacle it is: where it went nobody knows, and the robot stops."""
    inlet = ObstacleInlet("map")
    received(array(obstacle(number=7), obstacle(number=8)), inlet)
    assert names(array(obstacle(number=8)), inlet) == (["ros2.8"], [])
    # Several of one positive id are no tracks.
    received(array(obstacle(number=9), obstacle(number=9)), inlet)
    assert names(array(obstacle(number=9)), inlet) == (["ros2.9"], ["ros2.9.2"])
    assert names(array(), inlet)[1] == ["ros2.9", "ros2.9.2"]


@pytest.mark.parametrize(
    "partial",
    [array(obstacle(number=0), obstacle(number=0, frame="odom")), array(frame="odom"), array(age_ns=1001 * MS),
     array(*(obstacle(number=k + 1) for k in range(MOST_OBSTACLES)), *[obstacle(number=0)] * 3)],
)  # fmt: skip
def test_an_array_that_is_refused_or_another_publishers_removes_none(partial):
    inlet = ObstacleInlet("map")
    received(array(*[obstacle(number=0)] * 3), inlet)
    assert names(partial, inlet)[1] == []
    whole = array(obstacle(number=0))
    assert inlet.datagrams(whole, WALL_NS, 0, WALL_NS, publisher="another")[1:] == []


def later_array(count, after_s, inlet, publisher, set_back_s=0):
    """Return the names of those removed by an array of `count` numbered obstacles that comes so much later."""
    mono_ns = round(after_s * 1e9)
    at_ns = WALL_NS + mono_ns - set_back_s * 1_000_000_000
    message = msg.ObstacleArrayMsg(msg.Header(msg.stamp_of(at_ns), "map"), [obstacle(number=0)] * count)
    datagrams = inlet.datagrams(message, at_ns, mono_ns, at_ns, publisher)
    found = [one for datagram in datagrams for one in reports_in(datagram)]
    return [one.name for one in found if one.removed]


@pytest.mark.parametrize("set_back_s", [0, 3600])
def test_a_sender_that_restarts_takes_over_the_numbered_obstacles_of_before(set_back_s):
    """Also where the clock of the computer was set back meanwhile."""
    inlet = ObstacleInlet("map")
    later_array(4, 0.0, inlet, "first")
    assert later_array(2, 0.5, inlet, "restarted", set_back_s) == []
    # A removal is repeated, as a datagram can be lost.
    removed = [later_array(2, at_s, inlet, "restarted", set_back_s) for at_s in (1.5, 3.0)]
    assert removed == 2 * [["ros2.0.3", "ros2.0.4"]]


def test_a_bridge_that_restarts_takes_over_the_numbered_obstacles_that_the_daemon_has(tmp_path, monkeypatch):
    known = Obstacles()
    for name in ("ros2.0", "ros2.0.2", "ros2.0.3", "ros2.-1", "ros2.9", "ros2.9.2", "ros2.7", "cart", "ros2.x"):
        known.report(0, ObstacleReport(name=name, x_m=0.0, y_m=0.0, radius_m=1.0))
    status = {"area": {"obstacles": known.status(1_500 * MS)}}
    monkeypatch.setattr(ros2, "send_request", lambda _, __: status)
    monkeypatch.setattr(time, "monotonic_ns", lambda: 0)
    # Without a domain of DDS, which takes a second to join.
    bridge = Bridge.__new__(Bridge)
    bridge._config = load_setup(robot_file(tmp_path)).config
    bridge._obstacles = ObstacleInlet("map")
    bridge._take_over_obstacles()
    # A track, and what another program reports, is not the bridge's to remove.
    removed = later_array(1, 0.1, bridge._obstacles, "sender")
    assert set(removed) == {"ros2.0.2", "ros2.0.3", "ros2.-1", "ros2.9", "ros2.9.2"}
    # A daemon that does not answer has none.
    status.clear()
    bridge._take_over_obstacles()


def test_a_sender_that_is_silent_loses_nothing_to_one_that_was_there_beside_it():
    inlet = ObstacleInlet("map")
    later_array(0, 0.0, inlet, "beside")
    later_array(4, 0.1, inlet, "first")
    assert later_array(0, 5.0, inlet, "beside") == []


def test_an_array_without_a_frame_is_refused_with_what_to_do():
    inlet = ObstacleInlet("map")
    received(array(obstacle(), frame=""), inlet)
    assert list(inlet.refused) == ['in frame "", not "map"; have the sender fill in header.frame_id']


def test_an_obstacle_without_points_is_none():
    without_points = array(msg.ObstacleMsg(radius=1.0), obstacle(number=8))
    assert [one.name for one in received(without_points)] == ["ros2.8"]


def test_of_too_many_the_first_are_passed_on_and_the_others_counted():
    inlet = ObstacleInlet("map")
    found = received(array(*(obstacle(number=k) for k in range(MOST_OBSTACLES + 3))), inlet)
    assert len(found) == MOST_OBSTACLES
    assert dict(inlet.refused) == {f"more than {MOST_OBSTACLES} in a message": 3}


def test_text_holds_what_udp_takes():
    text = '[{"name": "cart", "x_m": 1.5, "y_m": 0, "radius_m": 0.4, "vx_m_s": 0.2, "age_limit_s": 3}]'
    inlet = ObstacleInlet("map")
    (found,) = received(msg.String(text), inlet)
    assert (found.name, found.x_m, found.vx_m_s, found.age_limit_s) == ("cart", 1.5, 0.2, 3.0)
    assert inlet.passed == 1
    assert not inlet.refused


def test_over_dds_both_types_come_to_the_daemons_source(tmp_path):
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    from disco_hw.bridge.ros2 import RELIABLE, wire_name

    file = robot_file(tmp_path)
    text = file.read_text(encoding="utf-8") + f"[fence]\nobstacles_port = {free_port(socket.SOCK_DGRAM)}\n"
    text += f'[ros2]\ndomain = {13 + os.getpid() % 20 * 3}\n[daemon]\ncontrol_socket = "{tmp_path / "control"}"\n'
    file.write_text(text, encoding="utf-8")
    setup, ended = load_setup(file), []
    daemon, bridge = obstacle_source_of(setup.config), Bridge(setup)
    assert bridge.where.endswith(f"; obstacles from {TOPIC}")
    thread = threading.Thread(target=bridge.run, args=(lambda: bool(ended),))
    thread.start()
    writers = [
        DataWriter(bridge._participant, Topic(bridge._participant, wire_name(TOPIC, ""), kind), RELIABLE)
        for kind in (msg.ObstacleArrayMsg, msg.String)
    ]
    found, deadline = {}, time.monotonic() + 60.0
    while len(found) < 2 and time.monotonic() < deadline:
        header = msg.Header(msg.stamp_of(time.time_ns()), "map")
        writers[0].write(msg.ObstacleArrayMsg(header, [obstacle(velocity=(0.5, 0.0))]))
        writers[1].write(msg.String('{"name": "cart", "x_m": 1.5, "y_m": 0, "radius_m": 0.4}'))
        found |= {one.name: one for one in daemon.receive(time.monotonic_ns())}
        time.sleep(0.02)
    ended.append(True)
    thread.join()
    bridge.close()
    daemon.close()
    assert (found["ros2.7"].x_m, found["ros2.7"].vx_m_s, found["cart"].x_m) == (1.25, 0.5, 1.5)
    diagnosis = {one.key: one.value for one in bridge._diagnosis(0, 0)[1].status[1].values if "obstacles" in one.key}
    assert int(diagnosis["obstacles passed on"]) >= 2
    assert diagnosis["obstacles not sent"] == "0"


def test_without_a_port_for_obstacles_none_are_read(tmp_path):
    bridge = Bridge(load_setup(robot_file(tmp_path)))
    assert "obstacles" not in bridge.where
    assert not any(handler == bridge._handle_obstacles for _, handler in bridge._readers)
    bridge.close()
