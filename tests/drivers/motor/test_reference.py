"""Tests of what is particular to the reference driver; the rest is in the conformance suite."""

from collections import Counter
from dataclasses import replace

import pytest

from drivers.motor.reference import ESTOP_REPEATS
from drivers.motor.reference_protocol import cyclic_frames
from drivers.types import CyclicFrame, DriverState, Frame, NoSettings, ReceivedFrame, Request, WheelCommand
from firmware_protocol.status_codes import FAULTS
from tests.drivers.motor.bench import IDLE_STATES, MS, START_NS
from tests.drivers.motor.reference_robot import CODEC, CONFIG, ReferenceRobot, create_bench, create_driver

SILENT = "the robot stopped sending: starting a new handshake; check the cable and the robot's power"
TIME_REQUEST = CODEC.encode("TIME_REQUEST", 0, sequence=1)
SECOND_HOST = "another host is on the link: it sends TIME_REQUEST; disconnect it"


@pytest.fixture
def bench():
    return create_bench()


def test_says_what_it_waits_for():
    driver = create_driver()
    assert driver.detail == "the link is down"
    assert driver.transmit(0, None) == ()
    driver.link_up(0)
    assert driver.state is DriverState.HANDSHAKE
    assert "no answer from the robot" in driver.detail
    driver.request(Request.ARM)
    assert driver.detail == "no answer from the robot; check that it is switched on and uses the same bit rate"
    bench = create_bench()
    bench.driver = driver
    bench.run_until(*IDLE_STATES)
    assert "not arming: no answer from the robot" in driver.detail
    bench.run(1.0)
    assert not bench.robot.armed, "a request made too early is not remembered"


def test_another_major_version_is_refused():
    bench = create_bench(ReferenceRobot(replace(CONFIG, protocol_major=2)))
    bench.run_until(DriverState.REFUSED)
    assert "the robot speaks protocol 2.0, this host 1.0" in bench.driver.detail
    bench.request(Request.ARM).run(3.0, (1.0, 1.0))
    assert bench.driver.state is DriverState.REFUSED
    assert bench.largest_speed == 0.0


def test_another_dbc_is_refused_but_telemetry_is_shown_until_the_robot_is_flashed():
    bench = create_bench(ReferenceRobot(replace(CONFIG, dbc_hash=0x0BADCAFE)))
    bench.run_until(DriverState.REFUSED)
    assert "0badcafe" in bench.driver.detail
    assert f"{CODEC.dbc_hash:08x}" in bench.driver.detail
    for request in (Request.READY, Request.ARM):
        bench.request(request).run(2.0, (1.0, 1.0))
    assert bench.driver.state is DriverState.REFUSED
    assert bench.driver.stats.sessions == 0
    assert bench.largest_speed == 0.0
    assert len(bench.wheels) > 100
    assert any("handshake refused" in event for event in bench.events)
    bench.robot = ReferenceRobot(boot_ns=bench.now_ns)
    bench.run_until(*IDLE_STATES, timeout_s=6.0)


@pytest.mark.parametrize("rate_hz", [20, 50, 100])
def test_arms_at_every_control_rate(rate_hz):
    bench = create_bench(rate_hz=rate_hz).drive(2.0, (3.0, 2.0))
    assert bench.driver.state is DriverState.ARMED
    assert bench.robot.core.rejections["STATE"] <= 2


def test_each_arming_has_a_session_of_its_own(bench):
    sessions = []
    for _ in range(4):
        bench.arm()
        sessions.append(bench.robot.session)
        bench.request(Request.STANDBY).run(0.3)
    assert 0 not in sessions
    assert len(set(sessions)) == 4


def test_a_robot_that_falls_silent_starts_a_new_handshake():
    bench = create_bench().drive(1.0, (3.0, 3.0))
    bench.loses = lambda _: True
    bench.run_until(DriverState.HANDSHAKE, timeout_s=0.6)
    assert bench.driver.identity is bench.driver.limits is None
    bench.loses = None
    bench.largest_speed = 0.0
    bench.run_until(*IDLE_STATES)
    assert bench.driver.detail == "disarmed: the robot stopped sending"
    bench.run(2.0)
    assert bench.largest_speed == 0.0


def test_a_lossy_link_does_not_disarm():
    """Three frames in a row may not be lost at 50 Hz: the fourth is out of sequence and the fifth comes too late."""
    bench = create_bench(loses=lambda generator: generator.random() < 0.03).drive(10.0, (3.0, 2.0))
    assert bench.driver.state is DriverState.ARMED
    assert bench.driver.stats.lost_frames > 30
    assert bench.driver.stats.implausible_ticks == 0
    assert bench.wheels[-1].left_angle_rad == pytest.approx(bench.robot.angle[0], abs=0.2)


