import math
import os
from pathlib import Path
from tempfile import NamedTemporaryFile

import numpy as np
import pytest
from hypothesis import strategies as st

from disco_hw.errors import InputError, LogError
from disco_hw.log.importing.csv_drive import read_csv
from tests.log.refusals import refused
from tests.tables import examples

REAL_LOGS = "DISCO_HW_REAL_LOGS"
HEADER = "t_s,cmd_left_rad_s,cmd_right_rad_s,enc_left_rad_s,enc_right_rad_s,pose_x_m,pose_y_m,pose_yaw_rad"
TICKS_HEADER = HEADER.replace("enc_left_rad_s,enc_right_rad_s", "enc_left_ticks,enc_right_ticks")


def write(tmp_path, text):
    path = tmp_path / "log.csv"
    path.write_text(text, encoding="utf-8")
    return path


def rows(count, row="{t:.2f},1.0,2.0,1.0,2.0,{x:.4f},0.0,0.1"):
    return "".join(row.format(t=0.1 * k, x=0.009 * k, k=k) + "\n" for k in range(count))


def circle(count=400):
    """A circle with wheels of 0.06 m, 0.31 m apart."""
    lines = []
    for k in range(count):
        t = 0.05 * k
        yaw = 0.06 * 1.0 / 0.31 * t
        radius = 0.06 * 2.5 / (0.06 / 0.31)
        x, y = radius * math.sin(yaw), radius * (1.0 - math.cos(yaw))
        lines.append([t, 2.0, 3.0, 2.0, 3.0, x, y, (yaw + math.pi) % (2 * math.pi) - math.pi])
    return lines


def text(lines, header=HEADER):
    return header + "\n" + "".join(",".join(repr(value) for value in line) + "\n" for line in lines)


def read(tmp_path, content, **arguments):
    return read_csv(write(tmp_path, content), **arguments)


def refusal(tmp_path, content, **arguments):
    with refused() as error:
        read(tmp_path, content, **arguments)
    assert str(error.value).startswith(str(tmp_path / "log.csv"))
    return str(error.value)


def test_columns_by_name_in_any_order_and_unknown_ones_with_a_note(tmp_path):
    lines = circle()
    header = ",".join([*reversed(HEADER.split(",")), "battery_v"])
    one, other = read(tmp_path, text(lines)), read(tmp_path, text([[*reversed(line), 7] for line in lines], header))
    for part in ("commands", "wheels", "poses"):
        for name in one.commands.__dataclass_fields__ if part == "commands" else ("t_s", "segment"):
            assert np.array_equal(getattr(getattr(one, part), name), getattr(getattr(other, part), name))
    assert one.notes == ()
    assert "battery_v" in other.notes[0]
    assert one.commands.left_rad_s.tolist() == [2.0] * 400
    assert one.poses.x_m.tolist() == [line[5] for line in lines]
    assert one.wheels.speed_measured
    assert not one.wheels.angle_measured
    assert one.wheels.right_angle_rad[-1] == pytest.approx(3.0 * lines[-1][0])


def test_empty_cells_are_no_samples(tmp_path):
    row = "{t:.2f},1.0,2.0,,,,,"
    content = HEADER + ",imu_wz_rad_s\n" + rows(5, row + ",") + "0.5,1.0,2.0,1.0,2.0,0.5,0.6,0.7,0.8\n"
    drive = read(tmp_path, content)
    assert drive.commands.t_s.size == 6
    assert drive.wheels.t_s.tolist() == [0.5]
    assert (drive.poses.x_m[0], drive.poses.y_m[0], drive.poses.yaw_rad[0]) == (0.5, 0.6, 0.7)
    assert (drive.gyro.t_s.tolist(), drive.gyro.yaw_rate_rad_s.tolist()) == ([0.5], [0.8])


def test_times_start_at_zero(tmp_path):
    drive = read(tmp_path, HEADER + "\n" + rows(10, "{k}.25,1.0,2.0,1.0,2.0,0.0,0.0,0.1"))
    assert drive.commands.t_s.tolist() == [float(k) for k in range(10)]


