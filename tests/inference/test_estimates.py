import numpy as np
import pytest

from disco_hw.inference.estimates import STATISTICS, estimates, whitening
from disco_hw.inference.excitation import excitation
from disco_hw.inference.noise import USUAL
from disco_hw.inference.simulate import Simulator, draw_seeds
from disco_hw.model import Model
from tests.inference.drives import THETA, logged


@pytest.mark.parametrize("name", ["poor", pytest.param("rich", marks=pytest.mark.thorough)])
def test_a_noiseless_log_gives_the_true_parameters(name):
    drive = excitation(logged(name, noiseless=True))
    found = estimates(drive, USUAL).theta(drive.pose[None])[0]
    assert found == pytest.approx(THETA, abs=2e-3)
    assert found[1:] == pytest.approx(THETA[1:], rel=2e-3)


def test_whitening_is_the_inverse_of_the_covariances_factor():
    drive = excitation(logged("poor"))
    lo, hi = drive.run_pose[:2]
    factor = whitening(drive, 0.005, 0.01, drive.moving_s)
    inner = slice(lo + 1, hi)
    bidiagonal = np.diag(factor.diagonal[inner]) + np.diag(factor.carry[inner][1:], -1)
    variance = 2.0 * 0.005**2 + 0.01**2 * drive.moving_s[inner]
    off = np.full(variance.size - 1, -(0.005**2))
    covariance = np.diag(variance) + np.diag(off, 1) + np.diag(off, -1)
    assert bidiagonal @ bidiagonal.T == pytest.approx(covariance, abs=1e-12)


def test_estimates_scatter_as_little_as_least_squares_promises():
    """Weights for the noise that is there do better than weights for none."""
    drive = excitation(logged("circle"))
    simulator = Simulator(Model(0.06, 0.4), drive, USUAL)
    poses = simulator.poses(np.repeat(THETA[None], 150, axis=0), draw_seeds(150, np.random.default_rng(0)))
    ours = estimates(drive, USUAL).theta(poses)
    plain = np.array([(pose[-1, 2] - pose[0, 2]) / drive.roll_rad[:, 1].sum() for pose in poses])
    assert ours.mean(axis=0) == pytest.approx(THETA, abs=2e-3)
    kappa = ours[:, 1] / ours[:, 2]
    assert kappa.std() < 1.05 * plain.std()
    assert ours[:, 1].std() < 5e-4


def test_statistics_stay_finite_where_nothing_moves():
    drive = excitation(logged("poor"))
    simulator = Simulator(Model(0.06, 0.4), drive, USUAL)
    corners = np.array([[0.0, 0.005, 0.5], [0.5, 0.5, 0.1], [0.0, 0.5, 0.1], [0.5, 0.005, 0.1]])
    statistics = estimates(drive, USUAL)(simulator.poses(corners, draw_seeds(4, np.random.default_rng(0))))
    assert statistics.shape == (4, len(STATISTICS))
    assert np.isfinite(statistics).all()
    stationary = np.zeros((1, drive.t_s.size, 3))
    assert np.isfinite(estimates(drive, USUAL)(stationary)).all()
