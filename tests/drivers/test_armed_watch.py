"""An armed robot whose commands come late, or whose state is not heard, is disarmed."""

import itertools

import pytest

from drivers.armed_watch import LATE_NS, STATE_TIMEOUT_NS, ArmedWatch
from drivers.reference import ReferenceDriver
from drivers.types import DriverState
from firmware_protocol.codec import Codec
from tests.drivers.bench import MS, Bench
from tests.drivers.reference_robot import ReferenceRobot

CODEC = Codec()


def make_bench(**options):
    return Bench(ReferenceDriver(CODEC, itertools.count(3).__next__), ReferenceRobot(), **options)


def test_it_objects_to_late_commands_and_to_silence_and_forgets_at_rest():
    watch = ArmedWatch()
    assert watch.objection(10**12) is None
    watch.sent(0, 0)
    watch.told(15, LATE_NS)
    assert watch.objection(LATE_NS) is None
    watch.told(15, LATE_NS + 1)
    assert "0.15 s late" in watch.objection(LATE_NS + 1)
    watch.told(0, LATE_NS + 1)
    assert watch.objection(LATE_NS + 1 + STATE_TIMEOUT_NS) is None
    assert "not told its state for 0.5 s" in watch.objection(LATE_NS + 2 + STATE_TIMEOUT_NS)
    assert (watch.late, watch.silent) == (1, 1)
    watch.rest()
    assert watch.objection(10**12) is None


@pytest.mark.parametrize("rate_hz", [20, 50, 100])
@pytest.mark.parametrize("growth", [0.05, 0.2, 1.0, 3.0])
def test_commands_that_come_later_and_later_disarm(growth, rate_hz):
    bench = make_bench(rate_hz=rate_hz)
    bench.arm()
    bench.run(1.0, (3.0, 3.0))
    begin_ns = bench.now_ns
    bench.lag_ns = lambda now_ns: growth * (now_ns - begin_ns)
    # What arrives a time E after the beginning was sent growth / (1 + growth) * E ago; telemetry tells of it at 10 Hz.
    told_ns = (150 * MS + bench.period_ns) * (1 + growth) / growth + 100 * MS + 2 * bench.period_ns
    while bench.driver.state is DriverState.ARMED:
        bench.step()
        assert bench.now_ns - begin_ns < told_ns
    under_way_ns = bench.lag_ns(bench.now_ns)
    gave_up_ns = bench.now_ns
    while bench.robot.armed:
        bench.step()
        assert bench.now_ns - gave_up_ns < under_way_ns + 110 * MS
    bench.run(5.0)
    assert not bench.robot.armed
    assert bench.robot.speed_rad_s == 0.0


def test_it_says_so_and_counts():
    bench = make_bench()
    bench.arm()
    bench.run(1.0, (3.0, 3.0))
    begin_ns = bench.now_ns
    bench.lag_ns = lambda now_ns: 0.2 * (now_ns - begin_ns)
    bench.run(3.0)
    assert bench.driver.stats.late_commands == 1
    assert "late" in bench.driver.detail
    assert any("late" in event for event in bench.events)


def test_a_link_that_is_slow_but_not_slower_and_slower_does_not_disarm():
    bench = make_bench(lag_ns=lambda now_ns: 60 * MS, delay_ns=lambda generator: generator.uniform(2, 25) * MS)
    bench.arm()
    bench.run(20.0, (3.0, 3.0))
    assert bench.driver.state is DriverState.ARMED
    assert bench.driver.stats.late_commands == 0


@pytest.mark.parametrize("rate_hz", [20, 50, 100])
def test_lost_frames_are_no_lateness(rate_hz):
    bench = make_bench(rate_hz=rate_hz, loses=lambda generator: generator.random() < (0.02 if rate_hz == 20 else 0.2))
    bench.arm()
    bench.run(20.0, (3.0, 3.0))
    assert bench.driver.stats.late_commands == 0


@pytest.mark.parametrize("lost", [("SYSTEM_STATE",), ("SYSTEM_STATE", "SESSION_STATE")])
def test_armed_it_goes_on_hearing_the_robots_state_or_stops(lost):
    """Armed is what the robot says it is: without its word for half a second nobody knows."""
    bench = make_bench()
    ids = [CODEC.can_id(name) for name in lost]
    bench.arm()
    bench.run(1.0, (3.0, 3.0))
    drain = bench.robot.drain
    bench.robot.drain = lambda: [frame for frame in drain() if frame.can_id not in ids]
    bench.run(0.35)
    assert bench.driver.state is DriverState.ARMED
    bench.run(0.55)
    assert not bench.robot.armed
    assert bench.robot.speed_rad_s == 0.0
    assert bench.driver.detail == "disarmed: the robot has not told its state for 0.5 s"
    assert sum("has not told its state" in event for event in bench.events) == 1
    lost_before = bench.driver.stats.lost_frames
    bench.robot.drain = drain
    bench.run(2.0)
    assert bench.driver.stats.lost_frames > lost_before
    assert not bench.robot.armed
