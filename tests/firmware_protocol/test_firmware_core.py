"""The Python object around the C core; what the core does is tested part by part in firmware/."""

import dataclasses

import msgspec
import pytest

from firmware_protocol import _firmware
from firmware_protocol.firmware_core import FirmwareConfig, FirmwareCore, FirmwareInputs, FirmwareOutputs, ResetCause
from tests.firmware_protocol.bench import CODEC, CONFIG, STATIONARY, Bench


def test_first_cycle():
    assert FirmwareCore(CONFIG).step(1000, STATIONARY) == FirmwareOutputs(
        left_setpoint_rad_s=0.0,
        right_setpoint_rad_s=0.0,
        driver_enabled=False,
        brake=True,
        limited=False,
        state="STANDBY",
        fault=0,
        session=0,
        estop_source="NONE",
        stop_cause="NONE",
        blockers=0b1111_1000,
        accepted_commands=0,
        last_command_counter=0,
        rejected_frames=0,
        watchdog_events=0,
    )


def test_two_cores_share_nothing():
    first, second = FirmwareCore(CONFIG), FirmwareCore(CONFIG)
    first.receive(0, 0x080, b"")
    first.step(1000, STATIONARY)
    assert first.step(2000, STATIONARY).state == "ESTOP"
    assert second.step(2000, STATIONARY).state == "STANDBY"


def test_the_configuration_is_copied_and_every_value_arrives():
    config = FirmwareConfig(ticks_per_rev=100, max_wheel_speed_rad_s=3.0, command_timeout_s=0.0204)
    core = FirmwareCore(config)
    c_config = core._core.config
    assert c_config.command_timeout_us == 20_400
    for field in dataclasses.fields(FirmwareConfig):
        value = getattr(config, field.name)
        if isinstance(value, float) and not field.name.endswith("_s"):
            name = field.name.rsplit("_", 1)[0].removesuffix("_rad")
            assert getattr(c_config, name) == pytest.approx(value), field.name


def test_every_input_arrives():
    core = FirmwareCore(CONFIG)
    left = {"ticks": 11, "speed_rad_s": 0.5, "current_a": 1.0, "temperature_c": 3.0, "encoder_valid": False}
    right = {"ticks": -1, "speed_rad_s": -0.25, "current_a": 2.0, "temperature_c": 4.0, "encoder_valid": True}
    battery = {"voltage_v": 24.5, "battery_current_a": 5.0, "battery_temperature_c": 6.0}
    bus = {"tx_error_count": 7, "rx_error_count": 8}
    board = {"estop_button": True, "estop_line": False, "self_test_failed": True, "reset_cause": ResetCause.BROWN_OUT}
    wheels = {f"{side}_{name}": of[name] for side, of in (("left", left), ("right", right)) for name in of}
    values = wheels | battery | bus | board
    assert set(values) == set(FirmwareInputs.__struct_fields__)
    core.step(1000, FirmwareInputs(**values))
    c = core._core.inputs
    assert list(c.ticks) == [11, 2**32 - 1]
    assert [*c.wheel_speed, *c.current, *c.temperature] == [0.5, -0.25, 1.0, 2.0, 3.0, 4.0]
    assert [*c.encoder_valid, c.estop_button, c.estop_line, c.self_test_failed] == [False, True, True, False, True]
    assert [c.voltage, c.battery_current, c.battery_temperature] == [24.5, 5.0, 6.0]
    assert [c.tx_error_count, c.rx_error_count, c.reset_cause] == [7, 8, 2]


def test_drain_gives_what_was_queued_once():
    core = FirmwareCore(CONFIG)
    core.step(1000, STATIONARY)
    frames = core.drain()
    assert [CODEC.decode(*frame).name for frame in frames[:3]] == ["HELLO", "SYSTEM_STATE", "SESSION_STATE"]
    assert core.drain() == []


def test_defaults_are_those_of_the_controller_in_decimal_digits():
    config = FirmwareConfig(ticks_per_rev=2048, max_wheel_speed_rad_s=8.0)
    assert dataclasses.asdict(config) == {
        "ticks_per_rev": 2048, "max_wheel_speed_rad_s": 8.0, "max_wheel_acceleration_rad_s2": 20.0,
        "stop_deceleration_rad_s2": 20.0, "still_speed_rad_s": 0.05, "cycle_s": 0.001, "command_timeout_s": 0.1,
        "drive_off_timeout_s": 0.5, "stop_timeout_s": 1.0, "host_state_timeout_s": 0.5, "host_forget_timeout_s": 5.0,
        "reset_quiet_s": 0.5, "under_voltage_v": 20.0, "over_voltage_v": 30.0, "over_current_a": 30.0,
        "over_temperature_c": 80.0, "stall_current_a": 15.0, "encoder_check_current_a": 0.5,
        "encoder_check_speed_rad_s": 1.0, "voltage_debounce_s": 0.2, "current_debounce_s": 0.1,
        "temperature_debounce_s": 1.0, "encoder_debounce_s": 0.3, "fault_hold_s": 0.5, "board_id": 1,
        "firmware_version": (0, 1, 0), "capabilities": 63, "dbc_hash": CODEC.dbc_hash, "protocol_major": 1, "key": b"",
    }  # fmt: skip


