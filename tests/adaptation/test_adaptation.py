import numpy as np
import pytest

from disco_hw.adaptation import CheckedAdaptation, NoAdaptation
from disco_hw.adaptation.adapter_link import InForce, LinkStats, Proposal, Range, Report, Samples
from disco_hw.adaptation.guard import BeliefGuard, Geometry
from disco_hw.log import records
from drivers.types import PoseSample, Readings, WheelSample

S = 1_000_000_000
MEAN = np.array([0.238, 0.061, 0.415])
STD = np.array([0.004, 0.0006, 0.004])
MODEL = Geometry(MEAN, np.diag(STD**2))


class FakeLink:
    def __init__(self) -> None:
        self.sent = []
        self.waiting = []
        self.alive = True
        self.restarted = 0

    @property
    def stats(self):
        return LinkStats(alive=self.alive)

    def send(self, message):
        self.sent.append(message)

    def receive(self):
        found, self.waiting = tuple(self.waiting), []
        return found

    def restart(self):
        if self.alive:
            return False
        self.alive = True
        self.restarted += 1
        return True

    def close(self):
        self.alive = False


class Bench:
    def __init__(self, refuse: bool = False) -> None:
        self.link = FakeLink()
        self.in_force = []
        self.refuse = refuse
        guard = BeliefGuard(MODEL, np.array([0.0, 0.0, 0.1]), np.array([0.5, 0.5, 0.5]))
        self.adaptation = CheckedAdaptation(self.link, guard, MODEL, self.put, 8.0)

    def put(self, geometry):
        if self.refuse:
            raise ValueError("too fast a turn")
        self.in_force.append(geometry)

    def step(self, t_s, *proposals, advantage=0.0):
        now_ns = round(t_s * S)
        if proposals or advantage:
            self.link.waiting.append(Report(now_ns, "so it goes", proposals, advantage))
        return self.adaptation.step(now_ns)


def proposal(t_s, scale=0.5, mean=MEAN):
    return Proposal(
        round(t_s * S), "recursive", tuple(mean.tolist()), tuple((scale**2 * np.diag(STD**2)).ravel()), 10.0
    )


def changes(learnt):
    return [record for record in learnt.records if isinstance(record, records.BeliefChange)]


def test_the_adapter_is_told_what_it_is_about():
    bench = Bench()
    bench.step(1.0)
    first, second = bench.link.sent
    assert isinstance(first, Range)
    assert first.wheel_rad_s == 8.0
    assert isinstance(second, InForce)
    assert not second.adapted


def test_what_passes_is_in_force_recorded_and_told_to_the_adapter():
    bench = Bench()
    bench.step(1.0)
    learnt = bench.step(10.0, proposal(10.0))
    (change,) = changes(learnt)
    assert change.source == "adapted"
    assert change.mean == tuple(MEAN.tolist())
    assert bench.in_force[-1].std == pytest.approx(0.5 * STD)
    assert np.reshape(change.covariance, (3, 3)) == pytest.approx(bench.in_force[-1].covariance, abs=0.0)
    assert bench.link.sent[-1].adapted
    assert bench.adaptation.status()["belief"] == "adapted"
    assert bench.adaptation.counts()["published"] == 1


def test_what_the_planner_refuses_is_not_in_force():
    bench = Bench(refuse=True)
    bench.step(1.0)
    learnt = bench.step(10.0, proposal(10.0))
    assert not changes(learnt)
    assert bench.adaptation.status()["belief"] == "model"
    assert learnt.records[-1].outcome == "refused"


def test_revert_brings_the_model_back_and_keeps_it():
    bench = Bench()
    bench.step(1.0)
    bench.step(10.0, proposal(10.0))
    assert bench.adaptation.ask("revert")[0]
    (change,) = changes(bench.step(11.0))
    assert change.source == "model"
    assert bench.in_force[-1] is None
    assert not changes(bench.step(20.0, proposal(20.0)))
    assert bench.adaptation.status()["paused"]
    bench.adaptation.ask("adapt")
    bench.step(21.0)
    assert bench.link.sent[-1].relearn
    assert changes(bench.step(22.0, proposal(22.0)))


@pytest.mark.parametrize("advantage", [-6.0, float("nan"), float("-inf")])
def test_a_belief_that_predicts_worse_than_the_model_goes(advantage):
    bench = Bench()
    bench.step(1.0)
    bench.step(10.0, proposal(10.0))
    learnt = bench.step(13.0, proposal(13.0, 0.2), advantage=advantage)
    assert [change.source for change in changes(learnt)] == ["model"]
    assert bench.in_force[-1] is None
    assert bench.link.sent[-1].relearn
    assert bench.adaptation.counts()["reverted"] == 1
    assert changes(bench.step(20.0, proposal(20.0)))


def test_silence_is_told_once_and_leaves_the_belief():
    bench = Bench()
    bench.step(1.0)
    bench.step(10.0, proposal(10.0))
    told = [text for t_s in np.arange(11.0, 30.0) for text in bench.step(t_s).events]
    assert len(told) == 1
    assert "says nothing" in told[0]
    assert bench.adaptation.status()["belief"] == "adapted"
    assert bench.adaptation.status()["silent"]
    assert "back" in bench.step(31.0, proposal(31.0, 0.2)).events[-1]


def test_death_is_told_and_mended_only_when_asked_to():
    bench = Bench()
    bench.step(1.0)
    bench.step(10.0, proposal(10.0))
    bench.link.alive = False
    assert "has ended" in bench.step(10.1).events[0]
    assert bench.link.restarted == 0
    assert bench.adaptation.status()["belief"] == "adapted"
    bench.adaptation.tend()
    assert bench.link.restarted == 1
    bench.step(12.0)
    begin = [message for message in bench.link.sent[-3:] if isinstance(message, InForce)]
    assert [message.adapted for message in begin] == [False, True]


def test_samples_go_out_with_every_tick():
    bench = Bench()
    wheels = WheelSample(5, 6, 1.0, 2.0, 3.0, 4.0)
    pose = PoseSample(7, 8, 0.1, 0.2, 0.3, 0.01, 0.01)
    bench.adaptation.feed(9, Readings(wheels=(wheels,), poses=(pose,)))
    bench.adaptation.feed(10, Readings())
    first, second = bench.link.sent
    assert isinstance(first, Samples)
    assert (first.wheels[0].left_rad, first.poses[0].yaw_rad) == (1.0, 0.3)
    assert second.now_ns == 10


def test_a_daemon_that_does_not_adapt_says_how_to():
    obeyed, text = NoAdaptation().ask("revert")
    assert not obeyed
    assert "--adapt" in text
