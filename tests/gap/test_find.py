"""The whole search on logs of a robot in which something is hidden; the truth never reaches the search."""

import json
import re
from dataclasses import replace
from functools import cache

import pytest

from disco_hw import gap
from disco_hw.errors import LogError
from disco_hw.gap import find_gap, missing_effects
from disco_hw.gap.data.stamp_clock import picked
from disco_hw.gap.report.judge import effect_findings
from disco_hw.gap.report.page import page
from disco_hw.gap.search.analysis import final_fit
from disco_hw.gap.search.selection import Selector
from disco_hw.model import Model, load_model, save_model
from tools.gap.logs import simulated_drive

MODEL = Model(0.061, 0.415, 0.238)


def first_s(log, seconds):
    """The beginning of a log."""
    commands, wheels, poses = (picked(part, part.t_s < seconds) for part in (log.commands, log.wheels, log.poses))
    return replace(log, commands=commands, wheels=wheels, poses=poses)


@cache
def report_of(*hidden, seed=902, drive="rich", dirty=False):
    log = simulated_drive(dict(hidden), seed=seed, drive=drive, dirty=dirty)
    # A lag shows in the first 20 s, and pictures of one report are enough to look at.
    is_lag = bool(hidden) and hidden[0][0] == "motor_lag"
    return find_gap(first_s(log, 20.0) if is_lag else log, MODEL, pictures=is_lag)


@pytest.mark.thorough
def test_nothing_is_missing_in_a_log_with_nothing_hidden():
    report = report_of(seed=900)
    assert report.verdict == "nothing_missing"
    assert not report.effects
    assert not report.unnamed
    assert {spot.name for spot in report.blind_spots} >= {"turn_slip", "motor_lag", "pose_offset", "encoder_scale"}


@pytest.mark.parametrize(
    ("name", "size", "parameter"),
    [
        ("motor_lag", 0.12, "tau_s"),
        # Quick tests have slip found in `search/test_searches.py`, and predicted in `search/test_stages.py`.
        pytest.param("turn_slip", 0.09, "k_s", marks=pytest.mark.long),
        pytest.param("yaw_acceleration_limit", 2.0, "limit_rad_s2", marks=pytest.mark.long),
        pytest.param("acceleration_limit", 7.3, "limit_rad_s2", marks=pytest.mark.long),
    ],
)
def test_exactly_the_hidden_effect_is_named_and_the_gap_closes(name, size, parameter):
    report = report_of((name, size))
    assert [effect.name for effect in report.effects] == [name]
    estimate = report.effects[0].parameters[parameter]
    assert estimate.value == pytest.approx(size, rel=0.12)
    assert estimate.low < estimate.value < estimate.high
    stages = {stage: errors[2.0].position_m for stage, errors in report.gap.items()}
    assert stages["amended"] < stages["refitted"]
    # The floor is the sensors' noise alone: wheels and ground of that robot err by more at random.
    assert stages["refitted"] - stages["amended"] > 0.5 * (stages["refitted"] - stages["floor"])
    assert report.offered == "amended"


@pytest.mark.thorough
def test_a_steady_circle_shows_what_stands_beside_the_lag_of_real_motors():
    log = simulated_drive({"wheel_gain": -0.044}, seed=11101, drive="circle", motors="real")
    report = find_gap(log, MODEL, pictures=False)
    assert {effect.name for effect in report.effects} == {"motor_lag", "wheel_gain"}
    gains = report.effects[[effect.name for effect in report.effects].index("wheel_gain")].parameters
    assert all(gain.low < -0.044 < gain.high for gain in gains.values())


@pytest.mark.long
def test_a_motor_with_a_slew_limit_is_not_given_a_gain_that_misleads():
    report = find_gap(simulated_drive({"acceleration_limit": 10.0}, seed=7002), MODEL)
    assert report.why_not_amended is None


@pytest.mark.long
def test_two_effects_of_different_channels_are_both_named():
    report = report_of(("yaw_rate_limit", 1.0), ("pose_latency", 0.1))
    assert {effect.name for effect in report.effects} == {"yaw_rate_limit", "pose_latency"}


@pytest.mark.long
def test_what_has_no_name_is_unnamed_with_its_form():
    # A third of it is named too, but a gain of the wheels fitted end to end hides most of that: 10.8 mm against 9.9 mm.
    report = report_of(("x_motor_droop", 0.03))
    assert not report.effects
    assert report.verdict == "unexplained"
    said = re.fullmatch(r"command \+= (-?[0-9.]+) u \|u\|", report.unnamed[0].form)
    assert said is not None
    assert float(said[1]) == pytest.approx(-0.03, rel=0.05)
    assert report.gap["amended"][2.0].position_m < 0.7 * report.gap["refitted"][2.0].position_m