@pytest.mark.parametrize(
    ("given_at", "count", "times_s", "is_known"),
    [
        (
            [0, 1, 4, 5, 20, 21],
            30,
            [0.0, 0.1, 0.4, 0.5, 0.6, 2.0, 2.1, 2.2],
            [True, True, True, True, False, True, True, False],
        ),
        ([2, 3], 4, [0.0, 0.2, 0.3], [False, True, True]),
    ],
    ids=["gaps", "begins late"],
)
def test_a_command_holds_over_a_short_gap_and_is_unknown_over_a_long_one_and_at_first(
    tmp_path, given_at, count, times_s, is_known
):
    lines = [f"{0.1 * k:.1f},{'1.0,2.0' if k in given_at else ','},0.5,0.5" for k in range(count)]
    content = "t_s,cmd_left_rad_s,cmd_right_rad_s,enc_left_rad_s,enc_right_rad_s\n" + "\n".join(lines) + "\n"
    commands = read(tmp_path, content).commands
    assert commands.t_s.tolist() == pytest.approx(times_s)
    assert np.isfinite(commands.left_rad_s).tolist() == is_known


def test_ticks_need_the_ticks_of_a_revolution(tmp_path):
    lines = [[*line[:3], round(line[0] * 100), round(line[0] * 150), *line[5:]] for line in circle()]
    content = text(lines, TICKS_HEADER)
    hint = "; give ticks_per_rev (--robot ROBOT.toml on the command line)"
    assert refusal(tmp_path, content).endswith(hint)
    wheels = read(tmp_path, content, ticks_per_rev=200.0).wheels
    assert wheels.angle_measured
    assert not wheels.speed_measured
    assert wheels.left_angle_rad[-1] == lines[-1][3] * (2.0 * math.pi / 200.0)
    assert np.median(wheels.right_speed_rad_s) == pytest.approx(150 * 2.0 * math.pi / 200.0, rel=0.1)


def test_ticks_and_speeds_together_are_both_measured(tmp_path):
    lines = [[*line, round(line[0] * 2.0 * 1000), round(line[0] * 3.0 * 1000)] for line in circle()]
    content = text(lines, HEADER + ",enc_left_ticks,enc_right_ticks")
    wheels = read(tmp_path, content, ticks_per_rev=2000.0 * math.pi).wheels
    assert wheels.angle_measured
    assert wheels.speed_measured
    assert wheels.right_speed_rad_s.tolist() == [3.0] * 400
    assert wheels.right_angle_rad[-1] == pytest.approx(3.0 * lines[-1][0], abs=1e-3)


def test_ticks_that_jump_all_the_time_are_refused(tmp_path):
    lines = [[*line[:3], (k * 7919) % 1_000_003, 0, *line[5:]] for k, line in enumerate(circle())]
    assert "must be cumulative" in refusal(tmp_path, text(lines, TICKS_HEADER), ticks_per_rev=200.0)


def test_segments_are_numbered_in_order_and_nothing_is_integrated_across(tmp_path):
    labels = ["", "7", "", "3", "3", "9", "9", "9", "3"]
    lines = [f"{0.1 * k:.1f},1,1,1,1,{0.009 * k},0,0.1,{label}" for k, label in enumerate(labels)]
    drive = read(tmp_path, HEADER + ",segment\n" + "\n".join(lines) + "\n")
    assert drive.poses.segment.tolist() == [0, 0, 0, 1, 1, 2, 2, 2, 3]
    assert drive.wheels.left_angle_rad[-1] == pytest.approx(0.5)


def test_yaw_beyond_pi_is_wrapped_with_a_note(tmp_path):
    lines = circle(1200)
    for line in lines:
        line[7] = 0.06 / 0.31 * line[0]
    drive = read(tmp_path, text(lines))
    assert "wrapped" in drive.notes[0]
    assert np.abs(drive.poses.yaw_rad).max() <= np.pi
    assert np.allclose(np.unwrap(drive.poses.yaw_rad), [line[7] for line in lines])


