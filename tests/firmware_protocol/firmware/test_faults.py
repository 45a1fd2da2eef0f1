"""Detection, debounce, latching and clearing of every fault."""

import dataclasses
import math

import msgspec
import numpy as np
import pytest

from firmware_protocol import _firmware
from firmware_protocol.firmware_core import FirmwareCore, ResetCause
from tests.firmware_protocol.bench import CONFIG, FAULTS, MS, STATIONARY, Bench

SIDES = ("left", "right")


def fault_after(bench, cycles):
    bench.run(cycles)
    return bench.fault()


def wait_for_fault(bench, within_ms=2000):
    start = bench.now_us
    for _ in range(within_ms):
        if bench.step().fault:
            return bench.fault(), (bench.now_us - start) // MS
    return None, None


THRESHOLDS = [
    ("voltage_v", 19.99, 20.0, "UNDER_VOLTAGE", 200),
    ("voltage_v", 30.01, 30.0, "OVER_VOLTAGE", 200),
    ("left_current_a", 30.01, 30.0, "OVER_CURRENT_LEFT", 100),
    ("right_current_a", -30.01, -30.0, "OVER_CURRENT_RIGHT", 100),
    ("left_temperature_c", 80.1, 80.0, "OVER_TEMPERATURE_LEFT", 1000),
    ("right_temperature_c", 80.1, 80.0, "OVER_TEMPERATURE_RIGHT", 1000),
    ("voltage_v", math.nan, 25.0, "UNDER_VOLTAGE", 200),
    ("left_current_a", math.nan, 0.0, "OVER_CURRENT_LEFT", 100),
    ("right_temperature_c", math.nan, 25.0, "OVER_TEMPERATURE_RIGHT", 1000),
    ("left_encoder_valid", False, True, "ENCODER_MISSING_LEFT", 300),
    ("right_encoder_valid", False, True, "ENCODER_MISSING_RIGHT", 300),
    ("left_speed_rad_s", math.nan, 0.0, "ENCODER_MISSING_LEFT", 300),
    ("right_speed_rad_s", math.inf, 0.0, "ENCODER_MISSING_RIGHT", 300),
    ("tx_error_count", 256, 255, "BUS_OFF", 0),
]


@pytest.mark.parametrize(("field", "bad", "good", "fault", "debounce_ms"), THRESHOLDS)
def test_threshold_and_debounce(field, bad, good, fault, debounce_ms, bench):
    bench.inputs[field] = good
    assert bench.run(1100).fault == 0
    for _ in range(3 if debounce_ms else 0):
        bench.inputs[field] = bad
        bench.run(debounce_ms - 1)
        bench.inputs[field] = good
        assert bench.run(2).fault == 0, "a shorter disturbance is no fault"
    bench.inputs[field] = bad
    assert wait_for_fault(bench) == (fault, max(debounce_ms, 1))


def test_time_counts_from_the_first_cycle_whatever_the_clock_shows_then():
    core, inputs = FirmwareCore(CONFIG), msgspec.structs.replace(STATIONARY, voltage_v=12.0)
    faults = [core.step(10_000 * MS + after_ms * MS, inputs).fault for after_ms in range(201)]
    assert faults == [0] * 200 + [FAULTS["UNDER_VOLTAGE"]]


def rolling(speed=4.0, config=CONFIG):
    """A robot that drives straight on, with wheels that go on at their speeds whatever the setpoint."""
    bench = Bench.driving(speed, speed, config)
    bench.wheels_follow = False
    return bench


def driving_with(side, **inputs):
    bench = rolling()
    bench.inputs.update({f"{side}_{name}": value for name, value in inputs.items()})
    return bench


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(
    ("current_a", "fault"), [(2.0, "ENCODER_MISSING"), (CONFIG.stall_current_a, "ENCODER_MISSING"), (-16.0, "STALL")]
)
def test_current_without_ticks_is_a_missing_encoder_and_more_than_the_stall_current_a_stall(side, current_a, fault):
    bench = driving_with(side, current_a=current_a)
    bench.inputs[f"{side}_ticks"] = int(bench.ticks[SIDES.index(side)])
    assert wait_for_fault(bench) == (f"{fault}_{side.upper()}", 300)
    assert (bench.out.state, bench.out.driver_enabled) == ("FAULT", False)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda bench: bench.inputs.update(left_current_a=CONFIG.encoder_check_current_a),
        lambda bench: setattr(bench, "command", {"left": CONFIG.encoder_check_speed_rad_s, "right": 4.0}),
        lambda bench: bench.inputs.pop("left_ticks"),
    ],
    ids=["no current", "hardly commanded", "ticks come"],
)
def test_what_is_no_missing_encoder(spoil):
    bench = driving_with("left", current_a=2.0)
    bench.inputs["left_ticks"] = int(bench.ticks[0])
    spoil(bench)
    assert wait_for_fault(bench) == (None, None)


