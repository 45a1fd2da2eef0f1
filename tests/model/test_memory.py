"""Features that remember: means that fade, as a first-order lag makes them."""

import math

import numpy as np
import pytest

from disco_hw.model.terms import BODY_MEMORIES, COMMAND_MEMORIES

STEP_S = 0.01
STEADY = np.full((2000, 2), (3.0, -2.0))
# What is left of a step after a second, in the mean over the hundredth step.
LEFT = (math.exp(-0.99) - math.exp(-1.0)) / STEP_S


def of_command(form, u):
    return COMMAND_MEMORIES[form].at_nodes(STEP_S, u, u[:, ::-1])


def test_a_mean_has_followed_a_step_by_63_percent_after_its_time():
    speed, rate = np.full(2000, 3.0), np.full(2000, -2.0)
    from_mean = BODY_MEMORIES["omega"]["(omega - mean_1s(omega))"].at_nodes(STEP_S, speed, rate)
    assert from_mean[99] == pytest.approx(-2.0 * LEFT)
    assert pytest.approx(math.exp(-1.0), rel=0.01) == LEFT
    assert from_mean[-1] == pytest.approx(0.0, abs=1e-6)
    slower = BODY_MEMORIES["v_x"]["(v - mean_3s(v))"].at_nodes(STEP_S, speed, rate)
    assert slower[299] == pytest.approx(3.0 * math.exp(-2.995 / 3.0), rel=1e-5)
    # Each by its own speed.
    assert BODY_MEMORIES["v_x"]["(v - mean_1s(v))"].at_nodes(STEP_S, speed, rate)[99] == pytest.approx(3.0 * LEFT)
    assert BODY_MEMORIES["v_y"] == {}


def test_what_both_wheels_take_lowers_each_in_proportion():
    load = of_command("u mean_1s(|u| + |u_other|)", STEADY)
    assert load[-1] == pytest.approx([15.0, -10.0], rel=1e-6)
    assert load[99] == pytest.approx(np.array([15.0, -10.0]) * (1.0 - LEFT))


def test_a_motor_warms_with_the_square_of_its_command():
    heat = of_command("u mean_30s(u^2)", STEADY)
    assert heat[-1] == pytest.approx(np.array([27.0, -8.0]) * (1.0 - math.exp(-20.0 / 30.0)), rel=1e-3)


def test_a_direction_is_that_of_the_last_change_and_fades():
    up_then_down = np.repeat([[1.0, 1.0], [3.0, 3.0], [2.0, 2.0]], 400, axis=0)
    direction = of_command("sign(u - mean_0.3s(u))", up_then_down)
    assert direction[405] == pytest.approx([1.0, 1.0], abs=0.01)
    assert direction[805] == pytest.approx([-1.0, -1.0], abs=0.02)
    assert direction[-1] == pytest.approx([0.0, 0.0], abs=1e-3)


def test_a_change_of_the_command_is_overshot_and_comes_to_rest():
    up = np.repeat([[1.0, -2.0], [3.0, -1.0]], 1000, axis=0)
    changed = of_command("(u - mean_1s(u))", up)
    assert changed[999] == pytest.approx([0.0, 0.0], abs=1e-3)
    assert changed[1099] == pytest.approx([2.0 * LEFT, 1.0 * LEFT], rel=1e-3)


def test_a_robot_whose_tyres_slip_follows_its_wheels_by_so_much_a_second():
    v = np.concatenate([np.full(40, 1.0), np.full(60, -0.2)])
    behind = BODY_MEMORIES["v_x"]["(v - slewed_5(v))"].at_nodes(STEP_S, v, 0.0 * v)
    # 0.05 m/s a step, half of it in the mean over the step in which it goes on.
    assert behind[:3] == pytest.approx([0.975, 0.925, 0.875])
    assert behind[20:40] == pytest.approx(np.zeros(20), abs=1e-12)
    assert behind[40:42] == pytest.approx([-1.175, -1.125])
    assert behind[64:] == pytest.approx(np.zeros(36), abs=1e-12)
    slower = BODY_MEMORIES["v_x"]["(v - slewed_1.25(v))"].at_nodes(STEP_S, v, 0.0 * v)
    assert slower[:2] == pytest.approx([1.0 - 0.00625, 1.0 - 0.01875])
    # What is nearer than a step's way is there for the rest of it.
    near = BODY_MEMORIES["v_x"]["(v - slewed_5(v))"].at_nodes(STEP_S, np.full(2, 0.03), np.zeros(2))
    assert near == pytest.approx([0.03 * 0.03 / 0.05 / 2.0, 0.0])
