"""Conformance tests of every vendor's driver, against the byte-level simulator of that controller.

These controllers know no session and send no time: what the reference protocol proves is proved by the driver here.
"""

import math
import random

import pytest

from drivers.motor import create_driver, find_driver
from drivers.types import DriverState, Frame, ReceivedFrame, Request, WheelCommand
from tests.drivers.motor.bench import FORWARD, IDLE_STATES
from tests.drivers.motor.conformance import check_that_what_is_no_command_is_refused, check_that_wheels_follow
from tests.drivers.motor.vendors import VENDORS
from tests.tables import thinned

# Of a released wheel 0.7 % of the speed is left after it.
COASTING_S = 0.5
# Longer than a controller takes to be found and armed: if anything were to move by itself, it would by then.
WATCHED_S = 0.7


# Of several boards with one driver all are tried by `make test-all`; of the quick ones, each driver has its first.
FURTHER = ("odrive-0.5", "odrive-four-axes", "vesc-four-braking", "vesc-uart", "roboclaw-a-board-a-side")


@pytest.fixture(
    params=[pytest.param(one, marks=pytest.mark.thorough) if str(one) in FURTHER else one for one in VENDORS], ids=str
)
def vendor(request):
    return request.param


@pytest.fixture
def new_bench(vendor):
    bench = vendor.bench(coasting_s=0.1)
    yield bench
    assert not [frame for frame in bench.robot.received if vendor.is_forbidden(frame)]


@pytest.fixture
def bench(new_bench):
    """A bench whose robot drives forward."""
    drive(new_bench)
    return new_bench


@pytest.fixture
def another_host(vendor, bench):
    """Send a frame as another host on the link."""
    if vendor.is_serial:
        assert "serial" in find_driver(vendor.name).kinds
        pytest.skip("a line with two ends has one host")
    return lambda frame: bench.inject_to_host(frame.can_id, frame.data, frame.extended)


def command(left, right):
    return WheelCommand(left, right, 0.1)


def no_wheel_is_driven(bench):
    return all(wheel in (None, 0.0) for wheel in bench.robot.controller.wheels_rad_s)


def drive(bench):
    began_ns = bench.now_ns
    bench.arm()
    assert bench.now_ns - began_ns < 1e9 * WATCHED_S
    bench.run(0.5, FORWARD)
    assert bench.robot.speed == pytest.approx(FORWARD, abs=0.02)


def test_nothing_that_moves_is_sent_before_arming_and_nothing_moves_if_that_is_taken_back(vendor, new_bench):
    new_bench.command = command(*FORWARD)
    new_bench.run(WATCHED_S)
    assert new_bench.driver.state in IDLE_STATES
    assert new_bench.largest_speed == 0.0
    new_bench.request(Request.READY).run(WATCHED_S)
    assert new_bench.driver.state is DriverState.READY
    assert not [frame for frame in new_bench.robot.received if vendor.is_motion(frame)]
    new_bench.request(Request.ARM).run(0.05)
    new_bench.request(Request.STANDBY).run(WATCHED_S)
    assert new_bench.driver.state in IDLE_STATES
    assert new_bench.largest_speed == 0.0


def test_a_controller_that_is_not_there_is_waited_for(vendor):
    bench = vendor.bench(loses=lambda _random: True)
    bench.run(1.0)
    assert bench.driver.state is DriverState.HANDSHAKE
    assert bench.driver.identity is bench.driver.limits is None
    assert len(bench.driver.detail) > 10


def test_armed_the_wheels_follow_and_the_samples_say_so(new_bench):
    check_that_wheels_follow(new_bench, 0.02, 0.05)


IDENTITIES = {
    "odrive-0.5": ("ODrive, firmware 0.5 (declared", {}),
    "odrive": ("ODrive, firmware 0.6.11 (reported", {}),
    "vesc": ("VESC (declared", {"command_timeout_s": "device"}),
    "agilex": ("AgileX base, CAN v2 (declared", {"command_timeout_s": "fixed"}),
    "ros2_base": ("ROS 2 base (declared", {}),
    "roboclaw": ("RoboClaw, firmware USB", {"max_wheel_speed_rad_s": "device", "command_timeout_s": "device"}),
}
"""By label, or else by driver: who it is, who says so, and which limits do not stand in robot.toml alone."""