def test_arming_is_given_up_with_the_robots_own_reason(bench):
    bench.run_until(*IDLE_STATES)
    bench.robot.pushed = 1.0
    bench.driver.request(Request.ARM)
    assert bench.driver.state is DriverState.ARMING
    bench.run_until(*IDLE_STATES, timeout_s=1.6)
    assert "the robot did not arm within 1.5 s" in bench.driver.detail
    assert "the wheels are turning" in bench.driver.detail
    bench.robot.pushed = 0.0
    bench.run(2.0)
    assert not bench.robot.armed


def test_a_second_host_is_pointed_out_once_a_link(bench):
    bench.run_until(*IDLE_STATES)
    for link in (1, 2):
        for _ in range(3):
            bench.inject_to_host(*TIME_REQUEST)
            bench.run(0.1)
        assert bench.events.count(SECOND_HOST) == link
        bench.host_end.plug(False)
        bench.run(0.1)
        bench.host_end.plug(True)
        bench.run(0.5)
        assert bench.events.count(SECOND_HOST) == link


def test_a_second_host_that_commands_motion_stops_the_robot_but_never_drives_it():
    bench = create_bench().drive(0.5, (1.0, 1.0))
    for counter in range(400):
        foreign = CODEC.encode(
            "WHEEL_COMMAND", counter, mode="SPEED", left_speed=8, right_speed=8, valid_for=0.1, session=200
        )
        bench.inject_to_robot(*foreign)
        bench.inject_to_host(*foreign)
        bench.run(0.005)
    assert bench.largest_speed < 1.01
    assert bench.driver.state is not DriverState.ARMED
    assert "another host is on the link: it sends WHEEL_COMMAND; disconnect it" in bench.events


def test_an_estop_from_outside_is_said_once_a_stop_and_is_no_second_host_unless_that_sends_more(bench):
    """As `disco-hw estop` sends it beside the daemon: three frames, which the robot and the driver both receive."""
    estop = CODEC.encode("ESTOP", reason="UNSPECIFIED")
    bench.arm()
    for stops in (1, 2):
        for _ in range(3):
            bench.inject_to_robot(*estop)
            bench.inject_to_host(*estop)
            bench.run(0.02)
        bench.run(2.0)
        assert bench.events.count("e-stop received on the link, sent by `disco-hw estop` or another host") == stops
    assert bench.driver.state is DriverState.ESTOP
    assert not any("another host is on the link" in event for event in bench.events)
    assert bench.driver.stats.unknown_id == 0
    bench.inject_to_host(*estop)
    bench.inject_to_host(*TIME_REQUEST)
    bench.run(0.1)
    assert SECOND_HOST in bench.events


def test_a_new_link_voids_everything_even_if_its_loss_went_unseen():
    bench = create_bench().drive(2.0, (1.0, 1.0))
    driver = bench.driver
    bench.host_end.receive()
    for renew in (driver.link_up, driver.link_down):
        renew(bench.now_ns)
        assert driver.identity is driver.limits is None
        assert driver.clock_offset_ns is None
        assert not driver.synced
    driver.link_up(bench.now_ns)
    assert driver.state is DriverState.HANDSHAKE
    assert set(names(driver.transmit(bench.now_ns, WheelCommand(1.0, 1.0, 0.1)))) == {
        "HELLO_REQUEST",
        "HOST_STATE",
        "TIME_REQUEST",
    }


def received_frame(name, counter=0, **signals):
    return ReceivedFrame(START_NS, Frame(*CODEC.encode(name, counter, **signals)))


def build():
    return received_frame("BUILD", dbc_hash=CODEC.dbc_hash, board_id=1)


def state(counter):
    names = ("state", "fault", "session", "estop_source", "last_command_counter", "rejected_count", "reject_reason")
    return received_frame("SYSTEM_STATE", counter, **dict.fromkeys(names, 0) | {"state": 1, "stop_cause": 0})


def limits(page):
    if page == 0:
        return received_frame("LIMITS", page=0, max_wheel_speed=8, max_wheel_acceleration=20, ticks_per_rev=2048)
    return received_frame("LIMITS", page=1, command_timeout=0.1, drive_off_timeout=0.5, stop_deceleration=20)


def hello():
    names = ("protocol_minor", "firmware_major", "firmware_minor", "firmware_patch", "capabilities")
    return received_frame("HELLO", protocol_major=1, **dict.fromkeys(names, 0))


