"""The pendulum experiment: its figures from costs that are known, its files, and the paper's ordering."""

import csv
import math

import numpy as np
import pytest

from disco_hw.control import pendulum
from disco_hw.experiments.pendulum import CURVES, POSTERIOR, PRIOR, PendulumOptions, PendulumResult, run_pendulum


def test_the_experiment_is_the_papers():
    five = ("true parameters", "UT, prior", "UT, posterior", "MC, prior", "MC, posterior")
    assert tuple(CURVES) == (*five, "posterior mean", "UT, truth")
    np.testing.assert_allclose(POSTERIOR.mean(), [0.8918, 0.8985])
    np.testing.assert_allclose(np.diag(POSTERIOR.covariance()), [0.0093, 0.0027])
    np.testing.assert_allclose(PRIOR.mean(), [2.55, 2.55])
    sampler = pendulum.PAPER_SAMPLER
    assert (sampler.samples, sampler.horizon, sampler.temperature, sampler.noise_std) == (500, 30, 10.0, 1.0)


def test_figures_of_costs_that_are_known():
    costs = {"one": np.array([[4.0, 4.0, 4.0, 0.0], [8.0, 8.0, 8.0, 8.0]])}
    (row,) = PendulumResult(PendulumOptions(seeds=2, steps=4), costs).rows()
    assert row["mean_cost"] == pytest.approx(5.5)
    assert row["std_over_seeds"] == pytest.approx(5.0 / math.sqrt(2.0))
    assert row["standard_error"] == pytest.approx(2.5)
    assert row["mean_cost_last_quarter"] == pytest.approx(4.0)


@pytest.fixture(scope="module")
def swings():
    reported = []
    return run_pendulum(PendulumOptions(seeds=3, steps=200), reported.append), reported


@pytest.mark.thorough
def test_the_papers_ordering(swings):
    result, reported = swings
    assert [line.rsplit(":", 1)[0] for line in reported] == list(CURVES)
    mean = {name: costs.mean() for name, costs in result.costs.items()}
    for posterior in ("UT, posterior", "MC, posterior"):
        assert mean[posterior] < 0.5 * min(mean["UT, prior"], mean["MC, prior"])
    # Three seeds do not separate the two to better than a few per cent.
    assert mean["UT, posterior"] < 1.05 * mean["true parameters"]
    # It swings up, and stays up.
    assert all(result.costs[name][:, -50:].mean() < 1.0 for name in ("true parameters", "UT, posterior"))
    assert result.costs["UT, prior"][:, 0].min() > 150.0


@pytest.mark.thorough
def test_what_it_knows_of_the_mean_matters_and_what_it_knows_of_the_spread_does_not(swings):
    mean = {name: costs.mean() for name, costs in swings[0].costs.items()}
    assert mean["posterior mean"] == pytest.approx(mean["UT, posterior"], rel=0.02)
    assert mean["UT, truth"] == pytest.approx(mean["true parameters"], rel=0.02)
    assert mean["posterior mean"] < 0.99 * mean["true parameters"]
    # Alike they are not the same: the transform does plan under five points.
    for one, other in (("posterior mean", "UT, posterior"), ("UT, truth", "true parameters")):
        assert not np.array_equal(swings[0].costs[one], swings[0].costs[other])


@pytest.mark.thorough
def test_seeds_repeat_and_an_offset_goes_on_where_other_seeds_ended(swings):
    result, _ = swings
    again = run_pendulum(PendulumOptions(seeds=1, steps=15))
    for name in CURVES:
        np.testing.assert_array_equal(again.costs[name], result.costs[name][:1, :15])
        assert not np.array_equal(result.costs[name][0], result.costs[name][1])
    last = run_pendulum(PendulumOptions(seeds=1, steps=15, seed_offset=2))
    np.testing.assert_array_equal(last.costs["MC, posterior"], result.costs["MC, posterior"][2:, :15])


@pytest.fixture
def made_up():
    """What a run could have given."""
    random = np.random.default_rng(1)
    return PendulumResult(
        PendulumOptions(seeds=3, steps=200), {name: random.exponential(50.0, (3, 200)) for name in CURVES}
    )


def test_the_band_of_costs_is_never_below_zero(made_up, tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr("disco_hw.experiments.pendulum.write_pictures", lambda figure, path: figures.append(figure))
    made_up.write_pictures(tmp_path / "pendulum.png")
    axes = figures[0].axes[0]
    assert "rad²/s²" in axes.get_ylabel()
    assert all(band.get_paths()[0].vertices[:, 1].min() >= 0.0 for band in axes.collections)


def test_table_csv_and_picture(made_up, tmp_path):
    result = made_up
    for fragment in (*CURVES, "3 seeds from 0 on, 200 steps of 0.05 s"):
        assert fragment in result.table()
    result.write_csv(tmp_path / "pendulum.csv")
    rows = list(csv.DictReader((tmp_path / "pendulum.csv").open()))
    assert len(rows) == 200
    assert rows[-1]["t_s"] == "10.00"
    one = result.costs["UT, posterior"][:, 7]
    assert float(rows[7]["UT, posterior: mean"]) == pytest.approx(one.mean(), rel=1e-5)
    assert float(rows[7]["UT, posterior: std"]) == pytest.approx(one.std(), rel=1e-4)
    result.write_pictures(tmp_path / "pendulum.png")
    assert (tmp_path / "pendulum.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "pendulum.pdf").read_bytes()[:4] == b"%PDF"
    assert "<svg" in (tmp_path / "pendulum.svg").read_text()
