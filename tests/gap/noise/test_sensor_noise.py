"""The sensors' noise is measured from samples next to each other, whatever the model lacks or believes of noise."""

from dataclasses import replace

import numpy as np
import pytest

from disco_hw.gap.noise import sensor_noise
from disco_hw.gap.noise.channels import BodyChannel
from disco_hw.gap.search.cross_validation import Chain, errors_of, floor_errors, smoothed_poses
from tests.gap.synthetic import NOISE, body_channel, vector_of


def measured_with(position_m, yaw_rad, believed=NOISE):
    """A drive of a robot whose turning slips, which is not in the channel's geometry, and the truth."""
    channel, line = body_channel(turn_slip=0.1)
    truth = vector_of(turn_slip=0.1)
    draws = np.random.default_rng(5).standard_normal(line.pose_values.shape)
    track = channel.track(truth)[line.pose.node]
    return BodyChannel.build(
        replace(line, pose_values=track + draws * (position_m, position_m, yaw_rad)), believed, channel.neutral
    ), truth


@pytest.mark.parametrize(("position_m", "yaw_rad"), [(0.002, 0.002), (0.008, 0.01), (0.03, 0.03)])
def test_injected_noise_is_measured_within_a_fifth_by_a_model_that_lacks_an_effect(position_m, yaw_rad):
    channel, _ = measured_with(position_m, yaw_rad)
    found = sensor_noise(channel, channel.neutral)
    assert found.position_m == pytest.approx(position_m, rel=0.2)
    assert found.yaw_rad == pytest.approx(yaw_rad, rel=0.2)


@pytest.mark.parametrize("position_m", [0.003, 0.012])
def test_the_floor_is_what_the_true_model_errs_by_whatever_is_believed_of_noise(position_m):
    channel, truth = measured_with(position_m, 0.006, replace(NOISE, position_m=0.05, yaw_rad=0.1))
    poses = smoothed_poses(channel, truth)
    floor = floor_errors(channel, sensor_noise(channel, channel.neutral), 2.0, poses)
    exact = errors_of(channel, None, dict.fromkeys((0, 1), Chain(truth, None)), 2.0, poses)
    assert floor.position_m == pytest.approx(exact.position_m, rel=0.2)
    assert floor.yaw_rad == pytest.approx(exact.yaw_rad, rel=0.2)


def test_single_jumps_of_a_pose_are_no_noise_of_every_pose():
    channel, _ = measured_with(0.004, 0.004)
    jumped = channel.measured.copy()
    jumped[:: jumped.shape[0] // 5, :2] += 1.0
    found = sensor_noise(replace(channel, measured=jumped), channel.neutral)
    assert found.position_m == pytest.approx(0.004, rel=0.3)
