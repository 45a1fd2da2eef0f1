"""The compiled step: exact arcs, the reference's numbers in double precision, the identity of x_icr."""

import math

import numpy as np
import pytest

from disco_hw.model import Model, plain
from disco_hw.model.step import FreeRun
from tests.model.reference import reference_run


def run(model, start, commands, step_s=0.1):
    return FreeRun(model, model.point()[None], step_s).states(np.array(start), np.array(commands), 0)


@pytest.mark.parametrize("step_s", [0.01, 0.1, 0.5])
def test_a_constant_turn_closes_the_circle_exactly(step_s):
    model = Model(0.06, 0.4, 0.2)
    omega = 0.06 * (5.0 - 3.0) / 0.4
    count = 50
    states = run(model, (1.0, 2.0, 0.5, 0.0, 0.0), [(3.0, 5.0)] * count, step_s)
    yaw = 0.5 + omega * step_s * np.arange(count + 1)
    # The point x_icr ahead goes round a circle of radius v / omega; the tracked point keeps its place relative to it.
    radius = 0.06 * 4.0 / omega
    centre = np.array(
        [1.0 + 0.2 * math.cos(0.5) - radius * math.sin(0.5), 2.0 + 0.2 * math.sin(0.5) + radius * math.cos(0.5)]
    )
    x = centre[0] + radius * np.sin(yaw) - 0.2 * np.cos(yaw)
    y = centre[1] - radius * np.cos(yaw) - 0.2 * np.sin(yaw)
    np.testing.assert_allclose(states[:, :3], np.column_stack([x, y, yaw]), atol=1e-12)


def test_the_steps_length_does_not_matter_under_constant_commands():
    model = Model(0.06, 0.3, 0.1)
    coarse = run(model, (0.0, 0.0, 0.0, 0.0, 0.0), [(2.0, 6.0)] * 10, 0.2)
    fine = run(model, (0.0, 0.0, 0.0, 0.0, 0.0), [(2.0, 6.0)] * 200, 0.01)
    np.testing.assert_allclose(coarse[-1, :3], fine[-1, :3], atol=1e-12)


def test_euler_steps_converge_to_it():
    model, dt = Model(0.06, 0.3, 0.15), 1e-4
    exact = run(model, (0.0, 0.0, 0.3, 0.0, 0.0), [(2.0, 6.0)] * 10)[-1, :3]
    x, y, yaw = 0.0, 0.0, 0.3
    v, omega = 0.06 * 4.0, 0.06 * 4.0 / 0.3
    for _ in range(10_000):
        x += dt * (v * math.cos(yaw) + omega * 0.15 * math.sin(yaw))
        y += dt * (v * math.sin(yaw) - omega * 0.15 * math.cos(yaw))
        yaw += dt * omega
    np.testing.assert_allclose(exact, [x, y, yaw], atol=1e-4)


def test_an_euler_step_is_the_published_one():
    theta = {"wheel_radius_m": 0.06, "axial_distance_m": 0.3, "x_icr_m": 0.15}
    state = plain.RobotState(1.0, 2.0, 0.3, 2.0, 6.0)
    after, v, omega = plain.step(theta, state, 2.0, 6.0, 0.1, euler=True)
    assert (v, omega) == pytest.approx((0.06 * 4.0, 0.06 * 4.0 / 0.3))
    assert after.x == pytest.approx(1.0 + 0.1 * (v * math.cos(0.3) + omega * 0.15 * math.sin(0.3)))
    assert after.y == pytest.approx(2.0 + 0.1 * (v * math.sin(0.3) - omega * 0.15 * math.cos(0.3)))
    assert after.yaw == pytest.approx(0.3 + 0.1 * omega)


def test_fast_turns_of_several_radians_a_step_stay_exact():
    model = Model(0.5, 0.1, 0.0)
    commands = [(-4.0, 4.0), (-8.0, 7.0)] * 5
    end = reference_run(model, commands, 0.1)[-1, :3]
    assert abs(end[2]) > 30.0
    np.testing.assert_allclose(run(model, (0.0,) * 5, commands)[-1, :3], end, atol=1e-6)


@pytest.mark.parametrize(("speed_rad_s", "carried"), [(3.0, 1.0), (0.1, 0.4)])
def test_a_robot_that_drifts_lies_beside_where_it_would_be(speed_rad_s, carried):
    model, yaw, drift = Model(0.06, 0.3, 0.15), 0.5, np.array([0.02, -0.03])
    commands = np.full((20, 2), speed_rad_s)
    start = np.array([1.0, 2.0, yaw, speed_rad_s, speed_rad_s])
    found = FreeRun(model, model.point()[None], 0.1).states(start, commands, 0, 0.0, 0, drift)
    time_s = 0.1 * np.arange(21)[:, None]
    ahead = np.array([math.cos(yaw), math.sin(yaw)])
    expected = start[:2] + time_s * (0.06 * speed_rad_s * ahead + carried * drift)
    np.testing.assert_allclose(found[:, :2], expected, atol=1e-12)
