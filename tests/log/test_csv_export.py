import csv
import math
from dataclasses import replace

import numpy as np
import pytest

from disco_hw.errors import LogError
from disco_hw.log.importing.csv_drive import read_csv, write_csv
from disco_hw.log.load import drive_from_log
from disco_hw.log.reader import open_log
from disco_hw.log.records import Command
from drivers.types import PoseSample, WheelSample
from tests.log.processes import files_of_at_most
from tools.log_samples import PERIOD_NS, write_log

TICKS = 2048
NUMBERS = np.random.default_rng(3).random((400, 8))


def driven_ticks():
    """Ticks 30 to 35 went missing; in ticks 20 to 24 the robot was not armed."""
    for k in range(1, 400):
        if 30 <= k < 36:
            continue
        t_ns, a = k * PERIOD_NS, NUMBERS[k].tolist()
        angle = round(0.04 * k * TICKS / (2.0 * math.pi)) * (2.0 * math.pi / TICKS)
        records = [
            WheelSample(t_ns - 10**6, t_ns, angle, angle, 2.0 + a[0] * 1e-3, 2.0 + a[1] * 1e-3),
            Command(t_ns, 9.0, 9.0, 2.0 + a[2], 2.0 + a[3], 0.1, not 20 <= k < 25),
        ]
        if k % 5 == 0:
            records.append(PoseSample(t_ns - 7 * 10**6, t_ns, 0.0024 * k + a[4] * 1e-3, a[5] * 1e-3, a[6], 0.0, 0.0))
        yield t_ns, records


@pytest.fixture
def drive(tmp_path):
    with open_log(write_log(tmp_path / "run.mcap", driven_ticks(), numbers=True)) as log:
        return drive_from_log(log)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.csv"


def test_what_is_exported_comes_back_to_the_last_bit(drive, path):
    count = write_csv(drive, path, TICKS)
    back = read_csv(path, ticks_per_rev=TICKS, wheel_radius_m=0.06)
    columns = {
        "wheels": ("t_s", "left_speed_rad_s", "right_speed_rad_s", "left_angle_rad", "segment"),
        "poses": ("t_s", "x_m", "y_m", "yaw_rad", "segment"),
    }
    for part, names in columns.items():
        for name in names:
            assert np.array_equal(getattr(getattr(back, part), name), getattr(getattr(drive, part), name)), name
    assert drive.segments == back.segments == 2
    assert count == np.unique(np.concatenate([drive.commands.t_s, drive.wheels.t_s, drive.poses.t_s])).size


def test_the_command_in_force_is_the_same_at_every_time(drive, path):
    write_csv(drive, path, TICKS)
    back = read_csv(path, ticks_per_rev=TICKS)

    def in_force(commands, t_s):
        return commands.left_rad_s[np.searchsorted(commands.t_s, t_s, side="right") - 1]

    for t_s in drive.commands.t_s[drive.commands.t_s < 0.36]:
        assert in_force(back.commands, t_s) == in_force(drive.commands, t_s)


def test_nothing_is_written_where_nothing_was_in_force(drive, path):
    write_csv(drive, path, None)
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert "enc_left_ticks" not in rows[0]
    silent = [row for row in rows if 0.385 < float(row["t_s"]) < 0.475]
    assert silent
    assert all(row["cmd_left_rad_s"] == "" for row in silent)
    assert any(row["pose_x_m"] == "" for row in rows)


@pytest.mark.parametrize(
    ("flags", "ticks_per_rev", "written"),
    [
        ({}, TICKS, {"ticks", "rad_s"}),
        ({"angle_measured": False}, TICKS, {"rad_s"}),
        ({"speed_measured": False}, TICKS, {"ticks"}),
        ({"speed_measured": False}, None, {"rad_s"}),
    ],
)
def test_of_the_wheels_what_was_measured_is_written(drive, path, flags, ticks_per_rev, written):
    write_csv(replace(drive, wheels=replace(drive.wheels, **flags)), path, ticks_per_rev)
    names = path.read_text(encoding="utf-8").splitlines()[0].split(",")
    assert {name.removeprefix("enc_left_") for name in names if name.startswith("enc_left")} == written


def test_nothing_is_overwritten_and_a_bad_place_is_named(drive, path, tmp_path):
    path.write_text("precious", encoding="utf-8")
    with pytest.raises(LogError, match="already exists"):
        write_csv(drive, path, None)
    for place in (tmp_path / "none" / "x.csv", path / "x.csv", tmp_path / ("x" * 300)):
        with pytest.raises(LogError, match=r"x: cannot be written|x\.csv: cannot be written"):
            write_csv(drive, place, None)
    assert path.read_text(encoding="utf-8") == "precious"


def test_an_interrupted_export_leaves_no_half_table_behind(drive, path, monkeypatch):
    class Interrupted:
        def __init__(self, file):
            self.writerow = csv_writer(file).writerow

        def writerows(self, rows):
            self.writerow(next(rows))
            raise KeyboardInterrupt

    csv_writer = csv.writer
    monkeypatch.setattr(csv, "writer", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_csv(drive, path, None)
    assert not path.exists()


def test_a_full_disk_leaves_no_half_table_behind(drive, path):
    with files_of_at_most(2_000), pytest.raises(LogError, match="File too large"):
        write_csv(drive, path, None)
    assert not path.exists()
