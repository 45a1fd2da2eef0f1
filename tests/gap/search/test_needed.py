"""The model that is handed out has of what was found only what predictions need, and nothing of this log's poses."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.effects.registry import REGISTRY
from disco_hw.gap import model_of
from disco_hw.gap import search as stages
from disco_hw.gap.data import WHEEL
from disco_hw.gap.noise.channels import BodyChannel
from disco_hw.gap.report.judge import left_out_notes
from disco_hw.gap.search import joint_predictions
from disco_hw.gap.search.analysis import GapAnalysis, final_fit
from disco_hw.gap.search.channel_result import ChannelResult, ParameterEstimate
from disco_hw.model import Model
from tests.gap.search.test_lacking import analysis_of, found, told
from tests.gap.synthetic import DRIVE, GEOMETRY, NOISE, body_channel, errors_in_stretches, selector_of


def kept_of(names):
    """What is kept of names that were found in a body that slips turning, the model and the notes of that."""
    _, line = body_channel(turn_slip=0.08, drive=DRIVE)
    # Without commands it starts from the wheels as measured.
    line = replace(line, command_rad_s=np.full_like(line.command_rad_s, np.nan))
    start = body_channel()[0].neutral.copy()
    channel = BodyChannel.build(line, NOISE, start)
    selector = selector_of(channel)
    analysis = GapAnalysis(line, start, WHEEL.neutral, ChannelResult(selector, names, channel), None)
    final = final_fit(analysis)
    predictions = joint_predictions(analysis, final)
    model, _ = model_of("amended", Model(*GEOMETRY), analysis, final, predictions)
    kept = predictions.kept[0]
    assert {effect.name for effect in model.effects} == set(kept.body.names)
    return kept.body.names, model, left_out_notes(analysis, final, kept)


def test_a_name_that_predictions_do_not_need_is_left_out_and_said_and_the_rest_is_believed_jointly():
    names, model, notes = kept_of(("turn_slip", "acceleration_slip"))
    assert names == ("turn_slip",)
    covariance, entries = model.belief.covariance(), model.belief.names
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    axial, slip = entries.index("axial_distance_m"), entries.index("turn_slip.k_s")
    assert abs(covariance[axial, slip]) > 0.1 * (covariance[axial, axial] * covariance[slip, slip]) ** 0.5
    assert notes == ("the amended model leaves out acceleration_slip: held-out data are predicted as well without",)


# What the mean score, a log of errors, must gain.
WORTH = 0.005


class Candidate:
    """Stands for a model that may be handed out: it errs by what is said of all that it has, apart or on top."""

    squares: dict
    judged_so_far: list

    def __init__(self, analysis, on_top=False):
        self.analysis, self.is_on_top = analysis, on_top

    @classmethod
    def of_channels(cls, analysis, apart):
        assert apart == "apart"
        return cls(analysis)

    def on_top(self, of):
        assert of == "timed"
        # From where the channels have it, which is far off, it errs by more.
        return type(self)(self.analysis, "far"), type(self)(self.analysis, True)

    def evaluate(self, ahead, apart):
        assert (ahead, apart) == ("ahead", "apart")
        wheels, body, _ = told(self.analysis)
        has = frozenset((*(wheels or ()), *(body or ())))
        if self.is_on_top != "far":
            self.judged_so_far.append((has, self.is_on_top))
        square = self.squares.get((has, self.is_on_top), 9.0)
        return stages._Evaluated(self, None, {}, errors_in_stretches([square] * 4, [square] * 4))


def needed(monkeypatch, squares, wheels=None, body=None, worth=WORTH):
    """What is needed of what was found, whether on top of the timed model, and all that was judged."""
    by_set = {(frozenset(names.split()), on_top): square for (names, on_top), square in squares.items()}
    monkeypatch.setattr(Candidate, "squares", by_set, raising=False)
    monkeypatch.setattr(Candidate, "judged_so_far", [], raising=False)
    monkeypatch.setattr(stages, "_Candidate", Candidate)
    analysis = analysis_of(wheels, body)
    kept = stages._needed(analysis, "timed", "ahead", "apart", None, worth).candidate
    wheels, body, left_out = told(kept.analysis)
    return " ".join((*(wheels or ()), *(body or ()))), kept.is_on_top, left_out, Candidate.judged_so_far


def test_the_least_evident_goes_first_where_nothing_is_worse_without_and_the_rest_stays(monkeypatch):
    squares = {
        ("turn_slip slope side_slip", False): 1.1, ("turn_slip slope side_slip", True): 1.0,
        ("turn_slip slope", True): 1.0, ("turn_slip", True): 1.01, ("slope", True): 1.0,
    }  # fmt: skip
    body = found(("turn_slip", "slope", "side_slip"))
    names, on_top, left_out, _ = needed(monkeypatch, squares, body=body)
    assert (names, on_top, left_out) == ("slope", True, ("side_slip", "turn_slip"))
    # Without the slope squares grow by a hundredth, and so does the score.
    assert needed(monkeypatch, squares, body=body, worth=0.0101)[0] == "turn_slip"
    assert needed(monkeypatch, squares, body=body, worth=0.0099)[0] == "slope"
    # Where it does better without, all else is held against that.
    better = {**squares, ("turn_slip slope", True): 0.8, ("slope", True): 0.9}
    assert needed(monkeypatch, better, body=body)[0] == "turn_slip slope"
    # Also where it is not the last that was as good.
    best = {
        **squares,
        ("turn_slip slope side_slip", True): 0.5,
        ("turn_slip slope", True): 0.8,
        ("slope side_slip", True): 0.8,
    }
    assert needed(monkeypatch, best, body=body)[:2] == ("turn_slip slope side_slip", True)


def test_channels_apart_are_kept_where_they_err_less_until_something_goes(monkeypatch):
    squares = {("turn_slip slope", False): 0.9, ("turn_slip slope", True): 1.0, ("turn_slip", True): 0.95}
    body = found(("turn_slip", "slope"))
    assert needed(monkeypatch, squares, body=body)[:2] == ("turn_slip slope", False)
    squares["turn_slip", True] = 0.9
    assert needed(monkeypatch, squares, body=body)[:3] == ("turn_slip", True, ("slope",))


def test_something_of_what_was_found_stays(monkeypatch):
    squares = {("slope", False): 1.0, ("slope", True): 2.0, ("", True): 0.1}
    names, _, _, judged = needed(monkeypatch, squares, body=found(("slope",)))
    assert names == "slope"
    assert judged == [({"slope"}, False), ({"slope"}, True)]
    # A lag is no candidate to go.
    squares = {("motor_lag slope", True): 1.0, ("motor_lag", True): 1.0}
    assert needed(monkeypatch, squares, found(("motor_lag",)), found(("slope",)))[0] == "motor_lag"


def test_where_nothing_was_found_the_channels_are_as_they_are(monkeypatch):
    judged = needed(monkeypatch, {}, found(("motor_lag",), given=("motor_lag",)), found(()))[3]
    assert judged == [({"motor_lag"}, False)]


def of_every_log(names, even=True, **estimates):
    """What stays of a body's names, and what goes, by intervals of its parameters; others are clearly there."""
    by_name = {
        column: ParameterEstimate(0.1, 0.05, 0.15)
        for name in names
        for column in REGISTRY[name].columns
    }  # fmt: skip
    by_name |= {column: ParameterEstimate(0.1, *ends) for column, ends in estimates.items()}
    analysis = replace(analysis_of(None, found(names, [("drag", 45.0)])), drive=SimpleNamespace(pose_clock_even=even))
    final = SimpleNamespace(body_estimates=SimpleNamespace(by_name=by_name))
    _, body, left_out = told(stages.of_every_log(analysis, final))
    return body, left_out


