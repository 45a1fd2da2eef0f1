"""A plan as a function of time."""

import numpy as np
import pytest

from disco_hw.control import Diagnostics, WheelPlan

SPEEDS = np.array([[0.0, 1.0], [2.0, 3.0], [4.0, -1.0]])
PLAN = WheelPlan(1_000_000_000, 0.1, SPEEDS, np.zeros((4, 3)), Diagnostics(20.0, 0.1, 1.0, 2.0, 1.5, 400))


@pytest.mark.parametrize(
    ("t_s", "expected"),
    [
        (0.5, (0.0, 1.0)),
        (1.0, (0.0, 1.0)),
        (1.05, (0.0, 1.0)),
        (1.1, (1.0, 2.0)),
        (1.15, (2.0, 3.0)),
        (1.225, (3.5, 0.0)),
        (1.25, (4.0, -1.0)),
        (9.0, (4.0, -1.0)),
    ],
)
def test_commands_are_linear_between_the_middles_of_steps(t_s, expected):
    assert PLAN.at(round(t_s * 1e9)) == pytest.approx(expected)


def test_age_and_expiry():
    assert PLAN.age_s(1_200_000_000) == pytest.approx(0.2)
    assert PLAN.age_s(900_000_000) == pytest.approx(-0.1)
    assert not PLAN.expired(1_300_000_000)
    assert PLAN.expired(1_300_000_001)
