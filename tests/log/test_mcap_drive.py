import math

import numpy as np
import pytest

from disco_hw.errors import LogError
from disco_hw.log import Attachment, End
from disco_hw.log.load import drive_from_log, nominal_robot
from disco_hw.log.reader import open_log
from disco_hw.log.records import Command, Event
from drivers.types import PoseSample, WheelSample
from tools.log_samples import PERIOD_NS, drive_ticks, tick, write_log


def drive_of(path, ticks, **changes):
    with open_log(write_log(path / "run.mcap", ticks, **changes)) as log:
        return drive_from_log(log)


def numbered(records):
    """Ticks of one record each."""
    return [(k, [record]) for k, record in enumerate(records, start=1)]


def test_what_was_executed_measured_and_seen(tmp_path):
    drive = drive_of(tmp_path, drive_ticks(100))
    assert drive.segments == 1
    assert drive.notes == ()
    assert drive.commands.left_rad_s.tolist() == [2.0] * 100
    assert drive.commands.right_rad_s.tolist() == [2.2] * 100
    assert np.array_equal(drive.wheels.left_angle_rad, 0.04 * np.arange(1, 101))
    assert drive.wheels.angle_measured
    assert drive.wheels.speed_measured
    assert np.array_equal(drive.poses.x_m, 0.002 * np.arange(5, 101, 5))
    assert min(drive.commands.t_s[0], drive.wheels.t_s[0], drive.poses.t_s[0]) == 0.0
    assert drive.commands.t_s[0] - drive.wheels.t_s[0] == pytest.approx(0.001, abs=1e-12)
    assert np.allclose(np.diff(drive.wheels.t_s), 0.02)


def test_while_nothing_is_in_force_no_command_is_known(tmp_path):
    drive = drive_of(tmp_path, numbered(Command(k, 9.0, 9.0, 1.0, 1.0, 0.1, k != 2) for k in (1, 2, 3)))
    assert np.isnan(drive.commands.left_rad_s).tolist() == [False, True, False]
    assert not drive.wheels.angle_measured


def test_missing_ticks_start_a_new_segment_in_every_array(tmp_path):
    ticks = [tick for tick in drive_ticks(100) if not 40 <= tick[0] // PERIOD_NS < 50]
    drive = drive_of(tmp_path, ticks, numbers=True)
    assert drive.segments == 2
    assert "10 ticks are missing" in drive.notes[0]
    assert np.count_nonzero(drive.commands.segment) == 51
    assert 50 <= np.count_nonzero(drive.wheels.segment) <= 51
    assert np.count_nonzero(drive.poses.segment) in (10, 11)


def test_a_drive_whose_log_goes_on_in_another_part_says_so(tmp_path):
    end = End(100 * PERIOD_NS, 100, 0, continued=True)
    drive = drive_of(tmp_path, drive_ticks(100), end=end)
    assert drive.notes == (
        f"{tmp_path / 'run.mcap'}: was full, and goes on in the next part, which is a log of its own",
    )


def test_silent_wheels_start_a_new_segment(tmp_path):
    times = [0, 10**8, 2 * 10**8, 10**9, 11 * 10**8]
    drive = drive_of(tmp_path, numbered(WheelSample(t_ns, t_ns, 0.0, 0.0, 0.0, 0.0) for t_ns in times))
    assert drive.wheels.segment.tolist() == [0, 0, 0, 1, 1]


def test_late_poses_are_put_in_order_and_doubles_and_broken_ones_left_out(tmp_path):
    times = [(10**7, 1.0), (3 * 10**7, 3.0), (2 * 10**7, 2.0), (3 * 10**7, 99.0), (4 * 10**7, math.nan)]
    drive = drive_of(tmp_path, numbered(PoseSample(t_ns, t_ns + 5, x_m, 0.0, 0.0, 0.1, 0.1) for t_ns, x_m in times))
    assert drive.poses.x_m.tolist() == [1.0, 2.0, 3.0]
    assert np.allclose(drive.poses.t_s, [0.0, 0.01, 0.02])
    assert any("not finite" in note for note in drive.notes)
    assert any("have the time of another" in note for note in drive.notes)


def test_positions_without_heading_are_left_out_and_said_to_be(tmp_path):
    poses = [PoseSample(k * 10**7, k * 10**7, 1.0 * k, 0.0, math.nan, 0.02, math.nan) for k in range(1, 6)]
    good = PoseSample(6 * 10**7, 6 * 10**7, 6.0, 0.0, 0.5, 0.02, 0.02)
    drive = drive_of(tmp_path, numbered([*poses, good]))
    assert drive.poses.x_m.tolist() == [6.0]
    (note,) = drive.notes
    assert "5 positions without heading were left out" in note


@pytest.mark.parametrize("flush_every", [None, 5])
def test_a_clock_that_goes_backwards_is_refused(tmp_path, flush_every):
    ticks = [(k * PERIOD_NS, tick(k)) for k in (*range(1, 61), *range(31, 70))]
    message = r"run\.mcap: the clock goes backwards by 0\.58 s after 1\.18 s of /command; give each run as a log"
    with pytest.raises(LogError, match=message):
        drive_of(tmp_path, ticks, flush_every=flush_every)


def test_a_log_in_which_nothing_was_driven_is_refused(tmp_path):
    with pytest.raises(LogError, match="nothing was driven"):
        drive_of(tmp_path, [(1, [Event(1, "info", "a", "b")])])


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"[robot]\nticks_per_rev = 2048\n", 2048),
        (None, None),
        (b"[robot]\n", None),
        (b"robot = 3\n", None),
        (b"[robot]\nticks_per_rev = 2796.8\n", 2796.8),
        (b"[robot]\nticks_per_rev = -1\n", None),
        (b"[robot]\nticks_per_rev = inf\n", None),
        (b'[robot]\nticks_per_rev = "x"\n', None),
        (b"\xff\xfe[", None),
        (b"[robot]\nticks_per_rev = " + b"1" * 5000, None),
        (b"robot = " + b"[" * 3000, None),
    ],
)
def test_the_ticks_of_a_revolution_come_from_the_configuration_in_the_log(tmp_path, content, expected):
    kept = () if content is None else (Attachment("robot.toml", "application/toml", content),)
    with open_log(write_log(tmp_path / "run.mcap", drive_ticks(1), attachments=kept)) as log:
        assert nominal_robot(log).get("ticks_per_rev") == expected
