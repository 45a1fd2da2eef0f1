"""What a drive could not have shown: its size is the one at which the effect is found, put into that very drive too."""

from dataclasses import replace

import numpy as np
import pytest

from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.data import BODY, WHEEL
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.noise.wheel_noise import WheelNoise
from disco_hw.gap.report.blind_spots import BlindSpot, blind_spots, proved, with_effect, with_size
from disco_hw.gap.search.channel_result import ChannelResult
from disco_hw.gap.search.richest_model import candidates_of
from disco_hw.gap.search.selection import Selector, body_moves, wheel_moves
from tests.gap.synthetic import GEOMETRY, LIMITS, body_channel, line_of


@pytest.mark.parametrize("name", candidates_of(BODY))
def test_poses_of_a_log_into_which_an_effect_is_put_are_those_of_a_robot_that_has_it(name):
    channel, drive = body_channel()
    found = ChannelResult(Selector(channel, body_moves(channel), LIMITS), (), channel)
    size = REGISTRY[name].parameters[0].realistic or REGISTRY[name].parameters[0].start
    vector = with_size(found, name, size)
    changed = with_effect(drive, found, vector)
    again = BodyChannel.build(changed, channel.noise, channel.neutral)

    def off(channel, vector):
        # However far the effect turns a robot on the whole: how far off the poses are, and their yaw.
        x, y, yaw = channel.raw_residual(vector).T
        return np.column_stack([np.hypot(x, y), yaw])

    before, after = off(channel, found.fit.vector), off(again, vector)
    # Without the effect in the model the poses do not fit.
    missing = off(again, found.fit.vector)
    assert np.sqrt(((after - before) ** 2).mean()) < 0.001
    assert np.sqrt(((missing - before) ** 2).mean()) > 3.0 * np.sqrt(((after - before) ** 2).mean())


def test_wheels_of_a_log_into_which_an_effect_is_put_are_those_of_a_robot_that_has_it():
    _, drive = body_channel()
    geometry = np.array(GEOMETRY)
    channel = WheelChannel.build(drive, WheelNoise(), geometry)
    found = ChannelResult(Selector(channel, wheel_moves(channel, geometry), LIMITS), (), channel)
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


def spots_of(channel, names=(), limits=None):
    selector = Selector(channel, body_moves(channel), limits or LIMITS)
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
        assert (name in Selector(channel, body_moves(channel), LIMITS).select()) is found, (name, share, size)


def test_what_moves_the_prediction_too_little_to_be_reported_is_called_too_small():
    limits = replace(LIMITS, moves_m=0.008)
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
        found = ChannelResult(Selector(channel, wheel_moves(channel, geometry), LIMITS), (), channel)
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
        found = ChannelResult(Selector(channel, wheel_moves(channel, geometry), LIMITS), (), channel)
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
        found = ChannelResult(Selector(channel, wheel_moves(channel, geometry), LIMITS), (), channel)
        for spot in blind_spots(found, top_rad_s):
            assert type(spot.blind) is bool, spot.name
            assert spot.smallest_visible is None or type(spot.smallest_visible) is float, spot.name
