import numpy as np
import pytest

from disco_hw.log.drive import Commands, DriveLog, Poses, Wheels, concatenate, differentiate_angle, integrate_angle


def zeros(count):
    return np.zeros(count, dtype=np.int64)


def drive(name, end_s, segments=1, wheels=True):
    t_s = np.linspace(0.0, end_s, 11)
    segment = np.minimum(np.arange(11) * segments // 11, segments - 1)
    count = 11 if wheels else 0
    return DriveLog(
        sources=(name,),
        commands=Commands(t_s, t_s + 1.0, t_s + 2.0, segment),
        wheels=Wheels(*(t_s[:count] for _ in range(5)), segment[:count], wheels, wheels),
        poses=Poses(t_s, t_s, t_s, t_s, segment),
        notes=(f"note of {name}",),
    )


def test_drives_follow_each_other_without_touching():
    joined = concatenate([drive("a", 5.0, segments=2), drive("b", 3.0)])
    assert joined.sources == ("a", "b")
    assert joined.notes == ("note of a", "note of b")
    assert joined.segments == 3
    assert joined.begins_s == (0.0, joined.commands.t_s[11])
    assert concatenate([joined, drive("c", 1.0)]).begins_s[:2] == joined.begins_s
    t_s, segment = joined.commands.t_s, joined.commands.segment
    assert (np.diff(t_s) > 0.0).all()
    assert t_s[11] - t_s[10] > 1.0
    assert set(segment[:11]) == {0, 1}
    assert set(segment[11:]) == {2}
    expected = np.concatenate([np.linspace(0.0, 5.0, 11), np.linspace(0.0, 3.0, 11)]) + 1.0
    assert np.array_equal(joined.commands.left_rad_s, expected)
    assert joined.wheels.angle_measured


def test_one_drive_stays_as_it_is_and_none_is_empty():
    one = drive("a", 5.0)
    joined = concatenate([one])
    assert np.array_equal(joined.poses.yaw_rad, one.poses.yaw_rad)
    assert joined.end_s == one.end_s == 5.0
    empty = DriveLog((), Commands(), Wheels(), Poses())
    assert (empty.end_s, empty.segments) == (0.0, 0)


def test_a_drive_without_wheels_does_not_change_how_they_were_measured():
    assert concatenate([drive("a", 5.0), drive("b", 5.0, wheels=False)]).wheels.angle_measured
    assert not concatenate([drive("b", 5.0, wheels=False)]).wheels.angle_measured


def test_angle_and_speed_undo_each_other():
    t_s = np.cumsum(np.full(200, 0.05))
    angle = np.sin(t_s)
    speed = differentiate_angle(t_s, angle, zeros(200))
    assert speed[0] == 0.0
    assert np.allclose(speed[1:], np.cos(t_s[1:] - 0.025), atol=1e-3)
    assert np.allclose(integrate_angle(t_s, np.cos(t_s), zeros(200)), angle - angle[0], atol=1e-3)


def test_nothing_is_carried_across_segments():
    t_s = np.array([0.0, 1.0, 100.0, 101.0])
    segment = np.array([0, 0, 1, 1])
    assert integrate_angle(t_s, np.ones(4), segment).tolist() == [0.0, 1.0, 1.0, 2.0]
    assert differentiate_angle(t_s, np.array([0.0, 1.0, 500.0, 502.0]), segment).tolist() == [0.0, 1.0, 0.0, 2.0]


@pytest.mark.parametrize("function", [integrate_angle, differentiate_angle])
def test_no_samples_give_no_samples(function):
    assert function(np.empty(0), np.empty(0), zeros(0)).size == 0
