"""The driver of bases on ROS 2: what the conformance suite of all vendors does not ask of it."""

import pytest

from drivers.motor import find_driver
from drivers.motor import ros2_base_wire as wire
from drivers.types import DriverState, Request, WheelCommand
from tests.drivers.motor.bench import FORWARD
from tests.drivers.motor.vendors import BY_LABEL

VENDOR = BY_LABEL["ros2-base"]


@pytest.fixture
def bench():
    return VENDOR.bench()


@pytest.fixture
def end(bench):
    """The bridge's end of the link."""
    bench.run_until(DriverState.STANDBY)
    return bench.robot.controller.end


@pytest.mark.parametrize(
    ("left", "right", "by_radius"),
    [(10.0, 20.0, (15.0, 10.0)), (25.0, 50.0, (18.75, 12.5))],
    ids=["as asked", "more than the base can, slowed down on the same curve"],
)
def test_wheel_speeds_become_those_of_the_body_by_the_nominal_geometry(bench, left, right, by_radius):
    bench.arm()
    (sent,) = bench.driver.transmit(bench.now_ns, WheelCommand(left, right, 0.1))
    assert sent.frame == wire.speeds(0.06 * by_radius[0], 0.06 * by_radius[1] / 0.31)


@pytest.mark.parametrize(
    ("flag", "wrong", "expected_detail", "state"),
    [
        ("others_speak", True, "another node publishes on /cmd_vel", DriverState.STANDBY),
        ("has_listener", False, "no node subscribes to /cmd_vel", DriverState.HANDSHAKE),
    ],
)
def test_a_base_that_others_drive_or_that_hears_nobody_is_not_armed_and_disarmed(
    bench, end, flag, wrong, expected_detail, state
):
    setattr(end, flag, wrong)
    bench.run(0.2)
    bench.driver.request(Request.ARM)
    assert bench.driver.state is state
    assert expected_detail in bench.driver.detail
    setattr(end, flag, not wrong)
    bench.run(0.2)
    bench.drive(0.5, FORWARD)
    setattr(end, flag, wrong)
    bench.run(0.2)
    assert bench.driver.state is DriverState.FAULT
    assert expected_detail in bench.driver.detail
    assert not end.driving


def test_a_bridge_that_was_started_with_other_settings_is_refused(bench, end):
    end._check_sum ^= 1
    bench.run(0.2)
    assert bench.driver.state is DriverState.HANDSHAKE
    assert "another [link] of robot.toml" in bench.driver.detail
    bench.request(Request.ARM).run(0.5, FORWARD)
    assert bench.largest_speed == 0.0


def test_why_there_is_no_odometry_is_said(bench, end):
    bench.robot.controller.joints = False
    for refusal, reason in enumerate(wire.REFUSALS):
        end.refusal = refusal
        bench.run(0.2)
        assert bench.driver.state is DriverState.HANDSHAKE
        assert bench.driver.detail == f"no odometry from /odom: {reason}"


def test_a_fault_stays_until_it_is_reset_although_its_cause_has_gone(bench, end):
    bench.arm()
    bench.robot.controller.joints = False
    bench.run(0.5, FORWARD)
    bench.robot.controller.joints = True
    bench.run(1.0, FORWARD)
    assert bench.driver.state is DriverState.FAULT
    bench.request(Request.RESET).run_until(DriverState.STANDBY)


def test_after_a_pause_longer_than_the_bridge_waits_nothing_is_sent_that_moves(bench):
    bench.drive(0.5, FORWARD)
    sent = bench.driver.transmit(bench.now_ns + 220_000_000, WheelCommand(*FORWARD, 0.1))
    assert bench.driver.state is DriverState.FAULT
    assert not [one for one in sent if one.frame.can_id == wire.SPEEDS]


def test_a_restart_of_the_base_alone_is_seen_by_its_angles(bench, end):
    bench.drive(1.0, FORWARD)
    bench.robot.controller._zero_ticks = (-50_000, 50_000)
    bench.run(0.1, FORWARD)
    assert bench.driver.state is DriverState.FAULT
    assert "the angles of its wheels jumped" in bench.driver.detail
    assert bench.driver.stats.implausible_ticks == 1


def test_the_safety_card_says_who_stops_the_base_and_that_its_time_out_is_only_declared():
    driver = find_driver("ros2_base")
    card = driver.safety_card(VENDOR.settings)
    assert card.reaction_s == pytest.approx(wire.DEADMAN_S + 0.5)
    assert "only the base's own time-out of 0.5 s" in card.host_silent
    assert any("declared" in text for text in card.unverified)
    assert any("Odometry" in text for text in card.unverified), "without joints"


def test_odometry_that_stops_while_it_slows_down_is_a_fault_that_stays(bench, end):
    bench.drive(0.5, (20.0, 20.0))
    bench.request(Request.STANDBY).run(0.1)
    VENDOR.lose_left(bench.robot)
    bench.run(0.4)
    assert not end.driving
    VENDOR.mend(bench.robot)
    bench.run(1.0)
    assert bench.driver.state is DriverState.FAULT
    assert "no odometry" in bench.driver.detail
