"""Logs as a host would write them: form, consistency with the physics, and dirt."""

import csv
import math
from dataclasses import replace

import numpy as np
import pytest

from sim.effects import hidden_effects
from sim.plant_parameters import PlantParameters
from tools.simulated_drives import create_drive
from tools.simulated_log import (
    COLUMNS,
    LogOptions,
    dirty_log_options,
    dirty_parameters,
    simulated_log,
    varied_parameters,
    write_csv,
)

pytestmark = pytest.mark.thorough

IDEAL = PlantParameters().with_ideal_motors()
EXACT = LogOptions(lateness_s=0.0, stamp_jitter_s=0.0)
POOR = create_drive("poor", 1)
CIRCLE = create_drive("circle", 1)


def columns(rows):
    """Column name -> array, NaN where there is no sample."""
    return dict(zip(COLUMNS, rows.T, strict=True))


def test_each_row_is_one_event_and_time_never_goes_back():
    rows = simulated_log(POOR, IDEAL, seed=1)
    log = columns(rows)
    assert log["t_s"][0] >= 0.0
    assert np.all(np.diff(log["t_s"]) >= 0.0)
    kinds = np.stack([~np.isnan(log[name]) for name in ("cmd_left_rad_s", "enc_left_ticks", "pose_x_m")])
    assert np.all(kinds.sum(axis=0) == 1)
    for first, *others in (("cmd_left_rad_s", "cmd_right_rad_s"), ("pose_x_m", "pose_y_m", "pose_yaw_rad")):
        assert all(np.array_equal(np.isnan(log[first]), np.isnan(log[other])) for other in others)


def test_commands_readings_and_poses_come_at_their_rates_and_commands_are_the_drives():
    log = columns(simulated_log(CIRCLE, IDEAL, seed=1))
    assert np.count_nonzero(~np.isnan(log["cmd_left_rad_s"])) == len(CIRCLE.t_s)
    assert np.count_nonzero(~np.isnan(log["enc_left_ticks"])) == 63 * 50
    assert np.count_nonzero(~np.isnan(log["pose_x_m"])) == 63 * 25
    given = log["cmd_right_rad_s"][~np.isnan(log["cmd_right_rad_s"])]
    np.testing.assert_allclose(given, CIRCLE.right_rad_s, atol=1e-5)


def test_dead_reckoning_of_the_ticks_gives_the_poses():
    log = columns(simulated_log(CIRCLE, IDEAL.noiseless(), seed=1, options=EXACT))
    read, seen = ~np.isnan(log["enc_left_ticks"]), ~np.isnan(log["pose_x_m"])
    turned = np.stack([log["enc_left_ticks"][read], log["enc_right_ticks"][read]]) * 2 * math.pi / 2048 * 0.061
    turned -= turned[:, :1]
    yaw = (turned[1] - turned[0]) / 0.415
    middle = 0.5 * (yaw[1:] + yaw[:-1])
    forward = np.diff(0.5 * (turned[0] + turned[1]))
    x = np.concatenate([[0.0], np.cumsum(forward * np.cos(middle))]) + 0.238 * (1.0 - np.cos(yaw))
    y = np.concatenate([[0.0], np.cumsum(forward * np.sin(middle))]) - 0.238 * np.sin(yaw)
    at = log["t_s"][seen]
    np.testing.assert_allclose(np.interp(at, log["t_s"][read], x), log["pose_x_m"][seen], atol=3e-3)
    np.testing.assert_allclose(np.interp(at, log["t_s"][read], y), log["pose_y_m"][seen], atol=3e-3)
    unwrapped = np.unwrap(log["pose_yaw_rad"][seen])
    np.testing.assert_allclose(np.interp(at, log["t_s"][read], yaw), unwrapped, atol=3e-3)


def test_a_hidden_effect_reaches_the_log():
    plain, slipping = (
        columns(simulated_log(CIRCLE, IDEAL.noiseless(), hidden_effects(effects), options=EXACT))
        for effects in ({}, {"turn_slip": 0.3})
    )
    assert np.array_equal(plain["enc_left_ticks"], slipping["enc_left_ticks"], equal_nan=True)
    turned = [np.nanmax(np.unwrap(log["pose_yaw_rad"][~np.isnan(log["pose_yaw_rad"])])) for log in (plain, slipping)]
    assert turned[1] / turned[0] == pytest.approx(1.0 - 0.3 * 0.061 * 1.92 / 0.415, rel=0.01)


