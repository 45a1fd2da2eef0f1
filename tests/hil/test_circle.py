"""The paper's circle, driven by the real daemon with the paper's posterior on a plant drawn from it."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import warnings

import pytest

pytestmark = pytest.mark.hil


# What is judged begins after a quarter lap.
@pytest.mark.parametrize(
    ("link", "plant_seed", "laps"), [("can", 3, 0.6), pytest.param("serial", 4, 1.0, marks=pytest.mark.long)]
)
def test_demo_follows_the_circle(tmp_path, link, plant_seed, laps):
    result = subprocess.run(
        [
            sys.executable, "-m", "disco_hw", "demo", "--json", "--link", link, "--laps", str(laps),
            "--plant-seed", str(plant_seed), "--out", str(tmp_path),
        ],
        capture_output=True,
        text=True,
        timeout=160,
        check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    if "driving anew" in result.stderr:
        warnings.warn(f"driven twice: {result.stderr}", stacklevel=1)
    figures = json.loads(result.stdout)
    assert figures["success"]
    assert figures["circle"]["laps"] >= laps - 0.02
    assert figures["circle"]["settled_rms_distance_m"] < 0.02
    assert figures["estimation"]["rms_position_m"] < 0.01
    assert figures["estimation"]["rms_yaw_rad"] < math.radians(1.0)
    assert figures["frames"]["rejected"] == 0
    assert (tmp_path / "demo.mcap").stat().st_size > 100_000
    assert (tmp_path / "circle.png").read_bytes().startswith(b"\x89PNG")
    replayed = subprocess.run(
        [sys.executable, "-m", "disco_hw", "replay", "--json", str(tmp_path / "demo.mcap")],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr
