"""The planner as a whole: it drives the circle, repeats itself bit for bit and answers as a function of time."""

import math
from pathlib import Path

import numpy as np
import pytest

from disco_hw.control import Circle, Disco, DiscoSettings, PlannerState, SentCommand, WheelLimits
from disco_hw.model import load_model

MODEL = load_model(Path(__file__).parents[2] / "disco_hw/robots/wombot_model.toml")
LIMITS = WheelLimits(8.0, 20.0)
TANGENT = PlannerState(0, 0.75, 0.0, math.pi / 2, 0.0, 0.0)


def drive(planner: Disco, seconds: float, period_s: float = 0.1):
    """Drive the paper's unicycle with a wheel lag of 0.1 s; returns the instant costs."""
    radius, axial, x_icr = 0.061, 0.415, 0.238
    x, y, yaw, wheels = TANGENT.x_m, TANGENT.y_m, TANGENT.yaw_rad, np.zeros(2)
    costs, sent, now_ns = [], (), 0
    for _ in range(round(seconds / period_s)):
        plan = planner.plan(now_ns, PlannerState(now_ns, x, y, yaw, wheels[0], wheels[1], sent))
        command = plan.at(now_ns)
        sent = (SentCommand(now_ns, *command),)
        for _ in range(20):
            dt = period_s / 20
            wheels = wheels + (np.array(command) - wheels) * dt / 0.1
            v, omega = radius * wheels.mean(), radius * (wheels[1] - wheels[0]) / axial
            x += dt * (v * math.cos(yaw) + omega * x_icr * math.sin(yaw))
            y += dt * (v * math.sin(yaw) - omega * x_icr * math.cos(yaw))
            yaw += dt * omega
        costs.append(planner.task.instant_cost(0.0, x, y, v))
        now_ns += round(period_s * 1e9)
    return np.array(costs)


@pytest.fixture(scope="module")
def planner():
    disco = Disco(MODEL, Circle(), DiscoSettings(), LIMITS, seed=3)
    disco.warm_up()
    return disco


def test_drives_the_circle_from_rest(planner):
    planner.reset()
    costs = drive(planner, 20.0)
    assert costs[100:].mean() < 0.04


def test_the_same_seed_and_states_give_the_same_plans_bit_for_bit():
    plans = []
    for _ in range(2):
        disco = Disco(MODEL, Circle(), DiscoSettings(), LIMITS, seed=5)
        plans.append([disco.plan(t * 20_000_000, TANGENT) for t in range(5)])
    for one, other in zip(*plans, strict=True):
        np.testing.assert_array_equal(one.wheel_speeds, other.wheel_speeds)
        np.testing.assert_array_equal(one.trajectory, other.trajectory)
        assert one.diagnostics == other.diagnostics
    other_seed = Disco(MODEL, Circle(), DiscoSettings(), LIMITS, seed=6).plan(0, TANGENT)
    assert not np.array_equal(other_seed.wheel_speeds, plans[0][0].wheel_speeds)


def test_warming_up_changes_no_plan(planner):
    cold = Disco(MODEL, Circle(), DiscoSettings(), LIMITS, seed=9)
    warm = Disco(MODEL, Circle(), DiscoSettings(), LIMITS, seed=9)
    warm.warm_up()
    np.testing.assert_array_equal(cold.plan(0, TANGENT).wheel_speeds, warm.plan(0, TANGENT).wheel_speeds)


def test_commands_stay_within_speed_and_acceleration():
    disco = Disco(MODEL, Circle(speed_m_s=3.0), DiscoSettings(), WheelLimits(2.0, 1.0), seed=1)
    for t in range(20):
        plan = disco.plan(t * 100_000_000, TANGENT)
        assert np.abs(plan.wheel_speeds).max() <= 2.0 + 1e-5
        steps = np.diff(np.vstack([[0.0, 0.0], plan.wheel_speeds]), axis=0)
        assert np.abs(steps).max() <= 0.1 + 1e-5
