"""The gap by stage, on a short drive whose wheels lag and whose body slips, without the searches before it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from disco_hw.gap.data import BODY, WHEEL
from disco_hw.gap.noise.channels import BodyChannel
from disco_hw.gap.noise.wheel_noise import WheelNoise
from disco_hw.gap.search import joint_predictions, stage_predictions
from disco_hw.gap.search.analysis import GapAnalysis, final_fit
from disco_hw.gap.settings import DEFAULT_SETTINGS
from tests.gap.synthetic import DRIVE, GEOMETRY, NOISE, answered, body_on, searched, vector_of, wheels_on

LAG_S, SLIP_S = 0.2, 0.08
LAG, SLIP = WHEEL.place["motor_lag.tau_s"], BODY.place["turn_slip.k_s"]


@cache
def driven(repeats=2):
    command = np.repeat(np.array(DRIVE * repeats, dtype=float), 200, axis=0)
    line, rng = answered(command, motor_lag=LAG_S), np.random.default_rng(8)
    read = line.encoder_angle_rad + 1e-3 * rng.standard_normal((line.encoder.node.size, 2))
    track = body_on(line, line.pose_values).track(vector_of(turn_slip=SLIP_S))
    poses = track[line.pose.node] + rng.standard_normal((line.pose.node.size, 3)) * (0.004, 0.004, 0.006)
    return replace(line, encoder_angle_rad=read, pose_values=poses)


def analysed(body_names=("turn_slip",), wheel_names=("motor_lag",), commands=True):
    line = driven()
    # What is believed of the geometry is a little off.
    nominal = BODY.neutral.copy()
    nominal[:3] = 0.062, 0.38, 0.12
    body = BodyChannel.build(line, NOISE, nominal)
    found = searched(body, body_names)
    wheels = None
    if commands:
        channel = wheels_on(line, WheelNoise(reading_rad=1e-3))
        wheels = searched(channel, wheel_names)
    return GapAnalysis(line, nominal, WHEEL.neutral, found, wheels)


@cache
def predicted():
    analysis = analysed()
    return analysis, joint_predictions(analysis, final_fit(analysis))


def test_each_stage_has_what_it_may_have_and_no_more():
    analysis, stages = predicted()
    assert set(stages.chains) == {"nominal", "refitted", "timed", "amended"}
    every = range(analysis.drive.folds.count)
    assert all(set(folds) == set(every) for folds in stages.chains.values())
    for fold in every:
        chain = {stage: folds[fold] for stage, folds in stages.chains.items()}
        assert (chain["nominal"].body == analysis.nominal_body).all()
        assert (chain["nominal"].wheels == analysis.nominal_wheels).all()
        for stage in ("refitted", "timed"):
            assert chain[stage].body[3:] == pytest.approx(analysis.nominal_body[3:])
        assert chain["refitted"].wheels == pytest.approx(WHEEL.neutral)
        assert chain["timed"].wheels[LAG] == pytest.approx(LAG_S, abs=0.05)
        assert chain["amended"].wheels[LAG] == pytest.approx(LAG_S, abs=0.01)
        assert chain["amended"].body[SLIP] == pytest.approx(SLIP_S, abs=0.02)
        assert chain["amended"].body[:3] == pytest.approx(GEOMETRY, abs=5e-3)


def test_each_stage_predicts_better_than_the_one_before_and_the_last_as_well_as_the_poses_allow():
    _, stages = predicted()
    table = stages.table()
    assert stages.scored_horizon_s == 2.0
    assert set(table["floor"]) == set(DEFAULT_SETTINGS.prediction.horizons_s)
    sizes = [table[stage][2.0].position_m for stage in ("nominal", "refitted", "timed", "amended")]
    assert sizes == sorted(sizes, reverse=True)
    assert stages.errors("timed").position_m == sizes[2]
    assert stages.errors("timed", 0.5).position_m == table["timed"][0.5].position_m
    assert sizes[3] == pytest.approx(table["floor"][2.0].position_m, rel=0.25)
    assert table["amended"][2.0].yaw_rad == pytest.approx(table["floor"][2.0].yaw_rad, rel=0.25)


def test_what_was_freed_is_told_with_the_fit_of_all_data():
    _, stages = predicted()
    for stage, names in {
        "refitted": ("wheel_radius_m", "axial_distance_m", "x_icr_m"),
        "timed": ("wheel_radius_m", "axial_distance_m", "x_icr_m", "motor_lag.tau_s", "command_delay.delay_s"),
    }.items():
        of, joint = stages.joint[stage]
        assert of.names == joint.names == names
        assert joint.covariance.shape == (len(names), len(names))
    of, joint = stages.joint["amended"]
    assert {"turn_slip.k_s", "motor_lag.tau_s"} < set(joint.names)
    value = joint.value("motor_lag.tau_s", of)
    assert value == pytest.approx(LAG_S, abs=0.01)


def test_channels_fitted_apart_are_told_at_once():
    analysis = analysed()
    apart = stage_predictions(analysis, final_fit(analysis))
    assert set(apart.chains) == {"refitted", "amended"}
    assert not apart.joint
    for fold in (0, 1):
        refitted, amended = (apart.chains[stage][fold] for stage in ("refitted", "amended"))
        assert refitted.body[SLIP] == 0.0
        assert refitted.body[1] == pytest.approx(GEOMETRY[1] * (1.0 + SLIP_S), rel=0.1)
        assert amended.body[SLIP] == pytest.approx(SLIP_S, abs=0.01)
        assert amended.wheels[LAG] == pytest.approx(LAG_S, abs=0.005)
    assert apart.errors("amended").position_m < 0.5 * apart.errors("refitted").position_m


def test_without_commands_there_is_nothing_to_time():
    analysis = analysed(commands=False)
    stages = joint_predictions(analysis, final_fit(analysis))
    assert {chain.wheels is None for folds in stages.chains.values() for chain in folds.values()} == {True}
    refitted, timed = (stages.joint[stage][1] for stage in ("refitted", "timed"))
    assert timed.names == refitted.names
    assert stages.errors("timed").yaw_rad == pytest.approx(stages.errors("refitted").yaw_rad, rel=0.01)
    assert stages.errors("amended").yaw_rad < 0.7 * stages.errors("timed").yaw_rad
