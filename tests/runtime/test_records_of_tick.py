"""The sampled rollouts as they are recorded, and that looking at them changes nothing."""

import numpy as np
import pytest

from disco_hw.control import Rollouts
from disco_hw.runtime.records_of_tick import fan
from disco_hw.runtime.supervisor import UserRequest
from disco_hw.viewer.scene import fan_paths
from tests.runtime.simulated import simulated_stack, start


def rollouts(count, steps):
    places = np.arange(count * (steps + 1) * 3, dtype=float).reshape(count, steps + 1, 3) / 7.0
    return Rollouts(np.zeros((count, steps, 2)), places, np.linspace(0.5, 0.1, count))


def test_a_fan_keeps_first_and_last_point_of_each_path_and_eleven_in_all():
    made = rollouts(3, 50)
    record = fan(7, made)
    paths = fan_paths(record.weights, record.x_m, record.y_m)
    assert paths.shape == (3, 11, 2)
    assert record.t_ns == 7
    assert record.weights == tuple(made.weights)
    for path, trajectory in zip(paths, made.trajectories, strict=True):
        assert path[[0, -1]] == pytest.approx(trajectory[[0, -1], :2], abs=6e-4)
    assert all(value == round(value, 3) for value in record.x_m)


@pytest.mark.parametrize("steps", [1, 2, 10])
def test_a_short_plan_is_kept_whole(steps):
    record = fan(0, rollouts(2, steps))
    assert fan_paths(record.weights, record.x_m, record.y_m).shape == (2, steps + 1, 2)


def drive(look):
    stack = simulated_stack(seed=2)
    start(stack, 0.02)
    seen, commands = [], []
    for _ in range(60):
        command = stack.run(0.02)[0].pipeline.command
        commands.append((command.left_rad_s, command.right_rad_s))
        if look:
            seen.append(stack.core.pipeline.rollouts(16))
    return stack, seen, commands


def test_looking_at_the_rollouts_in_every_tick_changes_no_command():
    stack, seen, looked_at = drive(look=True)
    assert looked_at == drive(look=False)[2]
    assert any(left for left, _ in looked_at)
    newest = seen[-1]
    assert newest.trajectories.shape[0] == 16
    assert (np.diff(newest.weights) <= 0.0).all()
    start = newest.trajectories[0, 0, :2]
    estimate = stack.core.last.pipeline.estimate
    assert start == pytest.approx((estimate.x_m, estimate.y_m), abs=0.05)
    stack.run(0.2, UserRequest.DISARM)
    assert stack.core.pipeline.rollouts(16) is None