def test_it_says_who_it_is_and_of_each_limit_whether_it_was_reported_or_declared(vendor, new_bench):
    new_bench.run_until(*IDLE_STATES)
    identity, limits = new_bench.driver.identity, new_bench.driver.limits
    begin, others = IDENTITIES.get(str(vendor)) or IDENTITIES[vendor.name]
    assert identity.describe().startswith(begin)
    declared = dict.fromkeys(("max_wheel_speed_rad_s", "command_timeout_s", "stop_deceleration_rad_s2"), "robot.toml")
    assert {name: limit.said_by for name, limit in limits.known().items()} == declared | others
    assert all(limit.value > 0.0 for limit in limits.known().values())


def test_a_silent_host_is_stopped_as_soon_as_the_safety_card_says_and_nothing_moves_when_it_is_back(vendor, bench):
    card = find_driver(vendor.name).safety_card(vendor.settings)
    bench.host_runs, last_ns = False, bench.now_ns
    while not no_wheel_is_driven(bench):
        assert bench.now_ns - last_ns < 2e9
        bench.step()
    driven_s = (bench.now_ns - last_ns) * 1e-9
    # A simulator looks at its time-out in steps, a VESC's of 10 ms.
    assert 0.0 < driven_s <= card.reaction_s + 0.011
    assert card.reaction_s < driven_s + 0.03 or vendor.name == "ros2_base", "where bridge and network fail together"
    bench.run(COASTING_S)
    assert bench.robot.speed_rad_s < 0.05
    bench.host_runs = True
    assert bench.largest_speed_in(WATCHED_S) < 0.05
    assert bench.driver.state in (*IDLE_STATES, DriverState.FAULT)


def test_a_host_that_was_frozen_blames_itself_and_not_a_controller_whose_replies_it_has_not_read_yet(vendor, bench):
    """What the controllers sent meanwhile is read by a thread that comes back later than the loop."""
    bench.pause_host(vendor.watchdog_s + COASTING_S)
    bench.run_unread(0.05)
    assert "stopped reporting" not in bench.driver.detail
    assert "does not accept" not in bench.driver.detail
    assert bench.largest_speed_in(WATCHED_S) < 0.05
    assert "stopped reporting" not in f"{bench.driver.detail} {bench.events}"
    assert bench.driver.state is not DriverState.ARMED


@thinned("pause_s", [0.06, 0.04, 0.07, 0.08, 0.09], quick=1)
def test_a_host_that_pauses_for_less_than_any_watchdog_drives_on(vendor, bench, pause_s):
    """Whatever came last before it; what the controllers sent meanwhile is read a tick after the loop is back."""
    if pause_s + 0.04 > vendor.watchdog_s:
        pytest.skip("its watchdog may stop it in such a pause")
    for _ in range(7):
        bench.pause_host(pause_s)
        bench.run_unread(0.012)
        bench.run(0.313)
        assert bench.driver.state is DriverState.ARMED, f"{bench.driver.detail} {bench.events}"


def test_counts_that_a_pause_of_the_host_has_brought_together_are_no_restart(vendor, new_bench):
    """The longest pause that no watchdog ends, at nearly full speed; what came in it is stamped at its end."""
    new_bench.arm()
    new_bench.run(1.0, (0.9 * new_bench.driver.limits.max_wheel_speed_rad_s.value,) * 2)
    while new_bench.now_ns + new_bench.period_ns != new_bench._due_ns:
        new_bench.step()
    pause_s = vendor.watchdog_s - 0.05
    ends_ns = new_bench.now_ns + round(pause_s * 1e9)
    new_bench.delay_ns = lambda _random: max(0, ends_ns - new_bench.now_ns)
    new_bench.pause_host(pause_s)
    new_bench.run(0.5)
    assert new_bench.driver.state is DriverState.ARMED, new_bench.driver.detail
    assert new_bench.driver.stats.implausible_ticks == 0
    behind = new_bench.robot.speed[0] * (new_bench.now_ns - new_bench.wheels[-1].t_ns) * 1e-9
    moved = new_bench.wheels[-1].left_angle_rad - new_bench.wheels[0].left_angle_rad
    assert moved == pytest.approx(new_bench.robot.angle[0] - behind, abs=0.1)


