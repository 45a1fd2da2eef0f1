import numpy as np
import pytest

from disco_hw.adaptation.recursive import RecursiveGeometry, evidence
from disco_hw.inference.excitation import Noise
from tools.adaptation_drives import TRUTH, excited

NOISE = Noise(0.005, 0.01, 0.004, 0.004, 0.012)
WIDE = np.diag([0.02, 0.006, 0.04]) ** 2
LIMIT = 30.0


def judged(drive, every_s=1.0, covariance=WIDE, fold_s=1e9, limit=LIMIT):
    """What is said every second, with a window that never lets go unless told."""
    whole = evidence(drive, NOISE)
    recursive = RecursiveGeometry(np.array(TRUTH), covariance, limit)
    found = []
    for now_s in np.arange(2.0, whole.t_s[-1], every_s):
        found.append(recursive.judge(whole.part(whole.t_s <= now_s), now_s - fold_s))
    return found


def test_folding_changes_nothing_but_the_drift():
    drive = excited(30.0)
    kept, folded = judged(drive)[-1], judged(drive, fold_s=8.0)[-1]
    std = np.sqrt(np.diag(kept.covariance))
    assert np.abs(folded.mean - kept.mean).max() < np.max(0.7 * std)
    assert np.sqrt(np.diag(folded.covariance)) == pytest.approx(std, rel=0.35)
    assert np.all(np.diag(folded.covariance) > np.diag(kept.covariance))


def test_no_change_is_found_where_there_is_none():
    for seed in range(6):
        assert all(one.changed_s is None for one in judged(excited(40.0, seed=seed), fold_s=15.0))


@pytest.mark.parametrize(("index", "factor"), [(1, 1.15), (1, 0.85), (2, 1.15), (2, 0.85)])
def test_a_change_is_found_at_its_time_and_learnt(index, factor):
    changed = list(TRUTH)
    changed[index] *= factor
    found = judged(excited(40.0, change_s=20.0, changed=tuple(changed)), fold_s=15.0)
    first = next(one for one in found if one.changed_s is not None)
    assert first.changed_s == pytest.approx(20.0, abs=1.5)
    last = found[-1]
    assert last.mean[index] == pytest.approx(changed[index], rel=0.02)
    assert last.since_s > 19.0
    before = found[17]
    assert before.mean[index] == pytest.approx(TRUTH[index], rel=0.03)


def test_published_widths_cover_the_truth_before_and_after_a_change():
    """90 % of 90 % intervals: of 24 drives with 3 parameters between 76 % and 98 %."""
    inside = []
    for seed in range(24):
        changed = (TRUTH[0], TRUTH[1] * 1.15, TRUTH[2])
        drive = excited(20.0, seed=seed, change_s=8.0, changed=changed)
        last = judged(drive, every_s=3.0)[-1]
        inside.append(np.abs(last.mean - changed) < 1.645 * np.sqrt(np.diag(last.covariance)))
    assert 0.76 < np.mean(inside) < 0.98


def test_after_a_change_on_a_straight_the_turning_is_not_known():
    changed = (TRUTH[0], TRUTH[1] * 1.2, TRUTH[2])

    def wheels(t_s):
        return (2.5, 4.0) if t_s < 10.0 else (4.0, 4.0)

    last = judged(excited(20.0, change_s=10.0, changed=changed, wheels=wheels))[-1]
    assert last.mean[1] == pytest.approx(changed[1], rel=0.02)
    assert np.sqrt(last.covariance[2, 2]) > 0.15 * TRUTH[2]
