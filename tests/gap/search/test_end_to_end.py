"""The last fit of the whole chain: it finds what predicts best, on the data that it may look at, and no more."""

from dataclasses import replace

import numpy as np
import pytest

from disco_hw.gap import offered_stage
from disco_hw.gap.data import BODY, WHEEL
from disco_hw.gap.report.amend import at_joint_fit
from disco_hw.gap.search import _on_top
from disco_hw.gap.search.channel_result import ChannelEstimates, ParameterEstimate
from disco_hw.gap.search.cross_validation import Chain, chain_wheels, smoothed_poses
from disco_hw.gap.search.end_to_end import Ahead, Freed, JointFit, Part
from disco_hw.gap.settings import DEFAULT_SETTINGS
from tests.gap.synthetic import GEOMETRY, body_channel, body_on, errors_of_size, wheels_on


def geometry_of(vector, information=0.0):
    part = Part(BODY, vector, (0, 1, 2), information * np.eye(3))
    return Freed((part,), lambda vectors: Chain(vectors[0], None))


def predictions(channel):
    return Ahead.of(channel, None, smoothed_poses(channel, channel.neutral))


def off(channel, by=(0.005, -0.03, 0.02)):
    vector = channel.neutral.copy()
    vector[:3] += by
    return vector


def test_the_geometry_that_predicts_is_found_from_one_that_does_not():
    channel, _ = body_channel()
    joint = predictions(channel).fit(geometry_of(off(channel)))
    assert joint.names == ("wheel_radius_m", "axial_distance_m", "x_icr_m")
    assert joint.vectors[0][:3] == pytest.approx(GEOMETRY, abs=2e-3)
    deviations = np.sqrt(np.diag(joint.covariance))
    assert (np.abs(joint.vectors[0][:3] - GEOMETRY) < 4.0 * deviations).all()


def test_the_fold_that_is_left_out_is_not_looked_at():
    channel, line = body_channel()
    spoilt = line.pose_values.copy()
    # In the first stretch of time every turn is measured a tenth too large.
    spoilt[line.pose.t_s < line.folds.stretch_s, 2] *= 1.1
    ahead = predictions(body_on(line, spoilt))
    axle = {held: ahead.fit(geometry_of(channel.neutral), held).vectors[0][1] for held in (0, 1)}
    assert axle[0] == pytest.approx(0.4, rel=0.01)
    assert abs(axle[1] - 0.4) > 3.0 * abs(axle[0] - 0.4)


def test_on_top_of_the_timed_model_a_channel_that_is_wrong_and_sure_does_not_hold_the_geometry():
    channel, _ = body_channel(turn_slip=0.08)
    ahead = predictions(channel)
    slip = BODY.place["turn_slip.k_s"]
    wrong = off(channel, (0.005, -0.05, 0.02))
    wrong[slip] = 0.08
    of = Freed((Part(BODY, wrong, (0, 1, 2, slip), 1e12 * np.eye(4)),), lambda vectors: Chain(vectors[0], None))
    held = ahead.fit(of).vectors[0]
    timed = geometry_of(channel.neutral)
    free = ahead.fit(_on_top(of, timed.at(ahead.fit(timed).vectors), True)).vectors[0]
    assert held[:3] == pytest.approx(wrong[:3], rel=1e-3)
    assert free[:3] == pytest.approx(GEOMETRY, abs=2e-3)
    assert free[slip] == pytest.approx(0.08, rel=1e-3)


def errors(position_m, yaw_rad):
    return {2.0: errors_of_size(position_m, yaw_rad)}


@pytest.mark.parametrize(
    ("amended", "timed", "refitted", "offered"),
    [
        ((0.02, 0.02), (0.04, 0.04), (0.08, 0.08), "amended"),
        ((0.04, 0.04), (0.04, 0.04), (0.08, 0.08), "timed"),
        ((0.06, 0.06), (0.04, 0.04), (0.08, 0.08), "timed"),
        ((0.041, 0.041), (0.04, 0.04), (0.08, 0.08), "timed"),
        ((0.06, 0.06), (0.05, 0.05), (0.04, 0.04), "refitted"),
        # Nearer in one and far off in the other.
        ((0.06, 0.60), (0.032, 0.08), (0.024, 0.50), "timed"),
        ((float("nan"), float("nan")), (0.04, 0.04), (0.08, 0.08), "amended"),
    ],
)
def test_a_model_that_does_not_beat_plainer_ones_is_not_offered(amended, timed, refitted, offered):
    gap = {"nominal": errors(1.0, 1.0), "refitted": errors(*refitted), "timed": errors(*timed)}
    gap["amended"] = errors(*amended)
    assert offered_stage(gap, True, DEFAULT_SETTINGS) == offered


def test_a_term_of_the_wheels_keeps_its_number_though_the_body_has_one_of_the_same_name():
    parts = []
    for layout in (BODY, WHEEL):
        longer = replace(
            layout, columns=(*layout.columns, "term0"), place={**layout.place, "term0": len(layout.columns)}
        )
        parts.append(Part(longer, np.append(layout.neutral, 0.0), (), np.zeros((0, 0))))
    of = Freed(tuple(parts), lambda vectors: Chain(*vectors))
    vectors = tuple(np.append(part.vector[:-1], k) for part, k in zip(parts, (0.38, 0.12), strict=True))
    joint = JointFit(vectors, 0.0, (), np.zeros((0, 0)))
    before = ChannelEstimates({"term0": ParameterEstimate(0.1, 0.08, 0.12)}, ("term0",), np.array([[1e-4]]))
    moved = [at_joint_fit(before, part, of, joint).by_name["term0"].value for part in parts]
    assert moved == [0.38, 0.12]


def test_derivatives_by_what_only_the_body_has_are_those_of_the_whole_chain():
    channel, line = body_channel(turn_slip=0.08)
    wheels = wheels_on(line)
    poses = smoothed_poses(channel, channel.neutral)
    slip = BODY.place["turn_slip.k_s"]
    parts = (
        Part(BODY, channel.neutral, (0, 1, 2, slip), np.zeros((4, 4))),
        Part(WHEEL, WHEEL.neutral, (WHEEL.place["motor_lag.tau_s"],), np.zeros((1, 1))),
    )
    of = Freed(parts, lambda vectors: Chain(*vectors))
    ahead = Ahead.of(channel, wheels, poses)
    vectors = of.vectors(of.joined(lambda part: part.vector))
    turned = chain_wheels(channel, wheels, of.chain(vectors))
    vectors[0][slip] += 0.01
    for own, known in zip(ahead.errors(of.chain(vectors)), ahead.errors(of.chain(vectors), turned), strict=True):
        np.testing.assert_array_equal(own, known)
    joint = ahead.fit(of)
    assert joint.vectors[0][slip] == pytest.approx(0.08, abs=0.01)
    assert joint.vectors[0][:3] == pytest.approx(GEOMETRY, abs=4e-3)
