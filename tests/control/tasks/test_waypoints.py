"""Way-points from a CSV: read by name, refused in one line with place and remedy."""

import numpy as np
import pytest

from disco_hw.control.tasks.waypoints import load_waypoints
from disco_hw.errors import InputError


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
        ("", "column x_m: missing; the first line must name x_m and y_m"),
        ("x_m,y\n0,0\n1,1\n", "column y_m: missing"),
        ("x_m,y_m\n0,0\n", "only 1 way-point; write at least two"),
        ("x_m,y_m\n0,0\n1,one\n", "line 3: y_m: 'one' is not a finite number; write one"),
        ("x_m,y_m\n0,0\nnan,1\n", "line 3: x_m: 'nan' is not a finite number"),
        ("x_m,y_m\n0,0\n1\n", "line 3: y_m: None is not a finite number"),
        ("x_m,y_m\n0,0\n1,1\n1,1\n", "line 4: the same way-point again; remove it"),
        ("x_m,y_m,t_s\n0,0,0\n1,1,1\n2,2,1\n", "line 4: t_s does not increase; sort"),
    ],
)
def test_faults_are_told_in_one_line(tmp_path, text, fault):
    with pytest.raises(InputError, match=fault) as error:
        read(tmp_path, text)
    assert "\n" not in str(error.value)


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        load_waypoints(tmp_path / "no.csv")
