"""From a hidden effect to better driving, by the daemon's own tick in simulated time and one command."""

import json

import pytest
from typer.testing import CliRunner

from disco_hw.cli import app
from disco_hw.model import load_model

# Compiling for two models takes most of it.
pytestmark = [pytest.mark.hil, pytest.mark.long, pytest.mark.timeout(900)]


def test_what_is_found_in_a_minutes_log_makes_the_circle_better(tmp_path):
    arguments = ["experiment", "gap", "--hide", "deadband=0.8", "--script", "separate", "--laps", "0.6", "--json"]
    done = CliRunner().invoke(app(), [*arguments, "-o", str(tmp_path)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)
    assert "deadband" in result["found"]
    assert result["gap_m"]["amended"] < 0.4 * result["gap_m"]["refitted"]
    found = {setting.name: setting.values for setting in load_model(tmp_path / "model.toml").effects}
    assert found["deadband"]["width_rad_s"] == pytest.approx(0.8, abs=0.03)
    circle = {run: lap["mean_cost"] for run, lap in result["circle"].items()}
    assert circle["amended"] < 0.7 * circle["given"]
    assert circle["amended"] < 0.7 * circle["geometry refitted"]
    for name in ("experiment.png", "experiment.csv", "experiment.json", "report.html", "drive.mcap"):
        assert (tmp_path / name).stat().st_size > 100


def test_an_effect_that_does_not_exist_is_refused_in_one_line(tmp_path):
    done = CliRunner().invoke(app(), ["experiment", "gap", "--hide", "rust=1", "-o", str(tmp_path)])
    assert done.exit_code != 0