def test_the_seed_decides_everything_and_counters_start_anywhere():
    first, again, other = (simulated_log(POOR, IDEAL, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(first, again, equal_nan=True)
    assert first.shape != other.shape or not np.array_equal(first, other, equal_nan=True)
    starts = {next(row[3] for row in rows if not np.isnan(row[3])) for rows in (first, other)}
    assert len(starts) == 2


def test_time_stamps_jitter_as_asked():
    log = columns(simulated_log(CIRCLE, IDEAL, seed=1, options=LogOptions(lateness_s=0.0, stamp_jitter_s=0.002)))
    for name, period_s in (("cmd_left_rad_s", 0.02), ("enc_left_ticks", 0.02), ("pose_x_m", 0.04)):
        off = np.diff(log["t_s"][~np.isnan(log[name])]) - period_s
        assert off.std() == pytest.approx(0.002 * math.sqrt(2.0), rel=0.1)


def test_lateness_is_in_commands_and_readings_and_not_in_poses():
    log = columns(simulated_log(CIRCLE, IDEAL, seed=1, options=LogOptions(lateness_s=0.001, stamp_jitter_s=0.0)))
    lateness_s = log["t_s"][~np.isnan(log["cmd_left_rad_s"])] - CIRCLE.t_s
    assert lateness_s.min() >= 0.0
    assert lateness_s.mean() == pytest.approx(0.001, rel=0.1)
    np.testing.assert_allclose(np.diff(log["t_s"][~np.isnan(log["pose_x_m"])]), 0.04, atol=1e-6)


def test_a_dirty_log_loses_poses_has_outliers_and_bad_stamps():
    dirty = columns(simulated_log(CIRCLE, dirty_parameters(IDEAL), seed=3, options=dirty_log_options()))
    seen = ~np.isnan(dirty["pose_x_m"])
    assert 0.80 < np.count_nonzero(seen) / (63 * 25) < 0.995
    t, x, y = (dirty[name][seen] for name in ("t_s", "pose_x_m", "pose_y_m"))
    jump = np.hypot(np.diff(x), np.diff(y)) - 0.25 * np.diff(t)
    assert 2 <= np.count_nonzero(jump > 0.045) <= 40
    assert np.diff(dirty["t_s"][~np.isnan(dirty["cmd_left_rad_s"])]).std() > 0.003


def test_varied_robots_differ_from_the_drawing_by_percents():
    robots = [varied_parameters(PlantParameters(), seed) for seed in range(200)]
    radius = np.array([robot.wheel_radius_m for robot in robots]) / 0.061 - 1.0
    axial = np.array([robot.axial_distance_m for robot in robots]) / 0.415 - 1.0
    assert radius.std() == pytest.approx(0.02, rel=0.2)
    assert axial.std() == pytest.approx(0.04, rel=0.2)
    assert robots[0] == varied_parameters(PlantParameters(), 0)


def test_the_file_has_the_columns_and_nothing_of_the_truth(tmp_path):
    write_csv(tmp_path / "log.csv", simulated_log(POOR, IDEAL, hidden_effects({"turn_slip": 0.1})))
    with (tmp_path / "log.csv").open() as file:
        header, *rows = csv.reader(file)
    assert tuple(header) == COLUMNS
    assert all(len(row) == len(COLUMNS) for row in rows)
    assert "slip" not in (tmp_path / "log.csv").read_text()


def test_noise_of_a_resting_robot_is_the_sensors():
    rest = create_drive("poor", 1)
    rest = replace(rest, left_rad_s=np.zeros_like(rest.t_s), right_rad_s=np.zeros_like(rest.t_s))
    log = columns(simulated_log(rest, IDEAL, seed=5))
    x = log["pose_x_m"][~np.isnan(log["pose_x_m"])]
    assert x.std() == pytest.approx(0.005, rel=0.12)
    ticks = log["enc_left_ticks"][~np.isnan(log["enc_left_ticks"])]
    assert np.all(ticks == ticks[0])
