"""Way-points from a CSV: read by name, refused in one line with place and remedy."""

from pathlib import Path

import numpy as np
import pytest
from cantools.database import load_file

import firmware_protocol
from disco_hw.config import Robot
from disco_hw.errors import InputError
from disco_hw.estimation.correction import MAX_POSITION_M
from disco_hw.tasks.line import load_waypoints
from disco_hw.tasks.path import PathTask
from disco_hw.tasks.timed_path import TimedPathTask
from drivers.samples import FARTHEST_M

# Its wheels do 0.5 m/s.
ROBOT = Robot(name="r", wheel_radius_m=0.1, axial_distance_m=0.4, ticks_per_rev=1024, max_wheel_speed_rad_s=5.0)


def read(tmp_path, text):
    path = tmp_path / "path.csv"
    path.write_text(text)
    return load_waypoints(path)


def test_columns_by_name_in_any_order_others_ignored(tmp_path):
    found = read(tmp_path, "note,y_m,x_m\na,1,0\nb,2,0.5\n")
    np.testing.assert_array_equal(found.places_m, [[0.0, 1.0], [0.5, 2.0]])
    assert found.times_s is None
    np.testing.assert_array_equal(read(tmp_path, "t_s,x_m,y_m\n0,1,2\n1.5,1,2\n").times_s, [0.0, 1.5])


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "line 1: column x_m: missing; name x_m and y_m there"),
        ("x_m,y\n0,0\n1,1\n", "column y_m: missing"),
        ("x_m,y_m\n0,0\n", "1 way-points; write at least two"),
        ("x_m,y_m\n0,0\n1,one\n", "line 3: y_m: 'one' is not a finite number; write one"),
        ("x_m,y_m\n0,0\nnan,1\n", "line 3: x_m: 'nan' is not a finite number"),
        ("x_m,y_m\n0,0\n1\n", "line 3: y_m: None is not a finite number"),
        ("x_m,y_m\n0,0\n1,1\n1,1\n", "line 4: repeats the way-point before it; remove it"),
        ("x_m,y_m,t_s\n0,0,0\n1,1,1\n2,2,1\n", "line 4: t_s does not increase; sort"),
    ],
)
def test_faults_are_reported_in_one_line(tmp_path, text, fault):
    with pytest.raises(InputError, match=fault) as error:
        read(tmp_path, text)
    assert "\n" not in str(error.value)


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        load_waypoints(tmp_path / "no.csv")


def test_lines_are_counted_as_an_editor_does_and_a_spreadsheets_mark_is_no_name(tmp_path):
    with pytest.raises(InputError, match="line 5: x_m: 'no' is not"):
        read(tmp_path, "x_m,y_m\n\n0,0\n\nno,1\n")
    found = read(tmp_path, "\ufeffx_m, y_m\n0, 0\n1, 2\n")
    np.testing.assert_array_equal(found.places_m, [[0.0, 0.0], [1.0, 2.0]])


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (
            "x_m,y_m,t_s\n0,0,0\n1,1,1\n",
            "line 1: column t_s: a path is followed at task.speed_m_s; remove the column.*timed_path",
        ),
        ("x_m,y_m\n0,0\n0.05,0\n", "0.05 m long; between 0.1 and 2000 m"),
        ("x_m,y_m\n0,0\n1e30,0\n", "long; between 0.1 and 2000 m"),
        ("x_m,y_m\n0,0\n1,-839\n", "line 3: y_m: -839 is more than 838 m from the origin"),
        ("x_m,y_m\n500000,838\n500010,838\n", "line 2: x_m: 500000 is more than.*in the frame of the poses"),
        ("x_m,y_m\n" + "".join(f"{0.001 * k},0\n" for k in range(10_001)), "over 10000 way-points; write at most"),
    ],
)
def test_what_a_robot_cannot_follow_is_refused(tmp_path, text, fault):
    path = tmp_path / "path.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=fault) as error:
        PathTask(path="path.csv").with_file(path, ROBOT, 0.2)
    assert str(path) in str(error.value)


def load_timed_path(tmp_path, text):
    path = tmp_path / "path.csv"
    path.write_text(text)
    return TimedPathTask(path="path.csv").with_file(path, ROBOT, 0.2)


def test_way_points_to_meet_may_rest_and_pass_one_place_twice(tmp_path):
    found = load_timed_path(tmp_path, "t_s,x_m,y_m\n0.5,0,0\n2,0.75,0\n3,0.75,0\n4.5,0,0\n")
    assert found.times_s == (0.5, 2.0, 3.0, 4.5)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("x_m,y_m\n0,0\n1,1\n", 'line 1: column t_s: missing; add the times.*or.*kind = "path"'),
        ("t_s,x_m,y_m\n-1,0,0\n4,1,1\n", "line 2: t_s: -1 is before the start; begin at 0 or later"),
        (
            "t_s,x_m,y_m\n0,0,0\n4,1,0\n\n5,1,0.6\n",
            "line 5: t_s: 0.6 m from line 3 in 1 s, but the wheels reach 0.5 m/s at most; write 5.2 or later",
        ),
        ("t_s,x_m,y_m\n0,0,0\n4,0,0\n", "0 m long; between 0.1 and 2000 m"),
        ("t_s,x_m,y_m\n4,0,0\n4,1,0\n", "line 3: t_s does not increase"),
    ],
)
def test_what_a_robot_cannot_meet_is_refused(tmp_path, text, fault):
    with pytest.raises(InputError, match=fault) as error:
        load_timed_path(tmp_path, text)
    assert str(tmp_path / "path.csv") in str(error.value)
    assert "\n" not in str(error.value)


def test_a_pose_can_be_expressed_wherever_a_robot_is_asked_to_go():
    database = load_file(Path(firmware_protocol.__file__).parent / "disco_robot.dbc")
    position = database.get_message_by_name("POSE_POSITION")
    for name in "xy":
        signal = position.get_signal_by_name(name)
        assert signal.minimum < -FARTHEST_M < FARTHEST_M < signal.maximum
    assert FARTHEST_M < MAX_POSITION_M
