"""The rewind buffer: order, exactness, bounds."""

import itertools
import random

import msgspec
import pytest

from disco_hw.config import Estimation
from disco_hw.estimation import RewindBuffer
from disco_hw.estimation.correction import Measurement, PoseReason
from disco_hw.estimation.filter import Evaluation, PoseFilter
from disco_hw.estimation.odometry import OdometryParameters, Pose, WheelReading
from tests.tables import thinned

PARAMETERS = OdometryParameters(0.061, 0.415, 0.238)
MS = 1_000_000
SETTINGS = Estimation(gate_lockout_count=3)


def reading(t_ms, gap=False):
    t = t_ms * 1e-3
    return WheelReading(round(t_ms * MS), 3.0 * t, 3.5 * t + t * t, 3.0, 3.5 + 2 * t, gap)


def measured(t_ms, x=0.0, y=0.0, yaw=0.0):
    return Measurement(round(t_ms * MS), Pose(x, y, yaw), 1e-4, 4e-4, False)


def near(t_ms):
    """A pose about where the readings lead, so that it passes the gate."""
    t = t_ms * 1e-3
    wobble = 0.01 * ((t_ms * 7919) % 13 - 6) / 6
    return measured(t_ms, 0.061 * (3.25 * t + t * t / 2) + wobble, -wobble, 0.061 / 0.415 * (0.5 * t + t * t))


def buffer_with(wheels_ms, history_s=1.0):
    first, *rest = wheels_ms
    buffer = RewindBuffer(PoseFilter(SETTINGS, PARAMETERS), reading(first), history_s)
    for t_ms in rest:
        buffer.add_wheels(reading(t_ms))
    return buffer


def run(events, first=0):
    """Feed (wheel time or Measurement) in this order; the final state."""
    buffer = buffer_with([first])
    for event in events:
        if isinstance(event, Measurement):
            assert isinstance(buffer.add_pose(event), Evaluation)
        else:
            buffer.add_wheels(reading(event))
    return buffer.head()


def test_every_order_of_arrival_gives_the_same_bits():
    poses = [near(5), near(20), near(23), near(27), near(40.5)]
    wheels = [10, 20, 30, 40, 50]
    in_order = run(sorted([*poses, *wheels], key=lambda e: e.t_ns / MS if isinstance(e, Measurement) else e - 1e-3))
    assert in_order.pose_t_ns == poses[-1].t_ns
    for permutation in itertools.permutations(poses):
        assert run([*wheels, *permutation]) == in_order


@thinned("seed", range(20), quick=5)
def test_random_delays_with_outliers_and_a_lockout_give_the_same_bits(seed):
    rng = random.Random(seed)
    wheels = [10 * k for k in range(1, 90)]
    poses = []
    for k in range(22):
        t_ms = 40 * k + rng.uniform(0.0, 39.0)
        pose = near(t_ms)
        if rng.random() < 0.2 or 10 <= k < 16:
            pose = measured(t_ms, pose.pose.x_m + (0.5 if k >= 10 else rng.uniform(1, 2)), 0.3, 0.1)
        poses.append(pose)

    def arrivals(delay):
        timed = [(t_ms * MS, 0, t_ms) for t_ms in wheels] + [(p.t_ns + delay(), 1, p) for p in poses]
        return [event for *_, event in sorted(timed, key=lambda item: item[:2])]

    ordered = run(arrivals(lambda: 0))
    assert ordered.reinitialisations >= 1
    assert run(arrivals(lambda: 30 * MS)) == ordered
    for _ in range(3):
        assert run(arrivals(lambda: rng.uniform(0.0, 400.0) * MS)) == ordered


def test_a_pose_between_wheel_readings_sees_interpolated_angles():
    buffer = buffer_with([0, 10, 20])
    buffer.add_pose(near(0.0))
    buffer.add_pose(near(12.5))
    state = buffer._states[-1]
    assert state.t_ns == 12.5 * MS
    assert state.left_rad == pytest.approx(0.75 * reading(10).left_rad + 0.25 * reading(20).left_rad)
    assert state.right_rad == pytest.approx(0.75 * reading(10).right_rad + 0.25 * reading(20).right_rad)


def test_a_pose_beyond_the_newest_reading_is_run_again_on_measured_wheels():
    poses_first = buffer_with([0, 10])
    poses_first.add_pose(near(0.0))
    poses_first.add_pose(near(18.0))
    extrapolated = poses_first.head()
    poses_first.add_wheels(reading(20))
    wheels_first = buffer_with([0, 10, 20])
    wheels_first.add_pose(near(0.0))
    wheels_first.add_pose(near(18.0))
    assert poses_first.head() == wheels_first.head()
    assert extrapolated.right_rad != wheels_first._states[-2].right_rad


def test_a_pose_at_the_stamp_of_a_reading_comes_after_it_whichever_arrives_first():
    assert run([10, near(5.0), near(20.0), 20, 30]) == run([10, near(5.0), 20, near(20.0), 30])


def test_a_pose_inside_a_gap_shares_its_doubt():
    buffer = buffer_with([0, 10])
    buffer.add_pose(near(10.0))
    buffer.add_wheels(reading(1010, gap=True))
    update = buffer.add_pose(near(510.0))
    half_m = 0.061 * (3.25 * 0.5 + 0.505**2)
    assert update.innovation_variance[0] > (0.25 * half_m * 0.9) ** 2


def test_a_pose_older_than_the_buffer_is_refused():
    buffer = buffer_with([10 * k for k in range(251)])
    assert buffer.add_pose(measured(1499.0)) is PoseReason.TOO_OLD
    assert isinstance(buffer.add_pose(measured(1500.0)), Evaluation)


