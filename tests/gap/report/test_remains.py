"""Which share of the prediction error is explained, and where most of the rest lies."""

from dataclasses import replace

import pytest

from disco_hw.effects import Channel
from disco_hw.gap.report import EffectFinding
from disco_hw.gap.report.page import page, summary_lines
from disco_hw.gap.report.remains import Remains
from disco_hw.gap.search.channel_result import ParameterEstimate
from tests.gap.report.test_findings import report
from tests.gap.synthetic import errors_of_size
from tests.gap.test_write_report import report_of


def errors(position_m, yaw_rad, **by_regime):
    squares = by_regime or {"curves": (position_m**2, yaw_rad**2)}
    return errors_of_size(position_m, yaw_rad, regime_squares=squares)


TIMED, FLOOR = errors(0.05, 0.10), errors(0.01, 0.02)


def test_the_share_of_the_gap_to_the_noise_that_is_closed_is_of_position_and_of_heading():
    remains = Remains.of(TIMED, errors(0.02, 0.10), FLOOR, None)
    assert remains.closed == pytest.approx((0.75, 0.0))
    assert remains.as_dict()["closed_position"] == pytest.approx(0.75)
    # Where `timed` errs by the noise there is no gap, and a model that errs by more has closed none.
    assert Remains.of(FLOOR, FLOOR, FLOOR, None).closed == (None, None)
    assert Remains.of(TIMED, errors(0.07, 0.06), FLOOR, None).closed == pytest.approx((0.0, 0.5))


def test_no_share_is_told_of_a_gap_as_small_as_what_the_noise_is_known_by_nor_more_than_all_of_it():
    # A robot of which all was found: in position there was next to nothing to explain.
    found = Remains.of(errors(0.00469, 0.013), errors(0.00446, 0.0040), errors(0.00464, 0.0041), None)
    assert found.closed == (None, 1.0)
    assert found.describe() == "Of what is more than the sensors' noise this explains 100% in heading."
    assert found.as_dict()["closed_position"] is None


def test_that_something_is_missing_is_not_said_of_a_robot_predicted_to_the_noise():
    residue = ("command_to_wheel: speeding up still disagrees: 5.5 times the noise",)
    bare = replace(report_of("motor_lag", 0.05, 0.02), effects=(), unnamed=(), doubtful=(), residue=residue)
    missing = "Something is missing that none of the known effects explains."
    said = summary_lines(replace(bare, remains=Remains.of(FLOOR, FLOOR, FLOOR, None)))
    assert missing not in said
    assert "What is left is the sensors' noise." in said
    assert missing in summary_lines(replace(bare, remains=Remains.of(TIMED, TIMED, FLOOR, None)))
    assert missing in summary_lines(bare)


@pytest.mark.parametrize(
    ("position_m", "yaw_rad", "explained"), [(0.02, 0.04, True), (0.021, 0.02, False), (0.01, 0.041, False)]
)
def test_above_twice_the_noise_it_is_only_partly_explained(position_m, yaw_rad, explained):
    remains = Remains.of(TIMED, errors(position_m, yaw_rad), FLOOR, None)
    assert remains.is_explained is explained
    found = replace(report_of("motor_lag", 0.05, 0.02), remains=remains)
    assert found.verdict == ("effects_found" if explained else "partly_explained")
    assert ("Most of the rest" in remains.describe()) is not explained
    # What is not found at all is not explained in part.
    assert replace(found, effects=()).verdict == "unexplained"


@pytest.mark.parametrize(("yaw_rad", "regime"), [(0.04, "curves"), (0.2, "standstill")])
def test_most_of_the_rest_lies_where_squared_errors_are_furthest_above_those_of_the_noise(yaw_rad, regime):
    # Of position in curves, of heading at standstill: that counts which is the larger in units of the noise.
    offered = errors(0.05, yaw_rad, curves=(3.0, 1.0), standstill=(4.0, 2.0))
    floor = errors(0.01, 0.02, curves=(0.1, 0.5), standstill=(3.5, 0.5))
    remains = Remains.of(TIMED, offered, floor, None)
    assert remains.regime == regime
    said = {"curves": "the robot drives curves", "standstill": "the robot stands still"}[regime]
    assert remains.describe().endswith(f"Most of the rest is while {said}.")


def test_a_regime_of_which_the_noise_is_not_known_counts_whole():
    offered = errors(0.05, 0.04, curves=(3.0, 1.0), standstill=(4.0, 2.0))
    assert Remains.of(TIMED, offered, errors(0.01, 0.02, curves=(0.1, 0.5)), None).regime == "standstill"


@pytest.mark.parametrize(
    ("body", "channel", "said"),
    [
        (errors(0.045, 0.09), Channel.WHEEL_TO_BODY, "between wheels and body"),
        (errors(0.02, 0.03), Channel.COMMAND_TO_WHEEL, "from command to wheel"),
    ],
)
def test_what_is_left_with_the_wheels_as_measured_is_of_the_body(body, channel, said):
    remains = Remains.of(TIMED, errors(0.05, 0.1), FLOOR, body)
    assert remains.channel is channel
    assert said in remains.describe()
    assert remains.as_dict()["channel"] == channel.value


def test_without_predictions_nothing_is_said_of_the_rest():
    nan = errors(float("nan"), float("nan"))
    assert Remains.of(nan, nan, nan, None) is None
    assert report(0.014).as_dict()["remains"] is None


def test_the_answer_says_how_sure_how_much_is_explained_and_in_at_most_ten_lines():
    found = replace(report_of("motor_lag", 0.05, 0.02), remains=Remains.of(TIMED, errors(0.02, 0.10), FLOOR, None))
    lines = summary_lines(found)
    assert lines[0] == "The wheels follow their command slowly, with a time constant of 123 ms."
    assert lines[1] == "How sure: with 95 % probability motor_lag is between 0.10 and 0.15 s."
    assert lines[3].startswith(
        "Of what is more than the sensors' noise this explains 75% in position and 0% in heading."
    )
    assert lines[3] in page(found).replace("&#x27;", "'")
    assert len(lines) <= 10
    early = EffectFinding("pose_latency", "pose_sensor", {"latency_s": ParameterEstimate(-0.065, -0.07, -0.06)}, 9.0)
    assert summary_lines(replace(found, effects=(early,)))[:2] == [
        "Poses are stamped 65 ms early (not in model.toml).",
        "How sure: with 95 % probability pose_latency is between 0.06 and 0.07 s.",
    ]


def test_the_ends_of_a_narrow_interval_are_told_apart():
    dead_band = EffectFinding("deadband", "actuator", {"width_rad_s": ParameterEstimate(0.8005, 0.799, 0.8019)}, 9.0)
    found = replace(report_of("motor_lag", 0.05, 0.02), effects=(dead_band,))
    assert summary_lines(found)[1] == "How sure: with 95 % probability deadband is between 0.799 and 0.802 rad/s."
