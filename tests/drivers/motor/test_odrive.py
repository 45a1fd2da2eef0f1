"""Tests of ODrive's own: the order of arming, states that fall by themselves, generations, silence, restarts."""

import itertools
import struct
from types import SimpleNamespace

import pytest

from drivers.motor import find_driver
from drivers.types import DriverState, Request
from sim.devices.odrive import CLOSED_LOOP, IDLE
from tests.drivers.motor.bench import FORWARD, IDLE_STATES
from tests.drivers.motor.vendors import BY_LABEL

NEW, OLD = BY_LABEL["odrive-0.6"], BY_LABEL["odrive-0.5"]


@pytest.fixture(params=[NEW, OLD], ids=str)
def bench(request):
    return request.param.bench()


def axes(bench):
    return [axis for side in bench.robot.controller.axes for axis in side]


def test_arming_sets_mode_and_zero_before_the_closed_loop_of_each_axis(bench):
    bench.run_until(*IDLE_STATES)
    bench.run(1.0)
    bench.robot.received.clear()
    bench.arm()
    for axis in axes(bench):
        sent = [
            f for f in bench.robot.received if f.can_id >> 5 == axis.node_id and f.can_id & 0x1F not in (0x17, 0x18)
        ]
        order = [command for command, _ in itertools.groupby(f.can_id & 0x1F for f in sent)]
        assert order == [0x0B, 0x0D, 0x07, 0x0D]
        assert sent[0].data == struct.pack("<II", 2, 1)
        assert sent[1].data == bytes(8)


def test_a_velocity_left_by_somebody_else_does_not_move_it(bench):
    bench.run_until(*IDLE_STATES)
    for axis in axes(bench):
        axis.input_vel_turns_s = 5.0
    bench.arm()
    assert bench.largest_speed == 0.0


def test_a_watchdog_that_ran_out_while_nobody_drove_is_cleared_by_arming_alone(bench):
    assert bench.robot.controller.boards[0].axes[0].watchdog_enabled
    bench.run(0.5)
    assert bench.driver.state in IDLE_STATES
    bench.arm()
    assert [axis.axis_error for axis in axes(bench)] == [0, 0]


def test_an_axis_that_idles_without_an_error_is_a_fault_that_stays(bench):
    bench.drive(0.5, FORWARD)
    axes(bench)[0].axis_state = IDLE
    bench.run_until(DriverState.FAULT, timeout_s=0.2)
    assert "closed loop" in bench.driver.detail
    bench.run(2.0)
    assert bench.driver.state is DriverState.FAULT
    assert [axis.axis_state for axis in axes(bench)] == [IDLE, IDLE]


def test_one_axis_whose_heartbeat_fails_to_come_stops_the_others(bench):
    bench.drive(0.5, FORWARD)
    silent_node = axes(bench)[1].node_id
    drain, bench.robot.drain = (
        bench.robot.drain,
        lambda: [frame for frame in drain() if frame.can_id != silent_node << 5 | 1],
    )
    bench.run(0.2, FORWARD)
    assert bench.driver.state is DriverState.FAULT
    assert f"node {silent_node} stopped reporting" in bench.driver.detail
    assert CLOSED_LOOP not in [axis.axis_state for axis in axes(bench)]


def test_a_missing_node_is_named():
    bench = NEW.bench()
    drain, bench.robot.drain = bench.robot.drain, lambda: [frame for frame in drain() if frame.can_id >> 5 != 5]
    bench.run(2.0)
    assert bench.driver.state is DriverState.HANDSHAKE
    assert "node 5" in bench.driver.detail


@pytest.mark.parametrize(("declared", "plays"), [(NEW, OLD), (OLD, NEW)], ids=["old for new", "new for old"])
def test_another_generation_than_declared_is_refused(declared, plays):
    bench = declared.bench()
    bench.robot.controller = plays.bench().robot.controller
    bench.run(2.0)
    assert bench.driver.state is DriverState.REFUSED
    assert "link.firmware" in bench.driver.detail
    assert bench.driver.identity is bench.driver.limits is None