def test_a_pose_at_the_far_end_of_the_buffer_gives_the_same_bits():
    wheels = [10 * k for k in range(1, 230)]
    on_time = run([*wheels[:130], near(1300.0), near(1310.0), *wheels[130:]])
    delayed = run([*wheels[:130], near(1310.0), *wheels[130:], near(1300.0)])
    assert on_time == delayed


def test_a_repeated_stamp_is_refused():
    buffer = buffer_with([0, 10, 20])
    buffer.add_pose(near(10.0))
    before = buffer.head()
    assert buffer.add_pose(measured(10.0, 5.0)) is PoseReason.DUPLICATE
    assert buffer.head() == before
    assert isinstance(buffer.add_pose(near(30.0)), Evaluation)
    buffer.add_wheels(reading(30))
    assert buffer.add_pose(near(30.0)) is PoseReason.DUPLICATE


def test_poses_far_beyond_the_newest_reading_have_no_odometry():
    buffer = buffer_with([0, 10])
    assert isinstance(buffer.add_pose(measured(1010.0)), Evaluation)
    assert buffer.add_pose(measured(1011.0)) is PoseReason.NO_ODOMETRY


def test_length_is_bounded_whatever_the_rates():
    buffer = buffer_with([0.0])
    for k in range(1, 3000):
        buffer.add_wheels(reading(k * 0.5))
        buffer.add_pose(measured(k * 0.5 - 0.25))
        assert len(buffer) <= buffer.capacity
    assert buffer.capacity == 301
    assert isinstance(buffer.head().t_ns, int)


@thinned("rate_hz", [240, 120, 360, 1000], quick=1)
def test_of_more_than_100_poses_a_second_the_rest_is_left_out_evenly(rate_hz):
    buffer = buffer_with([0])
    kept_ms = []
    for k in range(4 * rate_hz):
        t_ms = 1000.0 * k / rate_hz
        if t_ms >= buffer.newest_wheels.t_ns / MS + 10.0:
            buffer.add_wheels(reading(buffer.newest_wheels.t_ns / MS + 10.0))
        outcome = buffer.add_pose(measured(t_ms))
        assert outcome is PoseReason.OVERFLOW or isinstance(outcome, Evaluation)
        kept_ms += [t_ms] if isinstance(outcome, Evaluation) else []
        assert len(buffer) <= buffer.capacity
    gaps_ms = [after - before for before, after in itertools.pairwise(kept_ms)]
    assert max(gaps_ms) < 10.0 + 1000.0 / rate_hz
    # A second's worth may come at once; from then on they are as many as time has passed.
    assert len(kept_ms) == pytest.approx(min(4 * rate_hz, 500), abs=2)


def test_up_to_100_poses_a_second_none_is_left_out_in_whatever_order_and_by_whatever_jitter():
    rng = random.Random(1)
    poses = [measured(max(0.0, 10.0 * k + rng.uniform(-9.0, 9.0))) for k in range(90)]
    in_order = run(
        sorted([*poses, *range(1, 1000, 10)], key=lambda e: e.t_ns / MS if isinstance(e, Measurement) else e)
    )
    rng.shuffle(poses)
    assert run([*range(1, 1000, 10), *poses]) == in_order


def of_source(source, t_ms):
    return msgspec.structs.replace(near(t_ms), source=source)


def test_a_fast_source_takes_nothing_from_a_slow_one_that_is_late():
    buffer = RewindBuffer(PoseFilter(SETTINGS, PARAMETERS), reading(0), 1.0, 2)
    for t_ms in range(10, 2000, 10):
        buffer.add_wheels(reading(t_ms))
        fast = [isinstance(buffer.add_pose(of_source(0, t_ms - k)), Evaluation) for k in range(9, -1, -1)]
        assert sum(fast) == 1 or t_ms < 200
        if t_ms % 200 == 0 and t_ms > 900:
            assert isinstance(buffer.add_pose(of_source(1, t_ms - 899.5)), Evaluation)


def test_a_flood_of_four_sources_while_no_wheels_come_breaks_nothing():
    buffer = RewindBuffer(PoseFilter(SETTINGS, PARAMETERS), reading(0), 1.0, 4)
    for t_ms in range(1, 1000):
        for source in range(4):
            buffer.add_pose(of_source(source, t_ms))
    assert len(buffer) == buffer.capacity
    buffer.add_wheels(reading(1500))
    assert isinstance(buffer.add_pose(of_source(0, 1499.5)), Evaluation)
    assert buffer.head().t_ns == 1500 * MS


def test_a_gap_longer_than_the_buffer_loses_no_distance():
    buffer = buffer_with([0, 10])
    buffer.add_pose(near(10.0))
    buffer.add_wheels(reading(5000, gap=True))
    straight = buffer_with([0, 10])
    straight.add_pose(near(10.0))
    state = straight._filter.move(straight.head(), 5000 * MS, reading(5000).left_rad, reading(5000).right_rad, True)
    assert buffer.head() == state
    assert len(buffer) == 2


class CountingFilter(PoseFilter):
    calls = 0

    def move(self, *args):
        self.calls += 1
        return super().move(*args)


def test_a_call_runs_no_event_twice_and_an_ordered_batch_costs_one_pass():
    counting = CountingFilter(SETTINGS, PARAMETERS)
    buffer = RewindBuffer(counting, reading(0), 1.0)
    for k in range(1, 101):
        buffer.add_wheels(reading(10 * k))
        buffer.head()
    assert counting.calls == 100
    # Late by 0.9 s: what follows is run again once, with the poses, when the newest state is asked for.
    for t_ms in (101.0, 301.0, 501.0):
        buffer.add_pose(near(t_ms))
    buffer.head()
    assert counting.calls == 100 + 90 + 3
