import numpy as np
import pytest

from disco_hw.inference.excitation import excitation
from disco_hw.inference.noise import Noise
from disco_hw.inference.simulate import NAMES, Simulator, draw_seeds, physical_range
from disco_hw.model import EffectSetting, Model
from disco_hw.model.step import FreeRun
from tests.inference.drives import THETA, TRUTH, logged

SILENT = Noise(0.0, 0.0, 0.0, 0.0, 0.0)


def simulator(noise=SILENT, noiseless=False):
    return Simulator(Model(0.06, 0.4), excitation(logged("poor", noiseless=noiseless)), noise)


def undisturbed(sim, theta=THETA, count=1):
    """Poses of simulations with one seed for all."""
    return sim.poses(np.tile(theta, (count, 1)), np.zeros(count, dtype=np.uint32))


def repeated(sim, count):
    """Poses of simulations of the true parameters that differ in their noise."""
    return sim.poses(np.tile(THETA, (count, 1)), draw_seeds(count, np.random.default_rng(1)))


def test_without_noise_the_true_parameters_and_no_others_repeat_a_noiseless_log():
    sim = simulator(noiseless=True)
    error = np.abs(undisturbed(sim)[0] - sim.drive.pose)
    assert error[:, :2].max() < 3e-3
    assert error[:, 2].max() < 5e-3
    assert np.abs(undisturbed(sim, THETA * [1.0, 1.1, 1.0])[0] - sim.drive.pose)[:, :2].max() > 0.02


@pytest.mark.thorough
def test_each_simulation_remembers_its_own_drive_from_the_beginning():
    rubber = EffectSetting("omega += k (omega - mean_3s(omega))", {"k": -0.5})
    plain = simulator()
    drive = plain.drive
    found = Simulator(Model(0.06, 0.4, effects=(rubber,)), drive, SILENT)
    first, second = undisturbed(found, count=2)
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - undisturbed(plain)[0])[:, 2].max() > 0.02
    # As a run of the model from its first pose, whose wheels do as they are told.
    start = np.array([*drive.pose[0], *drive.wheel_rad_s[0]])
    model = Model(*(TRUTH[name] for name in ("wheel_radius_m", "axial_distance_m", "x_icr_m")), effects=(rubber,))
    end = drive.run_node[1]
    states = FreeRun(model, model.point()[None], drive.step_s).states(start, drive.wheel_rad_s[:end], 0)
    of_first_run = slice(0, drive.run_pose[1])
    node, part = drive.node[of_first_run], drive.fraction[of_first_run]
    expected = states[node, 2] + part * (states[node + 1, 2] - states[node, 2])
    np.testing.assert_allclose(first[of_first_run, 2], expected, atol=1e-6)


def test_the_same_seeds_give_the_same_poses_however_they_are_shared_out():
    sim = simulator(Noise(0.005, 0.01, 0.004, 0.004, 0.014))
    seeds = draw_seeds(70, np.random.default_rng(0))
    theta = np.tile(THETA, (70, 1))
    together = sim.summaries(theta, seeds, lambda poses: poses[:, -1])
    alone = np.concatenate([sim.poses(theta[i : i + 1], seeds[i : i + 1])[:, -1] for i in range(70)])
    assert np.array_equal(together, alone)
    assert np.unique(together[:, 0]).size == 70


def test_noise_has_the_size_it_says():
    sim = simulator(Noise(0.02, 0.03, 0.004, 0.006, 0.014))
    poses = repeated(sim, 400)
    assert poses[:, 0, :2].std(axis=0) == pytest.approx([0.02, 0.02], rel=0.15)
    assert poses[:, 0, 2].std() == pytest.approx(0.03, rel=0.15)
    yaw_sd = np.sqrt(0.03**2 + 0.014**2 * sim.drive.moving_s.sum())
    assert poses[:, -1, 2].std() == pytest.approx(yaw_sd, rel=0.15)


def test_slip_that_lasts_and_grows_with_speed_adds_up_to_as_much():
    sim = simulator(Noise(0.0, 0.0, 0.0, 0.0, 0.014, correlation_s=0.2, speed_share=1.0))
    poses = repeated(sim, 400)
    yaw_sd = 0.014 * np.sqrt(sim.drive.moving_s.sum())
    assert poses[:, -1, 2].std() == pytest.approx(yaw_sd, rel=0.15)
    steps = np.diff(poses[:, :, 2] - poses[:, :, 2].mean(axis=0), axis=1)
    lasting = (steps[:, 1:] * steps[:, :-1]).sum() / (steps**2).sum()
    period_s = float(np.median(np.diff(sim.drive.t_s)))
    assert lasting == pytest.approx(np.exp(-period_s / 0.2), abs=0.15)


def test_slip_in_yaw_turns_the_body_about_the_end_of_its_lever():
    poses = repeated(simulator(Noise(0.0, 0.0, 0.0, 0.0, 0.014, lever_m=TRUTH["x_icr_m"])), 50)
    ahead = TRUTH["x_icr_m"] * np.stack([np.cos(poses[..., 2]), np.sin(poses[..., 2])], axis=-1)
    # The centre of rotation goes where it heads: never sideways.
    steps = np.diff(poses[..., :2] + ahead, axis=1)
    middle = 0.5 * (poses[:, 1:, 2] + poses[:, :-1, 2])
    sideways = steps[..., 1] * np.cos(middle) - steps[..., 0] * np.sin(middle)
    of_the_point = np.diff(poses[..., :2], axis=1)
    lateral = of_the_point[..., 1] * np.cos(middle) - of_the_point[..., 0] * np.sin(middle)
    assert np.abs(sideways).mean() < 0.05 * np.abs(lateral).mean()


def test_progress_is_told_of_every_simulation():
    done = []
    seeds = draw_seeds(50, np.random.default_rng(1))
    simulator().summaries(np.tile(THETA, (50, 1)), seeds, lambda poses: poses[:, 0], done=done.append)
    assert sum(done) == 50


def test_the_physical_range_is_in_the_order_of_the_names():
    low, high = physical_range()
    assert low[NAMES.index("wheel_radius_m")] > 0.0
    assert low[NAMES.index("x_icr_m")] < 0.0 < high[NAMES.index("x_icr_m")]
