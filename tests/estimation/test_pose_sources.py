"""Several pose sources: fused in order of their stamps, a liar left out where the wheels show it, else a stop."""

import math

import msgspec
import numpy as np
import pytest

from disco_hw.config import Estimation
from disco_hw.estimation import PoseFusion
from disco_hw.estimation.correction import PoseReason
from disco_hw.estimation.odometry import OdometryParameters
from drivers.types import PoseSample
from tests.estimation.truth import drives, pose_error
from tests.tables import thinned

DRIVE = drives(1, 8.0, speeds=lambda t: (4.0, 5.0))
GEOMETRY = OdometryParameters(0.061, 0.415, 0.238)
FAST, SLOW = 0, 1
"""A motion capture at 25 Hz with heading, and a GPS receiver at 5 Hz without one that is 150 ms late."""


def sample_of_fast(index, off=(0.0, 0.0)):
    given = DRIVE.pose_sample(0, index)
    return msgspec.structs.replace(given, x_m=given.x_m + off[0], y_m=given.y_m + off[1], source=FAST)


def sample_of_slow(t_ns, truth, rng, off=(0.0, 0.0)):
    x, y = truth[:2] + rng.normal(0.0, 0.02, 2) + off
    return PoseSample(t_ns, t_ns + 150_000_000, float(x), float(y), math.nan, 0.02, math.nan, source=SLOW)


