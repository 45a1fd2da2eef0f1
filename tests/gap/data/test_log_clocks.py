"""Logs that are searched together are laid beside their wheels by the clock that each of them has."""

from dataclasses import replace

import numpy as np
import pytest

from disco_hw.gap.data import BODY
from disco_hw.gap.data.gridded_drive import grid_drive
from disco_hw.gap.data.stamp_clock import StampClock, aligned
from disco_hw.gap.search.channel_result import estimate_parameters
from disco_hw.gap.search.channel_search import search_body
from disco_hw.log.drive import Commands, DriveLog, Poses, Wheels, concatenate

BEGINS_S = (0.0, 22.0, 42.0)


def samples(begin_s=0.0, count=60):
    t_s = begin_s + np.arange(count, dtype=float)
    none = np.zeros(count, dtype=np.int64)
    wheels = Wheels(t_s, t_s, t_s, t_s, t_s, none, True, False)
    return wheels, Poses(t_s, 10.0 * t_s, t_s, 0.0 * t_s, none)


def laid(clocks, begins_s=BEGINS_S, least_s=0.03):
    """Samples laid by the clocks of three logs of 20 s, stamped 2 s early; all together they are 7 s late."""
    spans = []

    def clock_of(wheels, poses):
        assert wheels.t_s.tolist() == poses.t_s.tolist() == (poses.x_m / 10.0).tolist()
        spans.append((wheels.t_s[0], wheels.t_s[-1]))
        return (StampClock(7.0), True) if wheels.t_s.size == 60 else clocks[int(wheels.t_s[0] // 20.0)]

    return aligned(*samples(), begins_s, clock_of, least_s, "poses'"), spans


def test_logs_that_agree_are_taken_as_one():
    found, spans = laid([(StampClock(0.3), True), (StampClock(0.329), True), (StampClock(0.271), True)])
    assert spans == [(0.0, 19.0), (20.0, 39.0), (40.0, 59.0)]
    assert (found.delay_s, found.known, found.even, found.apart_s, found.notes) == (0.3, True, True, 0.0, ())
    assert found.samples.t_s.tolist() == samples()[1].t_s.tolist()
    # One log is looked at once.
    one, spans = laid([], (0.0,))
    assert (one.delay_s, one.apart_s, one.even, one.notes) == (7.0, 0.0, True, ())
    assert spans == [(0.0, 59.0)]
    # So far apart as the least they are not one.
    assert laid([(StampClock(0.25 * k), True) for k in (1, 2, 3)], least_s=0.25)[0].apart_s == 0.25


def test_two_logs_are_two_and_one_says_itself_what_its_clock_does():
    found, spans = laid([(StampClock(0.5), True), (StampClock(0.25), True)], (0.0, 22.0))
    assert spans == [(0.0, 19.0), (20.0, 59.0)]
    assert found.delay_s == 0.375
    drifting = StampClock(0.3, 30.0, 60.0, drift_s=0.2)
    alone = aligned(*samples(), (0.0,), lambda *of: (drifting, True), 0.03, "poses'")
    assert alone.notes == drifting.notes("poses'")
    assert not alone.even
    assert alone.samples.t_s.tolist() == drifting.corrected(samples()[1]).t_s.tolist()


def test_logs_that_do_not_agree_are_each_laid_by_their_own_delay():
    found, _ = laid([(StampClock(0.3), True), (StampClock(0.331), True), (StampClock(0.1), True)])
    t_s = samples()[1].t_s
    assert found.delay_s == 0.3
    np.testing.assert_allclose(found.samples.t_s, t_s - np.repeat([0.0, 0.031, -0.2], 20))
    np.testing.assert_array_equal(found.samples.x_m, 10.0 * t_s)
    assert found.apart_s == pytest.approx(np.std([0.3, 0.331, 0.1], ddof=1))
    assert found.known
    assert found.even
    assert "(0.3 s, 0.331 s, 0.1 s)" in found.notes[-1]
    assert "as if it were 0.3 s in all" in found.notes[-1]


def test_a_log_that_shows_no_delay_stays_and_speaks_for_none():
    found, _ = laid([(StampClock(0.3), True), (StampClock(0.9), False), (StampClock(0.1), True)])
    assert found.delay_s == pytest.approx(0.2)
    np.testing.assert_allclose(found.samples.t_s, samples()[1].t_s - np.repeat([0.1, 0.0, -0.1], 20))
    assert "(0.3 s, not known, 0.1 s)" in found.notes[-1]
    # Where no log shows one, they may together.
    nothing, spans = laid([(StampClock(0.0), False)] * 3)
    assert nothing.delay_s == 7.0
    assert spans[-1] == (0.0, 59.0)


def test_a_clock_that_drifts_in_one_log_is_mended_there_and_said():
    drifting, jumping = StampClock(0.3, 30.0, 20.0, drift_s=0.2), StampClock(0.3, jump_s=-0.5, jump_at_s=50.0)
    found, _ = laid([(StampClock(0.3), True), (drifting, True), (jumping, True)])
    t_s = samples()[1].t_s
    expected = t_s - np.where((t_s >= 20.0) & (t_s < 40.0), 0.2 * (t_s - 30.0) / 20.0, 0.0)
    expected -= np.where(t_s < 40.0, 0.0, np.where(t_s < 50.0, 0.25, -0.25))
    np.testing.assert_allclose(found.samples.t_s, expected)
    assert not found.even
    assert len(found.notes) == 1
    assert "(+200 ms over log 2, -500 ms at once in log 3)" in found.notes[0]


def log_of(seed, late_s, heard_s):
    """Wheels that change their speeds every second, poses stamped late by the one, commands heard late by the other."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, 60.0, 0.02)
    speeds = rng.uniform(-3.0, 3.0, (60, 2))
    asked = speeds[t_s.astype(int)]
    turned = speeds[np.maximum(t_s - heard_s, 0.0).astype(int)]
    angle = 0.02 * np.cumsum(turned, axis=0)
    rate, v = 0.3 * (turned[:, 1] - turned[:, 0]), 0.1 * turned.sum(axis=1)
    yaw = 0.02 * np.cumsum(rate)
    # Along the heading in the middle of each step: at its end, it would be a side slip of 10 ms.
    middle = yaw - 0.01 * rate
    x, y = 0.02 * np.cumsum(v * np.cos(middle)), 0.02 * np.cumsum(v * np.sin(middle))
    own = t_s[::2] + 0.0037
    seen = [np.interp(own - late_s, t_s, each) + 1e-3 * rng.standard_normal(own.size) for each in (x, y, yaw)]
    seen[2] = np.mod(seen[2] + np.pi, 2.0 * np.pi) - np.pi
    none = np.zeros(t_s.size, dtype=np.int64)
    return DriveLog(
        (f"made {seed}",),
        Commands(t_s + 0.0011, *asked.T, none),
        Wheels(t_s, *angle.T, *turned.T, none, True, False),
        Poses(own, *seen, none[::2]),
    )


@pytest.mark.thorough
def test_logs_whose_clocks_differ_lie_on_the_grid_beside_their_own_wheels():
    logs = [log_of(1, 0.1, 0.06), log_of(2, 0.42, 0.06), log_of(3, -0.2, 0.5)]
    each = [grid_drive(log) for log in logs]
    together = grid_drive(concatenate(logs))
    assert together.pose_delay_s == pytest.approx(0.1, abs=0.02)
    assert together.pose_stamps_s == pytest.approx(np.std([0.1, 0.42, -0.2], ddof=1), abs=0.02)
    # Commands of the third are heard 0.44 s later than those of the others.
    assert together.command_stamps_s == pytest.approx(0.44 / 3.0**0.5, abs=0.02)
    assert together.commands_moved_s == pytest.approx(0.06, abs=0.03)
    assert together.pose_clock_even
    assert [note.split(" delay")[0] for note in together.notes] == ["the poses'", "the commands'"]
    # Poses lie where they do when their log is searched alone.
    run = np.cumsum(together.first)[together.pose.node]
    for number, (alone, begins_s) in enumerate(zip(each, together.log_begins_s, strict=True), 1):
        np.testing.assert_allclose(together.pose.t_s[run == number] - begins_s, alone.pose.t_s, atol=1e-6)


@pytest.mark.thorough
def test_a_search_of_logs_whose_clocks_differ_finds_the_robot_and_holds_how_late_the_poses_of_each_are():
    start = BODY.neutral.copy()
    start[:3] = 0.2, 0.6, 0.0
    found = search_body(grid_drive(concatenate([log_of(1, 0.1, 0.06), log_of(2, 0.42, 0.06)])), start)
    assert found.names == ("pose_latency",)
    said = estimate_parameters(found).by_name
    late = said["pose_latency.latency_s"]
    assert late.value == pytest.approx(0.26, abs=0.02)
    assert late.low < 0.1 < late.high
    assert late.low < 0.42 < late.high
    # The wheels' radius over two is 0.1 m, over the axial distance 0.3.
    assert said["wheel_radius_m"].value == pytest.approx(0.2, rel=0.01)
    assert said["axial_distance_m"].value == pytest.approx(0.2 / 0.3, rel=0.01)


@pytest.mark.thorough
def test_a_log_without_commands_or_poses_speaks_for_no_delay():
    whole = log_of(1, 0.1, 0.06)
    bare = replace(log_of(2, 0.4, 0.2), commands=Commands())
    still = replace(log_of(3, 0.4, 0.06), poses=Poses())
    alone = grid_drive(whole)
    for logs in ([whole, bare, bare], [bare, whole]):
        assert grid_drive(concatenate(logs)).commands_moved_s == pytest.approx(alone.commands_moved_s, abs=0.001)
    together = grid_drive(concatenate([whole, still, still]))
    assert together.pose_delay_s == pytest.approx(alone.pose_delay_s, abs=1e-6)
    assert together.pose_stamps_s == 0.0
    assert grid_drive(concatenate([bare, bare])).commands_timed


@pytest.mark.thorough
def test_logs_with_one_clock_are_one():
    logs = [log_of(1, 0.1, 0.06), log_of(2, 0.11, 0.06)]
    together = grid_drive(concatenate(logs))
    assert together.pose_delay_s == pytest.approx(0.105, abs=0.01)
    assert (together.pose_stamps_s, together.command_stamps_s, together.notes) == (0.0, 0.0, ())
    assert grid_drive(replace(logs[0], begins_s=(0.0,))).log_begins_s == (0.0,)
