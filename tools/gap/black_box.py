"""A black box that predicts where commands take a robot, learnt from commands and poses: a peer of the gap's models.

Of the robot it knows only that poses are integrals of the body's velocities. What wheels were commanded lately, both
sides, goes through a linear map and a small network beside it, which give the forward and lateral speed and the yaw
rate. These are integrated from a known pose, and the network is trained on the poses up to the horizon. The mean
velocities of several networks are used. Where a drive has no commands, measured wheel speeds stand in, as for models.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from disco_hw.gap.data.gridded_drive import GriddedDrive
from disco_hw.gap.search.cross_validation import Starts
from disco_hw.gap.settings import GRID_STEP_S

Array = NDArray[np.float64]
Index = NDArray[np.int64]

STEP = 5
"""Cells of the grid in one step of integration."""
_POSES_EVERY = 50
_VALIDATED_SHARE = 0.2
# Iterations between two looks at the validated share.
_ITERATIONS = 5


@dataclass(frozen=True)
class Training:
    """Settings of the training, chosen on every other real log in order of size, the shortest first.

    `edges_s`: borders of the stretches whose mean command is an input, counted back from the pose's stamp. They begin
    after it, as stamps of commands and poses may disagree by that much. `decay`: penalty on squares of the linear map's
    and of the network's weights; `iterations` of L-BFGS of the linear map and then of all, `patience` of these.
    """

    networks: int = 3
    hidden: int = 48
    iterations: tuple[int, int] = (400, 1000)
    patience: int = 300
    decay: tuple[float, float] = (0.1, 0.1)
    edges_s: tuple[float, ...] = (*(round(-0.2 + 0.05 * k, 2) for k in range(17)), 0.7, 0.8, 0.9, 1.0, 1.25, 1.5)


class _Velocities(nn.Module):
    """Body velocities (N, 3) from scaled inputs (N, F): a linear map plus a network that begins as nothing."""

    def __init__(self, inputs: int, hidden: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, 3, bias=False)
        last = nn.Linear(hidden, 3, bias=False)
        nn.init.zeros_(self.linear.weight)
        nn.init.zeros_(last.weight)
        self.network = nn.Sequential(nn.Linear(inputs, hidden), nn.Tanh(), last)

    def forward(self, inputs: Tensor) -> Tensor:
        total: Tensor = self.linear(inputs) + self.network(inputs)
        return total

    def penalty(self, decay: tuple[float, float]) -> Tensor:
        """Squares of the weights, of the linear map and of the network."""
        of_network = torch.stack([(one**2).sum() for one in self.network.parameters() if one.dim() > 1]).sum()
        return decay[0] * (self.linear.weight**2).sum() + decay[1] * of_network


@dataclass(frozen=True)
class BlackBox:
    """Trained networks, the unit (F,) in which inputs are given to them, and the settings."""

    networks: tuple[_Velocities, ...]
    unit: Array
    training: Training

    def displacement(self, drive: GriddedDrive, node: Index, ahead_s: float) -> Array:
        """Forward, left and yaw (K, 3) from each start node to `ahead_s` later, in the frame of the start."""
        steps = _steps(node, ahead_s)
        used, place = np.unique(steps, return_inverse=True)
        inputs = _tensor(recent_speeds(drive, used, self.training.edges_s) / self.unit)
        with one_thread(), torch.no_grad():
            velocities = torch.stack([network(inputs) for network in self.networks]).mean(dim=0)
            ways = rollouts(velocities[torch.as_tensor(place.reshape(steps.shape))])
        return ways[:, -1].numpy().astype(np.float64)


def recent_speeds(drive: GriddedDrive, node: Index, edges_s: Sequence[float]) -> Array:
    """Mean commands (N, F) in stretches before each node, of each side; measured wheel speeds without commands.

    Stretches are counted back from when the pose at the node is stamped, to when commands are: what the grid moved
    them by is another number in another log. Before its run's start and after its end a speed is as there.
    """
    speed = np.nan_to_num(drive.command_rad_s) if drive.has_commands else drive.speed_rad_s
    moved_s = drive.poses_moved_s + drive.commands_moved_s if drive.has_commands else drive.poses_moved_s
    begins = np.flatnonzero(drive.first)
    run = np.searchsorted(begins, node, side="right") - 1
    low, high = begins[run], np.append(begins[1:], drive.first.size)[run]
    total = np.concatenate([np.zeros((1, 2)), np.cumsum(speed, axis=0)])
    edge = node[:, None] + np.round((moved_s - np.asarray(edges_s)) / GRID_STEP_S).astype(np.int64)
    inside = np.clip(edge, low[:, None], high[:, None])
    ends = speed[low][:, None] * np.minimum(edge - low[:, None], 0)[..., None]
    ends = ends + speed[high - 1][:, None] * np.maximum(edge - high[:, None], 0)[..., None]
    sums = total[inside] + ends
    means = (sums[:, :-1] - sums[:, 1:]) / (edge[:, :-1] - edge[:, 1:])[..., None]
    return np.asarray(means.reshape(node.size, -1))


def rollouts(velocities: Tensor) -> Tensor:
    """Forward, left and yaw (K, T, 3) after each step at body velocities (K, T, 3), in the frame of the start."""
    turn = velocities[..., 2] * (STEP * GRID_STEP_S)
    yaw = torch.cumsum(turn, dim=1)
    middle = yaw - 0.5 * turn
    cosine, sine = torch.cos(middle), torch.sin(middle)
    along, across = velocities[..., 0] * (STEP * GRID_STEP_S), velocities[..., 1] * (STEP * GRID_STEP_S)
    x = torch.cumsum(cosine * along - sine * across, dim=1)
    y = torch.cumsum(sine * along + cosine * across, dim=1)
    return torch.stack([x, y, yaw], dim=2)


def train(
    drive: GriddedDrive, starts: Starts, alone: Array, ahead_s: float, training: Training | None = None
) -> BlackBox:
    """Train on the predictions of a drive from `starts`, towards the poses `alone` (M, 3) on their way.

    The logarithms of both mean squares add up, that of position and that of heading: each is measured in the spread of
    its own errors. What was best on the last fifth of the drive is kept; no prediction of the others reaches into it.
    """
    training = training or Training()
    steps = _steps(starts.node, ahead_s)
    every = min(_POSES_EVERY, STEP * steps.shape[1])
    reached = np.arange(every, STEP * steps.shape[1] + 1, every)
    target = alone[starts.node[:, None] + reached]
    cosine, sine = np.cos(starts.pose[:, 2])[:, None], np.sin(starts.pose[:, 2])[:, None]
    dx, dy, turned = np.moveaxis(target - starts.pose[:, None], 2, 0)
    way = np.stack([cosine * dx + sine * dy, cosine * dy - sine * dx, turned], axis=2)
    border = starts.node[round((1.0 - _VALIDATED_SHARE) * (starts.node.size - 1))]
    used, place = np.unique(steps, return_inverse=True)
    inputs = recent_speeds(drive, used, training.edges_s)
    unit = np.maximum(np.sqrt((inputs**2).mean(axis=0)), 1e-6)
    data = _Data(
        _tensor(inputs / unit), torch.as_tensor(place.reshape(steps.shape)),
        torch.as_tensor(reached // STEP - 1), _tensor(way),
    )  # fmt: skip
    early = torch.as_tensor(np.flatnonzero(starts.node + STEP * steps.shape[1] < border))
    late = torch.as_tensor(np.flatnonzero(starts.node >= border))
    with one_thread():
        networks = tuple(_trained(data, early, late, seed, training) for seed in range(training.networks))
    return BlackBox(networks, unit, training)


@dataclass(frozen=True)
class _Data:
    """Inputs (N, F), those that rollouts read (K, T), and the ways (K, R, 3) after the steps that are `reached`."""

    inputs: Tensor
    place: Tensor
    reached: Tensor
    way: Tensor

    def loss(self, network: _Velocities, chosen: Tensor) -> Tensor:
        """Logarithms of the mean squares of position and of heading, over the chosen rollouts."""
        ways = rollouts(network(self.inputs)[self.place[chosen]])[:, self.reached]
        way = self.way[chosen]
        # Where no pose is near, none is compared with: not even a gradient may come of it.
        error = (ways - way)[torch.isfinite(way[..., 0])]
        yaw = torch.remainder(error[:, 2] + math.pi, 2.0 * math.pi) - math.pi
        return torch.log((error[:, :2] ** 2).sum(dim=1).mean()) + torch.log((yaw**2).mean())


def _trained(data: _Data, early: Tensor, late: Tensor, seed: int, training: Training) -> _Velocities:
    """One network, as it was when it predicted the `late` rollouts best; the linear map is trained first, alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = _Velocities(data.inputs.shape[1], training.hidden)
    best, best_loss = network, math.inf
    for part, iterations in zip(("linear", "all"), training.iterations, strict=True):
        network = copy.deepcopy(best)
        chosen = [*(network.linear if part == "linear" else network).parameters()]
        optimiser = torch.optim.LBFGS(chosen, max_iter=_ITERATIONS, history_size=30, line_search_fn="strong_wolfe")

        def cost(network: _Velocities = network, optimiser: torch.optim.LBFGS = optimiser) -> Tensor:
            optimiser.zero_grad()
            value = data.loss(network, early) + network.penalty(training.decay)
            value.backward()  # type: ignore[no-untyped-call]
            return value

        since = 0
        for _ in range(iterations // _ITERATIONS):
            optimiser.step(cost)  # type: ignore[no-untyped-call]
            with torch.no_grad():
                loss = float(data.loss(network, late))
            since = 0 if loss < best_loss else since + _ITERATIONS
            if loss < best_loss:
                best, best_loss = copy.deepcopy(network), loss
            if not math.isfinite(loss) or since >= training.patience:
                break
    return best


def _steps(node: Index, ahead_s: float) -> Index:
    """Nodes (K, T) in the middle of each step of integration from start nodes on."""
    count = round(ahead_s / (STEP * GRID_STEP_S))
    return np.asarray(node[:, None] + STEP * np.arange(count) + STEP // 2)


def _tensor(values: Array) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float32)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread: other processes use the other cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
