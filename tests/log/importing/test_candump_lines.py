"""Candumps in every format that the tool writes, and with faults of the kinds that are met in the field."""

import re
from datetime import UTC, datetime

import msgspec
import numpy as np
import pytest

from disco_hw.config import Link
from disco_hw.errors import InputError, LogError
from disco_hw.log.importing import import_log
from disco_hw.log.importing.candump import read_candump
from tests.inference.drives import ROBOT as ROBOT_TOML
from tests.log.importing.test_candump import CONFIG, dumped
from tests.log.refusals import refused

_LOGGED = re.compile(r"\((\d+\.\d+)\) can0 ([0-9A-F]{3})#([0-9A-F]*)")


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Time stamp (s), identifier and data of each frame of a drive."""
    text = dumped(tmp_path_factory.mktemp("dump") / "dump.log").read_text()
    found = [(float(t), can_id, data) for t, can_id, data in _LOGGED.findall(text)]
    assert len(found) == 900
    return found


def packed(stamp, can_id, data, channel="can0"):
    return f"({stamp}) {channel} {can_id}#{data}"


def screen(stamp, can_id, data, channel="can0"):
    spaced = " ".join(data[at : at + 2] for at in range(0, len(data), 2))
    begin = f" ({stamp})" if stamp else ""
    return f"{begin}  {channel}  {can_id}   [{len(data) // 2}]  {spaced}"


def absolute(t_s, _):
    return f"{t_s:.6f}"


def from_zero(t_s, first_s):
    return f"{t_s - first_s:010.6f}"


def dated(t_s, _):
    return datetime.fromtimestamp(t_s, UTC).strftime("%Y-%m-%d %H:%M:%S.%f")


def lines_of(frames, stamp=absolute, write=packed, **settings):
    return [write(stamp(t_s, frames[0][0]), can_id, data, **settings) for t_s, can_id, data in frames]


def differences(frames, write=screen):
    times = [t_s for t_s, _, _ in frames]
    gaps = np.diff(times, prepend=times[0])
    return [write(f"{gap_s:010.6f}", can_id, data) for gap_s, (_, can_id, data) in zip(gaps, frames, strict=True)]


def read(tmp_path, lines, end="\n", config=CONFIG, **settings):
    path = tmp_path / "dump.log"
    path.write_text("\n".join(lines) + end)
    return read_candump(path, config, **settings)


@pytest.fixture(scope="module")
def reference(frames, tmp_path_factory):
    return read(tmp_path_factory.mktemp("whole"), lines_of(frames))


def assert_same(drive, reference, atol_s=2e-6):
    np.testing.assert_allclose(drive.wheels.t_s, reference.wheels.t_s, atol=atol_s)
    np.testing.assert_array_equal(drive.wheels.left_angle_rad, reference.wheels.left_angle_rad)
    np.testing.assert_array_equal(drive.poses.x_m, reference.poses.x_m)
    np.testing.assert_array_equal(drive.commands.left_rad_s, reference.commands.left_rad_s)


@pytest.mark.parametrize("write", [packed, screen])
@pytest.mark.parametrize("stamp", [absolute, from_zero, dated])
def test_each_format_with_time_stamps_gives_the_same_drive(tmp_path, frames, reference, stamp, write):
    drive = read(tmp_path, lines_of(frames, stamp, write))
    assert_same(drive, reference)
    assert drive.notes == ()


@pytest.mark.parametrize("write", [packed, screen])
def test_differences_between_frames_are_summed_up(tmp_path, frames, reference, write):
    drive = read(tmp_path, differences(frames, write))
    assert_same(drive, reference, atol_s=2e-3)
    (note,) = drive.notes
    assert "are differences between frames (candump -td) and were summed up" in note


def test_the_screen_format_without_time_stamps_is_named(tmp_path, frames, robot):
    path = tmp_path / "dump.txt"
    path.write_text("\n".join(lines_of(frames, lambda *_: "", screen)))
    message = r"line 1: candump's screen format without time stamps; record with `candump -L`"
    with pytest.raises(LogError, match=message):
        import_log(path, robot, tmp_path / "log.mcap")


OTHERS = {
    "error": ["(1700000001.0) can0 20000004#0001000000000000"],
    "remote": ["(1700000001.0) can0 110#R", "(1700000001.0) can0 110#R8"],
    "FD": ["(1700000001.0) can0 110##1112233"],
    "extended": ["(1700000001.0) can0 00000110#0102030405060708"],
    "error on the screen": [" (1700000001.0)  can0  20000004   [8]  00 01 00 00 00 00 00 00   ERRORFRAME"],
    "remote on the screen": [" (1700000001.0)  can0  110   [0]  remote request"],
    "text beside the bytes": [" (1700000001.0)  can0  7A1   [2]  41 42   'AB'"],
    "blank": ["", "   "],
}


@pytest.mark.parametrize("others", OTHERS.values(), ids=OTHERS)
def test_frames_of_other_kinds_change_nothing(tmp_path, frames, reference, others):
    lines = lines_of(frames)
    drive = read(tmp_path, lines[:100] + others + lines[100:])
    assert_same(drive, reference)
    assert drive.notes == ()


@pytest.mark.parametrize("left", [1, 5, 25, 31, 36])
def test_a_last_line_that_is_cut_is_left_out_and_said(tmp_path, frames, reference, left):
    lines = lines_of(frames)
    drive = read(tmp_path, [*lines, lines[-1][:left]], end="")
    assert_same(drive, reference)
    assert "the last line is cut off" in drive.notes[0] or left > 30


@pytest.mark.parametrize(("count", "warns"), [(1, False), (30, False), (60, True)])
def test_lines_that_are_no_frame_are_counted(tmp_path, frames, reference, count, warns):
    lines = lines_of(frames)
    drive = read(tmp_path, lines[:300] + ["read: Network is down"] * count + lines[300:])
    assert_same(drive, reference)
    assert f"lines: {count} of {900 + count} are no frame and were left out, the first is line 301" in drive.notes[0]
    assert drive.notes[0].startswith("warning: ") == warns


def test_over_half_of_lines_that_are_no_frame_is_an_error(tmp_path, frames):
    with pytest.raises(LogError, match="lines: 901 of 1801 are no frame"):
        read(tmp_path, lines_of(frames) + ["?"] * 901)


def interleaved(one, other):
    return [line for pair in zip(one, other, strict=True) for line in pair]


def test_of_two_channels_the_one_that_speaks_the_protocol_is_read(tmp_path, frames, reference):
    chatter = [packed(absolute(t_s, 0.0), "7A1", "0011", "can1") for t_s, _, _ in frames]
    drive = read(tmp_path, interleaved(lines_of(frames), chatter))
    assert_same(drive, reference)
    assert "channel can0 was read, and can1 left out; --channel takes another" in drive.notes[0]


def two_robots(frames):
    later = [(t_s + 1e-5, can_id, data) for t_s, can_id, data in frames[450:]]
    return [*lines_of(frames[:450]), *interleaved(lines_of(frames[450:]), lines_of(later, channel="can1"))]


def test_of_two_robots_one_must_be_named(tmp_path, frames, reference):
    with refused(r"several channels hold a robot \(can0 with .*, can1 with .*--channel"):
        read(tmp_path, two_robots(frames))
    assert_same(read(tmp_path, two_robots(frames), channel="can0"), reference)
    usual = msgspec.structs.replace(CONFIG, link=Link(channel="can0"))
    assert_same(read(tmp_path, two_robots(frames), config=usual), reference)
    assert read(tmp_path, two_robots(frames), channel="can1").wheels.t_s.size < 0.6 * reference.wheels.t_s.size
    with pytest.raises(LogError, match="no channel can7; it has can0, can1"):
        read(tmp_path, two_robots(frames), channel="can7")


def test_the_channel_comes_from_the_command_line_or_robot_toml(tmp_path, frames, robot):
    path = tmp_path / "dump.log"
    path.write_text("\n".join(two_robots(frames)) + "\n")
    robot.write_text(ROBOT_TOML + '[link]\nchannel = "vcan0"\n')
    with pytest.raises(LogError, match="--channel"):
        import_log(path, robot, tmp_path / "a.mcap")
    assert import_log(path, robot, tmp_path / "a.mcap", channel="can0").duration_s > 9.0
    robot.write_text(ROBOT_TOML + '[link]\nchannel = "can1"\n')
    assert import_log(path, robot, tmp_path / "b.mcap").duration_s < 6.0
    (tmp_path / "a.csv").write_text("t_s\n")
    with pytest.raises(InputError, match=r"--channel: .* is a csv, which has no channels"):
        import_log(tmp_path / "a.csv", robot, tmp_path / "c.mcap", channel="can0")


def test_a_clock_that_was_set_back_is_taken_out(tmp_path, frames, reference):
    back = [(t_s - (3600.0 if k >= 450 else 0.0), can_id, data) for k, (t_s, can_id, data) in enumerate(frames)]
    drive = read(tmp_path, lines_of(back))
    np.testing.assert_allclose(drive.wheels.t_s, reference.wheels.t_s, atol=0.06)
    assert "the clock was set back 1 times, which was taken out" in drive.notes[0]


def test_frames_in_slight_disorder_are_read(tmp_path, frames, reference):
    mixed = list(frames)
    mixed[500], mixed[501] = mixed[501], mixed[500]
    drive = read(tmp_path, lines_of(mixed))
    assert drive.wheels.t_s.size >= reference.wheels.t_s.size - 1
    assert (np.diff(drive.wheels.t_s) > 0.0).all()
    assert drive.notes == ()
