"""Tests of what the drives contain, and that they stay within what robot and hand can do."""

import itertools

import numpy as np
import pytest

from tools.simulated_drives import DRIVES, create_drive

pytestmark = pytest.mark.thorough

SEEDS = range(4)


def speeds(drive, phase):
    """Commands of a phase after its first 0.5 s, shape (n, 2)."""
    inside = np.array([name == phase for name in drive.phase])
    settled = inside & np.roll(inside, 25)
    return np.stack([drive.left_rad_s, drive.right_rad_s], axis=1)[settled]


@pytest.mark.parametrize("name", DRIVES)
def test_commands_are_evenly_timed_finite_and_within_speed_and_slew(name):
    for seed in SEEDS:
        drive = create_drive(name, seed)
        assert drive.name == name
        assert len(drive.t_s) == len(drive.left_rad_s) == len(drive.right_rad_s) == len(drive.phase)
        np.testing.assert_allclose(np.diff(drive.t_s), drive.period_s)
        for wheel in (drive.left_rad_s, drive.right_rad_s):
            assert np.abs(wheel).max() <= 8.0
            assert np.abs(np.diff(wheel, prepend=0.0)).max() <= 20.0 / 50.0 + 1e-12


@pytest.mark.parametrize("name", DRIVES)
def test_a_drive_starts_and_ends_at_rest(name):
    drive = create_drive(name, 1)
    for wheel in (drive.left_rad_s, drive.right_rad_s):
        assert np.all(wheel[:10] == 0.0)
        assert wheel[-1] == 0.0


@pytest.mark.parametrize("name", DRIVES)
def test_the_seed_decides_the_drive(name):
    assert np.array_equal(create_drive(name, 1).left_rad_s, create_drive(name, 1).left_rad_s)
    if name != "circle":
        assert not np.array_equal(create_drive(name, 1).left_rad_s, create_drive(name, 2).left_rad_s)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_rich_drive_contains_what_distinguishes_effects(seed):
    drive = create_drive("rich", seed)
    assert 140.0 <= drive.duration_s <= 160.0
    for phase, share in (("straight slow", 0.35), ("straight fast", 0.95), ("reverse slow", -0.35)):
        wheels = speeds(drive, phase)
        np.testing.assert_allclose(wheels.mean(), 8.0 * share, rtol=0.1)
        np.testing.assert_array_equal(wheels[:, 0], wheels[:, 1])
    for side, sign in (("left", 1.0), ("right", -1.0)):
        slow, fast = (speeds(drive, f"spin {side} {rate}") for rate in ("slow", "fast"))
        turn = [sign * (wheels[:, 1] - wheels[:, 0]).mean() for wheels in (slow, fast)]
        assert 0.0 < 2.0 * turn[0] < 1.2 * turn[1]
        np.testing.assert_allclose(slow.sum(axis=1), 0.0, atol=1e-9)
        for phase in (f"arc {side} slow", f"arc {side} fast", f"arc {side} reverse"):
            wheels = speeds(drive, phase)
            assert np.all(sign * (wheels[:, 1] - wheels[:, 0]) > 0.5)
    phases = list(drive.phase)
    assert sum(a != "start" and b == "start" for a, b in itertools.pairwise(phases)) == 8
    assert speeds(drive, "start").min() < -4.0 < 4.0 < speeds(drive, "start").max()
    assert phases.count("free") >= 30 * 50
    weave = speeds(drive, "fast steering")
    turns = np.sign(weave[:, 1] - weave[:, 0])
    assert 8 <= np.count_nonzero(np.diff(turns)) <= 20
    for phase, side in (("ramp straight", 0), ("ramp spin", 1)):
        ramp = speeds(drive, phase)[:, side]
        assert np.count_nonzero(np.diff(np.sign(ramp))) >= 2
        assert np.abs(np.diff(ramp)).max() < 0.1


def test_drives_of_different_seeds_order_their_manoeuvres_differently():
    orders = {tuple(dict.fromkeys(create_drive("rich", seed).phase)) for seed in range(6)}
    assert len(orders) >= 4


def test_the_circle_is_steady_and_is_the_papers_on_the_papers_robot():
    wheels = speeds(create_drive("circle", 0), "circle")
    assert np.all(np.ptp(wheels, axis=0) == 0.0)
    left, right = wheels[0]
    v, omega = 0.061 * 0.5 * (left + right), 0.061 * (right - left) / 0.415
    assert v == pytest.approx(0.2, rel=0.01)
    assert np.hypot(v / omega, 0.238) == pytest.approx(0.75, rel=0.01)


def test_the_straight_drive_never_turns():
    drive = create_drive("straight", 1)
    assert np.array_equal(drive.left_rad_s, drive.right_rad_s)


def test_the_poor_drive_is_short_and_slow():
    drive = create_drive("poor", 1)
    assert drive.duration_s < 16.0
    assert np.abs(drive.left_rad_s).max() < 2.0


def test_random_steps_hold_each_pair():
    drive = create_drive("random_steps", 1)
    constant_share = np.count_nonzero(np.diff(drive.left_rad_s) == 0.0) / len(drive.t_s)
    assert constant_share > 0.85
    assert drive.left_rad_s.min() < -4.0 < 4.0 < drive.left_rad_s.max()
