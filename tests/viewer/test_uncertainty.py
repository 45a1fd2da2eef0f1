import msgspec
import numpy as np
import pytest

from disco_hw.control.parameter_points import unscented_points
from disco_hw.log import records
from disco_hw.model import EffectSetting, Gaussian, Model, load_model
from disco_hw.model.step import FreeRun
from disco_hw.viewer.recording import ParameterPoints
from tools.viewer_run import MODEL_FILE, plan_at


def start_and_commands(plan):
    """Where a plan starts, with wheels at 1 and 2 rad/s, and its wheel speeds."""
    start = np.array([plan.path_x_m[0], plan.path_y_m[0], plan.path_yaw_rad[0], 1.0, 2.0])
    return start, np.column_stack((plan.left_rad_s, plan.right_rad_s))


def test_paths_are_those_of_the_compiled_model():
    model = load_model(MODEL_FILE)
    plan = plan_at(0)
    paths = ParameterPoints(model).trajectories(plan, (1.0, 2.0))
    points, _ = unscented_points(model, 1.0)
    runs = FreeRun(model, points, plan.step_s)
    start, commands = start_and_commands(plan)
    assert paths.shape == (len(points), 11, 2)
    assert len(points) == 7
    for index, path in enumerate(paths):
        expected = runs.states(start, commands, 0, 0.0, index)[:, :2]
        assert np.abs(path - expected).max() < 1e-9


def remembering(**terms):
    """A robot whose commands count less after much driving, or whose turning does when it changes."""
    names = {"load": "command += k u mean_1s(|u| + |u_other|)", "turn": "omega += k (omega - mean_1s(omega))"}
    return Model(0.06, 0.3, 0.1, tuple(EffectSetting(names[name], {"k": k}) for name, k in terms.items()))


def test_what_a_robot_has_done_for_long_changes_nothing_more():
    plan = plan_at(0)
    left, right = plan.left_rad_s[0], plan.right_rad_s[0]
    plain = ParameterPoints(remembering())
    share = 1.0 - 0.02 * (left + right)
    less = msgspec.structs.replace(plan, left_rad_s=(share * left,) * 10, right_rad_s=(share * right,) * 10)
    loaded = ParameterPoints(remembering(load=-0.02)).trajectories(plan, (left, right))
    np.testing.assert_allclose(loaded, plain.trajectories(less, (left, right)), atol=1e-9)
    turning, before = ParameterPoints(remembering(turn=-0.5)), plain.trajectories(plan, (left, right))
    np.testing.assert_allclose(turning.trajectories(plan, (left, right)), before, atol=1e-9)
    assert np.abs(turning.trajectories(plan, (0.0, 0.0)) - before).max() > 1e-3


# For its effects alone a function is compiled.
@pytest.mark.thorough
def test_a_robot_that_remembers_is_taken_to_have_done_the_same_before():
    model, plan = remembering(load=-0.02, turn=-0.5), plan_at(0)
    (path,) = ParameterPoints(model).trajectories(plan, (1.0, 2.0))
    start, commands = start_and_commands(plan)
    load = np.abs(commands[0]).sum()
    run = FreeRun(model, model.point()[None], plan.step_s)
    expected = run.states(start, commands, 0, means=np.array([load, load, 2.0 - 1.0]))[:, :2]
    assert np.abs(path - expected).max() < 1e-9
    assert np.abs(path - run.states(start, commands, 0)[:, :2]).max() > 1e-3


def test_a_point_estimate_gives_one_path_and_none_of_a_plan_without_one():
    points = ParameterPoints(Model(0.06, 0.3, 0.1))
    assert points.trajectories(plan_at(0), (0.0, 0.0)).shape == (1, 11, 2)
    assert points.trajectories(records.Plan(0, 0, 0.1, (1.0,), (1.0,)), (0.0, 0.0)).shape == (0, 0, 2)


def test_three_times_the_uncertainty_fans_out_three_times_as_far():
    means, covariance = np.array((0.06, 0.3, 0.1)), np.diag((1e-6, 1e-5, 1e-5))
    names = ("wheel_radius_m", "axial_distance_m", "x_icr_m")

    def spread(scale):
        model = Model(0.06, 0.3, 0.1, belief=Gaussian(names, means, scale**2 * covariance))
        return np.ptp(ParameterPoints(model).trajectories(plan_at(0), (0.0, 0.0))[:, -1], axis=0)

    assert spread(3.0) == pytest.approx(3.0 * spread(1.0), rel=0.05)
