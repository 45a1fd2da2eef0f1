import numpy as np

from disco_hw.inference.checks import CHECKS, Predictive, edge_parameters, predictive
from disco_hw.inference.excitation import excitation
from disco_hw.inference.infer import noise_of
from disco_hw.inference.simulate import Simulator
from disco_hw.model import Model
from tests.inference.drives import THETA, logged

LOW, HIGH = np.array([0.0, 0.005, 0.1]), np.array([0.5, 0.5, 0.5])


def checked(theta, hidden=()):
    drive = excitation(logged("circle", 1, hidden))
    noise = noise_of(drive)
    draws = np.random.default_rng(0).normal(theta, [2e-3, 1e-4, 2e-3], (60, 3))
    return predictive(drive, noise, Simulator(Model(0.06, 0.4), drive, noise), draws, LOW, HIGH, 1)


def test_a_log_of_the_model_is_inside_and_one_of_other_parameters_is_outside():
    assert not checked(THETA).outside_simulated
    found = checked(THETA + np.array([0.0, 0.003, 0.0]))
    assert found.outside_simulated
    assert np.abs(found.estimate_deviations).max() > 5.0


def test_disagreements_name_their_effects_worst_first():
    deviations = np.zeros(len(CHECKS))
    deviations[2], deviations[9] = -7.0, 30.0
    found = Predictive(deviations, np.zeros(3), ())
    assert found.outside_simulated
    assert [check.effects for check, _ in found.disagreements] == [("turn_slip",), ("side_slip",)]


def test_a_posterior_pressed_against_the_prior_is_named():
    rng = np.random.default_rng(0)
    draws = np.column_stack(
        [rng.normal(0.2, 0.01, 500), 0.5 - np.abs(rng.normal(0.0, 1e-3, 500)), rng.normal(0.3, 0.01, 500)]
    )
    assert edge_parameters(draws, LOW, HIGH, THETA) == ("wheel_radius_m",)
    assert edge_parameters(rng.uniform(LOW, HIGH, (500, 3)), LOW, HIGH, THETA) == ()


def test_an_estimate_outside_the_prior_is_named_if_the_log_determines_it():
    sharp = np.random.default_rng(0).normal(THETA, 1e-3, (500, 3))
    outside = np.array([-0.1, 0.06, 0.45])
    assert edge_parameters(sharp, LOW, HIGH, outside) == ("x_icr_m",)
    wide = np.random.default_rng(0).uniform(LOW, HIGH, (500, 3))
    assert edge_parameters(wide, LOW, HIGH, outside) == ()