def test_asked_to_stand_by_after_a_pause_it_does_not_ramp_down_from_where_it_was(vendor, bench):
    """The controllers have stopped long since: a ramp from the last speed would move them again."""
    bench.host_runs = False
    bench.run(vendor.watchdog_s + COASTING_S)
    bench.driver.request(Request.STANDBY)
    bench.host_runs = True
    assert bench.largest_speed_in(WATCHED_S) < 0.05


def test_without_commands_the_controllers_watchdog_is_not_fed(vendor, bench):
    """Alive and listening, but no command: nothing else that the driver sends may keep the motors running."""
    bench.command = None
    bench.run(vendor.watchdog_s + COASTING_S)
    assert bench.robot.speed_rad_s < 0.05
    bench.run(WATCHED_S, FORWARD)
    assert bench.robot.speed_rad_s < 0.05
    assert bench.driver.state is not DriverState.ARMED


def test_disarming_ramps_down_and_says_so_until_it_stands(bench):
    bench.driver.request(Request.STANDBY)
    assert bench.driver.state is DriverState.STOPPING
    bench.run(0.1)
    assert 0.5 < bench.robot.speed_rad_s < max(FORWARD), "it is slowed down, not let go"
    bench.run_until(*IDLE_STATES)
    bench.run(0.2)
    assert bench.robot.speed_rad_s < 0.05
    assert no_wheel_is_driven(bench)


def test_one_side_lost_stops_the_other_and_is_a_fault_until_it_is_mended_and_reset(vendor, bench):
    vendor.lose_left(bench.robot)
    bench.run_until(DriverState.FAULT, timeout_s=0.5)
    bench.run(0.05)
    assert bench.robot.controller.wheels_rad_s[1] in (None, 0.0)
    assert len(bench.driver.detail) > 10
    bench.request(Request.ARM).run(COASTING_S, FORWARD)
    assert bench.driver.state is DriverState.FAULT
    assert bench.robot.speed_rad_s < 0.05
    vendor.mend(bench.robot)
    bench.request(Request.RESET).run_until(*IDLE_STATES)
    assert bench.largest_speed_in(WATCHED_S, FORWARD) < 0.05, "an error cleared does not energise again"
    drive(bench)


@thinned("when", ["armed", "before", "arming", "stopping", "standby", "fault"], quick=4)
def test_the_emergency_stop_stops_in_every_state(vendor, new_bench, when):
    if when != "before":
        new_bench.run_until(*IDLE_STATES)
    if when in ("armed", "stopping", "fault"):
        drive(new_bench)
    if when == "arming":
        new_bench.request(Request.ARM).run(0.045)
    if when == "stopping":
        new_bench.driver.request(Request.STANDBY)
    if when == "fault":
        vendor.lose_left(new_bench.robot)
        new_bench.run_until(DriverState.FAULT, timeout_s=0.5)
    assert new_bench.driver.state.value == ("disconnected" if when == "before" else when)
    new_bench.command = command(*FORWARD)
    new_bench.send_estop()
    new_bench.run(0.05)
    assert no_wheel_is_driven(new_bench)
    new_bench.run(COASTING_S)
    assert new_bench.robot.speed_rad_s < 0.05
    assert new_bench.driver.state is DriverState.ESTOP
    new_bench.driver.request(Request.ARM)
    assert new_bench.largest_speed_in(WATCHED_S) < 0.05
    assert new_bench.driver.state is DriverState.ESTOP
    vendor.mend(new_bench.robot)
    new_bench.request(Request.RESET).run_until(*IDLE_STATES)
    new_bench.run(WATCHED_S)
    assert new_bench.largest_speed < 0.05


