"""Wheels that are judged without poses: the way and the heading that they make, on stretches that were not fitted."""

from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.gap import model_of, offered_stage
from disco_hw.gap.data import WHEEL
from disco_hw.gap.noise.wheel_noise import WheelNoise
from disco_hw.gap.report import GapReport
from disco_hw.gap.report.page import as_text, page, summary_lines
from disco_hw.gap.search.analysis import GapAnalysis, final_fit
from disco_hw.gap.search.cross_validation import _errors, only_timed, wheel_table
from disco_hw.gap.settings import DEFAULT_SETTINGS
from disco_hw.model import Model
from tests.gap.synthetic import DRIVE, GEOMETRY, answered, line_of, searched, vector_of, wheels_on

MODEL = Model(*GEOMETRY)


def analysed(names, **effects):
    """Wheels that answer their commands with these first parameters of effects, and what was found of them."""
    command = np.repeat(np.array(DRIVE * 2, dtype=float), 200, axis=0)
    line = answered(command, **effects)
    found = searched(wheels_on(line, WheelNoise(reading_rad=1e-3)), names)
    return GapAnalysis(line, vector_of(), WHEEL.neutral, None, found)


def table_of(analysis):
    table = wheel_table(analysis)
    return table, offered_stage({**table, "refitted": table["nominal"]}, analysis.adds_to_timed, DEFAULT_SETTINGS)


def report_of(analysis):
    table, offered = table_of(analysis)
    return GapReport(("log",), (), (), (), (), {}, MODEL, 1.0, offered, wheels=table)


def test_wheels_with_a_dead_band_are_predicted_with_it_and_not_with_a_lag_alone():
    analysis = analysed(("deadband",), deadband=1.0)
    table, offered = table_of(analysis)
    errors = {stage: of[2.0] for stage, of in table.items()}
    # Each wheel loses 1 rad/s: 0.12 m in 2 s where both turn the same way, nothing where they turn against each other.
    assert 0.05 < errors["nominal"].position_m < 0.12
    # In every stretch.
    assert (errors["nominal"].squares[:, 0] > 0.0).all()
    assert errors["amended"].position_m < 0.02 * errors["nominal"].position_m
    assert errors["amended"].yaw_rad < 0.02 * errors["timed"].yaw_rad
    assert errors["amended"].wheel_rad_s < 0.1 * errors["nominal"].wheel_rad_s
    assert offered == "amended"


def test_a_lag_is_all_that_timed_wheels_need_and_they_are_offered_where_a_wrong_name_is_worse():
    analysis = analysed(("deadband",), motor_lag=0.2)
    table, offered = table_of(analysis)
    assert table["timed"][2.0].position_m < 0.05 * table["nominal"][2.0].position_m
    assert offered == "timed"
    assert only_timed(analysis.wheels).fit.vector[WHEEL.place["motor_lag.tau_s"]] == pytest.approx(0.2, rel=0.02)
    model, _ = model_of("timed", MODEL, analysis, final_fit(analysis), None)
    values = {setting.name: setting.values for setting in model.effects}
    assert values["motor_lag"]["tau_s"] == pytest.approx(0.2, rel=0.02)
    assert "deadband" not in values
    assert model_of("refitted", MODEL, analysis, final_fit(analysis), None)[0] == MODEL


def test_a_wheel_that_turns_too_far_makes_way_forward_and_heading_to_its_other_side():
    analysis = analysed((), wheel_gain=0.1)
    errors = wheel_table(analysis)["nominal"][2.0]
    # Of the left wheel alone, a tenth of what it was commanded: half its rim's way, and all of it over the axle.
    turned = 0.1 * np.mean([abs(left) for left, _ in DRIVE]) * 2.0
    assert errors.yaw_rad == pytest.approx(errors.position_m * 2.0 / GEOMETRY[1], rel=1e-6)
    assert 0.5 < errors.position_m / (0.5 * GEOMETRY[0] * turned) < 1.5


def test_a_log_without_poses_is_answered_with_the_way_that_its_wheels_make():
    report = report_of(analysed(("deadband",), motor_lag=0.2))
    line = summary_lines(report)[1]
    assert line.startswith("2 s ahead, in parts of the log that were not used, the wheels are off by ")
    assert "with a delay and a lag alone (timed), by" in line
    assert line.endswith(
        "Drive with the timed model, which is in model.toml. "
        "The amended model has more effects and does not clearly predict better."
    )
    assert "way and heading that the wheels make:" in as_text(report)
    assert "The wheels alone" in page(report)
    told = report.as_dict()
    assert [row["horizon_s"] for row in told["wheels"]] == list(DEFAULT_SETTINGS.prediction.horizons_s)
    assert told["offered"] == "timed"


def test_each_stretch_is_predicted_by_the_angles_of_its_own_fold():
    line = line_of(np.repeat([[3.0, 6.0]], 6000, axis=0))
    line.command_rad_s[2500:2600] = np.nan
    channel = SimpleNamespace(drive=line, geometry=np.array(GEOMETRY), settings=DEFAULT_SETTINGS)
    right = line.angle_rad
    wrong = right + np.outer(line.t_s, (0.1, -0.2))
    odd = np.arange(7) % 2 == 1
    for of, off in (({0: wrong, 1: right}, ~odd), ({0: right, 1: wrong}, odd)):
        told = _errors(channel, of, 2.0)
        # In 2 s the left wheel turns 0.2 rad less and the right one 0.4 rad more than was predicted.
        way_m, heading_rad = 0.5 * 0.06 * 0.2, 0.06 / 0.4 * 0.6
        (squares_m2, squares_rad2), many = told.squares.T, np.where(off, told.squares[:, 0] / way_m**2, 0.0)
        np.testing.assert_allclose(squares_m2, many * way_m**2, atol=1e-12)
        np.testing.assert_allclose(squares_rad2, many * heading_rad**2, atol=1e-12)
        assert many[off] == pytest.approx(np.round(many[off]))
        assert (many[off] > 15).all()
        share = told.position_m**2 / way_m**2
        assert told.wheel_rad_s == pytest.approx(0.05 * share**0.5)
        assert told.by_regime_m == {"curves": told.position_m}
    # Stretches of 9 s, where commands are known all the way.
    starts = _errors(channel, {0: wrong, 1: wrong}, 2.0).squares[:, 0] / way_m**2
    assert starts == pytest.approx([40, 45, 30, 45, 45, 45, 20], abs=6)


def test_without_commands_there_is_no_such_table():
    analysis = analysed((), motor_lag=0.2)
    assert wheel_table(GapAnalysis(analysis.drive, analysis.nominal_body, analysis.nominal_wheels, None, None)) == {}