@pytest.mark.parametrize("check_speed", [0.8, 1.6])
def test_few_ticks_a_turn_are_given_their_time(check_speed):
    coarse = dataclasses.replace(CONFIG, ticks_per_rev=20, encoder_check_speed_rad_s=check_speed)
    bench = Bench.driving(2.0, 2.0, config=coarse)
    bench.inputs["left_current_a"] = 2.0
    assert bench.run(2000).fault == 0
    # One last tick in the next cycle, from which the time counts.
    bench.inputs["left_ticks"] = int(bench.ticks[0]) + 1
    three_ticks_at_check_speed_ms = 3 * 2 * math.pi / 20 * 1000 / check_speed
    assert wait_for_fault(bench) == ("ENCODER_MISSING_LEFT", 1 + math.ceil(three_ticks_at_check_speed_ms))


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("jump", [1000, -1000, 1 << 31])
def test_ticks_that_no_wheel_can_make_are_a_jump(side, jump):
    bench = driving_with(side)
    bench.ticks[SIDES.index(side)] += jump
    assert wait_for_fault(bench) == (f"ENCODER_JUMP_{side.upper()}", 1)


@pytest.mark.parametrize("elapsed_ms", [1, 2, 3, 5, 20, 90])
def test_a_jump_is_more_than_three_times_the_fastest_wheel_and_sixteen_ticks(elapsed_ms):
    most = 3.0 * CONFIG.max_wheel_speed_rad_s * CONFIG.ticks_per_rev / (2.0 * math.pi) * elapsed_ms * 1e-3 + 16.0
    for ticks, jump in ((math.floor(most), False), (math.ceil(most), True)):
        for sign in (1, -1):
            bench = Bench()
            bench.inputs["left_ticks"] = sign * ticks
            bench.step(elapsed_us=elapsed_ms * MS)
            assert (bench.out.fault == FAULTS["ENCODER_JUMP_LEFT"]) == jump, ticks


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("elapsed_us", "most"), [(10 * MS, 46), (1, 16)])
def test_as_many_ticks_as_may_be_are_no_jump_and_one_more_is(elapsed_us, most, sign, side):
    """A turn a second at most, of 1000 ticks: thirty in ten milliseconds and none in a microsecond; and sixteen."""
    for ticks in (most, most + 1):
        bench = Bench(dataclasses.replace(CONFIG, max_wheel_speed_rad_s=2.0 * math.pi, ticks_per_rev=1000))
        bench.inputs[f"{side}_ticks"] = sign * ticks
        bench.step(elapsed_us)
        assert (bench.out.fault == FAULTS[f"ENCODER_JUMP_{side.upper()}"]) == (ticks > most)


def test_ticks_may_wrap(bench):
    bench.ticks = [2.0**32 - 500, -(2.0**31)]
    bench.core = Bench().core.__class__(CONFIG)
    bench.to_driving(4.0, -4.0)
    assert bench.run(1000).fault == 0
    assert bench.ticks[0] > 2**32


def test_the_fastest_turn_by_hand_is_no_jump(bench):
    bench.wheels_follow = False
    bench.speeds = [20.0, -20.0]
    assert bench.run(200).fault == 0


def test_ticks_made_up_for_a_pause_are_no_jump():
    bench = Bench.driving(6.0, 6.0)
    bench.step(elapsed_us=20 * MS)
    assert fault_after(bench, 1) == "NONE"


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("sign", [1, -1])
def test_turning_against_the_setpoint_is_wrong_direction(side, sign):
    bench = rolling(4.0 * sign)
    bench.speeds[SIDES.index(side)] = -3.0 * sign
    assert wait_for_fault(bench) == (f"WRONG_DIRECTION_{side.upper()}", 300)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("setpoint_rad_s", "speed"), [(1.0, -3.0), (4.0, -1.0), (4.0, 0.5), (4.0, -0.5), (4.0, 0.0)])