class Run:
    """The drive's samples as they arrive; each is off by what `off_fast(t_s)` and `off_slow(t_s)` say, None: silent."""

    def __init__(self, off_fast=lambda t: (0.0, 0.0), off_slow=lambda t: (0.0, 0.0), **settings):
        self.fusion = PoseFusion(Estimation(**settings), GEOMETRY, 0.15, ("natnet", "nmea"))
        self.output_lines, self.ok, self.updates = [], [], []
        rng = np.random.default_rng(3)
        arrivals = []
        for number, wheels in enumerate(DRIVE.wheels):
            t_s = number * 0.01
            arrivals.append((wheels.t_ns, 0, wheels))
            if number % 4 == 0 and off_fast(t_s) is not None:
                arrivals.append((wheels.t_ns, 1, sample_of_fast(number // 4, off_fast(t_s))))
            if number % 20 == 0 and off_slow(t_s) is not None:
                slow_sample = sample_of_slow(wheels.t_ns, DRIVE.truth[0, number], rng, off_slow(t_s))
                arrivals.append((slow_sample.received_ns, 2, slow_sample))
        self.start_ns = DRIVE.wheels[0].t_ns
        for now_ns, kind, sample in sorted(arrivals, key=lambda each: each[:2]):
            if kind:
                self.updates.append((sample, self.fusion.add_pose(sample, now_ns)))
                continue
            self.fusion.add_wheels(sample)
            self.fusion.sources.step(now_ns)
            self.output_lines += [
                ((now_ns - self.start_ns) * 1e-9, message) for message in self.fusion.sources.new_messages()
            ]
            self.ok.append(self.fusion.estimate(now_ns).pose_ok)
        self.end_ns = DRIVE.wheels[-1].t_ns

    def off_m(self):
        return math.hypot(*pose_error(self.fusion.estimate(self.end_ns), DRIVE.truth[0, -1])[:2])

    def standings(self):
        return [one.standing.value for one in self.fusion.sources.all]

    def status_text(self):
        return " | ".join(message for _, message in self.output_lines)


def test_two_that_agree_are_fused_each_late_pose_at_its_own_time():
    run = Run()
    assert run.standings() == ["good", "good"]
    assert all(run.ok[40:])
    assert run.off_m() < 0.03
    slow = run.fusion.sources.all[SLOW]
    assert slow.accepted >= 38
    assert slow.latency_s == pytest.approx(0.15)
    alone = Run(off_slow=lambda t: None).fusion.estimate(run.end_ns)
    assert run.fusion.estimate(run.end_ns).x_m != alone.x_m


def test_the_order_in_which_they_come_changes_no_bit():
    def fused(order):
        fusion = PoseFusion(Estimation(), GEOMETRY, 0.15, ("a", "b"))
        for wheels in DRIVE.wheels[:40]:
            fusion.add_wheels(wheels)
        now_ns = DRIVE.wheels[39].t_ns
        fusion.add_pose(sample_of_fast(0), now_ns)
        poses = [sample_of_fast(5), msgspec.structs.replace(sample_of_fast(5, (0.004, 0.0)), source=SLOW)]
        reasons = {fusion.add_pose(poses[index], now_ns).reason for index in order}
        assert reasons == {PoseReason.ACCEPTED}
        assert fusion.add_pose(poses[0], now_ns).reason is PoseReason.DUPLICATE
        return fusion.estimate(now_ns)

    assert fused((0, 1)) == fused((1, 0))


@pytest.mark.parametrize("silent", [FAST, SLOW])
def test_a_lost_one_is_said_and_the_other_goes_on(silent):
    def off(t):
        return None if t > 3.0 else (0.0, 0.0)

    run = Run(off_fast=off) if silent == FAST else Run(off_slow=off)
    label = ("natnet", "nmea")[silent]
    loss_times_s = [
        at_s for at_s, message in run.output_lines if message.startswith(f"{label}: no pose for 1 s; continuing with ")
    ]
    assert len(loss_times_s) == 1
    assert 3.8 < loss_times_s[0] < 4.3
    assert run.standings()[silent] == "lost"
    assert all(run.ok[40:])
    assert run.off_m() < 0.1


def test_all_lost_is_no_pose():
    run = Run(off_fast=lambda t: None if t > 3.0 else (0.0, 0.0), off_slow=lambda t: None if t > 3.0 else (0.0, 0.0))
    assert not any(run.ok[420:])
    assert run.status_text().count("no other source is left") == 1


@pytest.mark.parametrize("liar", [FAST, SLOW])
def test_one_that_jumps_is_left_out_even_if_it_speaks_more_often(liar):
    def off(t):
        return (0.5, 0.0) if t > 4.0 else (0.0, 0.0)

    # With so short a lock-out the fast one agrees with itself often enough between two poses of the slow one.
    settings = {"gate_lockout_count": 3}
    run = Run(off_fast=off, **settings) if liar == FAST else Run(off_slow=off, **settings)
    label = ("natnet", "nmea")[liar]
    assert (
        f"{label}: its poses jumped, which the wheels do not explain, and are not used; continuing with"
        in run.status_text()
    )
    assert run.standings()[liar] == "jumped"
    assert all(run.ok[40:])
    assert run.off_m() < 0.1
    assert run.fusion.sources.all[liar].outliers > 10


def test_one_that_jumped_and_came_back_is_used_again():
    run = Run(off_slow=lambda t: (0.5, 0.0) if 2.0 < t < 4.5 else (0.0, 0.0))
    assert run.standings() == ["good", "good"]
    assert [text for _, text in run.output_lines if text.startswith("nmea: ")][-1] == "nmea: its poses are used"


def test_a_single_outlier_of_one_is_counted_and_changes_nothing():
    run = Run(off_slow=lambda t: (2.0, 0.0) if 3.9 < t < 4.1 else (0.0, 0.0))
    assert run.fusion.sources.all[SLOW].outliers == 1
    assert run.standings() == ["good", "good"]
    assert all(run.ok[40:])


@pytest.mark.parametrize("liar", [FAST, SLOW])
@thinned("m_s", [0.03, 0.1], quick=1)
def test_two_that_drift_apart_stop_as_nobody_knows_who_is_right(liar, m_s):
    def off(t):
        return (max(0.0, t - 2.0) * m_s, 0.0)

    run = Run(off_fast=off) if liar == FAST else Run(off_slow=off)
    assert "disagree" in run.status_text()
    assert "jumped" not in run.status_text()
    assert not run.ok[-1]
    assert run.fusion.sources.contradiction


def test_two_of_equal_weight_that_pull_the_estimate_between_them_contradict_each_other():
    """Either is within the gate, as the estimate lies half-way."""
    fusion = PoseFusion(Estimation(), GEOMETRY, 0.15, ("a", "b"))
    for number, wheels in enumerate(DRIVE.wheels):
        fusion.add_wheels(wheels)
        if number % 4 == 0:
            fusion.add_pose(sample_of_fast(number // 4), wheels.t_ns)
            off = (min(0.065, 0.02 * number * 0.01), 0.0)
            fusion.add_pose(msgspec.structs.replace(sample_of_fast(number // 4, off), source=1), wheels.t_ns)
        fusion.sources.step(wheels.t_ns)
        if fusion.sources.contradiction:
            break
    assert [one.standing.value for one in fusion.sources.all] == ["good", "good"]
    assert "a and b disagree: 0.0" in fusion.sources.contradiction


def test_two_that_never_agreed_do_not_even_start():
    run = Run(off_slow=lambda t: (0.7, 0.0))
    assert not any(run.ok[60:])
    assert "nmea and natnet disagree by more than their stated noise; the task stops" in run.status_text()


def test_both_carried_off_together_are_believed():
    def off(t):
        return (1.0, 0.5) if t > 4.0 else (0.0, 0.0)

    run = Run(off_fast=off, off_slow=off)
    estimate = run.fusion.estimate(run.end_ns)
    assert estimate.reinitialisations == 1
    assert math.hypot(*(pose_error(estimate, DRIVE.truth[0, -1])[:2] - (1.0, 0.5))) < 0.1
    # Both say so, so that nobody waits for a time-out.
    assert all(run.ok[40:])


def test_a_liar_takes_over_only_after_the_task_has_stopped():
    """The good one is lost while the other lies: no tick in between may say that all is well."""
    run = Run(
        off_fast=lambda t: None if t > 4.0 else (0.0, 0.0),
        off_slow=lambda t: (0.5, 0.0) if t > 2.0 else (0.0, 0.0),
        gate_lockout_count=2,
    )
    assert run.fusion.estimate(run.end_ns).reinitialisations == 1
    assert run.ok[400]
    first_wrong = run.ok.index(False, 400)
    assert 500 <= first_wrong <= 520
    assert sum(not ok for ok in run.ok[first_wrong:]) > 60


def test_one_alone_behaves_as_ever_and_says_nothing():
    fusion = PoseFusion(Estimation(), GEOMETRY, 0.15)
    for number, wheels in enumerate(DRIVE.wheels[:400]):
        fusion.add_wheels(wheels)
        if number % 4 == 0:
            fusion.add_pose(sample_of_fast(number // 4, (1.0, 0.0) if number > 200 else (0.0, 0.0)), wheels.t_ns)
        fusion.sources.step(wheels.t_ns)
        assert not fusion.sources.new_messages()
    assert fusion.estimate(DRIVE.wheels[399].t_ns).reinitialisations == 1
    assert fusion.sources.counts() == {}


@pytest.mark.parametrize(
    ("changes", "age_s", "text"),
    [
        (
            {"x_m": 5e5, "y_m": -5e6},
            0.1,
            "poses at (500000, -5000000) m are over 1000 m from the origin; set pose.origin",
        ),
        ({"yaw_rad": 2e4}, 0.1, "poses have an impossible heading or offset; check the pose sensor and pose.offset"),
        ({"position_std_m": math.nan}, 0.1, "poses hold what is not a number; check the pose sensor"),
        (
            {},
            1.3,
            "poses are 1.3 s old, over estimation.history_s = 1; raise it, or correct the clock of the pose sensor",
        ),
        ({}, -0.2, "poses are stamped 0.20 s in the future; correct the clock of the pose sensor"),
    ],
    ids=["far", "heading", "not a number", "old", "future"],
)
def test_the_first_refusal_of_a_kind_is_reported_and_holds_until_a_pose_is_used(changes, age_s, text):
    fusion = PoseFusion(Estimation(), GEOMETRY, 0.15, ("natnet",))
    for wheels in DRIVE.wheels[:200]:
        fusion.add_wheels(wheels)
    now_ns = wheels.t_ns
    good = PoseSample(now_ns, now_ns, 1.0, 2.0, 0.3, 0.01, 0.02)
    for number in range(3):
        t_ns = now_ns - round(1e9 * age_s) + number
        fusion.add_pose(msgspec.structs.replace(good, t_ns=t_ns, **changes), now_ns)
    assert fusion.sources.new_messages() == [f"natnet: {text}"]
    assert fusion.sources.refusal(now_ns) == f"natnet: {text}"
    assert fusion.add_pose(good, now_ns).accepted
    assert (fusion.sources.new_messages(), fusion.sources.refusal(now_ns)) == ([], "")


def test_a_refusal_does_not_explain_why_later_poses_are_missing():
    fusion = PoseFusion(Estimation(), GEOMETRY, 0.15, ("natnet",))
    for wheels in DRIVE.wheels[:200]:
        fusion.add_wheels(wheels)
    now_ns = wheels.t_ns
    good = PoseSample(now_ns, now_ns, 1.0, 2.0, 0.3, 0.01, 0.02)
    many = [msgspec.structs.replace(good, t_ns=now_ns - 200_000_000 + 1_000_000 * k) for k in range(200)]
    reasons = [fusion.add_pose(one, now_ns).reason for one in many]
    assert reasons[-1] is PoseReason.OVERFLOW
    assert "more than 100 poses a second" in fusion.sources.new_messages()[0]
    assert fusion.sources.refusal(now_ns) == ""
    fusion.add_pose(msgspec.structs.replace(good, t_ns=now_ns + 10**9), now_ns)
    assert "in the future" in fusion.sources.refusal(now_ns)
    assert fusion.sources.refusal(now_ns + 2 * 10**9) == ""


def test_poses_further_apart_than_the_timeout_are_named_as_why_there_is_none():
    fusion = PoseFusion(Estimation(), GEOMETRY, 0.15, ("gps",))
    second_ns, come_ns = 10**9, []
    for wheels in DRIVE.wheels[:300]:
        fusion.add_wheels(wheels)
        if not come_ns or wheels.t_ns - come_ns[-1] >= second_ns:
            come_ns.append(wheels.t_ns)
            assert fusion.sources.refusal(wheels.t_ns) == ""
            fusion.add_pose(PoseSample(wheels.t_ns, wheels.t_ns, 1.0, 2.0, 0.3, 1.0, 1.0), wheels.t_ns + 20_000_000)
        if len(come_ns) == 2:
            break
    assert fusion.sources.all[0].accepted == 2
    text = (
        "gps: poses come 1 s apart and 0.02 s late, with estimation.pose_timeout_s = 1; raise that, or send poses more "
        "often"
    )
    assert fusion.sources.refusal(come_ns[-1] + second_ns) == text
    assert fusion.sources.refusal(come_ns[-1] + 3 * second_ns) == ""


def test_a_pose_from_before_the_first_wheel_sample_needs_no_remedy():
    fusion = PoseFusion(Estimation(), GEOMETRY, 0.15, ("natnet",))
    fusion.add_wheels(DRIVE.wheels[0])
    t_ns = DRIVE.wheels[0].t_ns
    update = fusion.add_pose(PoseSample(t_ns - 150_000_000, t_ns, 1.0, 2.0, 0.3, 0.01, 0.02), t_ns)
    assert update.reason is PoseReason.TOO_OLD
    assert (fusion.sources.new_messages(), fusion.sources.refusal(t_ns)) == ([], "")