def test_an_emergency_stop_from_beside_the_daemon_stops_it_and_is_confirmed(vendor, bench):
    found = find_driver(vendor.name)
    confirms_stop = found.stop_confirmation(vendor.settings)
    # A line that is one host's alone is taken only beside a daemon that is frozen.
    bench.host_runs = not vendor.is_serial
    bench.run(0.002)
    for frame in found.stop_frames(vendor.settings):
        bench.robot.receive(bench.now_ns, frame)
        if not vendor.is_serial:
            # Whoever is on the bus hears it too.
            bench.inject_to_host(frame.can_id, frame.data, frame.extended)
    bench.run(0.05)
    assert no_wheel_is_driven(bench)
    confirmed = False
    for step in range(500):
        bench.now_ns += 1_000_000
        bench.robot.step(bench.now_ns)
        if vendor.is_serial and step % 10 == 0:
            for frame in found.stop_frames(vendor.settings):
                bench.robot.receive(bench.now_ns, frame)
        frames = bench.robot.drain()
        confirmed = confirmed or True in [confirms_stop(ReceivedFrame(bench.now_ns, frame)) for frame in frames]
        for frame in frames:
            bench._send(bench.robot_end, frame)
    assert confirmed
    bench.host_runs = True
    bench.run(WATCHED_S, FORWARD)
    assert bench.driver.state in (DriverState.ESTOP, DriverState.FAULT)


def test_a_line_unplugged_stops_the_robot_and_reconnection_never_arms(vendor, bench):
    bench.host_end.plug(False)
    bench.run(vendor.watchdog_s + COASTING_S)
    assert bench.driver.state is DriverState.DISCONNECTED
    assert bench.robot.speed_rad_s < 0.05
    bench.driver.request(Request.ARM)
    bench.host_end.plug(True)
    assert bench.largest_speed_in(WATCHED_S, FORWARD) < 0.05
    assert bench.driver.state in (*IDLE_STATES, DriverState.FAULT)
    assert bench.wheels[-1].left_angle_rad > 1.0, "the angles go on from where they were"


def test_an_emergency_stop_is_latched_although_the_line_was_out_when_it_was_asked_for(bench):
    bench.host_end.plug(False)
    bench.run(0.5)
    bench.send_estop()
    bench.run(COASTING_S)
    bench.host_end.plug(True)
    bench.run(WATCHED_S)
    assert bench.driver.state is DriverState.ESTOP
    bench.driver.request(Request.ARM)
    assert bench.largest_speed_in(WATCHED_S, FORWARD) < 0.05
    assert bench.driver.state is DriverState.ESTOP
    bench.request(Request.RESET).run_until(*IDLE_STATES)


def test_a_fault_is_latched_although_the_line_was_out_since(vendor, bench):
    vendor.lose_left(bench.robot)
    bench.run_until(DriverState.FAULT, timeout_s=0.5)
    why = bench.driver.detail
    vendor.mend(bench.robot)
    bench.host_end.plug(False)
    bench.run(0.5)
    bench.robot.controller.restart()
    bench.host_end.plug(True)
    bench.run(WATCHED_S)
    assert (bench.driver.state, bench.driver.detail) == (DriverState.FAULT, why)
    bench.driver.request(Request.ARM)
    assert bench.largest_speed_in(0.2, FORWARD) < 0.05
    assert bench.driver.state is DriverState.FAULT
    bench.request(Request.RESET).run_until(*IDLE_STATES)


@thinned("out_for_s", [0.03, 0.09, 0.15], quick=1)
def test_a_short_interruption_disarms_too(vendor, bench, out_for_s):
    bench.host_end.plug(False)
    bench.run(out_for_s)
    bench.host_end.plug(True)
    bench.run(COASTING_S, FORWARD)
    assert bench.driver.state is not DriverState.ARMED
    assert bench.robot.speed_rad_s < 0.05
    assert no_wheel_is_driven(bench)


def test_a_brown_out_disarms_and_nothing_moves_after_it(bench):
    bench.robot.controller.restart()
    bench.run(COASTING_S)
    assert bench.driver.state is not DriverState.ARMED
    assert bench.largest_speed_in(WATCHED_S, FORWARD) < 0.05


@pytest.mark.parametrize("stops", [False, True], ids=["armed", "stopping"])
def test_another_host_that_commands_is_named_and_a_fault(vendor, bench, another_host, stops):
    if stops:
        bench.request(Request.STANDBY).run(0.05)
    another_host(vendor.foreign)
    bench.run(0.05)
    assert bench.driver.state is DriverState.FAULT
    assert "another host" in bench.driver.detail
    assert any("another host" in event for event in bench.events)


