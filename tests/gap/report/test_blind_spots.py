"""What a drive could not have shown: its size is the one at which the effect is found, put into that very drive too."""

import multiprocessing
import os
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.data import BODY, WHEEL
from disco_hw.gap.noise.channels import BodyChannel
from disco_hw.gap.report.blind_spots import (
    BlindSpot,
    being_proved,
    blind_spots,
    boldest_claims,
    side_by_side,
    with_effect,
    with_size,
)
from disco_hw.gap.search.richest_model import candidates_of
from tests.gap.synthetic import LIMITS, body_channel, line_of, searched, selector_of, wheels_on
from tests.tables import thinned


@thinned("name", candidates_of(BODY), quick=4)
def test_poses_of_a_log_into_which_an_effect_is_put_are_those_of_a_robot_that_has_it(name):
    channel, drive = body_channel()
    found = searched(channel)
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
    channel = wheels_on(drive)
    found = searched(channel)
    for name, size in {"motor_lag": 0.1, "command_delay": 0.1, "speed_limit": 4.0, "deadband": 0.5}.items():
        vector = with_size(found, name, size)
        again = wheels_on(with_effect(drive, found, vector))
        before, after = channel.raw_residual(WHEEL.neutral), again.raw_residual(vector)
        assert after == pytest.approx(before, abs=1e-9), name
        assert np.abs(again.raw_residual(WHEEL.neutral) - before).max() > 0.01, name


def spot(name, size, blind=False):
    return BlindSpot(name, REGISTRY[name].parameters[0].name, "", size, blind, "")


def realistic(name):
    return REGISTRY[name].parameters[0].realistic


def judged(spots, finds, most=9):
    with being_proved(spots, boldest_claims(spots, most), finds) as proved:
        return {one.name: one for one in proved()}


