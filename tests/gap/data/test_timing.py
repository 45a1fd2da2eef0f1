"""The delay of poses and commands against the wheels at first sight, on drives made here by arcs and by a lag."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from disco_hw.gap.data import timing
from disco_hw.gap.data.command_timing import Turned, command_clock, response
from disco_hw.gap.data.gridded_drive import grid_drive
from disco_hw.gap.data.stamp_clock import picked
from disco_hw.gap.data.timing import pose_clock, pose_delay_s
from disco_hw.gap.settings import GridSettings
from disco_hw.log.drive import Commands, Poses, Wheels
from tests.gap.synthetic import of_regression
from tests.tables import thinned
from tools.gap.logs import realistic, simulated_drive

RADIUS_M, TRACK_M = 0.11, 0.6


def older_by(poses, by_s):
    """Poses whose stamps come `by_s(t)` later still."""
    return replace(poses, t_s=poses.t_s + by_s(poses.t_s))


def drive(older_s, turning=True, segments=1, noise_m=0.003, seed=0):
    """Wheels at 50 Hz and poses at 12 Hz that are `older_s` older than their stamps, of a drive that nobody planned."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, 60.0, 0.001)
    tones = rng.uniform(0.3, 3.0, (2, 6)), rng.uniform(0.0, 6.0, (2, 6))
    left, right = (4.0 + 1.5 * np.sin(np.outer(t_s, tones[0][side]) + tones[1][side]).sum(axis=1) for side in (0, 1))
    if not turning:
        left, right = np.full_like(t_s, 3.0), np.full_like(t_s, 4.0)
    angle = np.cumsum(np.column_stack([left, right]), axis=0) * 0.001
    yaw = RADIUS_M / TRACK_M * (angle[:, 1] - angle[:, 0])
    speed = 0.5 * RADIUS_M * (left + right)
    x, y = np.cumsum(speed * np.cos(yaw)) * 0.001, np.cumsum(speed * np.sin(yaw)) * 0.001
    at, seen = np.arange(0, t_s.size, 20), np.arange(1000, t_s.size - 1000, 83)
    cut = np.minimum(t_s * segments / 60.0, segments - 1).astype(np.int64)
    wheels = Wheels(t_s[at], angle[at, 0], angle[at, 1], left[at], right[at], cut[at], True, True)
    errors = rng.normal(0.0, noise_m, (3, seen.size))
    yaw_seen = np.remainder(yaw[seen] + errors[2] + np.pi, 2.0 * np.pi) - np.pi
    poses = Poses(t_s[seen] + older_s, x[seen] + errors[0], y[seen] + errors[1], yaw_seen, cut[seen])
    return wheels, poses


@pytest.mark.parametrize("older_s", [-0.85, -0.32, -0.013, 0.0, 0.1, 0.207, 0.9])
def test_a_delay_of_either_sign_is_found_within_five_milliseconds(older_s):
    assert pose_delay_s(*drive(older_s), GridSettings()) == pytest.approx(older_s, abs=0.005)


def test_it_is_found_over_segments_and_beside_poses_that_jump():
    wheels, poses = drive(0.25, segments=12)
    jumps = np.where(np.arange(poses.t_s.size) % 25 == 0, 0.8, 0.0)
    found = pose_delay_s(wheels, replace(poses, x_m=poses.x_m + jumps), GridSettings())
    assert found == pytest.approx(0.25, abs=0.005)


def test_a_steady_circle_and_too_few_poses_have_no_delay_that_stands_out():
    assert pose_delay_s(*drive(0.4, turning=False), GridSettings()) == 0.0
    wheels, poses = drive(0.4)
    assert pose_delay_s(wheels, picked(poses, np.arange(50)), GridSettings()) == 0.0


def test_a_clock_that_drifts_is_made_even_and_said_to_drift():
    wheels, poses = drive(0.1)
    # As late in a long log.
    wheels, poses = (replace(part, t_s=part.t_s + 400.0) for part in (wheels, poses))
    drifting = older_by(poses, lambda t: 0.12 * (t - 430.0) / 60.0)
    clock = pose_clock(wheels, drifting, GridSettings())
    drift_s = clock.drift_s / clock.span_s
    assert drift_s == pytest.approx(0.12 / 60.0, rel=0.1)
    assert clock.delay_s == pytest.approx(0.1, abs=0.01)
    (said,) = clock.notes("poses'")
    assert "drifts" in said
    assert np.abs(clock.corrected(drifting).t_s - poses.t_s).max() < 0.01


