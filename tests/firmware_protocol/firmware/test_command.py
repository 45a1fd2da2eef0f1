"""Which wheel commands are accepted, and the watchdog that only an accepted one feeds."""

import dataclasses

import pytest

from tests.firmware_protocol.bench import CODEC, CONFIG, MS, Bench, sealed


def rejected(bench, act):
    """What `act` adds to the counters of rejections, and whether any command was accepted."""
    before, accepted = bench.core.rejections, bench.out.accepted_commands
    act()
    after = bench.core.rejections
    assert bench.step().accepted_commands == accepted
    return {name: after[name] - before[name] for name in after if after[name] != before[name]}


def driving():
    bench = Bench.driving()
    bench.command = None
    return bench


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"session": 8}, "SESSION"),
        ({"session": 0}, "SESSION"),
        ({"mode": 4}, "MODE"),
        ({"mode": 15}, "MODE"),
        ({"mode": "HOLD_ZERO"}, "MODE"),
        ({"mode": "BRAKE"}, "MODE"),
        ({"mode": "COAST"}, "MODE"),
        ({"valid_for": 0.0}, "VALIDITY"),
    ],
)
def test_armed_rejects(changes, reason):
    bench = driving()
    assert rejected(bench, lambda: bench.wheel_command(5.0, 5.0, **changes)) == {reason: 1}


def test_armed_accepts_and_follows():
    bench = driving()
    before = bench.out.accepted_commands
    bench.wheel_command(4.1, 2.1)
    assert bench.run(30).accepted_commands == before + 1
    assert (bench.out.left_setpoint_rad_s, bench.out.right_setpoint_rad_s) == pytest.approx((4.1, 2.1))
    assert bench.out.last_command_counter == bench.counters["WHEEL_COMMAND"]


DATA = CODEC.encode("WHEEL_COMMAND", 0, mode=1, left_speed=1, right_speed=1, valid_for=0.1, session=7).data


def test_wrong_length_and_another_majors_command_are_rejected():
    bench = driving()
    for data, reason in ((sealed(0x100, DATA[1:], major=2), "CRC"), *((DATA[:n], "LENGTH") for n in range(8))):
        assert rejected(bench, lambda d=data: bench.core.receive(bench.now_us, 0x100, d)) == {reason: 1}


def test_wrong_crc_is_rejected_whatever_bit_is_wrong():
    for bit in range(64):
        bench = Bench() if bit else driving()
        flipped = (int.from_bytes(DATA, "little") ^ 1 << bit).to_bytes(8, "little")
        assert rejected(bench, lambda b=bench, d=flipped: b.core.receive(b.now_us, 0x100, d)) == {"CRC": 1}


def test_a_replayed_run_of_old_frames_is_rejected_at_its_first_frame_and_by_its_session_for_ever():
    bench = Bench.armed()
    recorded = []
    for _ in range(20):
        values = {"mode": "SPEED", "left_speed": 6.0, "right_speed": 6.0, "valid_for": 0.5, "session": 7}
        recorded.append(CODEC.encode("WHEEL_COMMAND", bench.next_counter("WHEEL_COMMAND"), **values))
    bench.command = None
    bench.run_until("STANDBY")
    bench.to_armed(session=9)
    bench.command = None
    accepted = bench.out.accepted_commands
    for frame in recorded:
        bench.core.receive(bench.now_us, *frame)
        assert bench.step().left_setpoint_rad_s == 0.0
    assert bench.out.accepted_commands == accepted


@pytest.mark.parametrize("step", range(16))
def test_up_to_two_lost_frames_are_accepted_and_any_other_sequence_is_rejected(step):
    bench = driving()
    before = bench.out.accepted_commands
    bench.counters["WHEEL_COMMAND"] += step - 1
    if 1 <= step <= 3:
        bench.wheel_command(4.0, 2.0)
        assert bench.step().accepted_commands == before + 1
    else:
        reason = "REPEATED" if step == 0 else "SEQUENCE"
        assert rejected(bench, lambda: bench.wheel_command(5.0, 5.0)) == {reason: 1}


