"""What a drive could not have shown: its size is the one at which the effect begins to be found."""

import numpy as np
import pytest

from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.noise.channels import WheelChannel
from disco_hw.gap.noise.wheel_noise import WheelNoise
from disco_hw.gap.report.blind_spots import blind_spots
from disco_hw.gap.search.channel_search import ChannelResult, body_moves, wheel_moves
from disco_hw.gap.search.selection import Selector, Thresholds
from tests.gap.synthetic import GEOMETRY, body_channel, line_of


def spots_of(channel, names=(), limits=None):
    selector = Selector(channel, body_moves(channel), limits or Thresholds())
    return {spot.name: spot for spot in blind_spots(ChannelResult(selector, names, channel))}


def test_every_effect_that_was_not_found_is_listed_with_the_drive_that_shows_it():
    channel, _ = body_channel(turn_slip=0.08)
    spots = spots_of(channel, ("turn_slip",))
    assert "turn_slip" not in spots
    assert {"side_slip", "slope", "lateral_icr", "pose_offset", "heading_bias", "pose_latency"} <= set(spots)
    for name, spot in spots.items():
        assert f"--script {REGISTRY[name].script}" in spot.experiment
    assert spots["pose_offset"].smallest_visible == spots["lateral_icr"].smallest_visible


@pytest.mark.parametrize("name", ["turn_slip", "wheel_radius_asymmetry", "lateral_icr"])
def test_twice_the_smallest_visible_size_is_found_and_a_third_of_it_is_not(name):
    size = spots_of(body_channel()[0])[name].smallest_visible
    for share, found in ((2.0, True), (1.0 / 3.0, False)):
        channel, _ = body_channel(1, **{name: share * size})
        assert (name in Selector(channel, body_moves(channel)).select()) is found, (name, share, size)


def test_what_moves_the_prediction_too_little_to_be_reported_is_called_too_small():
    limits = Thresholds(moves_m=0.008)
    size = spots_of(body_channel()[0], limits=limits)["lateral_icr"].smallest_visible
    assert size > 1.5 * spots_of(body_channel()[0])["lateral_icr"].smallest_visible
    for share, found in ((1.2, True), (0.8, False)):
        channel, _ = body_channel(1, lateral_icr=share * size)
        assert ("lateral_icr" in Selector(channel, body_moves(channel), limits).select()) is found, (share, size)


def test_a_drive_that_only_goes_straight_is_blind_to_slip_in_turns():
    channel, _ = body_channel()
    straight = line_of(np.full((4000, 2), 4.0))
    from_straight = type(channel).build(straight, channel.noise, channel.neutral)
    spot = spots_of(from_straight)["turn_slip"]
    assert spot.blind
    assert not spots_of(channel)["turn_slip"].blind


def test_how_fast_turning_speeds_up_shows_only_where_the_robot_is_asked_to_turn():
    geometry = np.array(GEOMETRY)

    def spot_at(*commands):
        channel = WheelChannel.build(line_of(np.repeat(commands, 200, axis=0)), WheelNoise(), geometry)
        found = ChannelResult(Selector(channel, wheel_moves(channel, geometry)), (), channel)
        return {spot.name: spot for spot in blind_spots(found, 8.0)}["yaw_acceleration_limit"]

    straight = spot_at(*[(0.0, 0.0), (5.0, 5.0), (-5.0, -5.0)] * 4)
    assert straight.smallest_visible is None
    assert straight.blind
    gentle = spot_at(*[(4.0, 4.0), (3.9, 4.1), (4.1, 3.9)] * 4)
    sharp = spot_at(*[(4.0, 4.0), (-4.0, 4.0), (4.0, -4.0)] * 4)
    assert gentle.smallest_visible is None or gentle.smallest_visible < sharp.smallest_visible
    assert not sharp.blind
    assert "--script spins" in sharp.experiment


def test_no_limit_shows_above_what_was_asked_of_the_robot():
    geometry = np.array(GEOMETRY)

    def spots_at(left, right, top_rad_s):
        channel = WheelChannel.build(line_of(np.full((4000, 2), (left, right))), WheelNoise(), geometry)
        found = ChannelResult(Selector(channel, wheel_moves(channel, geometry)), (), channel)
        return {spot.name: spot for spot in blind_spots(found, top_rad_s)}

    # A steady circle at half speed: 0.3 rad/s of turning.
    slow = spots_at(3.0, 5.0, 10.0)
    assert slow["speed_limit"].smallest_visible == pytest.approx(0.97 * 5.0)
    assert slow["speed_limit"].blind
    assert slow["yaw_rate_limit"].blind
    spinning = spots_at(-7.9, 7.9, 10.0)
    assert not spinning["speed_limit"].blind
    assert not spinning["yaw_rate_limit"].blind
    # A robot that turns no faster: its own largest yaw rate is enough.
    assert not spots_at(-2.0, 2.0, 2.5)["yaw_rate_limit"].blind
    # Without knowing what the robot can do, a speed limit above what was asked cannot be called hidden.
    assert not spots_at(3.0, 5.0, None)["speed_limit"].blind


@pytest.mark.parametrize("top_rad_s", [0.5, 2.0, 5.0, 8.0, 50.0, None])
def test_whether_a_drive_is_blind_is_a_plain_truth_value_however_slowly_the_robot_turns(top_rad_s):
    geometry = np.array(GEOMETRY)
    for speeds in ((0.0, 0.0), (4.0, 4.0), (-1.5, 1.5), (-40.0, 40.0)):
        channel = WheelChannel.build(line_of(np.full((4000, 2), speeds)), WheelNoise(), geometry)
        found = ChannelResult(Selector(channel, wheel_moves(channel, geometry)), (), channel)
        for spot in blind_spots(found, top_rad_s):
            assert type(spot.blind) is bool, spot.name
            assert spot.smallest_visible is None or type(spot.smallest_visible) is float, spot.name
