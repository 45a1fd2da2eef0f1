"""Conformance suite of all motor drivers: inherit `DriverConformance` and say how to make both ends.

The robot simulator speaks the controller's bytes. It has: `receive(now_ns, frame)`, `step(now_ns)` at 1 kHz, `drain()`,
`armed`, `speed_rad_s` and `angle` of the wheels as they really are, `press_estop(pressed)` and `break_down(broken)`.
"""

import itertools
import math
import random

import pytest

from drivers.types import Driver, DriverState, Request, WheelCommand
from tests.drivers.motor.bench import FORWARD, IDLE_STATES, Bench
from tests.tables import thinned


def check_that_wheels_follow(bench, speed_tolerance_rad_s, angle_tolerance_rad):
    """Arm, which moves nothing, and command speeds, which the wheels take up and the samples report."""
    bench.arm()
    assert bench.largest_speed == 0.0, "arming alone moves nothing"
    bench.run(1.0, FORWARD)
    speeds = pytest.approx(FORWARD, abs=speed_tolerance_rad_s)
    last = bench.wheels[-1]
    assert bench.robot.speed == speeds
    assert (last.left_speed_rad_s, last.right_speed_rad_s) == speeds
    for wheel, name in enumerate(("left_angle_rad", "right_angle_rad")):
        moved = getattr(last, name) - getattr(bench.wheels[0], name)
        behind = bench.robot.speed[wheel] * (bench.now_ns - last.t_ns) * 1e-9
        assert moved == pytest.approx(bench.robot.angle[wheel] - behind, abs=angle_tolerance_rad)


def check_that_what_is_no_command_is_refused(bench):
    bench.arm()
    sent = bench.driver.stats.commands_sent
    speeds = [WheelCommand(*bad, 0.1) for bad in ((math.nan, 0.0), (0.0, math.inf), (0.0, -math.inf))]
    durations = [WheelCommand(0.0, 0.0, valid_for_s) for valid_for_s in (math.nan, 0.0, -1.0)]
    for command in speeds + durations:
        with pytest.raises(ValueError, match="not a wheel command"):
            bench.driver.transmit(bench.now_ns, command)
        assert bench.driver.stats.commands_sent == sent, command


