"""pytorch_mppi on the tasks of this project's planner: same model, cost, samples, horizon and parameter points.

It knows no parameter points, so the states under all of them are put side by side into one state, which is its fastest
way to carry them; everything is batched over samples and points, and its noise is its own.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from pytorch_mppi import MPPI
from torch import Tensor

from disco_hw.control import pendulum
from disco_hw.control.parameter_points import unscented_points
from disco_hw.control.pendulum import PendulumPoints
from disco_hw.control.plan import DiscoSettings, PlannerState
from disco_hw.model import Model
from disco_hw.tasks.circle import CircleCost


def circle_mppi(model: Model, circle: CircleCost, settings: DiscoSettings, largest_rad_s: float) -> Any:
    """MPPI for the paper's circle, round the origin, under sigma points; its state is x, y, yaw and speed of L points.

    Its shape is (4 L,); its cost is the paper's: distance from the line and error of the speed, as one length.
    """
    theta, weights = unscented_points(model, settings.ut_alpha)
    radius, axial, x_icr = (torch.tensor(column, dtype=torch.float32) for column in theta[:, :3].T)
    points, share, step_s = len(weights), torch.tensor(weights, dtype=torch.float32), settings.step_s
    half_radius, half_ratio = 0.5 * radius, 0.5 * radius / axial

    def dynamics(state: Tensor, control: Tensor) -> Tensor:
        x, y, yaw = state[:, :points], state[:, points : 2 * points], state[:, 2 * points : 3 * points]
        left, right = control[:, :1], control[:, 1:]
        v, half_omega = half_radius * (left + right), half_ratio * (right - left)
        middle = yaw + step_s * half_omega
        chord = step_s * torch.sinc(half_omega * (step_s / math.pi))
        cosine, sine = torch.cos(middle), torch.sin(middle)
        along, across = chord * v, chord * half_omega * 2.0 * x_icr
        return torch.cat(
            (x + along * cosine + across * sine, y + along * sine - across * cosine, middle + step_s * half_omega, v), 1
        )

    def cost(state: Tensor, _control: Tensor) -> Tensor:
        off = torch.hypot(state[:, :points], state[:, points : 2 * points]) - circle.radius_m
        return torch.hypot(off, state[:, 3 * points :] - circle.speed_m_s) @ share

    sampler = settings.sampler
    return MPPI(
        dynamics, cost, 4 * points, sampler.noise_std**2 * torch.eye(2), sampler.samples, sampler.horizon,
        lambda_=sampler.temperature or 0.1, u_max=torch.full((2,), largest_rad_s),
        U_init=torch.zeros(sampler.horizon, 2),
    )  # fmt: skip


def circle_state(points: int, state: PlannerState) -> Tensor:
    """The state that `circle_mppi` starts from."""
    here = np.array([state.x_m, state.y_m, state.yaw_rad, 0.0], dtype=np.float32)
    return torch.tensor(np.repeat(here, points))


def pendulum_mppi(points: PendulumPoints, samples: int, horizon: int) -> Any:
    """MPPI for the paper's pendulum; its state is angle and speed of L points, (2 L,)."""
    length, mass = (torch.tensor(column, dtype=torch.float32) for column in points.theta.T)
    count, share = len(points.weights), torch.tensor(points.weights, dtype=torch.float32)
    pull, gain = 1.5 * pendulum.GRAVITY_M_S2 / length, 3.0 / (mass * length**2)

    def dynamics(state: Tensor, control: Tensor) -> Tensor:
        angle, speed = state[:, :count], state[:, count:]
        speed = speed + (pull * torch.sin(angle) + gain * control) * pendulum.STEP_S
        angle = angle + speed * pendulum.STEP_S
        return torch.cat((angle, speed.clamp(-pendulum.LARGEST_SPEED_RAD_S, pendulum.LARGEST_SPEED_RAD_S)), 1)

    def cost(state: Tensor, _control: Tensor) -> Tensor:
        off = torch.cos(state[:, :count]) - 1.0
        return (pendulum.UPRIGHT_WEIGHT * off**2 + state[:, count:] ** 2) @ share

    return MPPI(
        dynamics, cost, 2 * count, torch.eye(1), samples, horizon, lambda_=10.0,
        u_max=torch.tensor([pendulum.LARGEST_TORQUE_NM]), U_init=torch.zeros(horizon, 1),
    )  # fmt: skip
