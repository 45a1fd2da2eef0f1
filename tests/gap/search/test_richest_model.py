"""The richest model takes what has no name out of the noise."""

from functools import cache

import numpy as np
import pytest

from disco_hw.gap.data import WHEEL
from disco_hw.gap.data.gridded_drive import grid_drive
from disco_hw.gap.noise import largest_command_jitter_s, learn_wheel_noise
from disco_hw.gap.noise.channels import WheelChannel
from disco_hw.gap.noise.wheel_noise import WheelNoise
from disco_hw.gap.search.richest_model import learn_saturated_wheels
from tools.gap.logs import simulated_drive

pytestmark = pytest.mark.long

GEOMETRY = np.array([0.061, 0.415, 0.238])


@cache
def learnt(*hidden):
    line = grid_drive(simulated_drive(dict(hidden), seed=905))
    channel = WheelChannel.build(line, WheelNoise(reading_rad=line.quantum_rad), GEOMETRY)
    plain = learn_wheel_noise(channel, channel.raw_residual(WHEEL.neutral))
    return plain, learn_saturated_wheels(plain, WHEEL.neutral)[0]


def test_the_noise_of_a_sound_robot_is_what_the_simulator_makes():
    _, channel = learnt()
    assert channel.noise.relative == pytest.approx(0.015, rel=0.15)
    assert channel.noise.correlation_s == pytest.approx(0.15, rel=0.35)
    assert channel.noise.reading_rad == pytest.approx(2 * np.pi / 2048 / 12**0.5, rel=0.2)


def test_what_has_no_name_does_not_pass_for_noise():
    plain, channel = learnt(("acceleration_limit", 8.0))
    assert plain.noise.relative > 0.03
    assert channel.noise.relative < 0.022
    assert channel.noise.command_stamp_s <= 1.001 * largest_command_jitter_s(channel.drive)
