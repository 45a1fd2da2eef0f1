"""Held wheel speeds are taken once, when they were new, and laid on the time before."""

from dataclasses import replace

import numpy as np

from disco_hw.gap.data.gridded_drive import undo_sample_hold
from disco_hw.gap.settings import DEFAULT_SETTINGS
from disco_hw.log.drive import Wheels, integrate_angle


def held_log(hold=4, dt=0.05, count=400):
    t = np.arange(count) * dt
    new = np.arange(count) // hold * hold
    # What is reported at an update is the mean speed over the hold before it.
    true_angle = np.sin(0.4 * t) * 5.0
    mean = (true_angle[new] - true_angle[np.maximum(new - hold, 0)]) / (hold * dt)
    segment = np.zeros(count, np.int64)
    angle = integrate_angle(t, mean, segment)
    return t, true_angle, Wheels(t, angle, angle, mean, mean, segment, False, True)


def test_held_speeds_give_the_angle_at_their_updates():
    t, true_angle, wheels = held_log()
    fresh = undo_sample_hold(wheels, DEFAULT_SETTINGS.grid)
    assert fresh.t_s.size == 100
    truth = np.interp(fresh.t_s, t, true_angle)
    error = fresh.left_angle_rad - truth
    assert np.ptp(error[1:]) < 1e-9
    late = wheels.left_angle_rad - true_angle
    assert np.ptp(late) > 0.1


def test_measured_angles_and_fresh_speeds_stay():
    t = np.arange(200) * 0.02
    speed = np.cos(t)
    wheels = Wheels(t, np.sin(t), np.sin(t), speed, speed, np.zeros(200, np.int64), False, True)
    assert undo_sample_hold(wheels, DEFAULT_SETTINGS.grid) is wheels
    measured = replace(held_log()[2], angle_measured=True)
    assert undo_sample_hold(measured, DEFAULT_SETTINGS.grid) is measured


def test_nothing_is_integrated_across_a_change_of_segment():
    t, _, wheels = held_log()
    segment = (t > 10.0).astype(np.int64)
    fresh = undo_sample_hold(replace(wheels, t_s=t + 50.0 * segment, segment=segment), DEFAULT_SETTINGS.grid)
    assert np.abs(np.diff(fresh.left_angle_rad)).max() < 1.0
