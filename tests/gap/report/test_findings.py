"""The report's sentences, where they decide what a person does next."""

import json
import math
import shlex
from dataclasses import replace

import pytest

from disco_hw.effects.registry import REGISTRY
from disco_hw.gap import offered_stage
from disco_hw.gap.report import STAGES, AcrossLogs, EffectFinding, GapReport, LowConfidence, Provenance, UnnamedFinding
from disco_hw.gap.report.blind_spots import BlindSpot
from disco_hw.gap.report.page import as_text, page, sentence, summary_lines
from disco_hw.gap.search.channel_result import ParameterEstimate
from disco_hw.gap.search.cross_validation import PredictionErrors
from disco_hw.gap.settings import DEFAULT_SETTINGS
from disco_hw.model import EffectSetting, Model
from disco_hw.model.terms import TERMS
from disco_hw.reports import as_json


def errors(position_m, yaw_rad=0.02):
    interval = (0.9 * position_m, 1.1 * position_m)
    return PredictionErrors(position_m, interval, yaw_rad, (0.9 * yaw_rad, 1.1 * yaw_rad), 0.1, {"curves": position_m})


NO_ERRORS = PredictionErrors(math.nan, (math.nan, math.nan), math.nan, (math.nan, math.nan), math.nan, {})


def effect(name, wide=0.0, **values):
    """A finding of parameters whose intervals reach so far to either side."""
    estimates = {key: ParameterEstimate(value, value - wide, value + wide) for key, value in values.items()}
    return EffectFinding(name, "command_to_wheel", estimates, 9.0)


def report(amended_m, yaw_rad=0.02, blind=(), offered="amended"):
    sizes = dict(zip(STAGES, (0.06, 0.05, 0.047, amended_m, 0.014), strict=True))
    of = {s: errors(size, yaw_rad if s == "amended" else 0.02) for s, size in sizes.items()}
    gap = {s: dict.fromkeys((0.5, 1.0, 2.0, 5.0), each) for s, each in of.items()}
    spots = tuple(
        BlindSpot(name, "k", "s", None, True, f"disco-hw drive ROBOT.toml --script x: {name}") for name in blind
    )
    unnamed = (UnnamedFinding("wheel_to_body", "v_x += -0.4 v^3", 99.0),)
    return GapReport(("log",), (), (), unnamed, spots, gap, Model(0.06, 0.4), 1.0, offered)


def test_the_answer_has_the_gap_before_and_after_and_the_noise():
    assert summary_lines(report(0.014))[1] == (
        "2 s ahead, in parts of the log that were not used, predictions are off by 47 mm and 0.02 rad with a delay "
        "and a lag alone (timed), by 14 mm and 0.02 rad with no effect (amended); the sensors' noise makes 14 mm "
        "and 0.02 rad."
    )


def test_a_term_is_told_in_words_where_it_is_known_what_it_means():
    plain = report(0.014)
    assert summary_lines(plain)[0] == "Something is missing that has no name: v_x += -0.4 v^3."
    meaning = TERMS["v_x += k (v - slewed_6.3(v))"].describe(-0.97)
    slipping = UnnamedFinding("wheel_to_body", "v_x += -0.97 (v - slewed_6.3(v))", 99.0, meaning=meaning)
    told = "v_x += -0.97 (v - slewed_6.3(v)) (tyres slip: the robot follows its wheels by about 6.3 m/s^2 at most)"
    assert summary_lines(replace(plain, unnamed=(slipping,)))[0] == f"Something is missing that has no name: {told}."
    assert f"unnamed: {told}" in as_text(replace(plain, unnamed=(slipping,)))
    assert replace(plain, unnamed=(slipping,)).as_dict()["unnamed"][0]["meaning"] == meaning
    overshoot = TERMS["command += k (u - mean_0.3s(u))"]
    assert overshoot.describe(0.14) == (
        "the wheels overshoot a change of their command by up to 14% of it, which fades with a time constant of 0.3 s"
    )
    assert "at first fall short of a change of their command by up to 14%" in str(overshoot.describe(-0.14))
    # Half of it is something else, and so is any other form.
    assert TERMS["v_x += k (v - slewed_6.3(v))"].describe(-0.4) is None
    assert TERMS["v_x += k (v - mean_1s(v))"].describe(-1.0) is None
    assert TERMS["v_x += k v^3"].describe(-1.0) is None


