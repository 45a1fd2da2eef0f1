"""Time stamps of the reference driver, and robots whose clock or encoder starts anew."""

import pytest

from drivers.types import DriverState, WheelCommand
from tests.drivers.motor.bench import IDLE_STATES, MS, START_NS
from tests.drivers.motor.reference_robot import CONFIG, ReferenceRobot, create_bench
from tests.tables import thinned


@thinned("jitter_ms", [3.0, 0.0], quick=1)
@thinned("skew", [80e-6, 0.0, -80e-6], quick=2)
def test_samples_carry_the_time_of_their_measurement(jitter_ms, skew):
    """Over a link that delays every frame by 2 ms and some; the robot samples in each of its 1 ms cycles."""

    def delay_ns(generator):
        return 2 * MS + generator.expovariate(1.0) * jitter_ms * MS

    robot = ReferenceRobot(boot_ns=START_NS - 123_456_789, skew=skew)
    bench = create_bench(robot, delay_ns=delay_ns)
    bench.arm()
    bench.command = WheelCommand(4.0, -4.0, 0.1)
    bench.run(4.0)
    bench.readings.clear()
    true_angle = {}
    for number in range(2600):
        if number % 40 == 0:
            latency_ms = 150
            sample_us = robot.us(bench.now_ns - latency_ms * MS)
            robot.core.pose(1.0, 2.0, 0.5, sample_us, 0.01, 0.02)
        true_angle[bench.now_ns] = robot.angle[0]
        bench.step()
    assert bench.driver.state is DriverState.ARMED
    assert bench.driver.synced
    tolerance_ns = (0.7 + 0.7 * jitter_ms) * MS
    offset = bench.wheels[0].left_angle_rad - true_angle[round(bench.wheels[0].t_ns / MS) * MS]
    resolution = 2 * 3.15 / CONFIG.ticks_per_rev
    for sample in bench.wheels:
        truth = true_angle.get(round(sample.t_ns / MS) * MS)
        if truth is not None:
            assert sample.left_angle_rad - offset == pytest.approx(
                truth, abs=4.0 * tolerance_ns * 1e-9 + 3 * resolution
            )
    assert len(bench.poses) > 60
    for pose in bench.poses:
        age_ns = (pose.t_ns - START_NS) % (40 * MS)
        sent_ns = (bench.poses[0].t_ns - START_NS) % (40 * MS)
        assert min(abs(age_ns - sent_ns), 40 * MS - abs(age_ns - sent_ns)) < 2 * tolerance_ns
        assert 150 * MS < pose.received_ns - pose.t_ns < 165 * MS + 12 * jitter_ms * MS


def test_a_restarted_robot_is_noticed_and_moves_nothing():
    bench = create_bench(ReferenceRobot(boot_ns=START_NS - 10**9)).drive(3.0, (3.0, 3.0))
    angle = bench.wheels[-1].left_angle_rad
    bench.robot = ReferenceRobot(boot_ns=bench.now_ns)
    assert bench.largest_speed_in(3.0) == 0.0
    assert bench.driver.state in IDLE_STATES
    assert bench.events.count("sample times disagree with the robot's clock: synchronising the clocks again") == 1
    assert bench.wheels[-1].left_angle_rad == pytest.approx(angle, abs=0.05), "the encoder's new zero is no motion"
    assert bench.driver.synced
    bench.arm()


def test_a_restart_that_only_the_clock_shows_is_noticed():
    """Three laps of the sample times later to the microsecond, so that these go on as if nothing had happened."""
    bench = create_bench(ReferenceRobot(boot_ns=START_NS - 10**10))
    bench.run(4.0)
    bench.robot = ReferenceRobot(boot_ns=START_NS - 10**10 + 3 * 1_310_720_000)
    bench.run(3.0)
    assert bench.events.count("the robot has restarted: its clock was set back") == 1
    assert not any("contradict" in event for event in bench.events)
    assert bench.driver.synced
    assert bench.driver.state in IDLE_STATES


def test_a_clock_that_leaps_ahead_is_distinguished_from_a_restart():
    """By three laps of the sample times, so that only the clock shows it."""
    bench = create_bench(ReferenceRobot(boot_ns=START_NS - 10**10))
    bench.run(4.0)
    bench.robot.boot_ns -= 3 * 1_310_720_000
    bench.run(3.0)
    reported = "the robot's clock jumped: this computer was suspended, or the controller's clock is over 200 ppm off"
    assert bench.events.count(reported) == 1
    assert not any("restarted" in event for event in bench.events)
    assert bench.driver.state in IDLE_STATES


def test_a_controller_whose_clock_goes_back_is_counted_and_goes_on():
    bench = create_bench(ReferenceRobot(boot_ns=START_NS - 10**10)).drive(1.0, (3.0, 3.0))
    reported = "the robot's controller saw its clock go backwards and counted a nominal period instead"
    for times in (1, 2):
        bench.robot.boot_ns += 15 * 10**6
        bench.run(1.0)
        assert bench.driver.stats.robot_clock_errors == times
        assert bench.events.count(reported) == times
    assert bench.driver.state is DriverState.ARMED
    bench.robot.boot_ns += 2 * 10**9
    bench.run(0.4)
    assert bench.driver.state in IDLE_STATES, "a clock that goes back so far stops the robot"
    assert any("fault CLOCK_MISMATCH" in event for event in bench.events)
    assert bench.driver.stats.robot_clock_errors == 3
    bench.robot = ReferenceRobot(boot_ns=bench.now_ns)
    bench.run(3.0)
    assert bench.driver.stats.robot_clock_errors == 3, "a restart is no clock that went back"


def test_the_ticks_of_another_robot_on_a_new_link_are_no_motion():
    bench = create_bench().drive(1.0, (3.0, 3.0))
    angle = bench.wheels[-1].left_angle_rad
    bench.host_end.plug(False)
    bench.run(0.1)
    bench.robot = ReferenceRobot(boot_ns=START_NS, first_ticks=(123_456, 5))
    bench.host_end.plug(True)
    bench.run(2.0)
    assert bench.wheels[-1].left_angle_rad == angle
    assert bench.driver.stats.implausible_ticks == 0
