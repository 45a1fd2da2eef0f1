"""The virtual robot's true parameters: the model's mean, or a draw from its belief."""

from __future__ import annotations

import numpy as np
import pytest
from typer.testing import CliRunner

from disco_hw.cli import app
from disco_hw.config import SHIPPED_ROBOT
from disco_hw.errors import InputError
from disco_hw.experiments import virtual, with_device
from disco_hw.experiments.virtual import run_sim, true_parameters
from disco_hw.runtime.robot_setup import load_setup
from tests.runtime.simulated import ROBOT_TEXT


def test_without_a_seed_the_plant_is_the_mean():
    plant = true_parameters(load_setup(SHIPPED_ROBOT), None)
    assert (plant.wheel_radius_m, plant.axial_distance_m, plant.x_icr_m) == (0.061, 0.415, 0.238)


def test_draws_have_the_posteriors_spread_parameter_by_parameter():
    setup = load_setup(SHIPPED_ROBOT)
    plants = [true_parameters(setup, seed) for seed in range(400)]
    samples = np.array([(p.wheel_radius_m, p.axial_distance_m, p.x_icr_m) for p in plants])
    assert samples.mean(0) == pytest.approx((0.061, 0.415, 0.238), abs=0.003)
    assert samples.std(0) == pytest.approx((0.01225, 0.00949, 0.0114), rel=0.15)


def test_the_plain_robot_is_the_one_that_its_model_describes(monkeypatch):
    played = []
    monkeypatch.setattr(virtual, "run_virtual_robot", played.append)
    run_sim(SHIPPED_ROBOT)
    (options,) = played
    assert options.plant == options.plant.with_ideal_motors()
    assert options.effects == {}
    run_sim(SHIPPED_ROBOT, hide=("motor_lag=0.06",))
    assert played[1].plant == options.plant
    assert set(played[1].effects) == {"motor_lag"}


@pytest.mark.parametrize(
    ("hide", "expected_error"),
    [("turn_slp=0.1", "turn_slp"), ("turn_slip", "no value"), ("turn_slip=much", "not a number")],
)
def test_a_mistake_in_what_to_hide_is_named(hide, expected_error):
    with pytest.raises(InputError, match=expected_error):
        run_sim(SHIPPED_ROBOT, hide=(hide,))


def test_a_fractional_encoder_is_refused(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(ROBOT_TEXT.replace("ticks_per_rev = 2048", "ticks_per_rev = 2796.8"))
    with pytest.raises(InputError, match="whole number"):
        run_sim(path)
    # Checked before the encoder, so that this ends even where the start is not looked at.
    with pytest.raises(InputError, match=r"--start: nan 0\.0 0\.0 is not a pose"):
        run_sim(path, start=(float("nan"), 0.0, 0.0))


@pytest.mark.parametrize("what", ["effects", "faults"])
def test_what_can_be_hidden_or_go_wrong_is_listed_without_a_robot(what):
    result = CliRunner().invoke(app(), ["sim", f"--list-{what}"])
    assert result.exit_code == 0
    assert {"effects": "motor_lag", "faults": "bus_off"}[what] in result.output


def test_a_robot_is_needed_to_run():
    with pytest.raises(InputError, match=r"no ROBOT\.toml given; name one"):
        CliRunner().invoke(app(), ["sim"], catch_exceptions=False)


def test_a_board_that_has_a_link_of_its_own_is_refused_what_the_simulators_link_does(tmp_path):
    with pytest.raises(InputError, match="--bus-log: cannot be used with --board"):
        run_sim(SHIPPED_ROBOT, board="/dev/ttyUSB1", bus_log=tmp_path / "bus.log")
    vendors = tmp_path / "robot.toml"
    vendors.write_text(with_device(ROBOT_TEXT, "odrive"), "utf-8")
    with pytest.raises(InputError, match=r"--board: .*robot\.toml has link\.driver odrive"):
        run_sim(vendors, board="/dev/ttyUSB1")
