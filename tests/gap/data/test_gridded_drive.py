"""A drive on the grid: commands exact in the mean, runs cut where nothing was measured, foreign stretches left out."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

from disco_hw.gap.data.gridded_drive import even_times, grid_drive
from disco_hw.gap.data.stamp_clock import StampClock
from disco_hw.gap.data.timing import tick_s
from disco_hw.gap.settings import DEFAULT_SETTINGS, GRID_STEP_S
from disco_hw.log.drive import Commands, DriveLog, Poses, Wheels
from tests.tables import thinned


def drive(t_command, command, t_wheel, speed, ticks=2048, segment=None, pose_s=None):
    quantum = 2 * math.pi / ticks
    angle = np.round(np.cumsum(speed * np.diff(t_wheel, prepend=t_wheel[0])) / quantum) * quantum
    where = np.zeros(t_wheel.size, np.int64) if segment is None else segment
    poses = np.arange(0.0, t_wheel[-1], 0.04) if pose_s is None else pose_s
    none = np.zeros(poses.size)
    zeros = np.zeros(t_command.size, np.int64)
    return DriveLog(
        ("made",),
        Commands(t_command, command, command, zeros),
        Wheels(t_wheel, angle, angle, speed, speed, where, True, False),
        Poses(poses, none, none, np.mod(poses + np.pi, 2 * np.pi) - np.pi, np.zeros(poses.size, np.int64)),
    )


def test_a_command_that_changes_within_a_cell_counts_by_its_share():
    t = np.arange(0.0, 10.0, 0.02)
    speed = np.where((t > 5.1) & (t < 8.1), 1.0, 0.0)
    # As much before a border as after one: in the mean they change at borders.
    line = grid_drive(drive(np.array([0.0, 5.002, 7.998]), np.array([0.0, 1.0, 0.0]), t, speed))
    moved_s = line.commands_moved_s
    cell = round((5.0 + moved_s) / GRID_STEP_S)
    assert line.command_rad_s[cell, 0] == pytest.approx(0.8, abs=1e-6)
    assert line.command_rad_s[cell - 1, 0] == pytest.approx(0.0, abs=1e-9)
    assert line.command_rad_s[round((8.0 + moved_s) / GRID_STEP_S) - 1, 0] == pytest.approx(0.8, abs=1e-6)


@pytest.mark.parametrize(("rows", "tick"), [(1, 0.0), (2, 0.05), (3, 0.05)])
def test_one_row_alone_says_nothing_of_how_close_rows_are(rows, tick):
    t = 0.05 * np.arange(rows)
    assert tick_s(t[:1], t) == pytest.approx(tick)
    assert tick_s(t, t[:0]) == 0.0


@pytest.mark.thorough
def test_what_rows_of_a_log_stamp_is_known_as_closely_as_they_follow_one_another():
    t = np.arange(0.0, 10.0, 0.05)
    turned = np.sin(t)
    # Any time between two rows.
    even = float(np.std(np.random.default_rng(0).uniform(0.0, 0.05, 100_000)))

    def scatter(commands_s, poses_s):
        line = grid_drive(drive(commands_s, np.zeros(commands_s.size), t, turned, pose_s=poses_s))
        return line.command_stamps_s, line.pose_stamps_s

    # Every third row has a pose, and all but a few a command.
    assert scatter(t[3:], t[::3]) == pytest.approx((even, even), rel=0.01)
    # To the microsecond: a table has no more digits.
    assert scatter(t + 2e-7, t[::3] - 2e-7) == pytest.approx((even, even), rel=0.01)
    # Stamps of their own, however few of them.
    assert scatter(t + 0.004, t[::3]) == (0.0, pytest.approx(even, rel=0.01))
    own = t[::3].copy()
    own[5] += 0.004
    assert scatter(t, own) == (pytest.approx(even, rel=0.01), 0.0)
    assert scatter(t[:0], t[:0]) == (0.0, 0.0)
    notes = grid_drive(drive(t, np.zeros(t.size), t, turned, pose_s=own)).notes
    said = "commands are stamped by the rows of the log, 50 ms apart: how late they are is known to 29 ms at best"
    assert said in notes
    assert not any(note.startswith("poses") for note in notes)
    # Rows that follow closely are no news.
    t = np.arange(0.0, 10.0, 0.02)
    line = grid_drive(drive(t, np.zeros(t.size), t, np.sin(t)))
    assert line.command_stamps_s == pytest.approx(0.4 * even, rel=0.01)
    assert not any(note.startswith("commands are") for note in line.notes)


@thinned("cells", [-7, 0, 7], quick=1)
def test_commands_in_force_are_earlier_ones_or_later_ones_where_their_stamps_are_late(cells):
    t = np.arange(0.0, 10.0, 0.02)
    line = grid_drive(drive(t, np.sin(t), t, np.sin(t)))
    own, in_force = (
        np.nan_to_num(line.command_rad_s),
        line.delayed_commands(line.commands_moved_s + cells * GRID_STEP_S),
    )
    assert in_force.shape == own.shape
    node = np.arange(20, own.shape[0] - 20)
    np.testing.assert_array_equal(in_force[node], own[node - cells])
    edge = own[0] if cells > 0 else own[-1]
    np.testing.assert_array_equal(in_force[0 if cells > 0 else -1], edge)


@pytest.mark.thorough
@thinned("by_s", [-0.3, -0.203, 0.107, 0.4], quick=1)
def test_a_log_whose_stamps_are_moved_lies_on_the_grid_as_if_they_were_not(by_s):
    rng = np.random.default_rng(7)
    t = np.arange(0.0, 40.0, 0.02)
    speed = rng.uniform(-2.0, 4.0, 40)[(t % 40.0).astype(int)]
    log = drive(t, speed, t, speed)
    yaw = np.interp(log.poses.t_s, t, np.sin(np.cumsum(speed) * 0.02))
    log = replace(
        log, poses=replace(log.poses, x_m=0.1 * np.interp(log.poses.t_s, t, np.cumsum(speed) * 0.02), yaw_rad=0.0 * yaw)
    )
    plain = grid_drive(log)
    commands = grid_drive(replace(log, commands=replace(log.commands, t_s=log.commands.t_s + by_s)))
    assert commands.commands_moved_s == pytest.approx(plain.commands_moved_s - by_s)
    inside = slice(round(abs(by_s) / GRID_STEP_S) + 1, -round(abs(by_s) / GRID_STEP_S) - 1)
    np.testing.assert_allclose(commands.command_rad_s[inside], plain.command_rad_s[inside], atol=1e-9)
    np.testing.assert_allclose(commands.command_change[inside], plain.command_change[inside], atol=1e-9)
    # And what is in force after a delay is counted from the stamps.
    late_s = commands.commands_moved_s + 0.05
    np.testing.assert_allclose(
        commands.delayed_commands(late_s)[inside][5:], plain.delayed_commands(plain.commands_moved_s + 0.05)[inside][5:]
    )
    poses = grid_drive(replace(log, poses=replace(log.poses, t_s=log.poses.t_s + by_s)))
    assert poses.poses_moved_s == poses.pose_delay_s == pytest.approx(plain.pose_delay_s + by_s, abs=1e-3)
    here, there = (each.pose.t_s[(each.pose.t_s > 1.0) & (each.pose.t_s < 38.0)] for each in (poses, plain))
    np.testing.assert_allclose(here, there, atol=1e-3)


@thinned("off_s", [0.0, 0.0004, 0.002, 0.003, 0.0062, -0.2026], quick=2)
@thinned("begin_s", [0.0, 3.304], quick=1)
def test_commands_are_laid_so_that_they_change_at_the_borders_of_cells(off_s, begin_s):
    rng = np.random.default_rng(9)
    t = np.arange(0.0, 20.0, 0.02)
    speed = rng.uniform(-2.0, 4.0, 20)[t.astype(int)]
    line = grid_drive(drive(begin_s + t + off_s, speed, begin_s + t, speed))
    changed = np.abs(np.diff(line.command_rad_s[:, 0])) > 1e-6
    # From one level to the next without a cell between.
    assert not (changed[1:] & changed[:-1])[150:-150].any()
    assert np.count_nonzero(changed[150:-150]) == 17
    # The angle of a sample has the speed since the sample before.
    assert line.commands_moved_s == pytest.approx(-0.02 - off_s)


@thinned(
    ("clock", "even"),
    [
        (StampClock(0.1), True),
        (StampClock(0.1, 5.0, 10.0, -0.06), False),
        (StampClock(0.1, jump_s=-0.2, jump_at_s=4.0), False),
    ],
    quick=1,
)
def test_a_drive_knows_whether_its_poses_clock_runs_evenly(monkeypatch, clock, even):
    monkeypatch.setitem(grid_drive.__globals__, "pose_clock", lambda *of: clock)
    t = np.arange(0.0, 10.0, 0.02)
    assert grid_drive(drive(t, np.sin(t), t, np.sin(t))).pose_clock_even == even


def test_silence_and_segments_cut_runs():
    t = np.concatenate([np.arange(0.0, 8.0, 0.02), np.arange(11.0, 20.0, 0.02)])
    line = grid_drive(drive(t, np.full(t.size, 1.0), t, np.full(t.size, 1.0)))
    assert line.first.sum() == 2
    segment = (t > 4.0).astype(np.int64)
    assert grid_drive(drive(t, np.full(t.size, 1.0), t, np.full(t.size, 1.0), segment=segment)).first.sum() == 3


def test_yaw_is_not_wrapped_and_stamps_scatter_as_they_do():
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 20.0, 0.02) + 0.001 * rng.standard_normal(1000)
    line = grid_drive(drive(t, np.full(t.size, 1.0), t, np.full(t.size, 1.0)))
    assert line.pose_values[-1, 2] - line.pose_values[0, 2] > 6.0
    assert line.stamp_scatter_s == pytest.approx(0.001, rel=0.3)


def test_the_smallest_step_of_the_angle_is_the_encoders():
    t = np.arange(0.0, 20.0, 0.02)
    line = grid_drive(drive(t, np.sin(t), t, np.sin(t)))
    assert line.quantum_rad == pytest.approx(2 * math.pi / 2048, rel=1e-6)


def test_even_times_take_the_jitter_of_stamps_out_and_keep_gaps():
    rng = np.random.default_rng(1)
    even = np.arange(500) * 0.02
    stamped = even + 0.003 * rng.standard_normal(500)
    assert np.std(even_times(stamped, 10)[20:-20] - even[20:-20]) < 0.001
    lost = np.concatenate([even[:200], even[200:] + 5.0])
    np.testing.assert_allclose(np.diff(even_times(lost, 10))[200:], 0.02, atol=0.012)
    assert even_times(lost, 10)[200] - even_times(lost, 10)[199] > 4.9


def test_wheels_that_another_master_turns_are_left_out():
    t = np.arange(0.0, 30.0, 0.02)
    command = np.where(t < 10.0, 2.0, 0.0)
    speed = np.where(t < 10.0, 2.0, np.where(t > 20.0, 1.5, 0.0))
    line = grid_drive(drive(t, command, t, speed))
    assert np.isnan(line.command_rad_s[round(25.0 / GRID_STEP_S), 0])
    assert np.isfinite(line.command_rad_s[round(5.0 / GRID_STEP_S), 0])
    assert any("left out" in note for note in line.notes)


def test_a_sudden_start_out_of_a_long_rest_is_no_other_master():
    t = np.arange(0.0, 20.0, 0.02)
    command = np.where((t >= 10.0) & (t < 13.0), 4.0, 0.0)
    line = grid_drive(drive(t, command, t, command))
    assert np.isfinite(line.command_rad_s[:-5]).all()
    assert not line.notes


@thinned("commanded_s", [(101.0, 139.0), (0.0, 200.0)], quick=1)
def test_of_a_long_drive_the_stretches_with_commands_are_judged_first(commanded_s):
    t = np.arange(0.0, 200.0, 0.02)
    begin_s, end_s = commanded_s
    speed = np.where((t >= begin_s) & (t < end_s), 2.0, 0.0)
    command = np.where((t >= begin_s) & (t < end_s), 2.0, np.nan)
    short = replace(DEFAULT_SETTINGS, grid=replace(DEFAULT_SETTINGS.grid, longest_s=60.0, stretch_s=10.0))
    line = grid_drive(drive(t, command, t, speed), short)
    assert line.settings is short
    known_s = GRID_STEP_S * np.isfinite(line.command_rad_s[:, 0]).sum()
    assert known_s == pytest.approx(min(end_s - begin_s, 60.0), abs=2.0)
    assert line.t_s.size * GRID_STEP_S == pytest.approx(60.0, abs=1.0)
    # From the first to the last; neighbours are one run.
    assert line.t_s[-1] - line.t_s[0] > 180.0
    assert line.first.sum() == (3 if end_s < 200.0 else 6)


@pytest.mark.thorough
@thinned("lag_s", [0.2, 4.0], quick=1)
def test_wheels_that_answer_slower_than_any_lag_do_not_say_how_late_commands_are(lag_s):
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 90.0, 0.02)
    command = np.repeat(rng.uniform(-2.0, 4.0, 18), 250)
    speed = lfilter([1.0 - math.exp(-0.02 / lag_s)], [1.0, -math.exp(-0.02 / lag_s)], command)
    line = grid_drive(drive(t, command, t, speed))
    said = [note for note in line.notes if "not known from this log" in note]
    assert line.commands_timed == (lag_s < 1.0)
    assert len(said) == (0 if line.commands_timed else 1)
    assert abs(line.commands_moved_s) < 0.05


@cache
def steady_drive():
    t_s = np.arange(0.0, 50.0, 0.02)
    return grid_drive(drive(t_s, np.ones(t_s.size), t_s, np.ones(t_s.size)))


@pytest.mark.parametrize(
    ("begins_s", "stretches"),
    [
        # One log of 50 s, in stretches of 9 s.
        ((0.0,), [0, 0, 1, 4]),
        # Four logs are too few to judge by.
        ((0.0, 10.0, 20.0, 30.0), [0, 0, 1, 4]),
        ((0.0, 5.0, 10.0, 20.0, 30.0), [0, 1, 2, 4]),
    ],
)
def test_a_stretch_is_one_log_where_there_are_several(begins_s, stretches):
    gridded = replace(steady_drive(), log_begins_s=begins_s)
    assert gridded.stretch(np.array([0.0, 8.9, 10.0, 44.0])).tolist() == stretches
