"""What the wheels do: following, limits, modes, the controlled stop and its end."""

import dataclasses

import pytest
from hypothesis import strategies as st

from tests.firmware_protocol.bench import CONFIG, MS, Bench
from tests.tables import examples

EPS = 1e-5


def setpoints(bench):
    return bench.out.left_setpoint_rad_s, bench.out.right_setpoint_rad_s


@pytest.mark.parametrize("state", ["STANDBY", "READY", "FAULT", "ESTOP"])
def test_driver_is_off_and_brake_on_wherever_the_robot_is_not_armed(state):
    bench = Bench.in_state(state)
    assert bench.step().state == state
    assert (bench.out.driver_enabled, bench.out.brake, setpoints(bench)) == (False, True, (0.0, 0.0))


def test_armed_holds_zero_with_driver_on():
    bench = Bench.armed()
    assert (bench.out.driver_enabled, bench.out.brake, bench.out.limited) == (True, False, False)
    assert setpoints(bench) == (0.0, 0.0)


def test_acceleration_is_limited_and_both_wheels_move_by_one_factor():
    bench = Bench.armed()
    bench.command = {"left": 4.0, "right": -2.0}
    assert bench.run(25).limited
    left, right = setpoints(bench)
    assert left > 0
    assert right == pytest.approx(-left / 2, abs=1e-4)
    previous = setpoints(bench)
    bench.step()
    assert setpoints(bench)[0] - previous[0] == pytest.approx(0.02, abs=1e-5)
    bench.run(300)
    assert setpoints(bench) == pytest.approx((4.0, -2.0))
    assert not bench.out.limited


def test_speed_is_limited_with_curvature_kept_and_said_so():
    bench = Bench.armed()
    bench.command = {"left": 65.0, "right": -32.5}
    bench.run(600)
    assert setpoints(bench) == pytest.approx((8.0, -4.0))
    assert bench.out.limited


def first_change(bench):
    """The setpoints of the first cycle in which they are others."""
    before = setpoints(bench)
    while setpoints(bench) == before:
        bench.step()
    return setpoints(bench)


def test_hold_zero_goes_back_to_zero_within_the_limit():
    bench = Bench.driving()
    bench.command = {"mode": "HOLD_ZERO"}
    assert first_change(bench) == pytest.approx((3.98, 1.99))
    bench.run(300)
    assert (setpoints(bench), bench.out.driver_enabled, bench.out.brake) == ((0.0, 0.0), True, False)


def test_brake_stops_then_brakes_and_stays_so_when_pushed_or_stopped():
    bench = Bench.driving(config=dataclasses.replace(CONFIG, stop_deceleration_rad_s2=40.0))
    bench.command = {"mode": "BRAKE"}
    assert first_change(bench)[0] == pytest.approx(3.96)
    assert bench.out.driver_enabled
    bench.run(200)
    assert (bench.out.state, bench.out.driver_enabled, bench.out.brake) == ("ARMED", False, True)
    bench.wheels_follow = False
    bench.speeds = [1.0, 1.0]
    bench.run(50)
    assert (bench.out.driver_enabled, bench.out.brake) == (False, True)
    assert (bench.estop().driver_enabled, bench.out.brake) == (False, True)


def test_brake_waits_for_wheels_that_still_roll():
    bench = Bench.driving(0.2, 0.2)
    bench.wheels_follow = False
    bench.command = {"mode": "BRAKE"}
    bench.run(100)
    assert (setpoints(bench), bench.out.driver_enabled, bench.out.brake) == ((0.0, 0.0), True, False)
    bench.speeds = [0.0, 0.0]
    bench.step()
    assert (bench.out.driver_enabled, bench.out.brake) == (False, True)


def coasting():
    bench = Bench.driving()
    bench.wheels_follow = False
    bench.command = {"mode": "COAST"}
    bench.run(40)
    return bench


@pytest.mark.parametrize(
    ("speeds", "command", "first_setpoints"),
    [
        ([3.0, 1.5], {"left": 4.0, "right": 2.0}, (3.02, 1.51)),
        ([12.0, 6.0], {"mode": "HOLD_ZERO"}, (7.98, 3.99)),
    ],
    ids=["rolling", "running away"],
)
def test_coast_lets_go_and_the_driver_takes_over_from_the_wheels_within_the_limit(speeds, command, first_setpoints):
    bench = coasting()
    assert (setpoints(bench), bench.out.driver_enabled, bench.out.brake) == ((0.0, 0.0), False, False)
    assert not bench.out.limited
    bench.speeds, bench.command = speeds, command
    while not bench.step().driver_enabled:
        pass
    assert setpoints(bench) == pytest.approx(first_setpoints)


