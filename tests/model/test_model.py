"""The model object: parameter vectors, completion within physical ranges, tables for the compiled step."""

import numpy as np
import pytest

from disco_hw.config import Prior, Robot
from disco_hw.model import EffectSetting, Gaussian, Model, Uniform
from disco_hw.model.model import coefficient_tables

ROBOT = Robot(name="r", wheel_radius_m=0.06, axial_distance_m=0.31, ticks_per_rev=2048, max_wheel_speed_rad_s=8.0)
LAG = EffectSetting("motor_lag", {"tau_s": 0.1})
GAIN = EffectSetting("wheel_gain", {"right": 0.2, "left": 0.1})


def test_nominal_takes_the_robots_geometry_and_the_prior():
    model = Model.nominal(ROBOT, Prior())
    assert (model.wheel_radius_m, model.axial_distance_m, model.x_icr_m, model.name) == (0.06, 0.31, 0.0, "r")
    assert isinstance(model.belief, Uniform)
    assert model.belief.names == ("wheel_radius_m", "axial_distance_m", "x_icr_m")
    np.testing.assert_array_equal(model.belief.low, [0.0, 0.1, 0.0])
    assert Model.nominal(ROBOT).belief is None


def test_parameters_come_base_first_then_by_effect():
    model = Model(0.06, 0.4, 0.1, (LAG, GAIN))
    assert model.parameter_names == (
        "wheel_radius_m",
        "axial_distance_m",
        "x_icr_m",
        "motor_lag.tau_s",
        "wheel_gain.left",
        "wheel_gain.right",
    )
    np.testing.assert_array_equal(model.point(), [0.06, 0.4, 0.1, 0.1, 0.1, 0.2])


def test_completing_points_fills_in_and_keeps_to_physical_ranges():
    model = Model(0.06, 0.4, 0.1, (LAG,))
    full = model.complete(np.array([[0.2, 0.05], [-1.0, -0.3]]), ("motor_lag.tau_s", "wheel_radius_m"))
    np.testing.assert_allclose(full, [[0.05, 0.4, 0.1, 0.2], [0.005, 0.4, 0.1, 0.0]])


def test_with_point_changes_values_by_full_name():
    model = Model(0.06, 0.4, 0.1, (LAG,)).with_point({"motor_lag.tau_s": 0.3, "x_icr_m": 0.2})
    np.testing.assert_allclose(model.point(), [0.06, 0.4, 0.2, 0.3])
    with pytest.raises(ValueError, match="'tau' is not a parameter of this model"):
        model.with_point({"tau": 1.0})


def test_a_belief_over_what_the_model_lacks_is_refused():
    belief = Gaussian(("motor_lag.tau_s",), np.array([0.1]), np.array([[0.01]]))
    with pytest.raises(ValueError, match=r"belief over 'motor_lag\.tau_s', which this model does not have"):
        Model(0.06, 0.4, belief=belief)
    Model(0.06, 0.4, effects=(LAG,), belief=belief)


def test_tables_hold_one_entry_a_point_and_none_for_absent_effects():
    model = Model(0.06, 0.4, 0.1, (LAG,))
    theta = np.tile(model.point(), (3, 1))
    theta[1, 3] = 0.2
    base, effects = coefficient_tables(model, theta, 0.1, np.float32)
    np.testing.assert_allclose(base.half_turn_ratio, 0.06 / 0.4 / 2)
    assert base.x_icr_m.dtype == np.float32
    np.testing.assert_allclose(effects.motor_lag[0], np.exp([-1.0, -0.5, -1.0]), rtol=1e-6)
    assert effects.deadband is None


def test_effects_that_only_measure_have_no_motion_term():
    model = Model(0.06, 0.4, effects=(EffectSetting("heading_bias", {"bias_rad": 0.1}), LAG))
    _, effects = coefficient_tables(model, model.point()[None], 0.1)
    assert "heading_bias" not in effects._fields
    np.testing.assert_allclose(effects.motor_lag[0], np.exp(-1.0))