def test_a_model_that_predicts_worse_is_not_recommended():
    worse = report(0.052, offered="timed")
    assert summary_lines(worse)[1].endswith(
        "Drive with the timed model, which is in model.toml. "
        "The amended model has more effects and does not clearly predict better."
    )
    told = worse.as_dict()["gap"]
    assert told["offered"] == "timed"
    assert told["why_not_amended"] == "The amended model has more effects and does not clearly predict better."
    assert report(0.048).as_dict()["gap"]["why_not_amended"] is None


def without_its_terms(written_m, offered="amended"):
    """A report of which the amended model, as it is written, errs by so much."""
    of = report(0.014, offered=offered)
    return replace(of, gap={**of.gap, "written": {ahead_s: errors(written_m) for ahead_s in of.gap["amended"]}})


@pytest.mark.parametrize(("written_m", "offered"), [(0.02, "amended"), (0.052, "timed")])
def test_a_model_that_lacks_what_no_model_can_carry_is_judged_without_it(written_m, offered):
    of = without_its_terms(written_m, offered)
    assert offered_stage(of.gap, True, DEFAULT_SETTINGS) == offered
    assert of.why_not_amended == (
        None if offered == "amended" else "The amended model has more effects and does not clearly predict better."
    )
    said = f"Without what no model can hold, as it is written, the amended model errs by {1e3 * written_m:g} mm"
    assert said in summary_lines(of)[1]
    assert of.as_dict()["gap"]["written"]["position_rmse_m"] == written_m
    assert "written" not in report(0.014).as_dict()["gap"]
    assert said in page(of)


def model_with(*names):
    """A model with these effects."""
    effects = (EffectSetting(name, {p.name: p.start for p in REGISTRY[name].parameters}) for name in names)
    return Model(0.06, 0.4, effects=tuple(effects))


def test_the_answer_credits_the_effects_of_the_model_that_is_written_and_marks_those_that_it_leaves_out():
    found = replace(
        report(0.014),
        effects=(effect("motor_lag", tau_s=0.1), effect("turn_slip", k_s=0.12)),
        doubtful=(LowConfidence("command_delay", "hardly known"),),
        model=model_with("command_delay", "motor_lag"),
    )
    lines = summary_lines(found)
    assert lines[0].endswith("with a time constant of 100 ms.")
    assert lines[1].endswith(" (not in model.toml).")
    assert "rad with command_delay (doubtful), motor_lag (amended);" in lines[3]
    timed = summary_lines(replace(found, gap=report(0.052).gap, offered="timed"))[3]
    assert "rad with more effects (amended);" in timed
    assert "in model.toml, with command_delay (doubtful), motor_lag. The amended model has more effects" in timed
    without = replace(without_its_terms(0.02), model=found.model, doubtful=found.doubtful)
    assert "with command_delay (doubtful), motor_lag and what no model can hold (amended);" in summary_lines(without)[1]


def test_the_values_of_the_model_stand_beside_those_found_with_the_reason_why_they_differ():
    found = (effect("motor_lag", 0.001, tau_s=0.1), effect("turn_slip", k_s=0.12))
    model = Model(0.06, 0.4, effects=(EffectSetting("motor_lag", {"tau_s": 0.1234}),))
    both = replace(report(0.014), effects=found, model=model)
    why = "model.toml's values are fitted to whole predictions, from commands to poses, and may lie outside"
    text, html = as_text(both), page(both).replace("&#x27;", "'")
    assert "command_to_wheel: motor_lag: tau_s 0.1 [0.099, 0.101], 0.1234 in model.toml" in text
    assert "command_to_wheel: turn_slip: k_s 0.12 [0.12, 0.12], not in model.toml" in text
    assert why in text
    assert why in html
    assert "<td>tau_s = 0.1 [0.099, 0.101]</td><td>tau_s = 0.1234</td>" in html
    assert "<td>k_s = 0.12 [0.12, 0.12]</td><td>not in it</td>" in html
    same = replace(both, model=Model(0.06, 0.4, effects=(EffectSetting("motor_lag", {"tau_s": 0.1}),)))
    assert why not in as_text(same)
    assert why not in page(same).replace("&#x27;", "'")


