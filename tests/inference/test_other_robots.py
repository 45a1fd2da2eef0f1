"""Robots of other sizes than the paper's, with nothing but [robot] filled in."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from disco_hw.config import load_robot_config
from disco_hw.inference.infer import InferOptions, infer
from disco_hw.inference.simulate import NAMES
from disco_hw.log.load import load_drive
from tests.inference.drives import write_log
from tests.tables import thinned

REAL_LOGS = os.environ.get("DISCO_HW_DATA")
FEW = InferOptions(simulations=600, seed=3)


def robot_file(directory: Path, radius_m: float, track_m: float, ticks_per_rev: float = 2048.0) -> Path:
    path = directory / "robot.toml"
    path.write_text(
        f'[robot]\nname = "other"\nwheel_radius_m = {radius_m}\naxial_distance_m = {track_m}\n'
        f"ticks_per_rev = {ticks_per_rev}\nmax_wheel_speed_rad_s = 20.0\n"
    )
    return path


def inferred(robot: Path, log: Path) -> dict[str, float]:
    config = load_robot_config(robot)
    drive = load_drive(log, config.robot.ticks_per_rev, config.robot.wheel_radius_m)
    return dict(zip(NAMES, infer(drive, config, FEW).draws.mean(axis=0).tolist(), strict=True))


@pytest.mark.thorough
@thinned(
    ("radius_m", "track_m", "truth"),
    [
        (0.165, 0.54, {"wheel_radius_m": 0.165, "axial_distance_m": 1.1, "x_icr_m": -0.15}),
        (0.04, 0.2, {"wheel_radius_m": 0.042, "axial_distance_m": 0.2, "x_icr_m": 0.0}),
    ],
    quick=1,
    ids=["as large as a Husky", "a small differential drive"],
)
def test_the_prior_of_a_robot_that_says_nothing_of_it_holds_the_robot(tmp_path, radius_m, track_m, truth):
    log = write_log(tmp_path / "drive.csv", "circle", **truth)
    found = inferred(robot_file(tmp_path, radius_m, track_m), log)
    assert found["wheel_radius_m"] == pytest.approx(truth["wheel_radius_m"], rel=0.03)
    assert found["axial_distance_m"] == pytest.approx(truth["axial_distance_m"], rel=0.03)
    assert found["x_icr_m"] == pytest.approx(truth["x_icr_m"], abs=0.02 * truth["axial_distance_m"])


# Plain least squares of r, a and x_icr over windows of 1 s of the same logs (soft L1 loss of 3 cm).
@pytest.mark.timeout(600)
@pytest.mark.skipif(REAL_LOGS is None, reason="set DISCO_HW_DATA to a folder with measured logs")
@pytest.mark.parametrize(
    ("log", "radius_m", "track_m", "ticks_per_rev", "least_squares"),
    [
        ("husky/husky_tile_deflated_20231212", 0.161827, 0.480865, 7800.0, (-0.1465, 0.1534, 0.978)),
        ("warthog/warthog_asphalt_20240920_0813", 0.30, 1.08, 7800.0, (-0.052, 0.2854, 1.948)),
        ("warthog/warthog_grass_20240718_a", 0.30, 1.08, 7800.0, (0.067, 0.2855, 1.664)),
        ("optiodom/circular_20201223_0121_run01", 0.042, 0.2, 2796.8, (0.0055, 0.0420, 0.2018)),
        ("optiodom/square_20200623_2042_run01", 0.042, 0.2, 2796.8, (0.0005, 0.0419, 0.2009)),
        ("optiodom/free_20210103_0001_run01", 0.042, 0.2, 2796.8, (0.0009, 0.0419, 0.2020)),
    ],
)
def test_a_measured_drive_gives_what_least_squares_gives(
    tmp_path, log, radius_m, track_m, ticks_per_rev, least_squares
):
    found = inferred(robot_file(tmp_path, radius_m, track_m, ticks_per_rev), Path(str(REAL_LOGS)) / f"{log}.csv")
    x_icr_m, wheel_radius_m, axial_distance_m = least_squares
    assert found["wheel_radius_m"] == pytest.approx(wheel_radius_m, rel=0.04)
    assert found["axial_distance_m"] == pytest.approx(axial_distance_m, rel=0.10)
    assert found["x_icr_m"] == pytest.approx(x_icr_m, abs=0.05 * track_m)
    assert np.isfinite(list(found.values())).all()
