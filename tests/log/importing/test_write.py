from dataclasses import replace

import numpy as np
import pytest

from disco_hw.errors import LogError
from disco_hw.log.importing import write_log
from disco_hw.log.load import load_drive
from tests.inference.drives import logged
from tests.log.processes import files_of_at_most


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
