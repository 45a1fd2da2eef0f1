"""Bags of a robot with four wheels and two SLAMs against the drive that they were made of."""

import json
import math
from itertools import product

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="pip install 'disco-hw[ros2]'")

from rosbags.typesys import Stores

from disco_hw.errors import LogError
from disco_hw.log.importing import import_log
from disco_hw.log.importing.rosbag import read_rosbag
from disco_hw.log.load import load_drive
from tests.inference.drives import robot_config
from tests.log.importing.bags import BEGAN_NS, LATENCY_NS, LEFT, RIGHT, config, read_bag, recorded, time_ns
from tests.log.importing.commands import call
from tests.tables import thinned


def has_note(drive, text):
    return any(text in note for note in drive.notes)


def chosen(drive):
    """The rows of the table that are read: role, topic."""
    return [tuple(line.split()[1:3]) for line in drive.notes[0].splitlines() if line.startswith("*")]


def assert_same_wheels(drive, truth):
    np.testing.assert_allclose(np.diff(drive.wheels.t_s), np.diff(truth.wheels.t_s), atol=1e-6)
    np.testing.assert_allclose(drive.wheels.left_angle_rad, truth.wheels.left_angle_rad, atol=1e-9)
    np.testing.assert_allclose(drive.wheels.right_speed_rad_s, truth.wheels.right_speed_rad_s, atol=1e-9)


RELEASES = [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED]
BAGS = [*product(["mcap", "sqlite3"], RELEASES), ("ros1", Stores.ROS1_NOETIC)]