def test_up_to_the_check_speed_a_wheel_does_not_turn_against_its_setpoint(setpoint_rad_s, speed, sign):
    bench = rolling(setpoint_rad_s * sign)
    bench.speeds[0] = speed * sign
    assert wait_for_fault(bench, within_ms=1000) == (None, None)


def test_each_time_the_wheel_turns_against_its_setpoint_is_judged_by_itself():
    bench = rolling()
    bench.speeds[0] = -7.0
    bench.run(100)
    bench.speeds[0] = 4.0
    bench.run(10)
    bench.speeds[0] = -3.0
    assert wait_for_fault(bench) == ("WRONG_DIRECTION_LEFT", 300)


def test_a_wheel_that_is_only_late_in_turning_round_is_not():
    bench = rolling()
    bench.command = {"left": -4.0, "right": -4.0}
    opposed_ms = 0
    for _ in range(3000):
        bench.speeds = [speed + (setpoint(bench) - speed) * 0.001 for speed in bench.speeds]
        assert bench.step().fault == 0
        opposed_ms += bench.speeds[0] > 1.0 and setpoint(bench) < -1.0
    assert opposed_ms > 300
    assert bench.speeds[0] < -3.0


def setpoint(bench):
    return bench.out.left_setpoint_rad_s


# The last is nine tenths of 3 rad/s in the core's arithmetic, to the bit.
@pytest.mark.parametrize(
    ("speed", "is_delayed"), [(2.685, True), (2.715, False), (np.float32(0.9) * np.float32(3.0), False)]
)
def test_a_wheel_is_late_if_it_lost_more_than_a_tenth_of_its_speed(speed, is_delayed):
    bench = rolling()
    bench.speeds[0] = -3.0
    bench.run(290)
    bench.speeds[0] = -float(speed)
    assert (bench.run(20).fault == 0) == is_delayed


def test_a_slow_wheel_that_slows_down_is_only_late_too():
    bench = rolling(config=dataclasses.replace(CONFIG, encoder_check_speed_rad_s=0.1))
    bench.speeds[0] = -0.3
    bench.run(290)
    bench.speeds[0] = -0.2
    assert bench.run(20).fault == 0


def test_wrong_direction_asks_for_an_enabled_driver():
    bench = Bench(dataclasses.replace(CONFIG, encoder_check_speed_rad_s=0.1))
    bench.wheels_follow = False
    bench.speeds = [-3.0, 3.0]
    assert wait_for_fault(bench) == (None, None)


@pytest.mark.parametrize(("cause", "fault"), [("WATCHDOG", "WATCHDOG_RESET"), ("BROWN_OUT", "BROWN_OUT_RESET")])
def test_reset_causes_latch_once_and_clear(cause, fault, bench):
    bench.core, bench.inputs["reset_cause"] = FirmwareCore(CONFIG), ResetCause[cause]
    assert fault_after(bench, 1) == fault
    reset(bench)
    assert (bench.out.state, bench.out.fault) == ("STANDBY", 0)


def reset(bench):
    bench.set_request("STANDBY").run(250)
    bench.set_request("RESET").run(60)


def test_the_graver_fault_is_shown_and_a_later_one_does_not_make_an_earlier_one_forgotten(bench):
    bench.inputs.update(voltage_v=10.0, left_temperature_c=100.0, tx_error_count=300)
    assert fault_after(bench, 1100) == "UNDER_VOLTAGE"
    bench.inputs["right_current_a"] = 99.0
    assert fault_after(bench, 200) == "OVER_CURRENT_RIGHT"
    bench.inputs["self_test_failed"] = True
    assert fault_after(bench, 2) == "SELF_TEST_FAILED"
    bench.inputs.clear()
    bench.inputs["left_current_a"] = 50.0
    bench.run(200)
    bench.inputs.clear()
    reset(bench)
    assert (bench.out.state, bench.fault()) == ("FAULT", "SELF_TEST_FAILED")


