"""The circle experiment: its figures from runs that are known, its plants, its files, a short drive of each curve."""

import csv
import math
from dataclasses import replace

import numpy as np
import pytest

from disco_hw.control.plan import ROTATION
from disco_hw.errors import InputError
from disco_hw.experiments.circle import CURVES, CircleOptions, CircleResult, Run, drive, plants, run_circle
from disco_hw.model import Gaussian
from disco_hw.tasks.circle import CircleCost
from tests.tasks.costs import instant_cost
from tests.tasks.drives import MEAN, MODEL


def standing(place, count=40, commands=None):
    """A run that stays in one place."""
    commands = np.zeros((count, 2)) if commands is None else commands
    return Run(np.tile([*place, 0.0], (count, 1)), np.zeros(count), commands)


def test_figures_of_runs_that_are_known():
    # One robot stands on the edge, c = s0; one 0.15 m inside it, c = hypot(0.15, 0.2); its left command saws.
    saw = np.column_stack([np.arange(40) % 2 * 0.1 * ROTATION, np.zeros(40)])
    runs = {"one": [standing((0.75, 0.0)), standing((0.0, 0.6), commands=saw)]}
    result = CircleResult(CircleOptions(seeds=2, duration_s=4.0), CircleCost(), "default", runs)
    (row,) = result.rows()
    assert row["mean_cost"] == row["steady_cost"] == pytest.approx(0.225)
    assert row["std_over_seeds"] == pytest.approx(0.05 / math.sqrt(2.0))
    assert row["steady_rms_mm"] == pytest.approx(150.0 / math.sqrt(2.0))
    assert row["steady_worst_mm"] == pytest.approx(150.0)
    assert row["command_change_rot_s"] == pytest.approx(0.1 / 4.0)
    fast = CircleResult(CircleOptions(seeds=2, rate_hz=20.0), CircleCost(), "default", runs)
    assert fast.rows()[0]["command_change_rot_s"] == pytest.approx(0.0)


def test_only_the_last_half_is_steady():
    run = standing((0.75, 0.0))
    run.forward_m_s[20:] = 0.2
    result = CircleResult(CircleOptions(seeds=1), CircleCost(), "default", {"one": [run]})
    (row,) = result.rows()
    assert (row["mean_cost"], row["steady_cost"]) == pytest.approx((0.1, 0.0))
    assert math.isnan(row["std_over_seeds"])


def test_plants_are_drawn_from_the_posterior():
    samples = np.array([[plant[name] for name in MODEL.belief.names] for plant in plants(MODEL, 4000)])
    np.testing.assert_allclose(samples.mean(axis=0), MODEL.belief.mean(), atol=1e-3)
    np.testing.assert_allclose(np.cov(samples.T), MODEL.belief.covariance(), atol=1.5e-5)
    assert plants(MODEL, 3) == plants(MODEL, 5)[:3]
    assert plants(MODEL, 2, first=3) == plants(MODEL, 5)[3:]


def test_a_wider_belief_is_that_of_plants_and_controllers_alike(monkeypatch):
    known = {}

    def noted(model, task, settings, options, seed):
        known.setdefault(len(known), model)
        return lambda now_ns, state: (0.0, 0.0)

    monkeypatch.setattr("disco_hw.experiments.circle.planner_command", noted)
    run_circle(MODEL, "default", CircleOptions(seeds=1, duration_s=1.0, belief_scale=3.0))
    models = dict(zip(CURVES, known.values(), strict=True))
    np.testing.assert_allclose(models["posterior"].belief.covariance(), 9.0 * MODEL.belief.covariance())
    assert models["posterior mean"].belief is None
    of_mean = dict(zip(MODEL.parameter_names, models["posterior mean"].point(), strict=True))
    of_truth = dict(zip(MODEL.parameter_names, models["true parameters"].point(), strict=True))
    (plain,) = plants(MODEL, 1)
    for name, value in zip(MODEL.belief.names, MODEL.belief.mean(), strict=True):
        assert of_mean[name] == pytest.approx(value)
        assert of_truth[name] - value == pytest.approx(3.0 * (plain[name] - value))


def test_a_robot_without_commands_stands_at_the_cost_of_standing():
    calls = []

    def command(now_ns, state):
        calls.append((now_ns, state.t_ns, len(state.sent)))
        return 0.0, 0.0

    run = drive(command, MEAN, CircleOptions(duration_s=3.0), 1)
    np.testing.assert_array_equal(run.poses, np.tile([0.75, 0.0, math.pi / 2], (30, 1)))
    assert [now_ns for now_ns, _, _ in calls] == [t_ns for _, t_ns, _ in calls] == list(range(0, 3 * 10**9, 10**8))
    assert [count for _, _, count in calls] == [min(step, 20) for step in range(30)]
    assert instant_cost(CircleCost(), *run.poses[-1, :2], run.forward_m_s[-1]) == pytest.approx(0.2)


@pytest.fixture(scope="module")
def short():
    # Bounded acceleration, as a real robot's: its planner is compiled already.
    reported = []
    options = CircleOptions(seeds=8, duration_s=6.0, largest_rot_s2=3.0)
    return run_circle(MODEL, "default", options, reported.append), reported


@pytest.mark.thorough
def test_every_curve_is_driven_and_reported(short):
    result, reported = short
    assert tuple(result.runs) == CURVES
    assert [line.split(":")[0] for line in reported] == list(CURVES)
    cost = {row["controller"]: row["steady_cost"] for row in result.rows()}
    # Who knows the robot is on the way after six seconds from rest. The truth is worth something over many plants, not
    # on one that happens to be the posterior's mean.
    assert cost["true parameters"] < 0.03
    assert cost["true parameters"] < cost["posterior"] < cost["point estimate"] < cost["prior"]


@pytest.mark.thorough
def test_table_csv_and_picture(short, tmp_path):
    result, _ = short
    table = result.table()
    for fragment in (*CURVES, "lag_s = 0.1", "wheel_noise = 0.05", "largest_rot_s = 1", "rate_hz = 10", "mode default"):
        assert fragment in table
    result.write_csv(tmp_path / "circle.csv")
    rows = list(csv.DictReader((tmp_path / "circle.csv").open()))
    assert list(rows[0]) == ["t_s", *CURVES]
    assert (len(rows), rows[-1]["t_s"]) == (60, "6.000")
    # The running mean of the instant cost ends at the mean cost.
    for row in result.rows():
        assert float(rows[-1][row["controller"]]) == pytest.approx(row["mean_cost"], rel=1e-5)
    result.write_pictures(tmp_path / "circle.png")
    assert (tmp_path / "circle.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "circle.pdf").read_bytes()[:4] == b"%PDF"
    assert "<svg" in (tmp_path / "circle.svg").read_text()


def test_a_model_without_the_posterior_is_refused():
    one = Gaussian(("wheel_radius_m",), np.array([0.06]), np.array([[1e-5]]))
    for belief in (None, one):
        with pytest.raises(InputError, match="no belief over wheel radius, axial distance and x_icr"):
            run_circle(replace(MODEL, belief=belief))