def test_a_core_made_with_the_defaults_has_the_very_configuration_of_c():
    core = FirmwareCore(FirmwareConfig(ticks_per_rev=2048, max_wheel_speed_rad_s=8.0))
    default = _firmware.lib.disco_config_default(2048, 8.0)
    for name, _ in _firmware.ffi.typeof("disco_config_t").fields:
        ours, theirs = getattr(core._core.config, name), getattr(default, name)
        arrays = name in ("firmware_version", "key")
        assert (list(ours) == list(theirs)) if arrays else (ours == theirs), name


def test_counters_are_there_by_name():
    core = FirmwareCore(CONFIG)
    core.receive(0, 0x100, b"")
    core.receive(0, 0x7FF, b"")
    assert core.rejections == dict.fromkeys(core.rejections, 0) | {"LENGTH": 1}
    assert (core.unknown_frames, core.overflowed_frames) == (1, 0)
    assert core.challenge == 0


def test_more_than_a_can_frame_and_odd_identifiers_are_taken_in():
    core = FirmwareCore(CONFIG)
    core.receive(0, 0x100, bytes(256 + 8))
    core.receive(0, 0x101, bytes(9))
    core.receive(0, -1, b"")
    core.receive(0, 2**40, b"")
    assert core.rejections["LENGTH"] == 2


def test_outputs_and_inputs_are_values():
    with pytest.raises(AttributeError):
        STATIONARY.left_ticks = 1
    assert msgspec.structs.replace(STATIONARY, left_ticks=5).left_ticks == 5


@pytest.mark.parametrize("step_back_s", [0.0, 0.001, 5.0, 100.0])
def test_a_clock_that_stands_or_goes_back_stops_no_watchdog(step_back_s, bench):
    """The wheels stand as soon as with a sound clock, which counts a cycle as a millisecond."""
    bench.now_us = 200_000_000
    bench.to_driving()
    bench.request = bench.command = None
    bench.now_us -= round(step_back_s * 1e6)
    states = [bench.step(1000 if step_back_s else 0).state for _ in range(700)]
    assert states.index("STOPPING") <= 100
    assert bench.out.state == "STANDBY"
    assert (bench.out.left_setpoint_rad_s, bench.out.driver_enabled) == (0.0, False)


def test_after_the_clock_went_back_time_goes_on_at_its_rate(bench):
    bench.run(1000)
    before = bench.core._core.now_us
    bench.now_us -= 600_000
    bench.run(500)
    assert bench.core._core.now_us - before == 500_000
    bench.core.receive(bench.now_us - 400_000, 0x7FF, b"")
    bench.run(1)
    assert bench.core._core.now_us - before == 501_000, "a frame stamped before the last cycle changes no clock"
    bench.core.pose(1.0, 2.0, 0.5, bench.now_us - 20_000, 0.01, 0.01)
    bench.run(1)
    heading = bench.messages("POSE_HEADING")[-1]
    expected = (before + 501_000 - 20_000) % 6_553_600
    assert heading.values["sample_time"] == pytest.approx(expected, abs=100)


@pytest.mark.parametrize("ahead_us", [10_001, 70_000, 1 << 32])
def test_a_frame_stamped_far_ahead_does_not_hold_time_up(ahead_us, bench):
    """As by a clock of two words that is read while its low word wraps: 71 minutes ahead, once."""
    bench.run(1000)
    before, since_us = bench.core._core.now_us, bench.now_us
    bench.core.receive(bench.now_us + 1000 + ahead_us, 0x7FF, b"")
    bench.run(500)
    assert bench.core._core.now_us - before == 1000 + ahead_us + 500_000
    assert len(bench.messages("WHEEL_SPEED", since_us)) >= 50
    bench.run(100)
    assert bench.messages("SESSION_STATE")[-1].values["clock_error_count"] == 1


def test_a_frame_may_be_stamped_after_the_cycle_that_follows(bench):
    """A board may read its clock for a cycle, take in frames, and then run the cycle."""
    bench.run(1000)
    before = bench.core._core.now_us
    bench.core.receive(bench.now_us + 1000 + 10_000, 0x7FF, b"")
    bench.run(1)
    assert bench.core._core.now_us - before == 11_000
    bench.run(500)
    assert bench.core._core.now_us - before == 501_000
    assert bench.messages("SESSION_STATE")[-1].values["clock_error_count"] == 0


@pytest.mark.parametrize("skipped", [1, 7, 15])
def test_lost_and_repeated_commands_and_leaps_of_the_counter_are_counted(skipped):
    bench = Bench.driving()
    errors = bench.core._core.sequence_errors
    for _ in range(skipped):
        bench.next_counter("WHEEL_COMMAND")
    bench.wheel_command(**bench.command)
    assert bench.core._core.sequence_errors == errors + 1
    assert bench.step().state == "ARMED"