def recorded_and_read(path, **settings):
    """The drive that a bag of all topics was made of, and what is read from it."""
    return recorded(path, **settings), read_rosbag(path, robot_config())


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A bag of all topics, the drive that it is of, and what is read from it."""
    path = tmp_path_factory.mktemp("bag") / "run"
    return path, *recorded_and_read(path)


@thinned(("storage", "distro"), BAGS, quick=1)
def test_four_wheels_commands_and_the_chain_of_frames_are_read(tmp_path, storage, distro):
    path = tmp_path / ("run.bag" if storage == "ros1" else "run")
    truth, drive = recorded_and_read(path, storage=storage, distro=distro)
    assert chosen(drive) == [("commands", "/cmd_vel"), ("wheels", "/joint_states"), ("poses", "tf")]
    assert_same_wheels(drive, truth)
    given = np.isfinite(drive.commands.left_rad_s)
    known = np.isfinite(truth.commands.left_rad_s)
    np.testing.assert_allclose(drive.commands.left_rad_s[given], truth.commands.left_rad_s[known], atol=1e-9)
    np.testing.assert_allclose(drive.commands.right_rad_s[given], truth.commands.right_rad_s[known], atol=1e-9)
    at = np.searchsorted(truth.poses.t_s, drive.poses.t_s - LATENCY_NS * 1e-9 - 1e-6)
    assert drive.poses.t_s.size >= truth.poses.t_s.size - 2
    np.testing.assert_allclose(drive.poses.x_m, truth.poses.x_m[at], atol=5e-3)
    np.testing.assert_allclose(np.unwrap(drive.poses.yaw_rad), np.unwrap(truth.poses.yaw_rad)[at], atol=2e-2)
    assert drive.segments == 1


def test_every_topic_is_in_the_table_with_the_reason(made):
    table = made[2].notes[0]
    for part in (
        "left: front_left_wheel_joint, rear_left_wheel_joint; right: front_right_wheel_joint",
        "map - odom - base_footprint - base_link",
        "/rtabmap/odom",
        "by frame and name the odometry of the wheels",
        "/goal_pose",
        "not where the robot is",
    ):
        assert part in table
    assert "camera" not in table


def test_a_topic_that_is_asked_for_is_taken_instead(made):
    path, truth, _ = made
    drive = read_rosbag(path, config(pose_topic="/rtabmap/odom", wheel_topic="/odom"))
    assert chosen(drive)[1:] == [("wheels", "/odom"), ("poses", "/rtabmap/odom")]
    np.testing.assert_allclose(drive.poses.x_m, truth.poses.x_m, atol=1e-12)
    np.testing.assert_allclose(drive.poses.t_s - drive.wheels.t_s[0], truth.poses.t_s - truth.wheels.t_s[0], atol=1e-6)
    np.testing.assert_allclose(drive.wheels.left_speed_rad_s, truth.wheels.left_speed_rad_s, atol=1e-9)
    assert not drive.wheels.angle_measured
    assert has_note(drive, "has been through the robot's own kinematics")


def test_without_joint_states_the_odometry_serves_and_that_is_said(path):
    truth, drive = recorded_and_read(path, leave=("/joint_states",))
    assert ("wheels", "/odom") in chosen(drive)
    np.testing.assert_allclose(drive.wheels.right_speed_rad_s, truth.wheels.right_speed_rad_s, atol=1e-9)
    assert has_note(drive, "record /joint_states")


def test_odometry_of_the_wheels_is_never_taken_for_a_measured_pose(path):
    _, drive = recorded_and_read(path, leave=("/rtabmap/odom", "/amcl_pose", "/tf"))
    assert not drive.poses.t_s.size
    assert has_note(drive, "no topic holds poses that were not made from the wheels")


def test_names_of_joints_and_frames_that_nobody_guesses_can_be_set(path):
    def write(maker, k):
        maker.write("/joints", maker.joints(time_ns(k), ("a", "b"), (0.1 * k, 0.2 * k), (5.0, 10.0)), time_ns(k))
        maker.write("/tf", maker.transforms(time_ns(k), ("hall", "rover", 0.006 * k, 0.0, 0.0, 0.0)), time_ns(k))

    names = {"left_joints": ["a"], "right_joints": ["b"], "map_frame": "hall", "base_frame": "rover"}
    drive = read_bag(path, 100, write, **names)
    assert drive.wheels.right_angle_rad[-1] == pytest.approx(19.8)
    assert drive.poses.x_m[-1] == pytest.approx(0.594)
    with pytest.raises(LogError, match="no topic with commands, wheels or poses"):
        read_rosbag(path, robot_config())


def test_a_gap_in_the_recording_starts_a_new_segment(path):
    _, drive = recorded_and_read(path, cut_s=(4.0, 7.0))
    assert drive.segments == 2
    assert np.diff(drive.wheels.t_s).max() == pytest.approx(3.0, abs=0.05)
    # What was commanded last holds for half a second, as the controllers of ROS have it.
    assert np.isnan(drive.commands.left_rad_s[np.searchsorted(drive.commands.t_s, 5.0) - 1])


@thinned("by_s", [-30.0, 30.0], quick=1)
def test_a_clock_that_is_set_is_said_and_taken_out(path, by_s):
    truth, drive = recorded_and_read(path, clock=lambda t_s: by_s if t_s > 5.0 else 0.0)
    assert has_note(drive, f"the clock of the stamps was set {'back' if by_s < 0 else 'ahead'} by 30 s")
    assert_same_wheels(drive, truth)
    assert drive.segments == 2
    assert drive.poses.t_s[-1] == pytest.approx(drive.wheels.t_s[-1], abs=0.2)


def test_commands_that_run_out_while_the_wheels_turn_are_named(path):
    """A joystick publishes on change: a command counts for half a second, and what holds it longer is not known."""

    def write(maker, k):
        maker.wheels(k)
        if k % 100 < 10:
            maker.write("/cmd_vel", maker.twist(0.1 * (k % 100), 0.0), time_ns(k))

    drive = read_bag(path, 400, write)
    assert has_note(drive, "commands: none is known for 5.3 of 8.0 s in which the wheels turn")
    assert any(note.startswith("warning: ") and "5.3 of 8.0 s" in note for note in drive.notes)


def test_a_transform_that_moves_is_none_that_stands_still_for_one_that_was_latched(path):
    def write(maker, k):
        if k == 0:
            maker.write("/tf_static", maker.transforms(time_ns(k), ("map", "odom", 7.0, 0.0, 0.0, 0.0)), time_ns(k))
        edges = [("map", "odom", 0.01 * k, 0.0, 0.0, 0.0), ("odom", "base_link", 0.02 * k, 0.0, 0.0, 0.0)]
        maker.write("/tf", maker.transforms(time_ns(k), *edges), time_ns(k))

    np.testing.assert_allclose(read_bag(path, 50, write).poses.x_m, 0.03 * np.arange(50), atol=1e-9)


def test_of_two_parents_of_a_frame_the_first_counts_and_the_other_is_named(tmp_path):
    for number in range(6):
        first, second = f"odom{number}", f"vision{number}"

        def write(maker, k, first=first, second=second):
            for name, y_m in ((first, 0.01 * k), (second, 5.0 + 0.01 * k)):
                edges = [("map", name, 0.0, y_m, 0.0, 0.0), (name, "base_link", 0.0, 0.0, 0.0, 0.0)]
                maker.write("/tf", maker.transforms(time_ns(k), *edges), time_ns(k))

        drive = read_bag(tmp_path / first, 20, write)
        assert drive.poses.y_m[-1] == pytest.approx(0.19)
        assert f"map - {first} - base_link" in drive.notes[0]
        assert f"base_link has another parent too, which is left out: {second}" in drive.notes[0]


def test_a_simulated_clock_is_said_and_unstamped_commands_are_carried_over(path):
    """A simulation at half the speed of time, whose clock began at 100 s."""
    start_s = 100.0 - BEGAN_NS * 1e-9
    truth, drive = recorded_and_read(path, clock=lambda t_s: start_s - 0.5 * t_s)
    assert has_note(drive, "a simulated clock, or one that was not set")
    np.testing.assert_allclose(np.diff(drive.wheels.t_s), 0.5 * np.diff(truth.wheels.t_s), atol=1e-6)
    given = drive.commands.t_s[np.isfinite(drive.commands.left_rad_s)]
    expected = 0.5 * (truth.commands.t_s[np.isfinite(truth.commands.left_rad_s)])
    np.testing.assert_allclose(given - given[0], expected - expected[0], atol=2e-3)


def test_messages_without_a_stamp_have_the_time_of_recording_and_that_is_said(path):
    drive = read_bag(path, 200, lambda maker, k: maker.wheels(k, stamp_ns=None if k % 10 else 0))
    assert has_note(drive, "20 of 200 messages have no stamp")
    np.testing.assert_allclose(np.diff(drive.wheels.t_s), 0.02, atol=1e-6)


def test_the_stamp_counts_not_the_recording(path):
    """Messages that the network held up for a while and then let go at once."""
    drive = read_bag(path, 200, lambda maker, k: maker.wheels(k, log_ns=time_ns(120 if 80 <= k < 120 else k) + k))
    np.testing.assert_allclose(np.diff(drive.wheels.t_s), 0.02, atol=1e-6)
    assert drive.segments == 1


def test_what_is_not_finite_is_left_out_and_counted(path):
    def write(maker, k):
        x = math.inf if k in {3, 4} else 0.0
        maker.wheels(k, math.nan if k == 7 else None)
        maker.write("/slam/pose", maker.pose_stamped(time_ns(k), "map", x, 0.0, 0.0), time_ns(k))

    drive = read_bag(path, 50, write)
    assert (drive.wheels.t_s.size, drive.poses.t_s.size) == (49, 48)
    assert has_note(drive, "poses, /slam/pose: 2 of 50 messages hold no finite value")
    assert has_note(drive, "wheels: 1 of 50 messages lack a position or velocity")


@pytest.mark.parametrize(
    ("reset_rad", "burst", "segments"), [(80.0, False, 2), (4.0, False, 2), (0.0, False, 1), (0.0, True, 1)]
)
def test_where_a_driver_counts_anew_nothing_is_predicted_across(path, reset_rad, burst, segments):
    def write(maker, k):
        # In a burst one comes right after the one before.
        t_ns = time_ns(k) - (19_900_000 if burst and k == 200 else 0)
        maker.wheels(k, 0.4 * k - (reset_rad if k >= 200 else 0.0), [], stamp_ns=t_ns, log_ns=t_ns)

    drive = read_bag(path, 300, write)
    assert drive.segments == segments
    assert has_note(drive, "1 times the wheels paused, or a clock or encoder was set") is (segments == 2)
    fast = np.abs(drive.wheels.left_speed_rad_s) > 30.0
    assert fast.any() == burst


def test_positions_within_one_turn_are_made_continuous(path):
    drive = read_bag(path, 200, lambda maker, k: maker.wheels(k, (0.1 * k + math.pi) % (2 * math.pi) - math.pi, []))
    assert drive.wheels.left_angle_rad[-1] == pytest.approx(19.9)
    np.testing.assert_allclose(drive.wheels.left_speed_rad_s[1:], 5.0, atol=1e-3)
    assert not drive.wheels.speed_measured
    assert has_note(drive, "left wheel wraps at 6.283185307 rad: made continuous at 3 places")


@pytest.mark.parametrize(
    ("topic", "build_message"),
    [
        ("/wheel_cmds", lambda m, t: m.joints(t, LEFT + RIGHT, [], [1.0, 3.0, 4.0, 6.0])),
        ("/base_controller/cmd_vel_out", lambda m, t: m.twist_stamped(t, 0.055 * 3.5, 0.055 * 3.0 / 0.4)),
        ("/velocity_controller/commands", lambda m, t: array(m, [2.0, 5.0])),
    ],
)
def test_the_controllers_own_commands_come_before_cmd_vel(path, topic, build_message):
    def write(maker, k):
        maker.wheels(k)
        maker.write("/cmd_vel", maker.twist(0.0, 9.0), time_ns(k))
        maker.write(topic, build_message(maker, time_ns(k)), time_ns(k))

    drive = read_bag(path, 50, write)
    assert chosen(drive)[0] == ("commands", topic)
    np.testing.assert_allclose(drive.commands.left_rad_s[:-1], 2.0)
    np.testing.assert_allclose(drive.commands.right_rad_s[:-1], 5.0)


def array(maker, values):
    layout = maker.create("std_msgs/msg/MultiArrayLayout", [], 0)
    return maker.create("std_msgs/msg/Float64MultiArray", layout, np.array(values))


def test_the_command_imports_a_folder_that_reads_as_any_log(robot, tmp_path, made):
    path, truth, _ = made
    out = tmp_path / "log.mcap"
    printed = call("import", path, "--robot", robot, "-o", out, "--topic", "poses=/rtabmap/odom", "--json")
    assert "*  poses     /rtabmap/odom" in json.loads(printed)["notes"][0]
    np.testing.assert_allclose(load_drive(out).poses.x_m, truth.poses.x_m, atol=1e-12)


def test_no_topics_are_taken_for_what_has_none(robot, tmp_path):
    (tmp_path / "a.csv").write_text("t_s\n")
    with pytest.raises(Exception, match=r"--topic: .*a.csv is a csv, which has no topics"):
        import_log(tmp_path / "a.csv", robot, tmp_path / "log.mcap", ["poses=/pose"])


@pytest.mark.parametrize("topic", ["poses", "poses=", "pose=/x"])
def test_a_topic_that_is_no_role_and_name_is_refused(robot, tmp_path, made, topic):
    with pytest.raises(Exception, match="is not ROLE=NAME"):
        import_log(made[0], robot, tmp_path / "log.mcap", [topic])


@pytest.mark.parametrize(("role", "hint"), [("wheels", "set ros2.left_joints"), ("commands", "name another")])
def test_joints_that_are_no_wheels_are_refused_as_a_named_topic(path, role, hint):
    def write(maker, k):
        maker.write("/arm", maker.joints(time_ns(k), ("elbow", "wrist"), [0.1 * k, 0.2], [0.1, 0.2]), time_ns(k))

    with pytest.raises(LogError, match=hint):
        read_bag(path, 20, write, **{f"{role.removesuffix('s')}_topic": "/arm"})