@pytest.mark.long
def test_an_encoder_that_counts_wrong_is_one_cause_not_two():
    report = report_of(("encoder_scale", 0.04))
    assert [effect.name for effect in report.effects] == ["encoder_scale"]
    assert report.effects[0].parameters["right"].value == pytest.approx(0.04, abs=0.006)


@pytest.mark.long
def test_a_sensor_mounted_aside_is_reported_as_a_class():
    report = report_of(("pose_offset", 0.04))
    assert len(report.effects) == 1
    assert {report.effects[0].name, *report.effects[0].indistinguishable_from} == {"lateral_icr", "pose_offset"}
    assert report.effects[0].experiment


@pytest.mark.thorough
def test_a_steady_circle_is_blind_to_what_it_cannot_show():
    report = report_of(("turn_slip", 0.1), drive="circle")
    assert not report.effects
    blind = {spot.name for spot in report.blind_spots if spot.blind}
    assert {"turn_slip", "side_slip", "wheel_radius_asymmetry", "heading_bias"} <= blind


@pytest.mark.thorough
def test_what_would_do_as_well_is_reported_with_the_drive_that_decides(monkeypatch):
    monkeypatch.setattr(Selector, "rivals", lambda self, accepted, name: ("command_delay",))
    report = find_gap(simulated_drive({"motor_lag": 0.12}, seed=902, drive="circle"), MODEL)
    (effect,) = report.effects
    assert effect.indistinguishable_from == ("command_delay",)
    assert effect.experiment.startswith("disco-hw drive ROBOT.toml --script starts")


@pytest.mark.long
def test_known_effects_of_the_model_are_not_reported_again():
    amended = report_of(("motor_lag", 0.12)).model
    again = find_gap(simulated_drive({"motor_lag": 0.12}, seed=902), amended)
    assert not again.effects
    assert again.model.effects[0].values["tau_s"] == pytest.approx(0.12, rel=0.05)


def test_report_and_model_can_be_written_and_read(tmp_path):
    report = report_of(("motor_lag", 0.12))
    content = json.loads(json.dumps(report.as_dict()))
    assert content["effects"][0]["channel"] == "command_to_wheel"
    assert set(content["gap"]) >= {"horizon_s", "held_out", "nominal", "refitted", "timed", "amended", "floor"}
    save_model(report.model, tmp_path / "model.toml")
    assert load_model(tmp_path / "model.toml").parameter_names == report.model.parameter_names
    html = page(report)
    assert "0.12" in html
    # Without the pictures, whose letters may spell anything.
    assert "http" not in re.sub(r'base64,[^"]*', "", html)
    assert html.count("data:image/png;base64,") == len(report.pictures) >= 4


def test_a_log_with_nothing_to_judge_is_refused():
    with pytest.raises(LogError, match="too little"):
        find_gap(first_s(simulated_drive(seed=900, drive="poor"), 0.4), MODEL)


@pytest.fixture
def searched(monkeypatch):
    """Makes a log in which this is hidden, whose search, the same for report and names, is made once."""

    def made(hidden, **drive):
        log = simulated_drive(hidden, **drive)
        found = gap.search_log(log, MODEL)

        def again(given, model, *_):
            return found if given is log and model is MODEL else None

        monkeypatch.setattr(gap, "search_log", again)
        return log

    return made


@pytest.mark.thorough
def test_the_names_alone_are_those_of_the_report(searched):
    log = searched({"pose_latency": 0.1, "motor_lag": 0.12}, seed=902, drive="poor")
    report = find_gap(log, MODEL)
    assert missing_effects(log, MODEL) == tuple(effect.name for effect in report.effects) != ()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("delay_s", "missing"), [(0.003, ()), pytest.param(0.1, ("command_delay",), marks=pytest.mark.long)]
)
def test_what_the_log_shows_and_no_prediction_needs_is_not_missing(searched, delay_s, missing):
    log = searched({"command_delay": delay_s}, seed=903, drive="rich")
    analysis, _ = gap.search_log(log, MODEL)
    assert [effect.name for effect in effect_findings(analysis, final_fit(analysis))] == ["command_delay"]
    assert missing_effects(log, MODEL) == missing
