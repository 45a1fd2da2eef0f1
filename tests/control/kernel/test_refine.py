"""The refinement's rollout against robots that are integrated in small steps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from disco_hw.control.kernel.refine import LateralLag, Problem, X, Y, refine
from disco_hw.control.parameter_points import mean_point
from disco_hw.control.refinement import create_buffers
from disco_hw.model import Model
from disco_hw.model.model import coefficient_tables
from disco_hw.model.step import integration_series

STEP_S, STEPS = 0.1, 15
RADIUS_M, AXLE_M, X_ICR_M = 0.06, 0.4, 0.25


def integrated(commands, lag_s):
    """Places (N + 1, 2) of a robot whose wheels obey at once and whose sideways speed comes `lag_s` later."""
    fine_s = 1e-4
    x = y = yaw = 0.0
    side_m_s, places = -X_ICR_M * RADIUS_M * (commands[0, 1] - commands[0, 0]) / AXLE_M, [(0.0, 0.0)]
    for left, right in commands:
        forward_m_s, turn_rad_s = 0.5 * RADIUS_M * (left + right), RADIUS_M * (right - left) / AXLE_M
        for _ in range(round(STEP_S / fine_s)):
            side_m_s += (-X_ICR_M * turn_rad_s - side_m_s) * fine_s / lag_s
            x += fine_s * (forward_m_s * math.cos(yaw) - side_m_s * math.sin(yaw))
            y += fine_s * (forward_m_s * math.sin(yaw) + side_m_s * math.cos(yaw))
            yaw += fine_s * turn_rad_s
        places.append((x, y))
    return np.array(places)


@pytest.mark.parametrize("lag_s", [0.02, 0.12])
def test_a_body_slides_late_behind_its_turning(lag_s):
    model = Model(RADIUS_M, AXLE_M, X_ICR_M)
    base, effects = coefficient_tables(model, mean_point(model), STEP_S)
    turning = 2.0 * np.sin(1.5 * STEP_S * np.arange(STEPS) + 0.4)
    commands = np.column_stack([4.0 - turning, 4.0 + turning])
    buffers = create_buffers(STEPS, 0, None)
    buffers.starts[0] = commands

    def rolled_out(lateral):
        problem = Problem(
            np.array([0.0, 0.0, 0.0, *commands[0]]), 0.0, np.zeros(2), lateral, None, base, effects,
            integration_series(STEP_S, wide=True), 0, np.zeros((STEPS, 2), np.float32), 100.0, 100.0, commands[0],
            0.0, np.array([1.0, 0.0], np.float32), 1.0, 0.0,
        )  # fmt: skip
        refine(problem, buffers, 1, 0)
        return buffers.states[:, [X, Y]].copy()

    expected = integrated(commands, lag_s)
    assert rolled_out(LateralLag.of(lag_s, STEP_S))[1:] == pytest.approx(expected[1:], abs=3e-4)
    at_once = rolled_out(LateralLag.of(0.0, STEP_S))
    assert np.abs(at_once[1:] - expected[1:]).max() > 0.1 * lag_s * X_ICR_M
