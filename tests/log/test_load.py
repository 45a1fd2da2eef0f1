import numpy as np
import pytest

from disco_hw.errors import InputError, LogError
from disco_hw.log.importing.csv_drive import write_csv
from disco_hw.log.load import load_drive
from disco_hw.log.log_command import recover_log
from tools.log_samples import drive_ticks, log_bytes, write_log


@pytest.fixture
def mcap(tmp_path):
    # The name says nothing: what a file is, its content says.
    return write_log(tmp_path / "log.dat", drive_ticks(100))


@pytest.fixture
def table(mcap, tmp_path):
    path = tmp_path / "table.dat"
    write_csv(load_drive(mcap), path, None)
    return path


def test_both_kinds_give_the_same_drive(mcap, table):
    one, other = load_drive(mcap), load_drive([table])
    assert np.array_equal(one.wheels.t_s, other.wheels.t_s)
    assert np.array_equal(one.wheels.left_speed_rad_s, other.wheels.left_speed_rad_s)
    assert np.array_equal(one.poses.x_m, other.poses.x_m)


def test_several_logs_are_one_drive_in_segments(mcap, table):
    drive = load_drive([mcap, table])
    assert drive.sources == (str(mcap), str(table))
    assert drive.segments == 2
    assert drive.poses.t_s.size == 40
    assert (np.diff(drive.poses.t_s) > 0.0).all()


def test_a_cut_log_is_loaded_as_far_as_it_goes(tmp_path):
    path = tmp_path / "cut.mcap"
    data = log_bytes(drive_ticks(100), flush_every=10)
    path.write_bytes(data[: len(data) // 2])
    assert 10 <= load_drive(path).wheels.t_s.size < 100


def test_bad_ones_are_refused(tmp_path, mcap):
    with pytest.raises(LogError, match="no log given"):
        load_drive([])
    with pytest.raises(InputError, match="cannot be read"):
        load_drive([mcap, tmp_path / "none"])
    (tmp_path / "x").write_text("a,b\n1,2\n", encoding="utf-8")
    with pytest.raises(LogError, match="no column"):
        load_drive(tmp_path / "x")


def test_a_log_given_twice_is_refused_by_whatever_name(tmp_path, mcap, table):
    link = tmp_path / "link"
    link.symlink_to(mcap)
    for again in (mcap, link, tmp_path / "." / mcap.name):
        with pytest.raises(LogError, match="given twice, so that its data would count twice; give each log once"):
            load_drive([mcap, table, again])


@pytest.mark.parametrize("share", [1.0, 0.6])
def test_a_log_and_its_copy_are_one_drive(tmp_path, share):
    data = log_bytes(drive_ticks(200), flush_every=5)
    complete, cut, mended = (tmp_path / name for name in ("whole.mcap", "cut.mcap", "mended.mcap"))
    complete.write_bytes(data)
    cut.write_bytes(data[: int(len(data) * share)])
    recover_log(cut, mended)
    with pytest.raises(LogError, match=r"mended\.mcap: holds the same data as .*whole\.mcap, which would count twice"):
        load_drive([complete, mended])


def test_two_drives_are_two(tmp_path):
    first, later = drive_ticks(200), drive_ticks(600)[380:]
    logs = [write_log(tmp_path / "first.mcap", first), write_log(tmp_path / "later.mcap", later, numbers=True)]
    assert load_drive(logs).poses.t_s.size == 84
