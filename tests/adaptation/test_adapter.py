import math
import subprocess
import sys
from functools import cache

import numpy as np
import pytest

from disco_hw.adaptation.adapter import Adapter
from disco_hw.adaptation.adapter_link import InForce
from disco_hw.adaptation.network import Training, train_network, training_range
from disco_hw.inference.excitation import USUAL
from disco_hw.model import Model
from tools.adaptation_drives import TRUTH, messages

WIDE = tuple((np.diag([0.02, 0.006, 0.04]) ** 2).ravel().tolist())
NARROW = tuple((np.diag([0.002, 0.0003, 0.002]) ** 2).ravel().tolist())


@cache
def network():
    low, high = training_range(np.array(TRUTH), np.array([0.0, 0.005, 0.1]), np.array([0.5, 0.5, 0.5]))
    return train_network(Training(low, high, 8.0, drives=40, of_each=10), USUAL, Model(0.061, 0.415, 0.238))


def run(adapter, sent):
    return [report for report in map(adapter.take, sent) if report is not None]


def begun(covariance=WIDE, network=None):
    adapter = Adapter(network)
    adapter.take(InForce(0, TRUTH, covariance, adapted=False))
    return adapter


def proposals(reports):
    return [proposal for report in reports for proposal in report.proposals]


def test_a_report_a_second():
    reports = run(begun(), messages(10.0))
    assert [round(report.now_ns * 1e-9) for report in reports] == list(range(10))


def test_what_it_proposes_gets_narrow_and_is_right():
    found = proposals(run(begun(), messages(30.0, truth=(0.22, 0.065, 0.40))))
    last = found[-1]
    std = np.sqrt(np.diag(np.reshape(last.covariance, (3, 3))))
    assert (np.abs(np.array(last.mean) - (0.22, 0.065, 0.40)) < 3.0 * std).all()
    assert (std < (0.006, 0.0008, 0.008)).all()
    assert not last.doubt


def test_the_same_messages_give_the_same_reports():
    sent = messages(12.0)
    assert run(begun(), sent) == run(begun(), sent)


def test_standing_proposes_nothing_and_says_so():
    reports = run(begun(), messages(8.0, wheels=lambda t: (0.0, 0.0)))
    assert not proposals(reports)
    assert "standing" in reports[-1].text


def test_no_update_after_the_robot_has_stopped():
    sent = messages(20.0, wheels=lambda t: (2.5, 4.0) if t < 10.0 else (0.0, 0.0))
    reports = run(begun(), sent)
    assert proposals(reports[:10])
    assert not proposals(reports[13:])


def test_straight_driving_says_what_it_cannot_tell():
    reports = run(begun(), messages(12.0, wheels=lambda t: (4.0, 4.0)))
    assert not proposals(reports)
    assert "low excitation: axial distance not determined" in reports[-1].text


def test_without_poses_nothing_is_learnt():
    sent = [message.__class__(message.now_ns, message.wheels) for message in messages(8.0)]
    assert not proposals(run(begun(), sent))


def test_garbage_among_the_samples_is_left_out():
    sent = messages(10.0)
    bad = [
        type(message)(
            message.now_ns,
            tuple(w.__class__(w.t_ns, math.nan, math.inf) for w in message.wheels) if k % 9 == 0 else message.wheels,
            tuple(p.__class__(p.t_ns, math.nan, p.y_m, p.yaw_rad) for p in message.poses)
            if k % 7 == 0
            else message.poses,
        )
        for k, message in enumerate(sent)
    ]
    last = proposals(run(begun(), bad))[-1]
    assert last.mean[1] == pytest.approx(TRUTH[1], rel=0.03)


def test_a_change_casts_doubt_first_and_is_proposed_then():
    changed = (TRUTH[0], TRUTH[1] * 1.15, TRUTH[2])
    reports = run(begun(NARROW), messages(40.0, change_s=20.0, changed=changed))
    after = [p for p in proposals(reports) if p.t_ns > 27e9 and not p.doubt]
    assert after
    assert after[-1].mean[1] == pytest.approx(changed[1], rel=0.015)
    wrong = [p for p in proposals(reports) if 21e9 < p.t_ns < 27e9 and not p.doubt and p.mean[1] < 1.03 * TRUTH[1]]
    assert len(wrong) <= 1


def test_the_model_is_told_to_be_better_when_it_is():
    """A wrong adapted belief loses against a right one of the model file, and a right one wins against a wrong one."""
    for truth, wins in ((TRUTH, False), ((TRUTH[0], TRUTH[1] * 1.1, TRUTH[2]), True)):
        adapter = begun(NARROW)
        sent = messages(20.0, truth=truth)
        run(adapter, sent[:250])
        adapter.take(InForce(sent[250].now_ns, (TRUTH[0], TRUTH[1] * 1.1, TRUTH[2]), NARROW, adapted=True))
        advantage = run(adapter, sent[250:])[-1].advantage
        assert (advantage > 5.0) if wins else (advantage < -5.0)


def test_the_network_is_conditioned_every_few_seconds():
    found = proposals(run(begun(network=network()), messages(30.0)))
    inferred = [p for p in found if p.estimator == "network"]
    assert 5 <= len(inferred) <= 8
    std = np.sqrt(np.diag(np.reshape(inferred[-1].covariance, (3, 3))))
    assert (np.abs(np.array(inferred[-1].mean) - TRUTH) < 4.0 * std).all()


def test_what_lies_outside_the_training_range_is_doubted():
    far = (0.238, 0.15, 0.415)
    wide = tuple((np.diag([0.1, 0.1, 0.2]) ** 2).ravel().tolist())
    found = proposals(run(begun(wide, network()), messages(15.0, truth=far)))
    assert "outside what was simulated" in found[-1].doubt


def test_the_adapter_takes_samples_before_torch_is_loaded():
    program = "import sys, disco_hw.adaptation.adapter; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False, timeout=120).returncode == 0