class DriverConformance:
    """The suite; `watchdog_s` and `deceleration_rad_s2` are those of the controller."""

    watchdog_s = 0.1
    deceleration_rad_s2 = 20.0
    frame_ids: range

    def create_driver(self):
        raise AssertionError("say how to make the driver")

    def create_robot(self, first_ticks=(0, 0)):
        raise AssertionError("say how to make its robot")

    def near_the_wrap(self):
        """First ticks of both wheels so that the left counter wraps forwards and the right backwards."""
        raise AssertionError("say where the encoder's counter wraps")

    @pytest.fixture
    def bench(self):
        return Bench(self.create_driver(), self.create_robot())

    def stop_time_s(self, speed_rad_s):
        return self.watchdog_s + speed_rad_s / self.deceleration_rad_s2 + 0.05

    def test_satisfies_the_protocol(self, bench):
        driver: Driver = bench.driver
        assert driver.state is DriverState.DISCONNECTED
        assert driver.identity is driver.limits is None
        assert driver.detail

    def test_introduces_itself_and_moves_nothing_before_it_is_armed(self, bench):
        bench.run_until(*IDLE_STATES)
        assert bench.driver.identity.controller
        assert bench.driver.limits.ticks_per_rev.value > 0
        assert bench.driver.limits.max_wheel_speed_rad_s.value > 0
        bench.run(1.0, FORWARD)
        assert not bench.robot.armed
        bench.request(Request.READY).run_until(DriverState.READY)
        bench.run(1.0, FORWARD)
        assert bench.driver.state is DriverState.READY
        assert bench.largest_speed == 0.0

    def test_armed_the_wheels_follow_the_command_and_the_samples_say_so(self, bench):
        bench.run_until(*IDLE_STATES)
        check_that_wheels_follow(bench, 0.005, 4 * math.pi / bench.driver.limits.ticks_per_rev.value + 0.02)
        assert bench.robot.armed

    def test_a_silent_host_stops_the_robot_and_is_not_armed_when_it_comes_back(self, bench):
        bench.drive(0.6, FORWARD)
        bench.host_runs = False
        bench.run(self.stop_time_s(max(FORWARD)))
        assert bench.robot.speed_rad_s < 0.05
        assert not bench.robot.armed
        bench.host_runs = True
        assert bench.largest_speed_in(1.5) == 0.0
        assert bench.driver.state in IDLE_STATES

    def test_a_host_without_commands_stops_the_robot_and_arm_is_consumed(self, bench):
        """Alive and talking, but no command: the house-keeping must not feed the watchdog."""
        bench.drive(0.6, FORWARD)
        bench.command = None
        bench.run(self.stop_time_s(max(FORWARD)))
        assert bench.robot.speed_rad_s < 0.05
        bench.run_until(*IDLE_STATES)
        bench.run(1.5, FORWARD)
        assert not bench.robot.armed
        assert bench.driver.detail not in ("", "armed", "arming"), "it says why"

    def test_disarms_on_request_while_moving(self, bench):
        bench.drive(0.6, FORWARD)
        bench.driver.request(Request.STANDBY)
        assert bench.driver.state is DriverState.STOPPING
        bench.run(self.stop_time_s(max(FORWARD)))
        assert bench.robot.speed_rad_s < 0.05
        bench.run_until(*IDLE_STATES)
        assert not bench.robot.armed

    def test_arms_again_only_on_request(self, bench):
        bench.arm()
        sessions = bench.driver.stats.sessions
        bench.request(Request.READY).run_until(DriverState.READY)
        bench.run(1.0, FORWARD)
        assert bench.largest_speed == 0.0
        bench.arm()
        assert bench.driver.stats.sessions > sessions
        bench.run(1.0)
        assert bench.robot.speed_rad_s > 1.0

    def test_a_fault_disarms_and_needs_reset_and_a_new_arming(self, bench):
        bench.drive(0.5, FORWARD)
        bench.robot.break_down(True)
        bench.run_until(DriverState.FAULT)
        bench.run(self.stop_time_s(max(FORWARD)))
        assert bench.robot.speed_rad_s < 0.05
        assert len(bench.driver.detail) > 10
        bench.request(Request.ARM).run(1.0)
        assert bench.driver.state is DriverState.FAULT
        bench.request(Request.RESET).run(1.0)
        assert bench.driver.state is DriverState.FAULT, "the cause is still there"
        bench.driver.request(Request.STANDBY)
        bench.robot.break_down(False)
        bench.run(0.5)
        bench.request(Request.RESET).run_until(*IDLE_STATES)
        assert bench.largest_speed_in(1.0) == 0.0
        bench.arm()

    @pytest.mark.parametrize("when", ["standby", "arming", "armed", "stopping"])
    def test_the_hosts_emergency_stop_latches_in_any_state(self, bench, when):
        bench.run_until(*IDLE_STATES)
        if when == "arming":
            bench.request(Request.ARM).run_until(DriverState.ARMING)
        if when in ("armed", "stopping"):
            bench.drive(0.5, FORWARD)
        if when == "stopping":
            bench.request(Request.STANDBY).run_until(DriverState.STOPPING)
        assert bench.driver.state.value == when
        bench.send_estop()
        bench.run(self.stop_time_s(max(FORWARD)))
        assert bench.robot.speed_rad_s < 0.05
        assert bench.driver.state is DriverState.ESTOP
        bench.request(Request.ARM).run(1.0, FORWARD)
        assert bench.driver.state is DriverState.ESTOP
        bench.request(Request.RESET).run_until(*IDLE_STATES)
        assert bench.largest_speed_in(1.0) == 0.0
        bench.arm()

    def test_the_emergency_stop_button_holds_until_released_and_reset(self, bench):
        bench.drive(0.5, FORWARD)
        bench.robot.press_estop(True)
        bench.run_until(DriverState.ESTOP)
        bench.run(self.stop_time_s(max(FORWARD)))
        assert bench.robot.speed_rad_s < 0.05
        bench.request(Request.RESET).run(1.0)
        assert bench.driver.state is DriverState.ESTOP
        bench.driver.request(Request.STANDBY)
        bench.robot.press_estop(False)
        bench.run(1.0)
        assert bench.driver.state is DriverState.ESTOP, "releasing the button alone is not enough"
        bench.request(Request.RESET).run_until(*IDLE_STATES)
        assert bench.largest_speed_in(1.0) == 0.0

    def test_encoders_wrap_in_both_directions(self):
        bench = Bench(self.create_driver(), self.create_robot(first_ticks=self.near_the_wrap()))
        bench.arm()
        for command in ((4.0, -4.0), (-4.0, 4.0), (4.0, -4.0)):
            bench.run(1.0, command)
        samples = bench.wheels
        for before, after in itertools.pairwise(samples):
            allowed = 4.1 * (after.t_ns - before.t_ns) * 1e-9 + 0.01
            assert abs(after.left_angle_rad - before.left_angle_rad) <= allowed
            assert abs(after.right_angle_rad - before.right_angle_rad) <= allowed
        assert samples[-1].left_angle_rad == pytest.approx(bench.robot.angle[0], abs=0.1)
        assert bench.driver.stats.implausible_ticks == 0

    def test_an_unplugged_line_stops_the_robot_and_nothing_moves_when_it_is_back(self, bench):
        bench.drive(0.6, FORWARD)
        bench.step()
        bench.host_end.plug(False)
        bench.run(self.stop_time_s(max(FORWARD)))
        assert bench.driver.state is DriverState.DISCONNECTED
        assert bench.robot.speed_rad_s < 0.05
        bench.driver.request(Request.ARM)
        bench.host_end.plug(True)
        assert bench.largest_speed_in(1.5, FORWARD) == 0.0
        assert bench.driver.state in IDLE_STATES
        angle = bench.wheels[-1].left_angle_rad
        assert angle > 1.0, "the angles go on from where they were"
        bench.drive(1.0)
        assert bench.wheels[-1].left_angle_rad > angle

    @thinned("unplugged_after_ms", range(20), quick=2)
    def test_unplugged_at_any_instant(self, bench, unplugged_after_ms):
        bench.drive(0.3 + unplugged_after_ms * 1e-3, FORWARD)
        bench.host_end.plug(False)
        bench.run(0.1)
        bench.host_end.plug(True)
        bench.run(1.0)
        assert bench.driver.state in IDLE_STATES
        for before, after in itertools.pairwise(bench.wheels):
            assert abs(after.left_angle_rad - before.left_angle_rad) < 0.5

    def test_garbage_from_anybody_is_counted_and_never_raises(self, bench):
        generator = random.Random(5)
        bench.arm()
        bench.command = WheelCommand(*FORWARD, 0.1)
        for _ in range(1000):
            for inject in (bench.inject_to_host, bench.inject_to_robot):
                can_id = generator.choice((generator.randrange(0x800), generator.choice(self.frame_ids)))
                if can_id != self.estop_id:
                    inject(can_id, generator.randbytes(generator.choice((0, 1, 7, 8, 8, 8, 8))))
            bench.step()
        stats = bench.driver.stats
        assert stats.rejected_crc
        assert stats.unknown_id
        assert stats.rejected_length
        assert bench.largest_speed <= max(FORWARD) + 0.01
        for sample in bench.wheels:
            assert abs(sample.left_angle_rad) < 20.0

    estop_id = 0x080

    def test_a_command_that_is_none_is_the_callers_error(self, bench):
        check_that_what_is_no_command_is_refused(bench)

    def test_released_the_wheels_roll_out_without_a_ramp_and_the_reason_is_a_fault_until_a_reset(self, bench):
        bench.drive(0.6, FORWARD)
        bench.driver.release("the left wheel does not count")
        bench.run(0.02)
        assert bench.driver.state is DriverState.FAULT
        assert "the left wheel does not count" in bench.driver.detail
        bench.run(1.0)
        assert bench.robot.speed_rad_s == pytest.approx(0.0, abs=0.05)
        assert not bench.robot.armed
        bench.request(Request.ARM).run(0.5)
        assert bench.driver.state is DriverState.FAULT
        bench.request(Request.RESET).run(0.5)
        bench.request(Request.STANDBY).run_until(*IDLE_STATES)
        bench.arm()