@pytest.mark.parametrize("even", [True, False])
def test_a_clock_that_runs_unevenly_says_nothing_of_how_late_poses_are(even):
    kept, gone = of_every_log(("turn_slip", "pose_latency"), even)
    assert ("pose_latency" in kept) is even
    assert gone == (() if even else ("pose_latency",))
    # Of how poses are turned it says as much as ever.
    assert of_every_log(("heading_bias",), even)[1] == ()


@pytest.mark.parametrize(
    ("ends", "goes"),
    [((-0.1, 0.3), True), ((0.0, 0.2), True), ((-0.2, 0.0), True), ((0.1, 0.3), False), ((-0.3, -0.1), False)],
)
def test_what_poses_may_as_well_not_have_in_another_log_is_of_this_log(ends, goes):
    # One that is of the robot is less evident, one is more so.
    for name in ("heading_bias", "pose_latency"):
        column = REGISTRY[name].columns[0]
        kept, gone = of_every_log(("turn_slip", name, "side_slip"), **{column: ends})
        assert gone == ((name,) if goes else ())
        assert ("turn_slip" in kept, name in kept, "side_slip" in kept) == (True, not goes, True)
    # Of the robot itself what is hardly known is the best that is known.
    assert of_every_log(("turn_slip",), **{REGISTRY["turn_slip"].columns[0]: ends})[1] == ()


def test_an_offset_is_there_that_is_so_in_one_direction():
    ahead, aside = REGISTRY["pose_offset"].columns
    assert of_every_log(("pose_offset",), **{ahead: (-0.1, 0.1)})[1] == ()
    assert of_every_log(("pose_offset",), **{ahead: (-0.1, 0.1), aside: (-0.1, 0.1)})[1] == ("pose_offset",)


def test_without_poses_nothing_is_of_the_pose_source():
    analysis = analysis_of(found(("motor_lag", "deadband")), None)
    assert stages.of_every_log(analysis, SimpleNamespace(body_estimates=None)) == analysis


def test_what_is_of_this_log_is_gone_before_anything_is_judged_and_that_is_said():
    names, model, notes = kept_of(("turn_slip", "heading_bias"))
    assert names == ("turn_slip",)
    assert "heading_bias.bias_rad" not in model.parameter_names
    assert notes == ("the amended model leaves out heading_bias: this log does not say how poses are in another drive",)


@pytest.mark.parametrize(
    ("ends", "why"),
    [((-0.1, 0.3), "this log does not say how poses are in another drive"), ((0.1, 0.3), "predicted as well without")],
)
def test_what_predictions_do_not_need_of_poses_is_not_said_to_be_of_this_log(ends, why):
    column = REGISTRY["heading_bias"].columns[0]
    final = SimpleNamespace(body_estimates=SimpleNamespace(by_name={column: ParameterEstimate(0.1, *ends)}))
    analysis = replace(
        analysis_of(None, found(("heading_bias", "turn_slip"))), drive=SimpleNamespace(pose_clock_even=True)
    )
    (note,) = left_out_notes(analysis, final, stages.lacking(analysis, "body", "heading_bias"))
    assert note.startswith("the amended model leaves out heading_bias: ")
    assert note.endswith(why)