def test_one_drive_is_asked_for():
    assert report(0.014).drive is None
    assert report(0.014, blind=("turn_slip", "yaw_rate_limit")).drive == "disco-hw drive ROBOT.toml --script spins"
    several = report(0.014, blind=("turn_slip", "deadband"))
    assert several.drive == "disco-hw drive ROBOT.toml --script separate"
    assert several.drive in summary_lines(several)[2]
    assert several.drive in page(several)


def test_the_page_says_what_is_in_the_model():
    inside = report(0.014)
    outside = replace(inside, unnamed=(replace(inside.unnamed[0], in_model=False),))
    assert "in the amended model" in page(inside)
    assert "no model&#x27;s state holds" in page(outside)
    assert not outside.as_dict()["unnamed"][0]["in_model"]


def test_a_log_of_short_stretches_says_that_it_does_not_tell_the_gap():
    some = report(0.014)
    short = replace(some, gap={s: dict.fromkeys(of, NO_ERRORS) for s, of in some.gap.items()})
    assert summary_lines(short)[1] == "No stretch of the logs is long enough to see how far 2 s predictions are off."
    told = json.loads(as_json(short.as_dict()), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert told["gap"]["amended"]["position_rmse_m"] is None
    assert told["gap"]["amended"]["position_ci95_m"] == [None, None]
    assert "nan" not in as_text(short)
    assert "nan" not in page(short).replace("dominant", "")


def test_the_page_names_the_score_that_a_name_takes():
    selection = DEFAULT_SETTINGS.selection
    accepts = f"score ({selection.named_score:g} accepts, up to {selection.heaviest * selection.named_score:g} where"
    assert accepts in page(report(0.014))


@pytest.mark.parametrize(("wide", "said"), [(0.004, True), (0.006, False)])
def test_that_wheels_are_unequal_is_said_where_only_their_load_shows_it_and_it_is_known(wide, said):
    load = effect("turning_load", wide, load_rad_s=0.53, unequal=-0.0095)
    line = summary_lines(replace(report(0.014), effects=(load,)))[0]
    assert line.startswith("Turning takes 0.53 rad/s from each side's wheels, however fast the robot turns")
    assert ("the right wheels are -0.95% larger than the mean" in line) is said


@pytest.mark.parametrize(
    ("stop_share", "wide", "said"),
    [
        (-0.003, 0.01, "; a wheel stops at once"),
        (0.03, 0.01, "; a wheel stops at once"),
        (0.5, 0.1, "; a stop takes 0.50 of that time"),
        # What is hardly known is not told.
        (-0.003, 2.94, ""),
    ],
)
def test_a_value_outside_what_is_possible_is_told_as_the_nearest_that_is(stop_share, wide, said):
    limit = effect("acceleration_limit", wide, limit_rad_s2=0.342, stop_share=stop_share)
    assert sentence(limit) == f"each wheel's speed changes by no more than 0.34 rad/s^2{said}"
    below = effect("acceleration_limit", wide, limit_rad_s2=0.01, stop_share=stop_share)
    assert sentence(below).startswith("each wheel's speed changes by no more than 0.05 rad/s^2")


@pytest.mark.parametrize(("delay_s", "wrong"), [(0.12, False), (-0.17, True)])
def test_a_response_before_its_command_is_said_to_be_a_wrong_clock(delay_s, wrong):
    assert ("clock" in sentence(effect("command_delay", delay_s=delay_s))) == wrong


def test_a_log_of_short_runs_is_answered_as_far_ahead_as_it_reaches():
    some = report(0.014)
    gap = {s: {h: e if h < 2.0 else NO_ERRORS for h, e in of.items()} for s, of in some.gap.items()}
    short = replace(some, gap=gap)
    assert short.horizon_s == 1.0
    begins = "1 s ahead, in parts of the log that were not used, predictions are off by 47 mm"
    assert summary_lines(short)[1].startswith(begins)
    assert short.as_dict()["gap"]["horizon_s"] == 1.0
    assert offered_stage(short.gap, True, DEFAULT_SETTINGS) == "amended"
    worse = {**short.gap, "amended": short.gap["nominal"]}
    assert offered_stage(worse, True, DEFAULT_SETTINGS) == "timed"


FIVE = ("turn_slip", "side_slip", "deadband", "stiction", "motor_lag")
MADE = Provenance("scout", "scout.toml", None, "2026-11-23T20:00+00:00", "0.1.0+gabc", "out/gap")


def test_the_page_says_whose_logs_when_and_by_which_version_and_how_to_go_on():
    made = replace(report(0.014), provenance=MADE)
    html = page(made)
    for said in ("scout", "2026-11-23T20:00+00:00", "0.1.0+gabc", "its nominal model"):
        assert said in html
    assert "<code>disco-hw run scout.toml --model out/gap/model.toml</code>" in html
    assert made.as_dict()["provenance"]["version"] == "0.1.0+gabc"
    assert "Go on" not in page(report(0.014))


def test_the_next_command_can_be_pasted_where_paths_have_spaces():
    made = replace(MADE, robot_file="my robot.toml", directory="my logs/gap")
    assert shlex.split(made.go_on) == ["disco-hw", "run", "my robot.toml", "--model", "my logs/gap/model.toml"]


def test_the_page_defines_its_words_in_the_margin_and_folds_what_is_for_experts():
    html = page(report(0.014))
    margin = html[html.index("<aside>") : html.index("</aside>")]
    for stage in STAGES:
        assert f"<dt>{stage}</dt>" in margin
    folded = html[html.index("For experts") :]
    assert folded.count("<details>") == folded.count("</details>") == 4
    assert "Evidence of every candidate" in folded
    assert "Evidence of every candidate" not in html[: html.index("For experts")]


def test_an_answer_of_many_names_is_short():
    effects = (effect("motor_lag", 0.1, tau_s=0.2),) * 5
    lines = summary_lines(replace(report(0.014, blind=FIVE), effects=effects))
    assert lines[2].endswith(". And 2 more, listed below.")
    assert " ".join(lines).count("time constant") == 3
    assert "this log could not have shown 5 effects, listed below, of realistic size" in lines[5]
    assert "side_slip" not in lines[5]
    few = summary_lines(replace(report(0.014, blind=("turn_slip",)), effects=effects[:3]))
    assert " ".join(few[:3]).count("time constant") == 3
    assert "more" not in " ".join(few[:3])
    next_drive = "Drive next: `disco-hw drive ROBOT.toml --script spins`; this log could not have shown turn_"
    assert few[5].startswith(next_drive)


def test_what_the_pose_sensor_does_is_corrected_in_robot_toml():
    bias, early = effect("heading_bias", 0.002, bias_rad=0.0499), effect("pose_latency", 0.01, latency_s=-0.065)
    beside = effect("pose_offset", 0.01, forward_m=0.02, left_m=-0.03)
    lines = summary_lines(replace(report(0.014), effects=(bias, early, beside)))
    assert lines[4] == (
        "Correct the pose sensor in [pose] of robot.toml, as no model does (a missing key is 0): add -0.0499 rad to "
        "yaw_offset_rad; add -0.0650 s to latency_s, and where that falls below 0 correct the stamps at their source; "
        "add [+0.0200, -0.0300] m to offset."
    )
    late = summary_lines(replace(report(0.014), effects=(effect("pose_latency", 0.01, latency_s=0.0897),)))
    assert late[2].endswith(": add +0.0897 s to latency_s.")
    other = replace(report(0.014), effects=(effect("motor_lag", tau_s=0.1),))
    assert "robot.toml" not in " ".join(summary_lines(other))


def test_what_logs_share_is_told_apart_from_what_differs():
    shared = AcrossLogs("wheel_radius_m", ((0.06, 0.059, 0.061), (0.0601, 0.059, 0.061)), False)
    other = AcrossLogs("axial_distance_m", ((0.4, 0.39, 0.41), (0.5, 0.49, 0.51)), True)
    both = replace(report(0.014), sources=("a.csv", "b.csv"), across=(shared, other))
    text = as_text(both)
    assert "the same in all 2 logs, of the robot: wheel_radius_m" in text
    assert "of the surface, the load or the day: axial_distance_m: 0.4 [0.39, 0.41], 0.5 [0.49, 0.51]" in text
    html = page(both)
    assert "<th>a.csv</th><th>b.csv</th>" in html
    assert html.count("the same: of the robot") == html.count("differs: of the surface") == 1
    assert both.as_dict()["across_logs"][1] == {
        "name": "axial_distance_m", "values_ci95": [[0.4, 0.39, 0.41], [0.5, 0.49, 0.51]], "differs": True,
    }  # fmt: skip
    assert "of the robot" not in as_text(replace(both, sources=("a.csv",)))
    assert "to compare them" in as_text(replace(both, across=()))