def test_before_qualification_nothing_is_accepted():
    bench = Bench.ready()
    for _ in range(3):
        assert rejected(bench, bench.wheel_command) == {"NOT_QUALIFIED": 1}
    bench.wheel_command()
    assert bench.step().accepted_commands == 1


@pytest.mark.parametrize("state", ["STANDBY", "READY"])
def test_nonzero_command_before_armed_is_rejected_and_in_standby_even_zero(state):
    bench = Bench.ready() if state == "READY" else Bench()
    bench.command = {}
    bench.run(200)
    bench.command = None
    if state == "STANDBY":
        assert rejected(bench, bench.wheel_command) == {"STATE": 1}
    assert rejected(bench, lambda: bench.wheel_command(0.0, 0.002)) == {"NONZERO_BEFORE_ARMED": 1}


@pytest.mark.parametrize("state", ["STOPPING", "FAULT", "ESTOP"])
def test_stopped_states_reject_everything(state):
    bench = Bench.driving()
    if state == "STOPPING":
        bench.set_request("STANDBY").run_until("STOPPING")
    elif state == "FAULT":
        bench.inputs["left_current_a"] = 100.0
        bench.run_until("FAULT")
    else:
        bench.estop()
    bench.command = None
    for left, right in ((4.0, 2.0), (0.0, 0.0)):
        assert rejected(bench, lambda speeds=(left, right): bench.wheel_command(*speeds)) == {"STATE": 1}


def ready_after(*commands):
    """Return a bench in READY that has qualified commands, of which these are the last."""
    bench = Bench.ready()
    for command in ({}, {}, {}, *commands):
        bench.wheel_command(**command)
        bench.step()
    return bench