@pytest.mark.parametrize(
    "act",
    [
        lambda bench: bench.core.receive(bench.now_us, 0x080, b""),
        lambda bench: bench.set_request("STANDBY"),
        lambda bench: setattr(bench, "command", None),
    ],
    ids=["estop", "disarmed", "silence"],
)
def test_released_wheels_are_braked_by_any_stop_without_a_ramp(act):
    bench = coasting()
    bench.speeds = [4.0, 4.0]
    act(bench)
    while not bench.step().brake:
        assert not bench.out.driver_enabled
    assert bench.out.state != "ARMED"
    for _ in range(200):
        bench.step()
        assert (bench.out.driver_enabled, bench.out.brake, setpoints(bench)) == (False, True, (0.0, 0.0))


def stop(bench, act):
    """Run `act` in motion and return the setpoints of each following cycle with the driver on."""
    act(bench)
    trace = []
    while bench.step().driver_enabled:
        trace.append(setpoints(bench))
        assert len(trace) < 3000
    return trace


STOPS = {
    "estop": lambda bench: bench.core.receive(bench.now_us, 0x080, b"\x01"),
    "button": lambda bench: bench.inputs.update(estop_button=True),
    "line": lambda bench: bench.inputs.update(estop_line=True),
}


@pytest.mark.parametrize("how", STOPS)
def test_estop_decelerates_from_the_very_next_cycle_then_brakes_and_does_not_begin_again(how):
    bench = Bench.driving()
    start = bench.now_us
    trace = stop(bench, STOPS[how])
    assert trace[0] == pytest.approx((3.98, 1.99))
    assert all(left == pytest.approx(2 * right, abs=1e-4) for left, right in trace)
    assert bench.now_us - start == pytest.approx(200 * MS, abs=3 * MS)
    assert (bench.out.state, bench.out.brake, setpoints(bench)) == ("ESTOP", True, (0.0, 0.0))
    assert not bench.out.limited
    bench.wheels_follow = False
    bench.speeds = [2.0, 2.0]
    for _ in range(100):
        assert not bench.step().driver_enabled


def test_stopping_keeps_curvature_and_ends_in_standby():
    bench = Bench.driving(4.0, -1.0, config=dataclasses.replace(CONFIG, stop_deceleration_rad_s2=10.0))
    bench.set_request("STANDBY").run_until("STOPPING")
    start = bench.now_us
    assert bench.out.limited
    while bench.step().state == "STOPPING":
        left, right = setpoints(bench)
        assert left == pytest.approx(-4 * right, abs=1e-4)
    assert bench.now_us - start == pytest.approx(400 * MS, abs=3 * MS)
    assert (bench.out.driver_enabled, bench.out.brake) == (False, True)


def test_silence_drives_no_longer_than_the_drive_off_timeout_and_the_next_motion_begins_at_zero():
    bench = Bench.driving(config=dataclasses.replace(CONFIG, stop_deceleration_rad_s2=2.0))
    bench.command = None
    bench.wheel_command(4.0, 2.0)
    start = bench.now_us
    while bench.step().driver_enabled:
        pass
    assert bench.now_us - start == 500 * MS
    assert (bench.out.state, bench.out.brake, setpoints(bench)) == ("STOPPING", True, (0.0, 0.0))
    bench.run_until("STANDBY", within_ms=10)
    bench.to_armed(session=8)
    assert bench.out.driver_enabled
    assert setpoints(bench) == (0.0, 0.0)


def test_a_stop_or_an_estop_that_does_not_end_is_ended():
    endless = Bench.driving(config=dataclasses.replace(CONFIG, drive_off_timeout_s=2.0, stop_timeout_s=0.3))
    endless.wheels_follow = False
    bench = endless.copy()
    bench.set_request("STANDBY").run_until("STOPPING")
    start = bench.now_us
    bench.run_until("STANDBY")
    assert bench.now_us - start == 300 * MS
    assert (bench.out.driver_enabled, bench.out.brake) == (False, True)
    assert len(stop(endless, STOPS["estop"])) == 299


