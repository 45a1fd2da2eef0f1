"""The model that is handed out has of what was found only what predictions need, and nothing of this log's clock."""

from dataclasses import replace

import numpy as np
import pytest

from disco_hw.gap import model_of
from disco_hw.gap.data import WHEEL
from disco_hw.gap.noise.channels import BodyChannel
from disco_hw.gap.report.judge import left_out_notes
from disco_hw.gap.search import joint_predictions
from disco_hw.gap.search.analysis import GapAnalysis, final_fit
from disco_hw.gap.search.channel_search import ChannelResult, body_moves
from disco_hw.gap.search.cross_validation import PredictionErrors, within_one_standard_error
from disco_hw.gap.search.selection import Selector
from disco_hw.model import Model
from tests.gap.synthetic import GEOMETRY, NOISE, body_channel

LATE_NODES = 6


def kept_of(names, late_nodes=0, even=True):
    """What is kept of names that were found in a body that slips turning, and the model and the notes of that."""
    _, line = body_channel(turn_slip=0.08)
    inside = line.pose.node < line.pose.node[-1] - late_nodes
    pose = type(line.pose)(
        line.pose.node[inside] + late_nodes,
        line.pose.fraction[inside],
        line.pose.t_s[inside] + 0.01 * late_nodes,
        line.pose.block[inside],
    )
    line = replace(line, pose=pose, pose_values=line.pose_values[inside], pose_clock_even=even)
    # Without commands it starts from the wheels as measured.
    line = replace(line, command_rad_s=np.full_like(line.command_rad_s, np.nan))
    start = body_channel()[0].neutral.copy()
    channel = BodyChannel.build(line, NOISE, start)
    selector = Selector(channel, body_moves(channel))
    analysis = GapAnalysis(line, start, WHEEL.neutral, ChannelResult(selector, names, channel), None)
    final = final_fit(analysis)
    predictions = joint_predictions(analysis, final)
    model, _ = model_of("amended", Model(*GEOMETRY), analysis, final, predictions)
    kept = predictions.kept[0]
    assert {effect.name for effect in model.effects} == set(kept.body.names)
    return kept.body.names, left_out_notes(analysis, kept)


def test_a_name_that_predictions_do_not_need_is_left_out_and_said():
    names, notes = kept_of(("turn_slip", "acceleration_slip"))
    assert names == ("turn_slip",)
    assert notes == ("the amended model leaves out acceleration_slip: held-out data are predicted as well without",)


@pytest.mark.parametrize("even", [True, False])
def test_how_late_poses_are_is_kept_only_where_their_clock_runs_evenly(even):
    names, notes = kept_of(("turn_slip", "pose_latency"), LATE_NODES, even)
    assert names == (("turn_slip", "pose_latency") if even else ("turn_slip",))
    assert [note.partition(":")[0] for note in notes] == ([] if even else ["the amended model leaves out pose_latency"])


def errors(*squares):
    of = np.column_stack([squares, squares])
    size = float(np.sqrt(np.mean(squares)))
    return PredictionErrors(size, (0.0, 1.0), size, (0.0, 1.0), 0.0, {}, of)


def test_errors_are_as_small_as_the_best_within_what_their_difference_scatters():
    best = errors(1.0, 1.0, 1.0, 1.0)
    assert within_one_standard_error(best, best)
    assert within_one_standard_error(best, errors(1.3, 0.8, 1.2, 0.8))
    assert not within_one_standard_error(best, errors(1.3, 1.2, 1.1, 1.2))
    # A single stretch says nothing of the scatter.
    assert within_one_standard_error(errors(1.0), errors(1.0))
    assert not within_one_standard_error(errors(1.0), errors(1.01))
