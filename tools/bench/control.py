"""Benchmark of the planner: time of a step, beside pytorch_mppi too.

The paper's size throughout: K = 400 sequences, T = 50 steps, L = 7 sigma points; one thread.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.control import CommandLimits, Disco, DiscoSettings, PlannerState, Sampler, SentCommand
from disco_hw.control.parameter_points import sigma_points
from disco_hw.control.pendulum import PendulumPlanner, PendulumPoints
from disco_hw.control.plan import ROTATION
from disco_hw.experiments.pendulum import POSTERIOR
from disco_hw.jit import block_function, float32, tune_loops
from disco_hw.model import Model, load_model
from disco_hw.runtime.assembly import create_planner
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.tasks.circle import CircleCost
from tools.bench.step_times import summary, times_ms, undisturbed

ROBOTS = SHIPPED_ROBOT.parent
PERIOD_NS = 20_000_000
STEP_NS = 100_000_000
PAPERS_SIZE = Sampler(samples=400, horizon=50)
LARGEST_RAD_S = ROTATION
ROUNDS = 4
# In a round our step and the bare loop take turns this often: who else is on the processor changes by the tenth second.
BURSTS = 10
BARE_ROUNDS, BARE_SIZE = 1600, 640
# States are made beforehand and used over and over; a step back in time leaves the plan where it is.
CALLS = 500


def run(steps: int = 3000, peer_steps: int = 100) -> dict[str, float]:
    """Return every figure of the planner, times in milliseconds."""
    torch.set_num_threads(1)
    model = load_model(ROBOTS / "wombot_model.toml")
    figures: dict[str, float] = {}
    with undisturbed() as allowed:
        figures["control.realtime"] = float(allowed)
        figures |= on_the_robot(steps)
        figures |= compare_with_peer("skid_steer", *skid_steer_pair(model), steps, peer_steps)
        figures |= compare_with_peer("pendulum", *pendulum_pair(), steps, peer_steps)
    return figures


def moving(number: int, period_ns: int = PERIOD_NS) -> tuple[int, PlannerState]:
    """Time and state of call `number`, on the circle and along it."""
    now_ns = number * period_ns
    sent = tuple(SentCommand(now_ns - back * period_ns, 2.3, 4.2) for back in range(50, 0, -1))
    return now_ns, PlannerState(now_ns, 0.75, 0.0, 1.25, 2.3, 4.2, sent)


def on_the_robot(steps: int) -> dict[str, float]:
    """The whole of `plan` as the daemon calls it, with the shipped robot's task, model and settings, at 50 Hz."""
    setup = load_setup(ROBOTS / "wombot.toml")
    planner = create_planner(setup.config, setup.model)
    calls = [moving(number) for number in range(CALLS)]
    return summary("control.plan_ms", times_ms(lambda number: planner.plan(*calls[number % CALLS]), steps))


Step = Callable[[int], object]


@block_function
def _multiply_and_add(numbers: Any, rounds: int) -> None:
    tune_loops()
    for _ in range(rounds):
        for i in range(BARE_SIZE):
            value = numbers[i]
            for _ in range(8):
                value = value * float32(0.999) + float32(0.001)
            numbers[i] = value


def bare_loop() -> Step:
    """Return a function of as many vector instructions as a step has, and nothing else.

    What it takes longer than its least, a step does: a processor whose other thread is somebody else's gives it half of
    its vector units.
    """
    numbers = np.ones(BARE_SIZE, np.float32)
    return lambda _: _multiply_and_add(numbers, BARE_ROUNDS)


def skid_steer_pair(model: Model) -> tuple[Step, Step]:
    """A step of DISCO and of the peer on the paper's circle, with the cost that the paper gives."""
    from tools.control_peers import circle_mppi, circle_state  # noqa: PLC0415  (a peer for the benchmark only)

    circle, settings = CircleCost().paper(), DiscoSettings(sampler=PAPERS_SIZE)
    planner = Disco(model, circle, settings, CommandLimits(LARGEST_RAD_S))
    planner.warm_up()
    mppi = circle_mppi(model, circle, settings, LARGEST_RAD_S)
    start = circle_state(mppi.nx // 4, moving(0)[1])
    calls = [moving(number, STEP_NS) for number in range(CALLS)]
    return lambda number: planner.plan(*calls[number % CALLS]), lambda _: mppi.command(start)


def pendulum_pair() -> tuple[Step, Step]:
    """A step of DISCO and of the peer on the paper's pendulum: K = 500, T = 30, L = 5."""
    from tools.control_peers import pendulum_mppi  # noqa: PLC0415  (a peer for the benchmark only)

    sigma = sigma_points(POSTERIOR.mean(), POSTERIOR.covariance(), 0.5)
    points = PendulumPoints(sigma.points, sigma.mean_weights)
    planner = PendulumPlanner(points)
    mppi = pendulum_mppi(points, 500, 30)
    start = torch.tensor([math.pi] * 5 + [0.0] * 5)
    return lambda _: planner.plan(math.pi, 0.0), lambda _: mppi.command(start)


def compare_with_peer(name: str, ours: Step, theirs: Step, steps: int, peer_steps: int) -> dict[str, float]:
    """Time of a step of both and of a bare loop, in turns so that all see the same machine.

    Ratio of the medians, and of the minima.
    """
    times: list[np.ndarray] = []
    bare_times: list[np.ndarray] = []
    peer_times: list[np.ndarray] = []
    bare = bare_loop()
    calls = max(steps // (ROUNDS * BURSTS), 1)
    for _ in range(ROUNDS):
        for _ in range(BURSTS):
            times.append(times_ms(ours, calls, left_out=5))
            bare_times.append(times_ms(bare, calls, left_out=1))
        peer_times.append(times_ms(theirs, max(peer_steps // ROUNDS, 2), left_out=2))
    mine, peer = np.concatenate(times), np.concatenate(peer_times)
    return {
        **summary(f"control.{name}_step_ms", mine),
        **summary(f"control.{name}_bare_loop_ms", np.concatenate(bare_times)),
        **summary(f"control.{name}_pytorch_mppi_ms", peer),
        f"control.{name}_ratio_to_pytorch_mppi": float(np.median(peer) / np.median(mine)),
        f"control.{name}_ratio_of_minima": float(peer.min() / mine.min()),
    }
