import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from disco_hw.config import Prior, Robot, RobotConfig
from disco_hw.errors import InputError
from disco_hw.inference.infer import InferOptions, infer, prior_region
from disco_hw.inference.simulate import NAMES
from disco_hw.log.drive import Wheels
from disco_hw.log.load import load_drive
from tests.inference.drives import THETA, logged, robot_config
from tests.tables import thinned

REAL_LOGS = os.environ.get("DISCO_HW_DATA")
FEW = InferOptions(simulations=600, seed=3)


@pytest.mark.thorough
def test_the_same_seed_gives_the_same_posterior():
    first, again = (infer(logged("circle"), robot_config(), FEW) for _ in range(2))
    assert np.array_equal(again.draws, first.draws)


@pytest.mark.thorough
def test_a_log_without_encoders_is_driven_by_its_commands():
    log = logged("circle")
    blind = replace(log, wheels=Wheels())
    found = infer(blind, robot_config(), FEW)
    assert found.drive.source == "commands"
    assert found.draws.mean(axis=0) == pytest.approx(THETA, rel=0.05)


@pytest.mark.thorough
def test_the_papers_way_leaves_the_wheel_radius_as_wide_as_the_prior():
    found = infer(logged("circle"), robot_config(), InferOptions(paper=True, seed=3))
    assert found.drive.source == "commands"
    assert found.observed.shape == (4,)
    assert found.fitted.simulations == 1000
    sd = found.draws.std(axis=0)
    assert sd[NAMES.index("wheel_radius_m")] > 0.6 * 0.5 / np.sqrt(12.0)
    assert any("wheel radius" in sentence for sentence in found.undetermined)


@thinned("seed", [1, 2, 3], quick=1)
def test_a_robot_outside_the_prior_is_said_to_be(seed):
    with pytest.raises(InputError, match=r"prior\.wheel_radius_m: the log points to 0\.06, outside .*; widen it"):
        infer(logged("circle"), robot_config(wheel_radius_m=(0.0, 0.05)), InferOptions(simulations=600, seed=seed))


def test_too_few_simulations_are_refused():
    with pytest.raises(InputError, match="--simulations 20: too few"):
        infer(logged("circle"), robot_config(), InferOptions(simulations=20))


def test_an_impossible_prior_is_refused():
    with pytest.raises(InputError, match=r"prior\.wheel_radius_m.*impossible; write a range within \[0\.\d+, \d"):
        prior_region(robot_config(wheel_radius_m=(-1.0, 0.001)))


@pytest.mark.timeout(600)
@pytest.mark.skipif(REAL_LOGS is None, reason="set DISCO_HW_DATA to a folder with measured logs")
@pytest.mark.parametrize("run", ["circular_20201223_0121_run01", "square_20200623_2042_run01"])
def test_a_real_differential_drive_is_recovered(run):
    robot = Robot(
        name="small", wheel_radius_m=0.042, axial_distance_m=0.2, ticks_per_rev=2797, max_wheel_speed_rad_s=20.0
    )
    log = load_drive(Path(REAL_LOGS) / "optiodom" / f"{run}.csv", 2796.8, 0.042)
    found = infer(log, RobotConfig(robot=robot, prior=Prior(x_icr_m=(-0.1, 0.1))), FEW)
    _, radius, axial = found.draws.mean(axis=0)
    assert radius == pytest.approx(0.0419, rel=0.02)
    assert axial == pytest.approx(0.2018, rel=0.02)


@pytest.mark.timeout(600)
@pytest.mark.skipif(REAL_LOGS is None, reason="set DISCO_HW_DATA to a folder with measured logs")
def test_a_real_skid_steer_robot_is_recovered_and_said_to_differ_from_the_model():
    robot = Robot(
        name="large", wheel_radius_m=0.162, axial_distance_m=0.481, ticks_per_rev=7800, max_wheel_speed_rad_s=10.0
    )
    prior = Prior(x_icr_m=(-0.5, 0.5), wheel_radius_m=(0.05, 0.5), axial_distance_m=(0.2, 2.0))
    found = infer(
        load_drive(Path(REAL_LOGS) / "husky" / "husky_tile_deflated_20231212.csv"),
        RobotConfig(robot=robot, prior=prior),
        FEW,
    )
    assert found.draws[:, NAMES.index("axial_distance_m")].mean() == pytest.approx(0.98, rel=0.05)
    assert found.predictive.outside_simulated