def test_a_latched_fault_outlives_its_cause_and_a_reset_waits_for_the_cause_to_go(bench):
    bench.inputs["left_current_a"] = 50.0
    bench.run_until("FAULT")
    reset(bench)
    assert bench.out.state == "FAULT"
    bench.inputs.clear()
    bench.run(2)
    assert (bench.out.state, bench.out.fault) == ("STANDBY", 0)
    bench.inputs["left_current_a"] = 50.0
    bench.run_until("FAULT")
    bench.inputs.clear()
    bench.run(1000)
    assert (bench.out.state, bench.fault()) == ("FAULT", "OVER_CURRENT_LEFT")


def test_a_reset_of_one_fault_hides_no_other_for_a_single_cycle(bench):
    bench.inputs.update(voltage_v=12.0, left_current_a=50.0)
    bench.run(300)
    bench.inputs.pop("left_current_a")
    bench.set_request("STANDBY").run(250)
    bench.set_request("RESET")
    assert {fault_after(bench, 1) for _ in range(60)} == {"OVER_CURRENT_LEFT", "UNDER_VOLTAGE"}
    assert (bench.out.state, bench.fault()) == ("STANDBY", "UNDER_VOLTAGE")


def test_a_passing_fault_blocks_ready_while_it_is_held():
    bench = Bench().hello()
    bench.inputs["voltage_v"] = 12.0
    bench.run(300)
    assert bench.set_request("READY").run(1000).state == "STANDBY"
    bench.inputs.clear()
    bench.run(400)
    assert (bench.out.state, bench.fault()) == ("STANDBY", "UNDER_VOLTAGE")
    bench.run(200)
    assert (bench.out.state, bench.out.fault) == ("READY", 0)


def test_a_passing_fault_is_held_to_the_millisecond(bench):
    bench.inputs["voltage_v"] = 12.0
    bench.run(300)
    bench.inputs.clear()
    assert fault_after(bench, 499) == "UNDER_VOLTAGE"
    assert fault_after(bench, 1) == "NONE"


def test_a_fault_that_lasts_longer_than_its_times_have_bits_is_held_when_it_goes():
    """The core's own step would need 71 minutes of cycles: here its detector is asked."""
    lib, ffi = _firmware.lib, _firmware.ffi
    config = ffi.new("disco_config_t *", lib.disco_config_default(2048, 8.0))
    faults, context = ffi.new("disco_faults_t *"), ffi.new("disco_fault_context_t *")
    lib.disco_faults_init(faults)

    def step(time_us, voltage):
        inputs = ffi.new("disco_inputs_t *", {"voltage": voltage, "encoder_valid": [True, True]})
        lib.disco_faults_step(faults, config, inputs, context, time_us)
        return lib.disco_faults_code(faults)

    begin_us, wrap_us = 5_000_000, 1 << 32
    assert step(begin_us, 25.0) == 0
    assert step(begin_us + config.voltage_debounce_us - 1, 10.0) == 0
    assert step(begin_us + config.voltage_debounce_us, 10.0) == FAULTS["UNDER_VOLTAGE"]
    # Half-way, then just after its beginning has come round again: still seen, so still held for its time.
    end_us = begin_us + wrap_us + 1000
    assert step(begin_us + wrap_us // 2, 10.0) == FAULTS["UNDER_VOLTAGE"]
    assert step(end_us, 10.0) == FAULTS["UNDER_VOLTAGE"]
    assert step(end_us + config.fault_hold_us - 1, 25.0) == FAULTS["UNDER_VOLTAGE"]
    assert step(end_us + config.fault_hold_us, 25.0) == 0


@pytest.mark.parametrize("bad_steps", [7, 8])
def test_a_fault_is_held_from_the_last_cycle_that_had_its_cause_though_its_debounce_is_one_cycle(bad_steps):
    config = dataclasses.replace(CONFIG, voltage_debounce_s=0.001)
    bench = Bench(config)
    bench.inputs["voltage_v"] = config.under_voltage_v - 1.0
    assert fault_after(bench, bad_steps) == "UNDER_VOLTAGE"
    bench.inputs["voltage_v"] = config.under_voltage_v + 1.0
    fault_cycles = 0
    while bench.step().fault:
        fault_cycles += 1
        assert fault_cycles < 10_000
    assert fault_cycles == round(config.fault_hold_s * 1e3) - 1