def test_latched_fault_lets_the_driver_go_at_once_even_in_a_stop():
    bench = Bench.driving()
    assert bench.estop().driver_enabled
    bench.inputs["left_ticks"] = 1 << 20
    bench.step()
    assert (bench.out.state, bench.out.driver_enabled, bench.out.brake) == ("ESTOP", False, True)


@pytest.mark.parametrize("cycle_us", [1 * MS, 5 * MS])
@pytest.mark.parametrize("leap_ms", [0, 2, 15])
def test_a_pause_or_a_leap_of_the_clock_is_no_bigger_step_than_any_other(cycle_us, leap_ms):
    bench = Bench.armed(config=dataclasses.replace(CONFIG, cycle_s=cycle_us * 1e-6))
    bench.command = {"left": 8.0, "right": 8.0}
    bench.run(20)
    bench.wheel_command(8.0, 8.0)
    before = setpoints(bench)[0]
    assert bench.step(elapsed_us=leap_ms * MS).state == "ARMED"
    assert setpoints(bench)[0] - before == pytest.approx(20.0 * cycle_us * 1e-6, abs=EPS)


@pytest.mark.parametrize("leap_ms", [110, 256, 480])
def test_a_stop_that_begins_with_a_leap_of_the_clock_begins_no_steeper(leap_ms):
    bench = Bench.armed()
    bench.command = {"left": 4.0, "right": 4.0}
    bench.run(300)
    before = setpoints(bench)[0]
    assert bench.step(elapsed_us=leap_ms * MS).state == "STOPPING"
    assert before - setpoints(bench)[0] == pytest.approx(20.0 * 0.001, abs=EPS)


@pytest.mark.parametrize("at_ms", range(1, 700, 23))
def test_estop_at_any_instant_stops_for_good(at_ms):
    """From the first cycle over the handshake, arming, acceleration and a turn: after it, only deceleration to zero."""
    bench = Bench().hello()
    for ms in range(1, 700):
        session_request = "READY" if bench.out.state == "STANDBY" else "ARM"
        bench.set_request(session_request)
        bench.command = {"left": 6.0, "right": -3.0} if bench.out.state == "ARMED" else {}
        bench.step()
        if ms == at_ms:
            bench.core.receive(bench.now_us, 0x080, bytes(at_ms % 9))
            speed = abs(setpoints(bench)[0])
            began = bench.now_us
        if ms > at_ms:
            assert bench.out.state == "ESTOP"
            assert abs(setpoints(bench)[0]) <= max(speed - 20.0 * (bench.now_us - began) * 1e-6, 0.0) + EPS
            if bench.now_us - began > 500 * MS:
                assert not bench.out.driver_enabled


commands = st.tuples(
    st.floats(-65.0, 65.0), st.floats(-65.0, 65.0), st.sampled_from(["SPEED", "HOLD_ZERO", "BRAKE", "COAST"])
)


@examples(
    quick=60,
    every=100,
    sequence=st.lists(commands, min_size=1, max_size=15),
    speed=st.floats(0.1, 20.0),
    acceleration=st.floats(0.5, 100.0),
    deceleration=st.floats(1.0, 100.0),
)
def test_whatever_is_commanded_the_setpoint_keeps_the_limits(sequence, speed, acceleration, deceleration):
    bench = Bench(
        dataclasses.replace(
            CONFIG,
            max_wheel_speed_rad_s=speed,
            max_wheel_acceleration_rad_s2=acceleration,
            stop_deceleration_rad_s2=deceleration,
        )
    )
    bench.to_armed()
    largest_step = max(acceleration, deceleration) * 1e-3
    previous, was_driven = setpoints(bench), True
    for left, right, mode in sequence:
        bench.command = {"left": left, "right": right, "mode": mode} if mode == "SPEED" else {"mode": mode}
        for _ in range(25):
            bench.step()
            now = setpoints(bench)
            assert max(map(abs, now)) <= speed * (1 + 1e-6)
            if bench.out.driver_enabled and was_driven:
                assert max(abs(a - b) for a, b in zip(now, previous, strict=True)) <= largest_step * (1 + 1e-3) + EPS
            previous, was_driven = now, bench.out.driver_enabled
