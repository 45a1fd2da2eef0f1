from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader

from disco_hw.errors import LogError
from disco_hw.log.drive import Commands, Wheels
from disco_hw.log.importing import import_log, write_log
from disco_hw.log.load import load_drive
from disco_hw.log.log_command import export, info, recover_log
from disco_hw.log.reader import open_log
from tests.inference.drives import TICKS_PER_REV, logged
from tests.log.processes import files_of_at_most
from tools.log_samples import with_damaged_chunk


def parts(drive):
    for name in ("commands", "wheels", "poses"):
        part = getattr(drive, name)
        for field in part.__slots__:
            if isinstance(getattr(part, field), np.ndarray):
                yield f"{name}.{field}", getattr(part, field)


def in_two_segments(drive):
    """The second half of the drive is another segment."""
    parts = {name: getattr(drive, name) for name in ("commands", "wheels", "poses", "gyro")}
    return replace(
        drive, **{name: replace(part, segment=(part.t_s > 6.0).astype(np.int64)) for name, part in parts.items()}
    )


@pytest.fixture
def path(tmp_path):
    return tmp_path / "log.mcap"


def test_what_is_written_is_read_back(path):
    drive = in_two_segments(logged("poor"))
    count = write_log(drive, path, "test")
    back = load_drive(path)
    assert count == drive.commands.t_s.size + drive.wheels.t_s.size + drive.poses.t_s.size
    assert back.segments == drive.segments == 2
    first_s = min(part.t_s[0] for part in (drive.commands, drive.wheels, drive.poses))
    for (name, written), (_, read) in zip(parts(drive), parts(back), strict=True):
        if name.endswith("t_s"):
            assert read == pytest.approx(written - first_s, abs=2e-9), name
        else:
            assert np.array_equal(read, written, equal_nan=True), name


def test_a_change_of_segment_is_no_loss(path):
    drive = in_two_segments(logged("poor"))
    later = replace(drive.poses, segment=7 * drive.poses.segment)
    count = write_log(replace(drive, commands=Commands(), wheels=Wheels(), poses=later), path, "test")
    assert f"{count} ticks, 0 missing, 1 segment break; ended properly" in info(path, as_json=False)
    assert (load_drive(path).segments, load_drive(path).notes) == (2, ())


def test_what_a_damaged_import_loses_is_missing(path, tmp_path):
    write_log(in_two_segments(logged("poor")), path, "test")
    with open_log(path) as log:
        ticks = log.summary().ticks
    path.write_bytes(with_damaged_chunk(path.read_bytes()))
    recover_log(path, tmp_path / "mended.mcap")
    with open_log(tmp_path / "mended.mcap") as log:
        left = log.summary()
    assert left.missing_ticks == pytest.approx(ticks - left.ticks, abs=1)
    assert left.missing_ticks > 10
    assert f"{left.missing_ticks} ticks are missing" in load_drive(tmp_path / "mended.mcap").notes[0]


@pytest.mark.parametrize("measured", [(True, True), (True, False), (False, True)])
def test_the_log_says_whether_wheel_angles_and_speeds_were_measured(path, measured):
    drive = logged("poor")
    flags = {"angle_measured": measured[0], "speed_measured": measured[1]}
    write_log(replace(drive, wheels=replace(drive.wheels, **flags)), path, "test")
    back = load_drive(path).wheels
    assert (back.angle_measured, back.speed_measured) == measured
    with path.open("rb") as file:
        (metadata,) = (one for one in make_reader(file).iter_metadata() if one.name == "disco-hw")
    assert {name for name in flags if name in metadata.metadata} == {name for name in flags if not flags[name]}


def test_a_log_without_wheels_measured_none_of_their_values(path):
    write_log(replace(logged("poor"), wheels=Wheels()), path, "test")
    assert not load_drive(path).wheels.angle_measured


def test_angles_that_were_derived_from_speeds_are_not_exported(path, tmp_path, robot):
    rows = "".join(f"{0.05 * k:.2f},2,3,2,3,{0.01 * k},0,0\n" for k in range(40))
    header = "t_s,cmd_left_rad_s,cmd_right_rad_s,enc_left_rad_s,enc_right_rad_s,pose_x_m,pose_y_m,pose_yaw_rad\n"
    source, out = tmp_path / "log.csv", tmp_path / "export.csv"
    source.write_text(header + rows, encoding="utf-8")
    import_log(source, robot, path)
    export(path, out, as_json=False)
    assert "enc_left_ticks" not in out.read_text(encoding="utf-8")
    assert not load_drive(out, TICKS_PER_REV).wheels.angle_measured


def test_a_log_is_never_overwritten_and_a_place_that_is_none_refused(path):
    path.write_bytes(b"precious")
    with pytest.raises(LogError, match="already exists; give another name"):
        write_log(logged("poor"), path, "test")
    assert path.read_bytes() == b"precious"
    with pytest.raises(LogError, match="cannot be created"):
        write_log(logged("poor"), path.parent / "nowhere" / "log.mcap", "test")


def test_times_that_do_not_fit_into_a_log_are_refused_and_leave_nothing_behind(path):
    drive = logged("poor")
    t_s = np.append(drive.commands.t_s[:-1], 1e12)
    far = replace(drive, commands=replace(drive.commands, t_s=t_s))
    with pytest.raises(LogError, match=r"its times span 1e\+12 s; correct the clock that jumps"):
        write_log(far, path, "test")
    assert not path.exists()


def test_a_full_disk_leaves_no_half_log_behind(path):
    drive = logged("poor")
    with files_of_at_most(20_000), pytest.raises(LogError, match="File too large"):
        write_log(drive, path, "test")
    assert not path.exists()