def test_another_host_is_noticed_by_a_driver_that_has_only_listened(vendor):
    if vendor.is_serial:
        pytest.skip("a line with two ends has one host")
    driver = create_driver(vendor.name, vendor.settings)
    driver.link_up(0)
    assert driver.receive(1, ()).other_host is None
    frame = Frame(vendor.foreign.can_id, vendor.foreign.data, vendor.foreign.extended)
    assert driver.receive(2, (ReceivedFrame(2, frame),)).other_host.startswith("it commands ")


def test_garbage_is_counted_never_raises_and_never_moves_faster(new_bench):
    generator = random.Random(5)
    new_bench.arm()
    new_bench.command = command(*FORWARD)
    for _ in range(1000):
        can_id = generator.randrange(0x800)
        new_bench.inject_to_host(can_id, generator.randbytes(generator.choice((0, 1, 7, 8, 8))))
        new_bench.step()
        assert all(map(math.isfinite, new_bench.robot.speed))
    assert new_bench.largest_speed <= max(FORWARD) + 0.02
    assert new_bench.driver.stats.unknown_id


def test_a_command_that_is_none_is_the_callers_error(new_bench):
    check_that_what_is_no_command_is_refused(new_bench)


def test_it_arms_again_only_on_request_and_does_not_forget_on_the_way_what_was_wanted(bench):
    sessions = bench.driver.stats.sessions
    bench.request(Request.READY).run(COASTING_S + WATCHED_S, FORWARD)
    assert bench.robot.speed_rad_s < 0.05
    assert bench.driver.state is DriverState.READY
    bench.arm()
    assert bench.driver.stats.sessions == sessions + 1


def test_a_controller_that_fell_silent_while_it_drove_is_a_fault_until_a_reset_though_it_is_back(vendor, bench):
    drain, bench.robot.drain = bench.robot.drain, lambda: drain() and []
    bench.run(1.0, FORWARD)
    assert bench.driver.state is DriverState.FAULT
    assert not [frame for frame in bench.robot.received[-4:] if vendor.is_motion(frame)]
    bench.robot.drain = drain
    bench.run(WATCHED_S)
    assert bench.driver.state is DriverState.FAULT
    assert "stopped reporting" in bench.driver.detail
    bench.request(Request.RESET).run_until(*IDLE_STATES)


def test_an_emergency_stop_is_not_reset_while_nothing_is_heard_of_the_controllers(bench):
    bench.send_estop()
    bench.run(COASTING_S)
    drain, bench.robot.drain = bench.robot.drain, lambda: drain() and []
    bench.run(2.5)
    bench.request(Request.RESET).run(1.0)
    assert bench.driver.state is DriverState.ESTOP
    bench.robot.drain = drain
    bench.run_until(*IDLE_STATES)


def test_an_emergency_stop_that_is_heard_is_taken_at_once_and_said_once(vendor, bench, another_host):
    for frame in 3 * find_driver(vendor.name).stop_frames(vendor.settings):
        another_host(frame)
    bench.run(0.02)
    assert bench.driver.state is DriverState.ESTOP
    assert [event for event in bench.events if "received on the link" in event or "another host is" in event] == [
        "e-stop received on the link, sent by `disco-hw estop` or another host"
    ]


def test_released_no_speed_but_zero_is_commanded_any_more_and_the_reason_is_a_fault_until_a_reset(vendor, bench):
    bench.driver.release("the left wheel does not count")
    bench.run(0.02)
    sent = len(bench.robot.received)
    assert bench.driver.state is DriverState.FAULT
    assert "the left wheel does not count" in bench.driver.detail
    bench.run(COASTING_S, FORWARD)
    assert not [frame for frame in bench.robot.received[sent:] if vendor.is_motion(frame)], "a ramp would be motion"
    assert no_wheel_is_driven(bench)
    bench.request(Request.ARM).run(0.5)
    assert bench.driver.state is DriverState.FAULT
    bench.request(Request.RESET).run(1.0)
    bench.run_until(*IDLE_STATES)
