"""The channels of a drive: what is measured is compared with what was driven meanwhile."""

from dataclasses import replace

import numpy as np
import pytest

from disco_hw.gap.data.stamp_clock import picked
from disco_hw.gap.noise.channels import BodyChannel
from tests.gap.synthetic import NOISE, line_of, poses_of, vector_of


@pytest.mark.parametrize("nominal", [1.0, 0.8, 1.3])
def test_more_than_half_a_turn_while_no_pose_comes_is_the_turn_of_the_wheels(nominal):
    truth = vector_of()
    line = line_of(np.tile((-6.5, 6.5), (600, 1)))
    clean = poses_of(line, truth)
    there = (line.pose.t_s < 1.0) | (line.pose.t_s > 2.8)
    assert np.diff(clean[there, 2]).max() > np.pi
    yaw = np.unwrap(np.angle(np.exp(1j * clean[there, 2])))
    poses = np.column_stack([clean[there, :2], yaw])
    guess = truth.copy()
    guess[1] *= nominal
    channel = BodyChannel.build(replace(line, pose=picked(line.pose, there), pose_values=poses), NOISE, guess)
    np.testing.assert_allclose(channel.raw_residual(truth), 0.0, atol=1e-9)
