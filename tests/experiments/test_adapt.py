"""A short form of the experiment through the daemon's core; the full one is `disco-hw experiment adapt`."""

from __future__ import annotations

from dataclasses import replace as replaced

import msgspec
import numpy as np
import pytest

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.experiments.adapt import AdaptOptions, AdaptResult, AdaptRun, drive
from disco_hw.log import records
from disco_hw.log.recorder import MemoryRecorder
from disco_hw.runtime.replay import replay
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.tasks.circle import CircleTask
from tests.runtime.test_replay import write_log

pytestmark = pytest.mark.long

CHANGE_S = 4.0
OPTIONS = AdaptOptions(change_s=CHANGE_S, settled_s=10.0, compared_s=0.5, seeds=1)


@pytest.fixture(scope="module")
def adapted():
    """A drive on which the wheels grow by 15 % after 4 s: what it did and what was recorded."""
    setup = load_setup(SHIPPED_ROBOT)
    recorder = MemoryRecorder()
    effects = {"surface_change": (0.0, CHANGE_S + 2.0, 0.15)}
    return drive(setup, effects, OPTIONS, adapted=True, seed=1, recorder=recorder), recorder.ticks


def test_the_belief_follows_the_change(adapted):
    run, _ = adapted
    assert len(run.beliefs) > 2
    _, mean, std = run.beliefs[-1]
    assert mean[1] == pytest.approx(0.061 * 1.15, abs=3.0 * std[1] + 0.001)
    assert std[1] < 0.002


def test_an_adapted_run_replays_bit_for_bit_and_not_without_its_beliefs(tmp_path, adapted):
    _, ticks = adapted
    report = replay(write_log(tmp_path / "run.mcap", ticks))
    assert report.ok, report.as_text()
    assert report.ticks == len(ticks)
    without = [(now, [one for one in tick if not isinstance(one, records.BeliefChange)]) for now, tick in ticks]
    assert not replay(write_log(tmp_path / "without.mcap", without)).ok


def test_a_robot_that_drives_backwards_is_judged_by_its_speed_backwards():
    setup = load_setup(SHIPPED_ROBOT)
    control = msgspec.structs.replace(setup.config.control, facing="backwards")
    setup = replaced(setup, config=msgspec.structs.replace(setup.config, control=control))
    run = drive(setup, {}, AdaptOptions(change_s=3.0, settled_s=1.0, compared_s=2.0, seeds=1), adapted=False, seed=1)
    assert run.cost[run.t_s > 4.0].max() < 0.1


def made_up(loss: float, adapted: float) -> AdaptRun:
    """A run whose laps of 10 s cost 0.01 in their first half and 0.03 in their second.

    After 60 s so much is lost, and after 67 s so much of it remains.
    """
    t_s = np.arange(0.02, 120.0, 0.02)
    cost = np.where(t_s % 10.0 < 5.0, 0.01, 0.03)
    cost = cost + np.where(t_s < 60.0, 0.0, np.where(t_s < 67.0, loss, adapted))
    return AdaptRun(t_s, cost, np.zeros((t_s.size, 2)), ((0.0, np.ones(3), np.ones(3)), (64.0, np.ones(3), np.ones(3))))


def test_the_figures_are_what_they_say(tmp_path):
    runs = {
        ("wheel radius", False): [made_up(0.04, 0.04)],
        ("wheel radius", True): [made_up(0.04, 0.01)],
        ("nothing", False): [made_up(0.0, 0.0)],
        ("nothing", True): [made_up(0.0, 0.0)],
    }
    result = AdaptResult(AdaptOptions(seeds=1), CircleTask(), runs)
    row, nothing = result.rows()
    assert row["cost_before"] == pytest.approx(0.02, rel=0.01)
    assert row["cost_after"] == pytest.approx(0.06, rel=0.01)
    assert row["won_back"] == pytest.approx(0.75)
    assert row["published_s"] == pytest.approx(4.0)
    # Over 5 s half of the 0.04 are back when two thirds of them are without 0.03; the lap's own ups and downs cancel.
    assert row["half_back_s"] == pytest.approx(7.0 + 5.0 * 2.0 / 3.0, abs=0.05)
    assert np.isnan(nothing["won_back"])
    result.write_csv(tmp_path / "adapt.csv")
    result.write_pictures(tmp_path / "adapt.png")
    assert (tmp_path / "adapt.svg").exists()
    assert (tmp_path / "adapt.csv").read_text().startswith('t_s,"wheel radius, not adapting, seed 1"')
    assert "75%" in result.table()


def test_what_is_never_won_back_is_said_to_be():
    runs = {(name, adapted): [made_up(0.0, 0.0)] for name in ("axial distance", "nothing") for adapted in (False, True)}
    runs["axial distance", False], runs["axial distance", True] = [made_up(0.04, 0.04)], [made_up(0.04, 0.03)]
    row, _ = AdaptResult(AdaptOptions(seeds=1), CircleTask(), runs).rows()
    assert row["won_back"] == pytest.approx(0.25)
    assert row["half_back_s"] == np.inf
