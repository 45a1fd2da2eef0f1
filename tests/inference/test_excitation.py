from dataclasses import replace

import numpy as np
import pytest

from disco_hw.inference.excitation import UnusableDriveError, excitation
from disco_hw.log.drive import Commands, DriveLog, Poses, Wheels, concatenate
from tests.inference.drives import logged


def straight(rate_hz=25.0, seconds=20.0, wheel_rad_s=2.0, radius_m=0.05, gap=None):
    t = np.arange(0.0, seconds, 1.0 / rate_hz)
    if gap is not None:
        t = t[(t < gap[0]) | (t > gap[1])]
    wheel_t = np.arange(-0.1, seconds + 0.1, 0.02)
    zero, segment = np.zeros(t.size), np.zeros(t.size, dtype=np.int64)
    angle, speed = wheel_rad_s * wheel_t, np.full(wheel_t.size, wheel_rad_s)
    wheel_segment = np.zeros(wheel_t.size, dtype=np.int64)
    return DriveLog(
        ("made.csv",),
        Commands(wheel_t, speed, speed, wheel_segment),
        Wheels(wheel_t, angle, angle, speed, speed, wheel_segment, True, True),
        Poses(t, radius_m * wheel_rad_s * t, zero, zero, segment),
    )


def with_poses(**columns):
    log = straight()
    return replace(log, poses=replace(log.poses, **columns))


def test_the_roll_between_poses_adds_up_to_the_wheels_angle():
    drive = excitation(straight())
    assert drive.source == "encoders"
    assert drive.roll_rad[:, 0].sum() == pytest.approx(2.0 * (drive.t_s[-1] - drive.t_s[0]), rel=1e-9)
    assert np.allclose(drive.roll_rad[:, 1], 0.0)
    assert drive.wheel_rad_s == pytest.approx(np.full(drive.wheel_rad_s.shape, 2.0))


def test_a_gap_in_the_poses_starts_a_new_run_with_no_roll_across():
    drive = excitation(straight(gap=(8.0, 11.0)))
    assert drive.run_pose.size == 3
    assert drive.starts.sum() == 2
    assert np.all(drive.roll_rad[drive.starts] == 0.0)
    assert drive.roll_rad[:, 0].max() < 2.0 * 0.1


def test_poses_lie_at_their_place_on_the_grid():
    drive = excitation(logged("poor"))
    first = np.repeat(drive.t_s[drive.run_pose[:-1]], np.diff(drive.run_pose))
    first_node = np.repeat(drive.run_node[:-1], np.diff(drive.run_pose))
    placed = first + (drive.node - first_node + drive.fraction) * drive.step_s
    assert placed == pytest.approx(drive.t_s, abs=1e-6)


def test_without_encoders_commands_drive_the_simulations():
    drive = excitation(replace(straight(), wheels=Wheels()))
    assert drive.source == "commands"
    assert drive.roll_rad[:, 0].sum() == pytest.approx(2.0 * (drive.t_s[-1] - drive.t_s[0]), rel=1e-6)


def test_a_log_without_encoders_beside_one_with_them_is_said_to_count_for_nothing():
    log = straight()
    mixed = concatenate([log, replace(log, wheels=Wheels())])
    drive = excitation(mixed)
    assert drive.t_s.size == excitation(log).t_s.size
    assert drive.notes == (
        "500 poses come without encoders and count for nothing beside those with them; infer their log alone",
    )
    assert excitation(concatenate([log, log])).notes == ()
    assert excitation(mixed, "commands").notes == ()


def test_an_unknown_command_breaks_the_run():
    log = straight()
    speed = log.commands.left_rad_s.copy()
    speed[500:600] = np.nan
    drive = excitation(replace(log, commands=replace(log.commands, left_rad_s=speed)), "commands")
    assert drive.run_pose.size == 3


@pytest.mark.parametrize(
    ("log", "expected_error"),
    [
        (straight(wheel_rad_s=0.0), "record a drive"),
        (straight(radius_m=0.0), "off the ground or the pose sensor is dead"),
        (straight(seconds=0.4), r"made\.csv: 10 poses.*pose sensor"),
        (with_poses(x_m=np.where(np.arange(500) == 30, np.nan, straight().poses.x_m)), "not finite"),
        (with_poses(t_s=straight().poses.t_s + 100.0), "record them together"),
    ],
    ids=["a robot at rest", "lifted wheels", "few poses", "a pose that is NaN", "no common stretch"],
)
def test_what_says_nothing_of_the_robot_is_refused(log, expected_error):
    with pytest.raises(UnusableDriveError, match=expected_error):
        excitation(log)