@pytest.mark.parametrize("jump_s", [-0.3, 0.15])
def test_a_clock_that_jumps_is_made_even_and_said_to_jump(jump_s):
    wheels, poses = drive(0.2)
    jumping = older_by(poses, lambda t: jump_s * (t > 33.0))
    clock = pose_clock(wheels, jumping, GridSettings())
    assert clock.jump_s == pytest.approx(jump_s, abs=0.02)
    assert clock.jump_at_s == pytest.approx(33.0, abs=2.0)
    # Half of a jump before it and half of it after: the delay is that of the middle.
    assert clock.delay_s == pytest.approx(0.2 + 0.5 * jump_s, abs=0.01)
    assert "jumps" in clock.notes("poses'")[0]
    assert (np.diff(clock.corrected(jumping).t_s) > 0.0).all()


@pytest.mark.parametrize("seed", range(3))
def test_an_even_clock_is_left_alone(seed):
    wheels, poses = drive(0.2, seed=seed, noise_m=0.01)
    clock = pose_clock(wheels, poses, GridSettings())
    assert clock.even
    assert clock.delay_s == pytest.approx(0.2, abs=0.01)
    assert (clock.corrected(poses).t_s == poses.t_s).all()


def test_poses_are_compared_over_no_silence_and_no_segment():
    t_s = np.array([0.0, 0.2, 0.4, 0.6, 1.15, 1.35, 1.55, 1.75])
    nothing = np.zeros(t_s.size)
    poses = Poses(t_s, nothing, nothing, nothing, np.array([0, 0, 0, 0, 0, 0, 1, 1]))
    # The first that is 0.3 s later, where that is hardly more than 0.3 s.
    pairs = [each.tolist() for each in timing.apart(poses.t_s, poses.segment, 0.3)]
    assert pairs == [[0, 1], [2, 3]]


@pytest.mark.parametrize("alike", [1.0, 1e-2, 1e-4, 0.0])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_regression_by_normal_equations_fits_as_one_by_decomposition(alike, scale):
    rng = np.random.default_rng(5)
    total = rng.normal(2.0, 1.0, 300)
    difference = scale * (0.4 * total + alike * rng.normal(0.0, 1.0, 300))
    measured = 0.11 * total + 0.05 / scale * difference + 0.01 * rng.normal(0.0, 1.0, 300)
    measured[::17] += 0.8
    found = timing.mismatch_of(difference, total, measured)
    assert found == pytest.approx(of_regression(np.column_stack([difference, total]), measured), abs=1e-8)
    assert timing.mismatch_of(difference, total, measured + 0.1 * total**2) > found + 0.1


def test_wheels_that_only_turn_alike_or_against_each_other_or_not_at_all_tell_all_that_they_do():
    nothing, turned, noise = np.random.default_rng(8).normal(0.0, 0.1, (3, 100)) * [[0.0], [1.0], [0.1]]
    measured = 2.0 * turned + noise
    for difference, total in ((nothing, turned), (turned, nothing), (nothing, nothing)):
        expected = of_regression(np.column_stack([difference, total]), measured)
        assert timing.mismatch_of(difference, total, measured) == pytest.approx(expected)


# As many pairs as tell a delay to 20 ms.
FEW_PAIRS = GridSettings(most_command_pairs=700)


def answered(wheels, commands):
    """What is seen of a log at first sight."""
    return response(Turned.of(wheels, FEW_PAIRS), commands, FEW_PAIRS)


def commanded(late_s, lag_s=0.0, seed=0, unlike=0.0):
    """Commands that change at random and wheels that answer `late_s` after their stamps, through a lag."""
    rng = np.random.default_rng(seed)
    step_s = 0.001
    t_s = np.arange(0.0, 60.0, step_s)
    steps = np.unique(rng.uniform(2.0, 58.0, 40).round(2))
    level = np.concatenate([np.zeros((1, 2)), rng.uniform(-4.0, 6.0, (steps.size, 2))])
    asked = level[np.searchsorted(steps, t_s, side="right")]
    keep = np.exp(-step_s / lag_s) if lag_s else 0.0
    turning = lfilter([1.0 - keep], [1.0, -keep], asked, axis=0)
    turning = turning * [1.0, 1.0 + unlike] + rng.normal(0.0, 0.2, asked.shape)
    angle = np.cumsum(turning, axis=0) * step_s
    every, one = slice(0, None, 20), np.zeros(t_s[::20].size, np.int64)
    wheels = Wheels(t_s[every], *angle[every].T, *turning[every].T, one, True, True)
    return wheels, Commands(t_s[every] - late_s, *asked[every].T, one)


@thinned(("late_s", "lag_s"), [(-0.7, 0.0), (-0.2, 0.12), (0.0, 0.25), (0.15, 0.06)], quick=2)
def test_a_delay_of_commands_of_either_sign_is_parted_from_a_lag(late_s, lag_s):
    found = answered(*commanded(late_s, lag_s))
    assert found.known
    assert found.delay_s == pytest.approx(late_s, abs=0.02)


