"""Headings that nobody measured, in a CSV file and in bags: positions only, and a warning that says so."""

import json
import math

import numpy as np
import pytest

from disco_hw.log.drive import DriveLog
from disco_hw.log.importing.losses import without_standing_headings
from disco_hw.log.load import load_drive
from tests.log.importing.commands import call, refusal_of_import
from tests.log.importing.test_csv_faults import as_text, read, table
from tests.tables import thinned


def csv_drive(tmp_path, yaw, count=800) -> DriveLog:
    """40 s on a circle, 7.7 rad in all, with the heading that `yaw` makes of the row and the true one."""
    rows = table(count)
    for k, row in enumerate(rows):
        row["pose_yaw_rad"] = repr(yaw(k, float(row["pose_yaw_rad"])))
    return read(tmp_path, as_text(rows))


@pytest.mark.parametrize("standing", [0.0, 1.234, -math.pi / 2])
def test_a_heading_that_stands_still_while_the_wheels_turn_is_not_used(tmp_path, standing):
    drive = without_standing_headings(csv_drive(tmp_path, lambda *_: standing))
    assert np.isnan(drive.poses.yaw_rad).all()
    assert drive.poses.x_m.size == 800
    assert drive.notes[0].startswith("warning: ")
    assert "headings: 800 of 800 stand still while the wheels turn the robot (100 %)" in drive.notes[0]


def test_a_heading_that_freezes_on_the_way_is_used_until_then(tmp_path):
    drive = without_standing_headings(csv_drive(tmp_path, lambda k, yaw: yaw if k < 300 else 2.903226))
    measured = np.isfinite(drive.poses.yaw_rad)
    assert measured[:299].all()
    assert not measured[301:].any()


@pytest.mark.parametrize(
    "yaw",
    [
        lambda _, yaw: yaw,
        lambda k, yaw: 1e-4 * (k % 2),
        lambda k, yaw: round(yaw / 0.1) * 0.1,
        lambda k, yaw: math.nan,
    ],
    ids=["true", "noise", "coarse", "unknown"],
)
def test_other_headings_stay_as_they_are(tmp_path, yaw):
    drive = csv_drive(tmp_path, yaw)
    assert without_standing_headings(drive) is drive


def test_a_robot_that_drives_straight_on_keeps_its_heading(tmp_path):
    rows = table(800)
    for k, row in enumerate(rows):
        row |= {"enc_right_rad_s": "2.0", "cmd_right_rad_s": "2.0", "pose_x_m": f"{0.006 * k:.6f}", "pose_y_m": "0"}
        row["pose_yaw_rad"] = "0"
    drive = read(tmp_path, as_text(rows))
    assert without_standing_headings(drive) is drive


def test_whoever_compares_headings_is_given_none_that_stands_still(tmp_path):
    csv_drive(tmp_path, lambda *_: 0.0)
    drive = load_drive(tmp_path / "log.csv")
    assert not drive.poses.t_s.size
    assert any("800 of 800 positions have no heading and were left out" in note for note in drive.notes)


def test_the_warning_comes_first_in_the_text_and_has_its_list_in_json(tmp_path, robot):
    csv_drive(tmp_path, lambda *_: 0.0)
    arguments = ("import", tmp_path / "log.csv", "--robot", robot, "-o")
    printed = call(*arguments, tmp_path / "a.mcap")
    assert printed.startswith("warning: ")
    assert "stand still" in printed.splitlines()[0]
    (warning,) = json.loads(call(*arguments, tmp_path / "b.mcap", "--json"))["warnings"]
    assert "headings: 800 of 800 stand still" in warning


def test_a_loss_of_over_half_ends_with_exit_code_two_and_one_line(tmp_path, robot):
    rows = table()
    for row in rows[:60]:
        row["pose_x_m"] = "?"
    (tmp_path / "log.csv").write_text(as_text(rows))
    assert "positions: 60 of 100" in " ".join(refusal_of_import(tmp_path / "log.csv", robot).split())


bags = pytest.importorskip("tests.log.importing.bags", reason="pip install 'disco-hw[ros2]'")


def bag_drive(path, yaw_variance, yaw=lambda _: 0.0):
    """A bag of a robot on a circle, 5 Hz of nav_msgs/Odometry in `map` with this variance of the heading."""
    from disco_hw.log.importing.rosbag import read_rosbag
    from tests.inference.drives import robot_config

    with bags.bag(path) as maker:
        for k in range(750):
            t_ns = bags.BEGAN_NS + k * 20_000_000
            true_yaw = 0.055 / 0.4 * 0.02 * k
            angles, names = [0.04 * k, 0.06 * k], (bags.LEFT[0], bags.RIGHT[0])
            maker.write("/joint_states", maker.joints(t_ns, names, angles, [2.0, 3.0]), t_ns)
            if k % 10 == 0:
                place = (math.sin(true_yaw), 1.0 - math.cos(true_yaw))
                odometry = maker.odometry(t_ns, "map", *place, yaw(true_yaw))
                odometry.pose.covariance[35] = yaw_variance
                maker.write("/odometry/gps", odometry, t_ns)
    return without_standing_headings(read_rosbag(path, robot_config()))


@thinned("variance", [0.0, 99999.0, -1.0, math.nan, 0.01], quick=2)
def test_a_position_without_heading_in_a_bag_is_a_position_only(tmp_path, variance):
    drive = bag_drive(tmp_path / "b", variance)
    assert drive.poses.t_s.size == 75
    assert np.isnan(drive.poses.yaw_rad).all()
    assert np.isfinite(drive.poses.x_m).all()
    warnings = [note for note in drive.notes if note.startswith("warning: ")]
    assert "heading" in warnings[0]


@thinned(("variance", "is_used"), [(0.0, True), (0.01, True), (99999.0, False), (-1.0, False)], quick=2)
def test_a_heading_that_turns_is_used_unless_its_covariance_says_unknown(tmp_path, variance, is_used):
    drive = bag_drive(tmp_path / "b", variance, lambda yaw: yaw)
    assert np.isfinite(drive.poses.yaw_rad[1:]).all() == is_used
