"""Counters that wrap so fast, or unseen for so long, that nobody can tell how often: refused, or a new segment."""

import numpy as np
import pytest

from disco_hw.errors import LogError
from disco_hw.log.importing.counter_wrap import continuous_wheels, restarts, unwrap_counter
from disco_hw.log.importing.csv_drive import read_csv

DT_S = 0.05
T_S = DT_S * np.arange(400)
TICKS_PER_REV = 2048
TICKS_PER_RAD = TICKS_PER_REV / (2.0 * np.pi)


def write(path, t_s, ticks, speed_rad_s):
    commanded = f"{speed_rad_s},{speed_rad_s}"
    rows = [f"{t:.3f},{commanded},{left:.0f},{right:.0f}" for t, (left, right) in zip(t_s, ticks, strict=True)]
    header = "t_s,cmd_left_rad_s,cmd_right_rad_s,enc_left_ticks,enc_right_ticks"
    path.write_text("\n".join([header, *rows]) + "\n")


@pytest.mark.parametrize("share", [0.6, 0.83, 1.02, 3.2])
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("span", [256, 4096])
def test_a_counter_that_the_commands_carry_over_half_its_span_is_refused(tmp_path, span, direction, share):
    # Evenly driven the counts look like a slow counter, and only the commands tell that it is none.
    path = tmp_path / "drive.csv"
    speed_rad_s = direction * share * span / TICKS_PER_RAD / DT_S
    counts = np.floor(speed_rad_s * TICKS_PER_RAD * T_S) % span
    write(path, T_S, np.column_stack([counts, counts]), speed_rad_s)
    with pytest.raises(LogError, match=r"enc_left_ticks: counts stay within \d+ .* wraps faster than it is read"):
        read_csv(path, TICKS_PER_REV, 0.1)


def test_a_pause_in_which_a_counter_may_wrap_unseen_begins_a_segment(tmp_path):
    path = tmp_path / "drive.csv"
    speed_rad_s = 0.1 * 256 / TICKS_PER_RAD / DT_S
    counts = np.floor(speed_rad_s * TICKS_PER_RAD * T_S)
    rows = np.delete(np.arange(T_S.size), range(200, 212))
    write(path, T_S[rows], np.column_stack([counts[rows] % 256, counts[rows]]), speed_rad_s)
    drive = read_csv(path, TICKS_PER_REV, 0.1)
    np.testing.assert_array_equal(np.flatnonzero(np.diff(drive.wheels.segment)), [199])
    assert any("may have wrapped unseen, 1 times" in note for note in drive.notes)
    inside = np.diff(drive.wheels.segment) == 0
    np.testing.assert_allclose(
        np.diff(drive.wheels.left_angle_rad)[inside], np.diff(counts[rows])[inside] / TICKS_PER_RAD
    )


def test_a_wheel_that_wraps_too_rarely_takes_the_span_of_the_other():
    counts = np.column_stack([np.floor(90.0 * np.arange(400)), np.floor(25.0 * np.arange(400))])
    no_restarts, unknown = np.zeros(T_S.size, dtype=bool), np.full((T_S.size, 2), np.nan)
    notes = []
    values, _ = continuous_wheels(("left", "right"), T_S, counts % 6000.0, (), no_restarts, unknown, notes)
    assert notes[0].startswith("left wraps at 6000 counts: ")
    assert notes[1:] == ["right wraps at 6000 counts: made continuous at 1 places"]
    np.testing.assert_array_equal(values, counts)


def test_a_step_from_one_segment_to_the_next_is_no_wrap():
    counts = np.floor(20.0 * np.arange(400))
    begins = np.zeros(T_S.size, dtype=bool)
    begins[300] = True
    values = counts % 4096.0
    values[300:] = counts[300:] - counts[300]
    found = unwrap_counter(T_S, values, (), begins, np.full(T_S.size, np.nan))
    assert (found.span, found.wraps) == (4096.0, 1)
    steps = np.delete(np.diff(found.values), 299)
    np.testing.assert_array_equal(steps, 20.0)


@pytest.mark.parametrize("period_s", [0.01, 0.1, 0.2])
@pytest.mark.parametrize("turned_rad", [3.0, 30.0, 300.0])
@pytest.mark.parametrize("speed_rad_s", [3.0, -3.0])
def test_an_encoder_that_returns_to_zero_is_seen_at_any_rate(period_s, turned_rad, speed_rad_s):
    angles = speed_rad_s * period_s * np.arange(1 + round(2.0 * turned_rad / abs(speed_rad_s) / period_s))
    other, at = angles.copy(), angles.size // 2
    angles[at:] -= angles[at]
    restarted = restarts(period_s * np.arange(angles.size), np.column_stack([angles, other]))
    assert np.flatnonzero(restarted).tolist() == [at]


def test_samples_that_were_held_and_come_in_bursts_are_no_reset():
    t_s = 0.02 * np.arange(1000)
    angles = 6.0 * 0.1 * np.floor(t_s / 0.1 + 1e-9)
    assert not restarts(t_s, np.column_stack([angles, angles])).any()
