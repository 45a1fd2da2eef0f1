"""An effect that is put into a log leaves the residuals of a robot that has it, and claims follow what is found."""

from dataclasses import replace

import numpy as np
import pytest

from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.data.layout import BODY, WHEEL
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.noise.wheel_noise import WheelNoise
from disco_hw.gap.report.blind_spots import BlindSpot
from disco_hw.gap.report.injection import proved, with_effect, with_size
from disco_hw.gap.search.channel_search import ChannelResult, body_moves, wheel_moves
from disco_hw.gap.search.richest_model import candidates_of
from disco_hw.gap.search.selection import Selector
from tests.gap.synthetic import GEOMETRY, body_channel


@pytest.mark.parametrize("name", candidates_of(BODY))
def test_poses_of_a_log_into_which_an_effect_is_put_are_those_of_a_robot_that_has_it(name):
    channel, drive = body_channel()
    found = ChannelResult(Selector(channel, body_moves(channel)), (), channel)
    size = REGISTRY[name].parameters[0].realistic or REGISTRY[name].parameters[0].start
    vector = with_size(found, name, size)
    changed = with_effect(drive, found, vector)
    again = BodyChannel.build(changed, channel.noise, channel.neutral)
    before, after = channel.raw_residual(found.fit.vector), again.raw_residual(vector)
    # Without the effect in the model the poses do not fit.
    missing = again.raw_residual(found.fit.vector)
    assert np.sqrt(((after - before) ** 2).mean()) < 0.001
    assert np.sqrt(((missing - before) ** 2).mean()) > 3.0 * np.sqrt(((after - before) ** 2).mean())


def test_wheels_of_a_log_into_which_an_effect_is_put_are_those_of_a_robot_that_has_it():
    _, drive = body_channel()
    geometry = np.array(GEOMETRY)
    channel = WheelChannel.build(drive, WheelNoise(), geometry)
    found = ChannelResult(Selector(channel, wheel_moves(channel, geometry)), (), channel)
    for name, size in {"motor_lag": 0.1, "command_delay": 0.1, "speed_limit": 4.0, "deadband": 0.5}.items():
        vector = with_size(found, name, size)
        again = WheelChannel.build(with_effect(drive, found, vector), WheelNoise(), geometry)
        before, after = channel.raw_residual(WHEEL.neutral), again.raw_residual(vector)
        assert after == pytest.approx(before, abs=1e-9), name
        assert np.abs(again.raw_residual(WHEEL.neutral) - before).max() > 0.01, name


def spot(name, size, blind=False):
    return BlindSpot(name, REGISTRY[name].parameters[0].name, "", size, blind, "")


def test_a_claim_that_is_found_only_at_twice_its_size_is_made_for_that_and_one_that_is_not_is_not_made():
    spots = spot("turn_slip", 0.001), spot("side_slip", 0.001), spot("pose_latency", 0.001), spot("slope", None, True)
    least = {"turn_slip": 0.0, "side_slip": 0.0015, "pose_latency": 1.0}
    tried = []

    def finds(claim, size):
        tried.append((claim.name, size))
        return size > least[claim.name]

    judged = {one.name: one for one in proved(spots, finds, 3)}
    assert judged["turn_slip"] == replace(spots[0], proved=True)
    assert judged["side_slip"] == replace(spots[1], smallest_visible=0.002, proved=True)
    assert judged["pose_latency"] == replace(spots[2], smallest_visible=None, blind=True, proved=False)
    assert judged["slope"] == spots[3]
    assert len(tried) == 5


def test_of_a_limit_half_of_it_is_tried_and_what_is_the_same_by_algebra_follows():
    spots = spot("yaw_rate_limit", 100.0), spot("lateral_icr", 0.001), spot("pose_offset", 0.001)
    judged = {one.name: one for one in proved(spots, lambda claim, size: size != 0.001 and size < 60.0, 9)}
    assert judged["yaw_rate_limit"].smallest_visible == 50.0
    assert judged["pose_offset"].smallest_visible == judged["lateral_icr"].smallest_visible == 0.002
    assert judged["pose_offset"].proved


def test_the_boldest_claims_are_proved_first():
    spots = spot("turn_slip", 0.02), spot("side_slip", 0.0001)
    assert [one.proved for one in proved(spots, lambda *_: True, 1)] == [None, True]
