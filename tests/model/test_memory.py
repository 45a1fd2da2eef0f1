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


def test_the_body_is_asked_in_its_own_speeds():
    v, w = np.full(500, 0.4), np.full(500, -0.9)
    turning = BODY_MEMORIES["omega"]["(omega - mean_1s(omega))"].at_nodes(STEP_S, v, w)
    assert turning[99] == pytest.approx(-0.9 * LEFT)
    forward = BODY_MEMORIES["v_x"]["(v - mean_1s(v))"].at_nodes(STEP_S, v, w)
    assert forward[99] == pytest.approx(0.4 * LEFT)
    assert BODY_MEMORIES["v_y"] == {}