@pytest.fixture
def alone(monkeypatch):
    """One processor: everything happens in this process."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})


@pytest.mark.usefixtures("alone")
def test_a_claim_that_is_missed_is_made_for_what_robots_show_and_one_that_is_missed_there_too_is_not_made():
    usual = {name: realistic(name) for name in ("turn_slip", "side_slip", "pose_latency")}
    spots = *(spot(name, 0.3 * size) for name, size in usual.items()), spot("slope", None, True)
    least = {"turn_slip": 0.0, "side_slip": 0.5 * usual["side_slip"], "pose_latency": 1.0}
    tried = []

    def finds(claim, size):
        tried.append((claim.name, size / usual[claim.name]))
        return size > least[claim.name]

    found = judged(spots, finds)
    assert found["turn_slip"] == replace(spots[0], proved=True)
    assert found["side_slip"] == replace(spots[1], smallest_visible=usual["side_slip"], proved=True)
    assert found["pose_latency"] == replace(spots[2], smallest_visible=None, blind=True, proved=False)
    assert found["slope"] == spots[3]
    assert sorted(tried) == [
        (name, pytest.approx(share))
        for name, share in (
            ("pose_latency", 0.3), ("pose_latency", 1.0), ("side_slip", 0.3), ("side_slip", 1.0), ("turn_slip", 0.3)
        )
    ]  # fmt: skip


@pytest.mark.usefixtures("alone")
def test_no_claim_is_bolder_than_a_tenth_of_what_robots_show_of_a_limit_than_ten_times_that():
    slip, limit = realistic("turn_slip"), realistic("yaw_rate_limit")
    found = judged((spot("turn_slip", 0.01 * slip), spot("yaw_rate_limit", 40.0 * limit)), lambda *_: True)
    assert found["turn_slip"].smallest_visible == pytest.approx(0.1 * slip)
    assert found["yaw_rate_limit"].smallest_visible == pytest.approx(10.0 * limit)
    found = judged((spot("yaw_rate_limit", 3.0 * limit),), lambda claim, size: size < 2.0 * limit)
    assert found["yaw_rate_limit"] == replace(spot("yaw_rate_limit", limit), proved=True)
    tried = []
    judged((spot("turn_slip", slip),), lambda claim, size: tried.append(size))
    assert tried == [slip]


@pytest.mark.usefixtures("alone")
def test_what_is_the_same_by_algebra_follows():
    least = realistic("lateral_icr") / 20.0
    spots = spot("lateral_icr", least), spot("pose_offset", least)
    assert [claim.name for claim in boldest_claims(spots, 9)] == ["lateral_icr"]
    found = judged(spots, lambda *_: True)
    assert found["pose_offset"].smallest_visible == found["lateral_icr"].smallest_visible == pytest.approx(2.0 * least)
    assert found["pose_offset"].proved


def test_the_boldest_claims_are_proved_first():
    spots = spot("turn_slip", 0.02), spot("side_slip", 0.0001), spot("slope", 1e9, True), spot("deadband", None)
    assert [one.name for one in boldest_claims(spots, 1)] == ["side_slip"]
    assert [one.name for one in boldest_claims(spots, 9)] == ["side_slip", "turn_slip"]
    with being_proved(spots, spots[1:2], lambda *_: True) as proved:
        assert [one.proved for one in proved()] == [None, None, True, None]


def in_processes(claims, judge, monkeypatch, processors=2, threads=1, meanwhile=lambda: None):
    monkeypatch.setattr(threading, "active_count", lambda: threads)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(processors)))
    with side_by_side(judge, claims) as all_judged:
        meanwhile()
        done = all_judged()
    assert not multiprocessing.active_children()
    return done


def others_end():
    for copy in multiprocessing.active_children():
        copy.join(60.0)


def by_whom(claim):
    return replace(claim, unit=str(os.getpid()))


CLAIMS = [spot(name, 0.1) for name in ("turn_slip", "side_slip", "slope", "deadband", "motor_lag")]


def test_claims_are_judged_while_this_process_does_something_else_and_come_back_in_order(monkeypatch):
    done = in_processes(CLAIMS, by_whom, monkeypatch, meanwhile=others_end)
    assert [replace(one, unit="") for one in done] == CLAIMS
    assert len({one.unit for one in done}) == 1
    assert done[0].unit != str(os.getpid())
    assert in_processes([], by_whom, monkeypatch) == []


def test_there_is_a_process_for_every_other_processor_and_none_without_a_claim(monkeypatch):
    together = multiprocessing.get_context("fork").Barrier(5)

    def judge(claim):
        together.wait(60.0)
        return by_whom(claim)

    done = in_processes(CLAIMS, judge, monkeypatch, processors=9, meanwhile=others_end)
    assert len({one.unit for one in done} - {str(os.getpid())}) == 5


def test_what_no_other_process_has_taken_is_judged_here(monkeypatch):
    fork, here = multiprocessing.get_context("fork"), os.getpid()
    taken, done_here = fork.Event(), fork.Event()

    def judge(claim):
        if os.getpid() != here:
            taken.set()
            done_here.wait(60.0)
            return by_whom(claim)
        taken.wait(60.0)
        if claim == CLAIMS[-1]:
            done_here.set()
        return by_whom(claim)

    # The other process waits with the one that it has until the last one is judged here.
    done = in_processes(CLAIMS, judge, monkeypatch)
    assert [replace(one, unit="") for one in done] == CLAIMS
    assert sum(one.unit == str(here) for one in done) == 4


def test_what_fails_in_another_process_fails_here(monkeypatch):
    def judge(claim):
        return replace(claim, smallest_visible=1 / (claim.name != "side_slip"))

    with pytest.raises(ZeroDivisionError):
        in_processes(CLAIMS[:2], judge, monkeypatch, meanwhile=others_end)
    assert not multiprocessing.active_children()


def test_other_processes_end_with_what_is_done_meanwhile(monkeypatch):
    def judge(claim):
        time.sleep(60.0)
        return claim

    def interrupted():
        assert len(multiprocessing.active_children()) == 1
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        in_processes(CLAIMS, judge, monkeypatch, meanwhile=interrupted)
    assert not multiprocessing.active_children()


def test_another_process_that_is_interrupted_says_nothing_and_its_share_is_judged_here(monkeypatch, capfd):
    here = os.getpid()

    def judge(claim):
        if os.getpid() != here:
            raise KeyboardInterrupt
        return replace(claim, proved=True)

    done = in_processes(CLAIMS, judge, monkeypatch, meanwhile=others_end)
    assert [one.proved for one in done] == [True] * 5
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("of", ["threads", "a helper"])
def test_no_process_is_copied_that_has_other_threads_or_may_have_no_copies(monkeypatch, of):
    if of == "a helper":
        monkeypatch.setattr(multiprocessing, "current_process", lambda: SimpleNamespace(daemon=True))
    threads = 2 if of == "threads" else 1
    done = in_processes(CLAIMS, by_whom, monkeypatch, threads=threads, meanwhile=others_end)
    assert [one.unit for one in done] == [str(os.getpid())] * 5


def test_where_nobody_says_how_many_processors_there_are_no_process_is_copied(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    with side_by_side(by_whom, CLAIMS) as all_judged:
        assert not multiprocessing.active_children()
        assert [one.unit for one in all_judged()] == [str(os.getpid())] * 5


def spots_of(channel, names=(), limits=LIMITS, top_rad_s=None):
    return {spot.name: spot for spot in blind_spots(searched(channel, names, limits), top_rad_s)}


def test_every_effect_that_was_not_found_is_listed_with_the_drive_that_shows_it():
    channel, _ = body_channel(turn_slip=0.08)
    spots = spots_of(channel, ("turn_slip",))
    assert "turn_slip" not in spots
    assert {"side_slip", "slope", "lateral_icr", "pose_offset", "heading_bias", "pose_latency"} <= set(spots)
    for name, spot in spots.items():
        assert f"--script {REGISTRY[name].script}" in spot.experiment
    assert spots["pose_offset"].smallest_visible == spots["lateral_icr"].smallest_visible


@thinned("name", ["turn_slip", "wheel_radius_asymmetry", "lateral_icr"], quick=1)
def test_twice_the_smallest_visible_size_is_found_and_a_third_of_it_is_not(name):
    size = spots_of(body_channel()[0])[name].smallest_visible
    for share, found in ((2.0, True), (1.0 / 3.0, False)):
        channel, _ = body_channel(1, **{name: share * size})
        assert (name in selector_of(channel).select()) is found, (name, share, size)


def test_what_moves_the_prediction_too_little_to_be_reported_is_called_too_small():
    limits = replace(LIMITS, moves_m=0.008)
    size = spots_of(body_channel()[0], limits=limits)["lateral_icr"].smallest_visible
    assert size > 1.5 * spots_of(body_channel()[0])["lateral_icr"].smallest_visible
    for share, found in ((1.2, True), (0.8, False)):
        channel, _ = body_channel(1, lateral_icr=share * size)
        assert ("lateral_icr" in selector_of(channel, limits).select()) is found, (share, size)


def test_a_drive_that_only_goes_straight_is_blind_to_slip_in_turns():
    channel, _ = body_channel()
    straight = line_of(np.full((4000, 2), 4.0))
    from_straight = type(channel).build(straight, channel.noise, channel.neutral)
    spot = spots_of(from_straight)["turn_slip"]
    assert spot.blind
    assert not spots_of(channel)["turn_slip"].blind


def test_how_fast_turning_speeds_up_shows_only_where_the_robot_is_asked_to_turn():
    def spot_at(*commands):
        channel = wheels_on(line_of(np.repeat(commands, 200, axis=0)))
        return spots_of(channel, top_rad_s=8.0)["yaw_acceleration_limit"]

    straight = spot_at(*[(0.0, 0.0), (5.0, 5.0), (-5.0, -5.0)] * 4)
    assert straight.smallest_visible is None
    assert straight.blind
    gentle = spot_at(*[(4.0, 4.0), (3.9, 4.1), (4.1, 3.9)] * 4)
    sharp = spot_at(*[(4.0, 4.0), (-4.0, 4.0), (4.0, -4.0)] * 4)
    assert gentle.smallest_visible is None or gentle.smallest_visible < sharp.smallest_visible
    assert not sharp.blind
    assert "--script spins" in sharp.experiment


def test_no_limit_shows_above_what_was_asked_of_the_robot():
    def spots_at(left, right, top_rad_s):
        return spots_of(wheels_on(line_of(np.full((4000, 2), (left, right)))), top_rad_s=top_rad_s)

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


@thinned("top_rad_s", [0.5, 2.0, 5.0, 8.0, 50.0, None], quick=2)
def test_whether_a_drive_is_blind_is_a_plain_truth_value_however_slowly_the_robot_turns(top_rad_s):
    for speeds in ((0.0, 0.0), (4.0, 4.0), (-1.5, 1.5), (-40.0, 40.0)):
        for spot in spots_of(wheels_on(line_of(np.full((4000, 2), speeds))), top_rad_s=top_rad_s).values():
            assert type(spot.blind) is bool, spot.name
            assert spot.smallest_visible is None or type(spot.smallest_visible) is float, spot.name
