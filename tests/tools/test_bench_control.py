"""The planner's benchmark: its parts on a small scale; the peer rolls the same model and cost."""

import numpy as np
import pytest
import torch

from disco_hw.control import DiscoSettings, PlannerState
from disco_hw.control.parameter_points import unscented_points
from disco_hw.model import load_model
from disco_hw.model import plain as physics
from disco_hw.tasks.circle import CircleCost
from tests.control import oracle
from tests.tasks import costs
from tools.bench.control import ROBOTS, compare_with_peer
from tools.bench.step_times import summary, times_ms, undisturbed

MODEL = load_model(ROBOTS / "wombot_model.toml")


def test_the_ratio_is_of_times_in_the_same_run():
    figures = compare_with_peer("x", lambda _: None, lambda _: sum(range(20_000)), 40, 40)
    assert figures["control.x_ratio_to_pytorch_mppi"] > 10.0
    assert figures["control.x_step_ms.min"] <= figures["control.x_step_ms.p50"] <= figures["control.x_step_ms.max"]
    # Eight million multiplications cannot be that fast, unless a compiler has seen through them.
    assert figures["control.x_bare_loop_ms.min"] > 0.01


def test_calls_are_given_their_number_and_summed_up():
    numbers = []
    with undisturbed():
        durations_ms = times_ms(numbers.append, 5, left_out=2)
    assert numbers == list(range(7))
    assert summary("k", np.array([1.0, 2.0, 3.0]))["k.p50"] == 2.0
    assert durations_ms.size == 5


def test_the_peer_rolls_the_same_model_and_cost():
    peers = pytest.importorskip("tools.control_peers", reason="pytorch_mppi comes with the extra [bench]")
    settings, circle = DiscoSettings(), CircleCost().paper()
    mppi = peers.circle_mppi(MODEL, circle, settings, 6.0)
    commands = np.random.default_rng(1).uniform(-6.0, 6.0, (3, settings.sampler.horizon, 2))
    state = peers.circle_state(7, PlannerState(0, 0.7, 0.1, 1.2, 0.0, 0.0)).expand(3, -1)
    total = torch.zeros(3)
    for t in range(settings.sampler.horizon):
        control = torch.tensor(commands[:, t], dtype=torch.float32)
        state = mppi.F(state, control)
        total += mppi.running_cost(state, control)
    theta, weights = unscented_points(MODEL, settings.ut_alpha)
    start = physics.RobotState(0.7, 0.1, 1.2, 0.0, 0.0)
    cost = costs.circle_cost(circle, settings.step_s)
    expected = [
        oracle.point_costs(
            physics.theta_of(MODEL.parameter_names, point), start, commands, np.zeros((1, 2)), settings.step_s, cost
        )
        for point in theta
    ]
    np.testing.assert_allclose(total.numpy(), oracle.mean_risk(np.array(expected), weights), rtol=1e-5)