def test_arming_takes_five_zero_commands_in_a_row():
    zero, other = {}, {"left": 1.0}
    for commands, state in (
        ([zero] * 4, "READY"),
        ([zero] * 5, "ARMED"),
        ([zero] * 4 + [other] + [zero] * 4, "READY"),
        ([zero] * 4 + [other] + [zero] * 5, "ARMED"),
        ([zero] * 4 + [{"session": 8}] + [zero] * 4, "READY"),
    ):
        bench = ready_after(*commands)
        assert bench.set_request("ARM").run(50 - bench.now_us // MS % 50).state == state, commands


@pytest.mark.parametrize("broken", ["crc", "repeated"])
def test_an_unusable_frame_breaks_the_row_of_zeros(broken):
    bench = ready_after(*[{}] * 4)
    if broken == "crc":
        bench.core.receive(bench.now_us, 0x100, bytes(8))
    else:
        bench.counters["WHEEL_COMMAND"] -= 1
        bench.wheel_command()
    five_zeros_more(bench)


def five_zeros_more(bench):
    """Nothing of what was sent before counts towards the five in a row."""
    for _ in range(4):
        bench.wheel_command()
        bench.step()
        assert "ZERO_COMMANDS" in bench.blockers()
    bench.wheel_command()
    bench.step()
    assert "ZERO_COMMANDS" not in bench.blockers()


def test_zeros_of_an_arming_before_do_not_count():
    bench = Bench.armed().to_standby()
    bench.set_request("READY", session=9).run_until("READY", within_ms=60)
    five_zeros_more(bench)


def test_zeros_count_until_the_command_timeout_is_over():
    bench = ready_after(*[{}] * 5)
    assert "ZERO_COMMANDS" not in bench.blockers()
    bench.run(99)
    assert "ZERO_COMMANDS" not in bench.blockers()
    bench.step()
    assert "ZERO_COMMANDS" in bench.blockers()
    assert bench.set_request("ARM").run(100).state == "READY"


def stop_time_us(bench):
    """Time from now until the core leaves ARMED."""
    start = bench.now_us
    bench.run_until("STOPPING", "STANDBY", within_ms=1000)
    return bench.now_us - start


def test_no_command_from_before_arming_outlives_it():
    """Neither its mode, nor its time of validity, nor its age: the watchdog runs from the instant of arming."""
    bench = ready_after(*[{"mode": "COAST", "valid_for": 0.002}] * 5)
    bench.run(40)
    assert bench.set_request("ARM").run_until("ARMED", within_ms=50).driver_enabled
    assert stop_time_us(bench) == 100 * MS
    assert (bench.out.stop_cause, bench.out.watchdog_events) == ("COMMAND_TIMEOUT", 1)


@pytest.mark.parametrize(
    "feed",
    [
        lambda bench: None,
        lambda bench: bench.hello(),
        lambda bench: bench.send("TIME_REQUEST", sequence=1),
        lambda bench: bench.send("PARAM_REQUEST", operation="READ", key=1, value=0.0),
        lambda bench: bench.core.receive(bench.now_us, 0x110, bytes(8)),
        lambda bench: bench.wheel_command(4.0, 2.0, session=8),
        lambda bench: bench.wheel_command(4.0, 2.0, valid_for=0.0),
    ],
    ids=["silence", "hello", "time", "parameter", "telemetry", "old session", "not valid"],
)
def test_only_an_accepted_command_feeds_the_watchdog(feed):
    bench = driving()
    bench.wheel_command(4.0, 2.0)
    start = bench.now_us
    while bench.step().state == "ARMED":
        if bench.now_us % (10 * MS) == 0:
            feed(bench)
    assert bench.now_us - start == 100 * MS
    assert bench.out.stop_cause == "COMMAND_TIMEOUT"


@pytest.mark.parametrize(
    ("valid_for_s", "expected_ms", "cause"),
    [
        (0.002, 2, "COMMAND_EXPIRED"),
        (0.04, 40, "COMMAND_EXPIRED"),
        (0.098, 98, "COMMAND_EXPIRED"),
        (0.1, 100, "COMMAND_TIMEOUT"),
        (0.51, 100, "COMMAND_TIMEOUT"),
    ],
)
def test_a_command_holds_no_longer_than_it_says_nor_than_the_firmware_allows(valid_for_s, expected_ms, cause):
    bench = driving()
    bench.wheel_command(4.0, 2.0, valid_for=valid_for_s)
    assert stop_time_us(bench) == expected_ms * MS
    assert (bench.out.stop_cause, bench.out.watchdog_events) == (cause, 1)


def test_a_stop_for_another_reason_is_no_watchdog_event():
    bench = driving()
    bench.set_request("STANDBY")
    bench.command = {"left": 4.0, "right": 2.0}
    assert bench.run_until("STOPPING").watchdog_events == 0


def test_a_late_command_finds_the_watchdog_expired_even_if_no_cycle_ran_in_between():
    bench = driving()
    bench.wheel_command(4.0, 2.0)
    accepted = bench.step().accepted_commands
    bench.now_us += 150 * MS
    bench.wheel_command(4.0, 2.0)
    assert bench.step().state == "STOPPING"
    assert bench.out.accepted_commands == accepted


def test_a_clock_that_steps_back_neither_trips_nor_extends_the_watchdog():
    bench = driving()
    bench.wheel_command(4.0, 2.0)
    bench.run(50)
    assert bench.step(-15 * MS).state == "ARMED"
    assert stop_time_us(bench) == 49 * MS, "the cycle in which it went back counts as one of 1 ms"


def test_timeouts_are_those_of_the_configuration():
    bench = Bench.driving(config=dataclasses.replace(CONFIG, command_timeout_s=0.06))
    bench.command = None
    bench.wheel_command(4.0, 2.0)
    assert stop_time_us(bench) == 60 * MS