@thinned("lag_s", [0.0, 0.11], quick=1)
@thinned("by_s", [-0.317, -0.2, 0.107, 0.213], quick=2)
def test_commands_whose_stamps_are_moved_by_no_steps_of_the_scan_are_seen_moved_by_as_much(by_s, lag_s):
    wheels, commands = commanded(0.1, lag_s)
    plain, moved = answered(wheels, commands), answered(wheels, replace(commands, t_s=commands.t_s + by_s))
    assert moved.delay_s == pytest.approx(plain.delay_s - by_s, abs=5e-4)
    assert moved.lag_s == plain.lag_s


def test_commands_that_stay_as_they_are_in_each_short_segment_do_not_show_when_they_are_acted_on():
    """What wheels turn late in a segment is explained better than early in it, whatever the delay."""
    rng = np.random.default_rng(8)
    t_s = np.arange(0.0, 240.0, 0.05)
    number = (t_s // 3.0).astype(np.int64)
    level, inside = rng.uniform(-4.0, 4.0, 80)[number], t_s % 3.0 < 2.0
    turning = level * (1.0 - np.exp(-(t_s % 3.0) / 0.4)) + rng.normal(0.0, 0.05, t_s.size)
    angle = np.cumsum(turning) * 0.05
    columns = (t_s, angle, angle, turning, turning, number)
    wheels = Wheels(*(each[inside] for each in columns), True, True)
    commands = Commands(*(each[inside] for each in (t_s, level, level, number)))
    for by_s in (0.0, 0.1, 0.4):
        found = answered(wheels, replace(commands, t_s=commands.t_s + by_s))
        assert (found.delay_s, found.known) == (0.0, False)


@thinned("jump_s", [-0.2, 0.17], quick=1)
def test_a_link_that_jumps_is_made_even_and_said_to_jump(jump_s):
    wheels, commands = commanded(0.1, 0.05)
    later = replace(commands, t_s=commands.t_s + jump_s * (commands.t_s > 33.0))
    clock, known = command_clock(wheels, later, FEW_PAIRS)
    assert known
    assert clock.jump_s == pytest.approx(jump_s, abs=0.02)
    assert clock.jump_at_s == pytest.approx(33.0, abs=2.0)
    assert clock.delay_s == pytest.approx(-0.1 + 0.5 * jump_s, abs=0.02)


def test_a_link_that_drifts_is_made_even_and_said_to_drift():
    wheels, commands = commanded(0.1, 0.05)
    clock, known = command_clock(
        wheels, replace(commands, t_s=commands.t_s + 0.2 * (commands.t_s - 30.0) / 60.0), FEW_PAIRS
    )
    assert known
    assert clock.drift_s == pytest.approx(0.2, abs=0.04)
    assert clock.delay_s == pytest.approx(-0.1, abs=0.02)
    assert "commands' clock drifts" in clock.notes("commands'")[0]


@pytest.mark.thorough
def test_a_drive_that_ramps_answers_late_by_what_it_is_asked_and_no_clock_jumps():
    drive = simulated_drive(realistic("acceleration_limit", 1), seed=1)
    assert not [note for note in grid_drive(drive).notes if "commands' clock" in note]


@thinned("seed", range(3), quick=1)
def test_an_even_link_is_left_alone(seed):
    wheels, commands = commanded(0.1, 0.05, seed=seed)
    clock, known = command_clock(wheels, commands, FEW_PAIRS)
    assert known
    assert clock.even
    assert (clock.corrected(commands).t_s == commands.t_s).all()


def test_unequal_wheels_and_commands_that_are_not_known_do_not_move_it():
    wheels, commands = commanded(0.3, 0.1, unlike=0.1)
    unknown = (commands.t_s > 20.0) & (commands.t_s < 24.0)
    left, right = (np.where(unknown, np.nan, each) for each in (commands.left_rad_s, commands.right_rad_s))
    assert answered(wheels, replace(commands, left_rad_s=left, right_rad_s=right)).delay_s == (
        pytest.approx(0.3, abs=0.02)
    )


@pytest.mark.filterwarnings("error")
def test_commands_that_begin_long_after_the_wheels_are_followed_from_there():
    wheels, commands = commanded(0.3, 0.02)
    assert answered(wheels, picked(commands, commands.t_s > 30.0)).delay_s == pytest.approx(0.3, abs=0.02)


def test_a_steady_command_has_no_delay_that_stands_out():
    t_s = np.arange(0.0, 60.0, 0.02)
    steady, one = np.full(t_s.size, 3.0), np.zeros(t_s.size, np.int64)
    wheels = Wheels(t_s, 3.0 * t_s, 3.0 * t_s, steady, steady, one, True, True)
    found = answered(wheels, Commands(t_s, steady, steady, one))
    assert (found.delay_s, found.known) == (0.0, False)


def test_speeds_that_come_less_often_than_they_are_compared_show_it_too():
    wheels, commands = commanded(0.3, 0.1)
    held = replace(picked(wheels, np.arange(0, wheels.t_s.size, 30)), angle_measured=False)
    assert answered(held, commands).delay_s == pytest.approx(0.3, abs=0.04)
