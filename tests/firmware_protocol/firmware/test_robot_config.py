"""The bounds of every configuration value; no timeout can be switched off."""

import dataclasses
import math

import pytest

from firmware_protocol.firmware_core import FirmwareConfig
from tests.firmware_protocol.bench import CONFIG, FAULTS, Bench

BOUNDS = {
    "ticks_per_rev": (1, 65535),
    "max_wheel_speed_rad_s": (0.001, 65.5),
    "max_wheel_acceleration_rad_s2": (0.001, 655.0),
    "stop_deceleration_rad_s2": (1.0, 655.0),
    "still_speed_rad_s": (0.001, 0.5),
    "under_voltage_v": (0.0, CONFIG.over_voltage_v),
    "over_voltage_v": (CONFIG.under_voltage_v, 100.0),
    "over_current_a": (0.1, 300.0),
    "over_temperature_c": (20.0, 127.0),
    "stall_current_a": (0.1, 300.0),
    "encoder_check_current_a": (0.01, 300.0),
    "encoder_check_speed_rad_s": (0.01, 65.5),
    "cycle_s": (0.001, 0.01),
    "command_timeout_s": (0.01, 0.5),
    "drive_off_timeout_s": (CONFIG.command_timeout_s, 2.0),
    "stop_timeout_s": (0.1, 5.0),
    "host_state_timeout_s": (0.1, 2.0),
    "host_forget_timeout_s": (CONFIG.host_state_timeout_s, 60.0),
    "reset_quiet_s": (0.1, 5.0),
    "voltage_debounce_s": (0.0, 5.0),
    "current_debounce_s": (0.0, 1.0),
    "temperature_debounce_s": (0.0, 5.0),
    "encoder_debounce_s": (0.001, 1.0),
    "fault_hold_s": (0.0, 10.0),
}
FREE = {"board_id", "firmware_version", "capabilities", "dbc_hash", "protocol_major", "key"}


def valid_with(**changes):
    bench = Bench(dataclasses.replace(CONFIG, **changes))
    assert bench.out.state == ("FAULT" if bench.out.fault == FAULTS["CONFIG_INVALID"] else "STANDBY")
    return bench.out.state == "STANDBY"


def test_every_field_is_bounded_or_free():
    assert {field.name for field in dataclasses.fields(FirmwareConfig)} == set(BOUNDS) | FREE


# What has to be at least as large as another: without it that one's own bound would not be seen.
ROOM = {"command_timeout_s": {"drive_off_timeout_s": 2.0}, "host_state_timeout_s": {"host_forget_timeout_s": 60.0}}


@pytest.mark.parametrize("name", BOUNDS)
def test_bounds(name):
    low, high = BOUNDS[name]

    def valid(**changes):
        return valid_with(**ROOM.get(name, {}), **changes)

    assert valid(**{name: low})
    assert valid(**{name: high})
    if low > 0:
        assert not valid(**{name: low * (1 - 1e-3) if isinstance(low, float) else low - 1})
    if name != "ticks_per_rev":
        assert not valid(**{name: high * (1 + 1e-3)})


@pytest.mark.parametrize("name", [name for name in BOUNDS if name.endswith(("rad_s", "rad_s2", "_v", "_a", "_c"))])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_a_number_is_refused(name, value):
    assert not valid_with(**{name: value})


def test_the_two_voltages_share_one_range():
    assert valid_with(under_voltage_v=99.5, over_voltage_v=100.0)
    assert not valid_with(under_voltage_v=99.5, over_voltage_v=99.4)


def test_an_invalid_configuration_never_leaves_fault():
    bench = Bench(dataclasses.replace(CONFIG, max_wheel_speed_rad_s=math.nan)).hello()
    bench.set_request("READY")
    bench.command = {}
    assert bench.run(1000).state == "FAULT"
    assert not bench.out.driver_enabled


def test_a_value_that_its_field_cannot_hold_is_a_programming_error():
    with pytest.raises(OverflowError):
        Bench(dataclasses.replace(CONFIG, ticks_per_rev=65536))
