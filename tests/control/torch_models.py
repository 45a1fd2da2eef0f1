"""The paper's pendulum and its skid-steer robot as torch models, for `BlackBoxDisco`."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from disco_hw.control import pendulum
from disco_hw.control.black_box import StageCost, Transition
from disco_hw.tasks.circle import CircleCost


def pendulum_transition(state: Tensor, control: Tensor, theta: Tensor) -> Tensor:
    """States (L, K, 2) angle and speed after a step; `theta` (L, 1 or K, 2) length and mass."""
    angle, speed = state.unbind(-1)
    length, mass = theta.unbind(-1)
    torque = control[..., 0].clamp(-pendulum.LARGEST_TORQUE_NM, pendulum.LARGEST_TORQUE_NM)
    pull = 1.5 * pendulum.GRAVITY_M_S2 / length * torch.sin(angle)
    speed = speed + (pull + 3.0 / (mass * length**2) * torque) * pendulum.STEP_S
    angle = angle + speed * pendulum.STEP_S
    return torch.stack([angle, speed.clamp(-pendulum.LARGEST_SPEED_RAD_S, pendulum.LARGEST_SPEED_RAD_S)], dim=-1)


def pendulum_cost(state: Tensor, t: int) -> Tensor:
    """Stage cost (L, K) of pendulum states."""
    angle, speed = state.unbind(-1)
    return pendulum.UPRIGHT_WEIGHT * (torch.cos(angle) - 1.0) ** 2 + speed**2


def skid_steer_transition(step_s: float) -> Transition:
    """Return the bare skid-steer model: states (L, K, 4) x, y, yaw and forward speed.

    Theta radius, axial distance, x_icr.
    """

    def transition(state: Tensor, control: Tensor, theta: Tensor) -> Tensor:
        x, y, yaw, _ = state.unbind(-1)
        radius, axial, x_icr = theta.unbind(-1)
        left, right = control.unbind(-1)
        v = 0.5 * radius * (left + right)
        omega = radius / axial * (right - left)
        half = 0.5 * step_s * omega
        chord = step_s * torch.sinc(half / math.pi)
        cosine, sine = torch.cos(yaw + half), torch.sin(yaw + half)
        lateral = -omega * x_icr
        return torch.stack(
            [x + chord * (v * cosine - lateral * sine), y + chord * (v * sine + lateral * cosine), yaw + 2.0 * half, v],
            dim=-1,
        )

    return transition


def circle_cost(circle: CircleCost) -> StageCost:
    """Return the paper's stage cost (L, K) of skid-steer states."""

    def cost(state: Tensor, t: int) -> Tensor:
        x, y, _, forward = state.unbind(-1)
        off_edge = torch.hypot(x - circle.center_x_m, y - circle.center_y_m) - circle.radius_m
        return torch.hypot(off_edge, forward - circle.speed_m_s)

    return cost