def test_says_which_part_of_the_handshake_is_missing():
    driver = create_driver()
    driver.link_up(START_NS)
    driver.receive(START_NS, [hello(), limits(0)])
    assert driver.detail == "waiting for the robot's BUILD, LIMITS"
    driver.receive(START_NS, [build(), limits(1)])
    assert driver.identity is not None
    assert driver.detail == "waiting for the robot's SYSTEM_STATE"
    later_ns = START_NS + 400 * MS
    assert "HELLO_REQUEST" in names(driver.transmit(later_ns, None)), "until the robot says that it has accepted us"


def test_a_response_to_a_request_of_the_last_link_teaches_nothing():
    driver = create_driver()
    driver.link_up(START_NS)
    driver.transmit(START_NS, None)
    driver.link_up(START_NS)
    driver.receive(START_NS, [received_frame("TIME_RESPONSE", sequence=1, receive_time=5)])
    assert driver.clock_offset_ns is None
    driver.transmit(START_NS, None)
    driver.receive(START_NS, [received_frame("TIME_RESPONSE", sequence=2, receive_time=5)])
    assert driver.clock_offset_ns == START_NS - 5_000


def test_silence_is_noticed_by_whoever_only_transmits(bench):
    bench.run_until(*IDLE_STATES)
    bench.driver.transmit(bench.now_ns + 501 * MS, None)
    assert bench.driver.state is DriverState.HANDSHAKE


def test_nothing_is_silent_that_was_never_heard(bench):
    bench.loses = lambda _: True
    bench.run(4.0)
    assert bench.events == []


@pytest.mark.parametrize(
    ("protocol", "silence_ms"), [({}, 500), ({"dbc_hash": 0x0BADCAFE}, 3000), ({"protocol_major": 2}, 3000)]
)
def test_a_silence_counts_only_beyond_its_limit_which_is_longer_for_a_robot_that_was_refused(protocol, silence_ms):
    """One that is refused says less, and should stay refused in words until it is gone."""
    bench = create_bench(ReferenceRobot(replace(CONFIG, **protocol)))
    bench.run_until(DriverState.REFUSED if protocol else DriverState.STANDBY)
    limit_ns = bench.driver._last_received_ns + silence_ms * MS
    assert bench.driver.receive(limit_ns, ()).events == ()
    assert bench.driver.receive(limit_ns + 1, ()).events == (SILENT,)
    assert bench.driver.state is DriverState.HANDSHAKE


@pytest.mark.parametrize(
    ("frames", "is_identified"),
    [([state(counter) for counter in range(4)], False), ([hello(), limits(0), limits(1), build()], True)],
    ids=["only its state", "all but its state"],
)
def test_a_robot_that_has_shown_only_a_part_can_fall_silent_too(frames, is_identified):
    driver = create_driver()
    driver.link_up(START_NS)
    driver.receive(START_NS, frames)
    assert (driver.identity is not None, driver.limits is not None) == (is_identified, is_identified)
    assert driver.receive(START_NS + 501 * MS, ()).events == (SILENT,)


def test_a_robot_that_turns_out_to_be_another_is_commanded_no_more():
    bench = create_bench().drive(0.5, (1.0, 1.0))
    bench.inject_to_host(*CODEC.encode("BUILD", 0, dbc_hash=0x0BADCAFE, board_id=1))
    bench.run_until(DriverState.REFUSED)
    assert "WHEEL_COMMAND" not in names(bench.driver.transmit(bench.now_ns, WheelCommand(1.0, 1.0, 0.1)))
    bench.run(1.0)
    assert bench.robot.speed_rad_s == 0.0


def test_an_emergency_stop_of_ours_ends_the_wish_to_be_armed(bench):
    bench.arm()
    bench.driver.estop(bench.now_ns)
    assert bench.driver.state is DriverState.STOPPING
    assert "without a request from this host" in bench.driver.detail
    bench.run(1.0, (1.0, 1.0))
    assert not bench.robot.armed, "even if the frames themselves are lost"


def test_faults_and_emergency_stops_are_reported_in_words():
    bench = create_bench()
    bench.arm()
    bench.robot.press_estop(True)
    bench.run_until(DriverState.ESTOP)
    assert bench.driver.detail == "emergency stop button pressed; release it, then reset"
    bench = create_bench()
    bench.run_until(*IDLE_STATES)
    bench.robot.break_down(True)
    bench.run_until(DriverState.FAULT)
    assert bench.driver.detail == f"the robot reports OVER_CURRENT_LEFT: {FAULTS['OVER_CURRENT_LEFT'].advice}"
    assert any(event == f"robot STANDBY -> FAULT, fault {bench.driver.detail[18:]}" for event in bench.events)