def test_an_axis_that_calibrates_is_refused_until_it_has_done(bench):
    bench.run_until(*IDLE_STATES)
    calibrating = axes(bench)[0]
    calibrating.axis_error, calibrating.axis_state = 0, 3
    calibrating.feed()
    bench.run(0.3)
    assert bench.driver.state is DriverState.REFUSED
    axes(bench)[0].axis_state = IDLE
    bench.run_until(*IDLE_STATES)


def test_axes_that_somebody_else_has_armed_are_brought_to_idle(bench):
    for axis in axes(bench):
        axis.axis_state, axis.control_mode, axis.input_vel_turns_s = CLOSED_LOOP, 2, 1.0
        axis.feed()
    bench.run(0.3)
    assert [axis.axis_state for axis in axes(bench)] == [IDLE, IDLE]


def test_an_axis_that_is_not_calibrated_is_said_not_to_arm(bench):
    bench.run_until(*IDLE_STATES)
    axes(bench)[1].calibrated = False
    bench.request(Request.ARM).run(2.0)
    assert bench.driver.state is DriverState.FAULT
    assert "node 5" in bench.driver.detail
    assert [axis.axis_state for axis in axes(bench)] == [IDLE, IDLE]


def test_a_position_that_jumps_does_not_move_the_angle(bench):
    bench.drive(1.0, FORWARD)
    angle = bench.wheels[-1].left_angle_rad
    bench.robot.angle[0] += 1000.0
    bench.run(0.2, (0.0, 0.0))
    assert bench.driver.stats.implausible_ticks >= 1
    assert bench.wheels[-1].left_angle_rad == pytest.approx(angle, abs=1.0)


def test_it_does_not_arm_while_an_axis_turns(bench):
    """The closed loop holds zero from its first moment: it would brake as hard as it can."""
    bench.run_until(*IDLE_STATES)
    bench.robot.speed = [4.0, 4.0]
    bench.run(0.1)
    bench.robot.received.clear()
    bench.request(Request.ARM).run(0.3, FORWARD)
    assert bench.driver.state in IDLE_STATES
    assert "a motor is turning" in bench.driver.detail
    assert not [frame for frame in bench.robot.received if frame.can_id & 0x1F == 0x07 and frame.data[0] == CLOSED_LOOP]


def test_it_does_not_arm_without_encoder_estimates(bench):
    drain, bench.robot.drain = bench.robot.drain, lambda: [frame for frame in drain() if frame.can_id & 0x1F != 0x09]
    bench.run_until(*IDLE_STATES)
    bench.request(Request.ARM).run(0.3)
    assert bench.driver.state in IDLE_STATES
    assert "no encoder estimates" in bench.driver.detail


def test_the_lines_of_the_setup_keep_the_watchdog_over_a_power_up(bench):
    """Each axis begins as the firmware has it, with the watchdog off; then the lines are typed into odrivetool."""
    controller = bench.robot.controller
    configs = [SimpleNamespace(enable_watchdog=False, watchdog_timeout=0.0) for _ in axes(bench)]

    def save_configuration():
        for axis, config in zip(axes(bench), configs, strict=True):
            axis.watchdog_enabled, axis.watchdog_timeout_s = config.enable_watchdog, config.watchdog_timeout
        controller.save_configuration()

    for axis in axes(bench):
        axis.watchdog_enabled, axis.watchdog_timeout_s = False, 0.0
    controller.save_configuration()
    for config in configs:
        typed = SimpleNamespace(config=config, controller=SimpleNamespace(config=SimpleNamespace()))
        odrv0 = SimpleNamespace(axis0=typed, save_configuration=save_configuration)
        for line in find_driver("odrive").safety_card(NEW.settings).setup:
            if line.startswith("odrv0."):
                exec(line, {"odrv0": odrv0})
    controller.restart()
    assert [(axis.watchdog_enabled, axis.watchdog_timeout_s) for axis in axes(bench)] == 2 * [(True, 0.1)]
    bench.drive(0.5, FORWARD)
    bench.pause_host(0.5)
    assert controller.wheels_rad_s == (None, None)