def test_yaw_within_pi_keeps_its_bits(tmp_path):
    yaws = [math.pi, -math.pi, -3.0, 0.1, -0.0, 5e-324, 3.0]
    content = HEADER + "\n" + "".join(f"{0.1 * k},0.0,0.0,0.0,0.0,0.0,0.0,{yaw!r}\n" for k, yaw in enumerate(yaws))
    yaw_rad = read(tmp_path, content).poses.yaw_rad
    assert yaw_rad.tolist() == [math.pi, math.pi, *yaws[2:]]
    assert math.copysign(1.0, yaw_rad[4]) == -1.0


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "empty file"),
        (HEADER + "\n", "has a header but no rows"),
        ("time,a,b\n1,2,3\n", "no column t_s, cmd_left_rad_s, cmd_right_rad_s"),
        ("t_s,cmd_left_rad_s,cmd_right_rad_s\n0,1,1\n", "neither encoder nor pose"),
        (HEADER.replace(",pose_y_m", "") + "\n" + rows(3, "{t:.2f},1,1,1,1,1,1"), "no column pose_y_m"),
        (HEADER.replace("enc_right", "enc_rigth") + "\n" + rows(3), "no column enc_right_rad_s"),
        (HEADER + ",t_s\n" + rows(3), "column t_s appears twice"),
        (HEADER + "\n" + rows(30) + "1.5,1,2,1,1,1,1,1\n", "line 32: the clock goes backwards (t_s 2.9, then 1.5)"),
        (HEADER + "\n" + rows(30, "{k}00,1,2,1,2,1,1,0.1"), "does not look like seconds"),
        (HEADER + "\n" + rows(5, "{t:.2f},,,,,,,"), "nothing was driven"),
        ("\x00\x01\x02", "no column"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, content, message):
    assert message in refusal(tmp_path, content)


def test_degrees_and_millimetres_are_refused(tmp_path):
    lines = circle(1200)
    assert "degrees" in refusal(tmp_path, text([[*line[:7], math.degrees(line[7])] for line in lines]))
    millimetres = [[*line[:5], 1e3 * line[5], 1e3 * line[6], line[7]] for line in lines]
    assert "write metres" in refusal(tmp_path, text(millimetres))


def test_a_missing_file_and_one_that_is_no_text(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_csv(tmp_path / "none.csv")
    path = tmp_path / "x.csv"
    path.write_bytes(b"\xff\xfe\x00t")
    with pytest.raises(InputError, match="not a CSV file"):
        read_csv(path)


CELLS = st.sampled_from(["", "0", "1.5", "-2", "nan", "1e400", "x", '"', "9" * 30, "\x00", "é"])
TABLE = st.lists(st.lists(CELLS, min_size=7, max_size=9), max_size=8)


@examples(quick=50, every=200, cells=TABLE, header=st.sampled_from([HEADER, HEADER + ",segment"]))
def test_whatever_the_cells_it_reads_or_is_refused(cells, header):
    with NamedTemporaryFile("w", suffix=".csv", encoding="utf-8") as file:
        file.write(header + "\n" + "".join(f"{k}," + ",".join(row) + "\n" for k, row in enumerate(cells)))
        file.flush()
        message = file.name
        try:
            assert np.isfinite(read_csv(Path(file.name)).poses.x_m).all()
        except LogError as error:
            message = str(error)
        assert message.startswith(file.name)
        assert "\n" not in message


@pytest.mark.skipif(REAL_LOGS not in os.environ, reason=f"set {REAL_LOGS} to a directory of real logs as CSV")
def test_real_logs_are_read():
    paths = sorted(Path(os.environ[REAL_LOGS]).rglob("*.csv"))
    assert paths
    for path in paths:
        drive = read_csv(path, ticks_per_rev=2796.8)
        assert (np.diff(drive.wheels.t_s) > 0.0).all()
        assert np.isfinite(drive.wheels.left_angle_rad).all()
        assert drive.end_s > 10.0
        assert np.isfinite(drive.commands.left_rad_s).any()