def test_a_board_whose_wheels_are_virtual_is_distinguished_from_a_robots():
    bench = create_bench(ReferenceRobot(replace(CONFIG, board_id=0x8003)))
    bench.run_until(*IDLE_STATES)
    assert any("board 3 with VIRTUAL wheels" in event for event in bench.events)


def test_each_event_is_reported_once():
    bench = create_bench().drive(2.0)
    reported = [event for event in bench.events if not event.startswith("handshake complete: firmware 0.1.0, board 1")]
    assert reported == ["robot unknown -> STANDBY", "robot STANDBY -> READY", "robot READY -> ARMED"]
    assert len(bench.events) == 4


def test_slow_telemetry_is_handed_on(bench):
    bench.run(6.0)
    kinds = {
        kind for readings in bench.readings for kind in ("motors", "power", "link_health") if getattr(readings, kind)
    }
    assert kinds == {"motors", "power", "link_health"}
    *_, status = (status for readings in bench.readings for status in readings.status)
    assert (status.state, status.fault, status.fault_code) == ("STANDBY", "NONE", 0)


def names(frames):
    return [CODEC.decode(outgoing.frame.can_id, outgoing.frame.data).name for outgoing in frames]


def test_house_keeping_is_sent_as_often_as_it_should(bench):
    transmit, counts, sent = bench.driver.transmit, [], []
    bench.driver.transmit = lambda now_ns, command: sent.extend(frames := transmit(now_ns, command)) or frames
    for _ in range(4):
        sent.clear()
        bench.run(1.0)
        counts.append(Counter(names(sent)))
    assert counts[0]["TIME_REQUEST"] == 5
    assert counts[3]["TIME_REQUEST"] == 1
    assert counts[0]["HELLO_REQUEST"] in (1, 2)
    assert counts[3]["HELLO_REQUEST"] == 0
    assert all(10 <= count["HOST_STATE"] <= 13 for count in counts)
    assert all(count["WHEEL_COMMAND"] == 0 for count in counts)


def test_emergency_stop_frames(bench):
    frames = bench.driver.estop(1_000)
    assert len(frames) == ESTOP_REPEATS == 3
    assert {outgoing.frame.can_id for outgoing in frames} == {0x080}
    assert all(outgoing.deadline_ns > 1_000 + 100 * MS for outgoing in frames)


def test_commands_are_counted_and_leave_in_time_or_not_at_all(bench):
    bench.arm()
    before = bench.driver.stats.commands_sent
    bench.run(1.0, (1.0, 1.0))
    assert bench.driver.stats.commands_sent - before == 50
    frames = bench.driver.transmit(bench.now_ns, WheelCommand(1.0, 1.0, 0.1))
    (command,) = (outgoing for outgoing in frames if outgoing.frame.can_id == CODEC.can_id("WHEEL_COMMAND"))
    assert command.deadline_ns == bench.now_ns + 50 * MS
    values = CODEC.decode(command.frame.can_id, command.frame.data).values
    assert values["valid_for"] == pytest.approx(0.1)
    assert values["session"] == bench.robot.session
    with pytest.raises(ValueError, match="left_speed"):
        bench.driver.transmit(bench.now_ns, WheelCommand(70.0, 0.0, 0.1))


def test_released_its_motors_are_off_for_a_moment_then_braked_and_nothing_that_is_wanted_meanwhile_ramps():
    bench = create_bench().drive(0.6, (3.0, 2.0))
    bench.driver.release("the left wheel does not count")
    bench.run(0.05)
    bench.driver.request(Request.STANDBY)
    braked = []
    for _ in range(30):
        bench.run(0.05)
        assert not bench.robot.outputs.driver_enabled
        braked.append(bench.robot.outputs.brake)
    assert braked == sorted(braked)
    assert not braked[0]
    assert all(braked[6:])
    assert not bench.robot.armed
    assert "disarmed: the left wheel does not count" in bench.events


def test_the_protocols_cyclic_frames_are_those_of_the_dbc():
    by_name = {frame.name: frame for frame in cyclic_frames(NoSettings(), 50.0, False)}
    assert by_name["WHEEL_SPEED"] == CyclicFrame("WHEEL_SPEED", "ROBOT", 8, 100.0)
    assert by_name["LIMITS"].rate_hz == 2.0
    assert by_name["WHEEL_COMMAND"] == CyclicFrame("WHEEL_COMMAND", "HOST", 8, 50.0)
    assert {frame.name: frame for frame in cyclic_frames(NoSettings(), 100.0, False)}["WHEEL_COMMAND"].rate_hz == 100.0
    assert "ESTOP" not in by_name
