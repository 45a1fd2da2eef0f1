"""Logs from which nothing may be inferred: one line that names fault and remedy, and no model."""

import csv
import math
import subprocess
import sys

import pytest

from disco_hw.errors import InputError
from disco_hw.inference.infer_command import infer_command
from tests.inference.drives import ROBOT, write_log
from tests.inference.test_infer_command import finds


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    (folder / "robot.toml").write_text(ROBOT)
    with write_log(folder / "log.csv", "poor").open(newline="") as file:
        return folder / "robot.toml", list(csv.DictReader(file))


def scaled(names, factor):
    def change(rows):
        return [
            row | {name: str(float(row[name]) * factor) for name in row if name.startswith(names) and row[name]}
            for row in rows
        ]

    return change


def empty(*names):
    return lambda rows: [row | dict.fromkeys(names, "") for row in rows]


def at(place, **values):
    return lambda rows: [row | values if index == place else row for index, row in enumerate(rows)]


def everywhere(**values):
    return lambda rows: [row | values for row in rows]


def constant_columns(prefixes, value):
    """Every sample of these columns has the same value."""
    return lambda rows: [row | {name: value for name in row if name.startswith(prefixes) and row[name]} for row in rows]


at_rest = constant_columns(("pose", "enc", "cmd"), "0")
lifted = constant_columns(("pose",), "0.1")


POSE = ("pose_x_m", "pose_y_m", "pose_yaw_rad")
WITH_POSES = "t_s,cmd_left_rad_s,cmd_right_rad_s,pose_x_m,pose_y_m,pose_yaw_rad\n"
# What becomes of the rows of a good log, or the text in their place; the fault.
CASES = {
    "an empty file": ("", "empty file"),
    "two rows without poses": (
        "t_s,cmd_left_rad_s,cmd_right_rad_s,enc_left_ticks,enc_right_ticks\n0,1,1,0,0\n1,1,1,5,5\n",
        "0 poses",
    ),
    "two rows of one time": (WITH_POSES + "0,1,1,0,0,0\n0,1,1,nan,0,0\n", "."),
    "two rows, the later one first": (WITH_POSES + "5,1,1,0,0,0\n0,1,1,0,0,0\n", "backwards"),
    "no rows": (lambda rows: [], r"no rows|empty|no samples|at least"),
    "no motion": (at_rest, r"wheels turn by 0 rad in all; record a drive"),
    "wheels in the air": (lifted, r"wheels are off the ground or the pose sensor is dead"),
    "poses that are NaN": (everywhere(pose_x_m="nan"), r"0 poses, at least 50 are needed"),
    "encoders that are infinite": (
        everywhere(enc_left_ticks="inf"),
        r"wheel ticks: .* line 2: enc_left_ticks is 'inf'",
    ),
    "words": (everywhere(pose_y_m="lost"), r"positions: .* line 2: pose_y_m is 'lost' .*; leave a cell .* empty"),
    "a clock that goes backwards": (at(30, t_s="-9.0"), r"line 32: the clock goes backwards .* a file of its own"),
    "a clock that stands still": (
        everywhere(t_s="1.0"),
        r"have the time of another sample .*the clock does not advance",
    ),
    "milliseconds": (scaled(("t_s",), 1e5), r"t_s: .* does not look like seconds; write seconds"),
    "millimetres": (scaled(("pose_x", "pose_y_"), 1e3), r"pose_x_m, pose_y_m against the wheels: .*write metres"),
    "degrees": (scaled(("pose_yaw",), 180.0 / math.pi), r"pose_yaw_rad: .*like degrees; write radians"),
    "wrong ticks": (scaled(("enc_",), 50.0), r"write metres, rad/s and the encoder's true ticks_per_rev|jumps by"),
    "no poses": (empty(*POSE), r"0 poses, at least 50 are needed; record with a pose sensor"),
}


@pytest.mark.parametrize("case", CASES)
def test_one_line_names_fault_and_remedy_and_nothing_is_written(good, tmp_path, case):
    robot, rows = good
    change, message = CASES[case]
    log = tmp_path / "bad.csv"
    if isinstance(change, str):
        log.write_text(change)
    else:
        write(log, list(rows[0]), change(rows))
    with pytest.raises(InputError, match=message) as caught:
        infer_command([log], robot, tmp_path / "model.toml", tmp_path / "report.html", search=finds())
    assert "\n" not in str(caught.value)
    assert str(log) in str(caught.value)
    assert not (tmp_path / "model.toml").exists()
    assert not (tmp_path / "report.html").exists()


def test_columns_of_the_pose_may_not_be_missing(good, tmp_path):
    robot, rows = good
    log = tmp_path / "bad.csv"
    names = [name for name in rows[0] if name != "pose_yaw_rad"]
    write(log, names, [{name: row[name] for name in names} for row in rows])
    with pytest.raises(InputError, match=r"0 poses, at least 50 are needed; .*pose_yaw_rad"):
        infer_command([log], robot, search=finds())


@pytest.mark.thorough
def test_the_command_ends_with_2_and_one_line(good, tmp_path):
    robot, rows = good
    log = tmp_path / "bad.csv"
    write(log, list(rows[0]), at_rest(rows))
    command = [sys.executable, "-m", "disco_hw", "infer", str(log), "--robot", str(robot), "--json"]
    done = subprocess.run([*command, "-o", str(tmp_path / "model.toml")], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("disco-hw: ")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "model.toml").exists()


def write(path, names, rows):
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)
