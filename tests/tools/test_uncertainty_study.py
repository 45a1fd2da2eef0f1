"""The sled before a wall: its drive, its points and its table on cases that can be worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tools import uncertainty_study


class FullAhead:
    """A planner that never brakes."""

    def __init__(self, *_arguments, **_options):
        pass

    def plan(self, _state):
        """One command, the largest."""
        return np.array([[1.0]])


def test_a_sled_that_never_brakes_hits_the_wall_after_27_steps(monkeypatch):
    monkeypatch.setattr(uncertainty_study, "BlackBoxDisco", FullAhead)
    cost, furthest_m = uncertainty_study.run("mean alone", 0.0, 1)
    # 15 steps at 1 m/s^2 from -3 m to -1.875 m, then 30 of 0.15 m at 1.5 m/s, the last 18 of them beyond the wall.
    assert furthest_m == pytest.approx(2.625, abs=1e-4)
    assert cost == pytest.approx((38.8 + 10.8 + 24.3 + 18 * 100.0) / 45, rel=1e-5)


def test_sigma_points_lie_one_standard_deviation_to_either_side():
    found, weights = uncertainty_study.points("sigma", 0.3, 0.5, np.random.default_rng(1))
    assert found[weights > 0.0, 0] == pytest.approx([1.3, 0.7])
    assert weights[weights > 0.0] == pytest.approx([0.5, 0.5])
    assert uncertainty_study.points("truth", 0.3, 0.5, np.random.default_rng(1))[0] == 0.5


def test_the_table_has_mean_standard_error_hits_and_median(monkeypatch, capsys):
    drives = {5: (1.0, -0.02), 6: (2.0, -0.04), 7: (6.0, 0.1)}
    monkeypatch.setattr(uncertainty_study, "run", lambda _name, _width, seed: drives[seed])
    monkeypatch.setattr("sys.argv", ["uncertainty_study", "--seeds", "3", "--seed-offset", "5"])
    assert uncertainty_study.main() == 0
    # Standard error: the root of ((1 - 3)^2 + (2 - 3)^2 + (6 - 3)^2) / 2 / 3.
    assert "| 10% | mean alone | 3.000 | 1.528 | 1 of 3 | 20 |" in capsys.readouterr().out
