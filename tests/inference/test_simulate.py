import numpy as np
import pytest

from disco_hw.inference.excitation import excitation
from disco_hw.inference.noise import Noise
from disco_hw.inference.simulate import NAMES, Simulator, draw_seeds, physical_range
from disco_hw.model import EffectSetting, Model
from disco_hw.model.step import FreeRun
from tests.inference.drives import TRUTH, logged

SILENT = Noise(0.0, 0.0, 0.0, 0.0, 0.0)
THETA = np.array([[TRUTH[name] for name in NAMES]])


def simulator(noise=SILENT, drive="poor", noiseless=False):
    return Simulator(Model(0.06, 0.4), excitation(logged(drive, noiseless=noiseless)), noise)


def test_without_noise_the_true_parameters_repeat_a_noiseless_log():
    sim = simulator(noiseless=True)
    poses = sim.poses(THETA, np.zeros(1, dtype=np.uint32))[0]
    error = poses - sim.drive.pose
    assert np.abs(error[:, :2]).max() < 3e-3
    assert np.abs(error[:, 2]).max() < 5e-3


@pytest.mark.thorough
def test_each_simulation_remembers_its_own_drive_from_the_beginning():
    rubber = EffectSetting("omega += k (omega - mean_3s(omega))", {"k": -0.5})
    plain = simulator()
    drive = plain.drive
    found = Simulator(Model(0.06, 0.4, effects=(rubber,)), drive, SILENT)
    first, second = found.poses(np.repeat(THETA, 2, axis=0), np.zeros(2, dtype=np.uint32))
    np.testing.assert_array_equal(first, second)
    without = plain.poses(THETA, np.zeros(1, dtype=np.uint32))[0]
    assert np.abs(first - without)[:, 2].max() > 0.02
    # As a run of the model from its first pose, whose wheels do as they are told.
    start = np.array([*drive.pose[0], *drive.wheel_rad_s[0]])
    model = Model(*(TRUTH[name] for name in ("wheel_radius_m", "axial_distance_m", "x_icr_m")), effects=(rubber,))
    end = drive.run_node[1]
    states = FreeRun(model, model.point()[None], drive.step_s).states(start, drive.wheel_rad_s[:end], 0)
    of_first_run = slice(0, drive.run_pose[1])
    node, part = drive.node[of_first_run], drive.fraction[of_first_run]
    expected = states[node, 2] + part * (states[node + 1, 2] - states[node, 2])
    np.testing.assert_allclose(first[of_first_run, 2], expected, atol=1e-6)


def test_wrong_parameters_do_not():
    sim = simulator(noiseless=True)
    poses = sim.poses(THETA * [1.0, 1.1, 1.0], np.zeros(1, dtype=np.uint32))[0]
    assert np.abs(poses - sim.drive.pose)[:, :2].max() > 0.02


def test_the_same_seeds_give_the_same_poses_however_they_are_shared_out():
    sim = simulator(Noise(0.005, 0.01, 0.004, 0.004, 0.014))
    seeds = draw_seeds(70, np.random.default_rng(0))
    theta = np.repeat(THETA, 70, axis=0)

    def last(poses):
        return poses[:, -1]

    together = sim.summaries(theta, seeds, last)
    alone = np.concatenate([sim.poses(theta[i : i + 1], seeds[i : i + 1])[:, -1] for i in range(70)])
    assert np.array_equal(together, alone)
    assert np.unique(together[:, 0]).size == 70


def test_noise_has_the_size_it_says():
    noise = Noise(0.02, 0.03, 0.004, 0.006, 0.014)
    sim = simulator(noise)
    poses = sim.poses(np.repeat(THETA, 400, axis=0), draw_seeds(400, np.random.default_rng(1)))
    assert poses[:, 0, :2].std(axis=0) == pytest.approx([0.02, 0.02], rel=0.15)
    assert poses[:, 0, 2].std() == pytest.approx(0.03, rel=0.15)
    yaw_sd = np.sqrt(0.03**2 + 0.014**2 * sim.drive.moving_s.sum())
    assert poses[:, -1, 2].std() == pytest.approx(yaw_sd, rel=0.15)


def test_slip_that_lasts_and_grows_with_speed_adds_up_to_as_much():
    noise = Noise(0.0, 0.0, 0.0, 0.0, 0.014, correlation_s=0.2, speed_share=1.0)
    sim = simulator(noise)
    poses = sim.poses(np.repeat(THETA, 400, axis=0), draw_seeds(400, np.random.default_rng(1)))
    yaw_sd = 0.014 * np.sqrt(sim.drive.moving_s.sum())
    assert poses[:, -1, 2].std() == pytest.approx(yaw_sd, rel=0.15)
    steps = np.diff(poses[:, :, 2] - poses[:, :, 2].mean(axis=0), axis=1)
    lasting = (steps[:, 1:] * steps[:, :-1]).sum() / (steps**2).sum()
    period_s = float(np.median(np.diff(sim.drive.t_s)))
    assert lasting == pytest.approx(np.exp(-period_s / 0.2), abs=0.15)


def test_slip_in_yaw_turns_the_body_about_the_end_of_its_lever():
    sim = simulator(Noise(0.0, 0.0, 0.0, 0.0, 0.014, lever_m=TRUTH["x_icr_m"]))
    poses = sim.poses(np.repeat(THETA, 50, axis=0), draw_seeds(50, np.random.default_rng(1)))
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
    sim = simulator()
    seeds = draw_seeds(50, np.random.default_rng(1))
    sim.summaries(np.repeat(THETA, 50, axis=0), seeds, lambda p: p[:, 0], done=done.append)
    assert sum(done) == 50


def test_the_physical_range_is_in_the_order_of_the_names():
    low, high = physical_range()
    assert low[NAMES.index("wheel_radius_m")] > 0.0
    assert low[NAMES.index("x_icr_m")] < 0.0 < high[NAMES.index("x_icr_m")]
