"""An armed robot whose commands come late, or whose state is not heard, is disarmed."""

import pytest

from drivers.motor.reference_arming import DELAY_NS, STATE_TIMEOUT_NS, ArmedWatch
from drivers.types import DriverState
from tests.drivers.motor.bench import MS
from tests.drivers.motor.reference_robot import CODEC, create_bench
from tests.tables import thinned


def test_it_objects_to_late_commands_and_to_silence_and_forgets_at_rest():
    watch = ArmedWatch()
    assert watch.objection(10**12) is None
    watch.sent(0, 0)
    watch.reported(15, DELAY_NS)
    assert watch.objection(DELAY_NS) is None
    watch.reported(15, DELAY_NS + 1)
    assert "0.15 s late" in watch.objection(DELAY_NS + 1)
    watch.reported(0, DELAY_NS + 1)
    assert watch.objection(DELAY_NS + 1 + STATE_TIMEOUT_NS) is None
    assert "not sent its state for 0.5 s" in watch.objection(DELAY_NS + 2 + STATE_TIMEOUT_NS)
    assert (watch.late_commands, watch.silent) == (1, 1)
    watch.rest()
    assert watch.objection(10**12) is None


@thinned("rate_hz", [50, 20, 100], quick=1)
@thinned("growth", [0.05, 0.2, 1.0, 3.0], quick=2)
def test_commands_that_come_later_and_later_disarm(growth, rate_hz):
    bench = create_bench(rate_hz=rate_hz).drive(1.0, (3.0, 3.0))
    begin_ns = bench.now_ns
    bench.lag_ns = lambda now_ns: growth * (now_ns - begin_ns)
    # What arrives a time E after the beginning was sent growth / (1 + growth) * E ago; telemetry reports it at 10 Hz.
    deadline_ns = (150 * MS + bench.period_ns) * (1 + growth) / growth + 100 * MS + 2 * bench.period_ns
    while bench.driver.state is DriverState.ARMED:
        bench.step()
        assert bench.now_ns - begin_ns < deadline_ns
    under_way_ns = bench.lag_ns(bench.now_ns)
    gave_up_ns = bench.now_ns
    while bench.robot.armed:
        bench.step()
        assert bench.now_ns - gave_up_ns < under_way_ns + 110 * MS
    bench.run(1.0)
    assert not bench.robot.armed
    assert bench.robot.speed_rad_s == 0.0


def test_it_says_so_and_counts():
    bench = create_bench().drive(1.0, (3.0, 3.0))
    begin_ns = bench.now_ns
    bench.lag_ns = lambda now_ns: 0.2 * (now_ns - begin_ns)
    bench.run(3.0)
    assert bench.driver.stats.late_commands == 1
    assert "late" in bench.driver.detail
    assert any("late" in event for event in bench.events)


def test_a_link_that_is_slow_but_not_slower_and_slower_does_not_disarm():
    bench = create_bench(lag_ns=lambda now_ns: 60 * MS, delay_ns=lambda generator: generator.uniform(2, 25) * MS)
    bench.drive(8.0, (3.0, 3.0))
    assert bench.driver.state is DriverState.ARMED
    assert bench.driver.stats.late_commands == 0


@thinned("rate_hz", [50, 20, 100], quick=1)
def test_lost_frames_are_no_lateness(rate_hz):
    bench = create_bench(rate_hz=rate_hz, loses=lambda generator: generator.random() < (0.02 if rate_hz == 20 else 0.2))
    bench.drive(8.0, (3.0, 3.0))
    assert bench.driver.stats.late_commands == 0


@pytest.mark.parametrize("missing", [("SYSTEM_STATE",), ("SYSTEM_STATE", "SESSION_STATE")])
def test_armed_it_goes_on_hearing_the_robots_state_or_stops(missing):
    """Armed is what the robot says it is: without its word for half a second nobody knows."""
    bench = create_bench()
    ids = [CODEC.can_id(name) for name in missing]
    bench.drive(1.0, (3.0, 3.0))
    drain, bench.robot.drain = bench.robot.drain, lambda: [frame for frame in drain() if frame.can_id not in ids]
    bench.run(0.35)
    assert bench.driver.state is DriverState.ARMED
    bench.run(0.55)
    assert not bench.robot.armed
    assert bench.robot.speed_rad_s == 0.0
    assert (
        bench.driver.detail
        == "disarmed: the robot has not sent its state for 0.5 s; check the cable and the load of the link"
    )
    assert sum("has not sent its state" in event for event in bench.events) == 1
    missing_before = bench.driver.stats.lost_frames
    bench.robot.drain = drain
    bench.run(2.0)
    assert bench.driver.stats.lost_frames > missing_before
    assert not bench.robot.armed


PERIOD_NS = 20_000_000


def watch_after(count, first=0):
    watch = ArmedWatch()
    for number in range(first, first + count):
        watch.sent(number, number * PERIOD_NS)
    return watch


def delay_ns(watch, counter, received_ns):
    watch.reported(counter, received_ns)
    return watch.delay_ns


def test_the_oldest_command_not_taken_says_how_late_the_robot_is():
    assert delay_ns(watch_after(10), 9, 10 * PERIOD_NS) == 0
    assert delay_ns(watch_after(10), 7, 10 * PERIOD_NS) == 2 * PERIOD_NS
    assert delay_ns(ArmedWatch(), 5, 10 * PERIOD_NS) == 0
    assert delay_ns(watch_after(5, first=100), 99 % 16, 105 * PERIOD_NS) == 5 * PERIOD_NS, "none taken at all"


def test_the_counter_is_followed_past_its_wrap():
    watch = ArmedWatch()
    for number in range(200):
        watch.sent(number, number * PERIOD_NS)
        behind = number // 5
        if number % 5 == 4:
            assert delay_ns(watch, (number - behind) % 16, (number + 1) * PERIOD_NS) == behind * PERIOD_NS


def test_a_gap_in_telemetry_is_no_lateness():
    watch = watch_after(1)
    assert delay_ns(watch, 0, PERIOD_NS) == 0
    for number in range(1, 40):
        watch.sent(number, number * PERIOD_NS)
    assert delay_ns(watch, 38 % 16, 40 * PERIOD_NS) == PERIOD_NS


def test_what_was_sent_before_does_not_count_after_forgetting():
    watch = watch_after(10)
    watch.rest()
    watch.sent(10, 500 * PERIOD_NS)
    assert delay_ns(watch, 5, 501 * PERIOD_NS) == PERIOD_NS
