"""The filter on a robot of other equations, and a network that says what each test has it say."""

import numpy as np
import pytest

from disco_hw.adaptation.adapter_link import NAMES, Proposal, Report
from disco_hw.adaptation.fast import AuditedAdaptation
from disco_hw.adaptation.guard import Geometry
from disco_hw.log.records import Adaptation, BeliefChange
from tests.adaptation.test_adaptation import FakeLink
from tools.foreign_plant import NOMINAL, ForeignPlant, ForeignRobot

MEAN = np.array([NOMINAL[2], NOMINAL[0], NOMINAL[1]])
MODEL = Geometry(MEAN, np.diag((0.08 * MEAN) ** 2))
OTHERWISE = MEAN * (1.0, 1.0, 1.2)


class Bench:
    """A robot that turned for 4 s, so that the filter knows it, with every record, event and belief since then."""

    def __init__(self, refused=()):
        self.link, self.put, self.refused = FakeLink(), [], list(refused)
        self.adaptation = AuditedAdaptation(MODEL, 0.5 * MEAN, 1.6 * MEAN, self.link, self._put, 8.0)
        self.plant = ForeignPlant(ForeignRobot(*NOMINAL), (0.0, 0.0, 0.3), 5)
        self.records, self.events = [], []
        self.drive(4.0)
        assert self.adaptation.status()["belief"] == "adapted"
        self.put.clear(), self.records.clear()

    def _put(self, geometry):
        if geometry is not None and any(np.allclose(geometry.mean, mean) for mean in self.refused):
            raise ValueError("too fast a turn")
        self.put.append(geometry)

    def drive(self, seconds):
        for _ in range(round(seconds / 0.02)):
            learnt = self.adaptation.step(self.plant.now_ns)
            self.records += learnt.records
            self.events += learnt.events
            self.adaptation.feed(self.plant.now_ns, self.plant.readings())
            self.plant.advance(2.6, 4.6, 20)

    def network_says(self, *means, estimator="network", doubt=""):
        """One estimate after the other, a second apart."""
        for mean in means:
            covariance = tuple(np.diag((0.01 * mean) ** 2).ravel().tolist())
            proposal = Proposal(self.plant.now_ns, estimator, tuple(mean.tolist()), covariance, 10.0, doubt)
            self.link.waiting.append(Report(self.plant.now_ns, "so it goes", (proposal,)))
            self.drive(1.0)

    def outcomes(self):
        return [record.outcome for record in self.records if isinstance(record, Adaptation)]


def test_a_network_that_agrees_is_recorded_and_changes_nothing():
    bench = Bench()
    bench.network_says(*[MEAN * 1.01] * 4)
    assert bench.outcomes() == ["audit"] * 4
    assert "agree" in bench.adaptation.status()["audit"]
    assert not np.isin(1.01 * MEAN, [geometry.mean for geometry in bench.put]).any()


def test_a_network_that_goes_on_to_disagree_takes_over_and_says_so():
    bench = Bench()
    bench.network_says(OTHERWISE, OTHERWISE, OTHERWISE)
    assert bench.outcomes() == ["audit"] * 3 + ["taken_over"]
    assert any("takes over" in event and NAMES[2] in event for event in bench.events)
    np.testing.assert_allclose(bench.put[-1].mean, OTHERWISE)
    changes = [record for record in bench.records if isinstance(record, BeliefChange)]
    np.testing.assert_allclose(changes[-1].mean, OTHERWISE)
    assert bench.adaptation.status()["mean"][NAMES[2]] == pytest.approx(OTHERWISE[2])
    assert bench.adaptation.counts()["takeovers"] == 1
    # From now on the network alone is heard, and put in force.
    count = len(bench.put)
    bench.drive(2.0)
    assert len(bench.put) == count
    bench.network_says(*[MEAN * (1.0, 1.0, 1.24)] * 4)
    assert bench.put[-1].mean[2] == pytest.approx(1.24 * MEAN[2])


def test_one_that_disagrees_for_a_short_time_or_has_doubts_does_not_take_over():
    bench = Bench()
    bench.network_says(OTHERWISE, OTHERWISE, MEAN, OTHERWISE, OTHERWISE)
    bench.network_says(MEAN)
    bench.network_says(*[OTHERWISE] * 4, doubt="outside the training range")
    bench.network_says(*[OTHERWISE] * 4, estimator="recursive")
    assert "taken_over" not in bench.outcomes()
    assert bench.adaptation.counts()["takeovers"] == 0


def test_what_the_network_would_have_done_meanwhile_is_not_put_in_force():
    bench = Bench()
    bench.network_says(OTHERWISE, OTHERWISE)
    for geometry in bench.put:
        assert geometry is not None
        assert abs(geometry.mean[2] / MEAN[2] - 1.0) < 0.05


def test_the_filter_begins_again_when_asked():
    bench = Bench()
    bench.network_says(*[OTHERWISE] * 3)
    assert bench.adaptation.ask("adapt")[0]
    bench.drive(0.04)
    assert bench.put[-1] is None
    assert isinstance(bench.records[-1], BeliefChange)
    assert bench.records[-1].source == "model"
    bench.drive(6.0)
    assert abs(bench.put[-1].mean[2] / MEAN[2] - 1.0) < 0.05


def test_the_model_file_is_in_force_after_a_revert_whoever_drove():
    for means in ((), (OTHERWISE,) * 3):
        bench = Bench()
        bench.network_says(*means)
        assert bench.adaptation.ask("revert")[0]
        bench.drive(2.0)
        assert bench.put[-1] is None
        assert bench.adaptation.status()["belief"] == "model"


def test_a_network_that_the_planner_cannot_follow_leaves_the_model_file():
    bench = Bench(refused=[OTHERWISE])
    bench.network_says(*[OTHERWISE] * 3)
    assert bench.put[-1] is None
    assert bench.adaptation.status()["belief"] == "model"


def test_without_the_network_the_filter_goes_on():
    bench = Bench()
    bench.link.alive = False
    bench.drive(1.0)
    assert bench.outcomes() == ["lost"]
    assert any("without an audit" in event for event in bench.events)
    assert bench.adaptation.status()["belief"] == "adapted"
    bench.adaptation.tend()
    assert bench.link.restarted == 1
    bench.adaptation.close()
