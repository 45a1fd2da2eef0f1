import numpy as np
import pytest

from disco_hw.log import records
from disco_hw.viewer.recording import PLAN_AGE_NS, snapshot_at, thinned
from disco_hw.viewer.timeline import Timeline
from tools.viewer_run import LEFT_RAD_S, PERIOD_NS, RIGHT_RAD_S, START_NS, plan_at, pose_at


def test_an_instant_is_what_was_known_then(timeline):
    at_ns = START_NS + 50 * PERIOD_NS + 1
    shot = snapshot_at(timeline, at_ns, plan_at(50))
    assert shot.pose == pytest.approx(pose_at(50))
    assert shot.wheel_speeds == (LEFT_RAD_S, RIGHT_RAD_S)
    assert shot.wheel_angles == pytest.approx((LEFT_RAD_S * 1.0, RIGHT_RAD_S * 1.0))
    assert shot.command == (LEFT_RAD_S, RIGHT_RAD_S)
    assert shot.in_force
    assert shot.source == "plan"
    assert shot.covariance[1, 1] == 4e-4
    assert shot.state.state == "ARMED"
    assert shot.status.fault == "NONE"
    assert shot.voltage_v == 24.5
    assert len(shot.trail) == 51
    assert shot.trail[-1] == pytest.approx(pose_at(50)[:2])
    assert len(shot.poses) == 26
    assert [event.text for _, event in shot.events] == ["ready -> armed: armed on request"]


def test_later_things_are_not_known_yet(timeline):
    early = snapshot_at(timeline, START_NS + 5 * PERIOD_NS, None)
    assert early.state is None
    assert early.events == ()
    assert snapshot_at(timeline, START_NS - 1, None).pose is None


def test_nothing_known_is_shown_as_nothing():
    shot = snapshot_at(Timeline(), 7, None)
    assert shot.pose is None
    assert shot.wheel_speeds is None
    assert np.isnan(shot.covariance).all()
    assert len(shot.trail) == len(shot.poses) == 0


def test_an_old_plan_is_none(timeline):
    plan = plan_at(50)
    assert snapshot_at(timeline, plan.t_ns + PLAN_AGE_NS, plan).plan is plan
    assert snapshot_at(timeline, plan.t_ns + PLAN_AGE_NS + 1, plan).plan is None


def test_the_trail_begins_with_the_first_pose():
    line = Timeline()
    for t_ns, x_m, healthy in ((1, 0.0, False), (2, 0.7, True), (3, 0.8, True)):
        line.add(t_ns, records.Estimate(t_ns, x_m, 0.0, 0.0, (0.0,) * 9, 0.0, 0.0, 0.0, 0.0, True, healthy))
    assert snapshot_at(line, 3, None).trail[:, 0].tolist() == [0.7, 0.8]


@pytest.mark.parametrize("length", [0, 1, 10, 11, 20, 21, 1000])
def test_thinning_keeps_both_ends_and_bounds_the_number(length):
    rows = np.arange(length, dtype=float)[:, None]
    kept = thinned(rows, 10)
    assert len(kept) <= 11
    if length:
        assert kept[0] == 0
        assert kept[-1] == length - 1


def test_a_growing_trail_keeps_its_points():
    shorter = thinned(np.arange(500.0)[:, None], 100)[:-1]
    longer = thinned(np.arange(505.0)[:, None], 100)
    assert longer[: len(shorter)].tolist() == shorter.tolist()
