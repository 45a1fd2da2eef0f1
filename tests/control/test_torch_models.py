"""The torch forms of the models against the numpy ones."""

import numpy as np
import torch

from disco_hw.control import pendulum
from disco_hw.model import plain as physics
from disco_hw.tasks.circle import CircleCost
from tests.control.torch_models import circle_cost, pendulum_cost, pendulum_transition, skid_steer_transition
from tests.tasks.costs import instant_cost

RNG = np.random.default_rng(4)


def tensor(values):
    return torch.as_tensor(values, dtype=torch.float64)


def test_pendulum():
    state = RNG.uniform(-8.0, 8.0, (3, 40, 2))
    torque, theta = RNG.uniform(-4.0, 4.0, (40, 1)), RNG.uniform(0.5, 2.0, (3, 1, 2))
    got = pendulum_transition(tensor(state), tensor(torque), tensor(theta)).numpy()
    angle, speed = pendulum.step(state[..., 0], state[..., 1], torque[:, 0], theta[..., 0], theta[..., 1])
    np.testing.assert_allclose(got, np.stack([angle, speed], -1), atol=1e-12)
    assert (np.abs(got[..., 1]) == pendulum.LARGEST_SPEED_RAD_S).any()
    cost = pendulum_cost(tensor(got), 0).numpy()
    np.testing.assert_allclose(cost[1, 2], pendulum.instant_cost(got[1, 2, 0], got[1, 2, 1]))


def test_skid_steer_and_circle():
    state, control = RNG.uniform(-2.0, 2.0, (3, 40, 4)), RNG.uniform(-8.0, 8.0, (40, 2))
    theta = RNG.uniform([0.05, 0.3, -0.2], [0.1, 0.6, 0.3], (3, 1, 3))
    got = skid_steer_transition(0.1)(tensor(state), tensor(control), tensor(theta)).numpy()
    named = physics.theta_of(("wheel_radius_m", "axial_distance_m", "x_icr_m"), theta)
    start = physics.RobotState(state[..., 0], state[..., 1], state[..., 2], 0.0, 0.0)
    after, forward, _ = physics.step(named, start, control[:, 0], control[:, 1], 0.1)
    np.testing.assert_allclose(got, np.stack([after.x, after.y, after.yaw, forward], -1), atol=1e-12)
    circle = CircleCost(0.2, -0.1)
    cost = circle_cost(circle)(tensor(got), 0).numpy()
    np.testing.assert_allclose(cost[2, 7], instant_cost(circle, *got[2, 7, [0, 1, 3]]))
