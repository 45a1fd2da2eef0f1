import math
import struct
from dataclasses import replace

import pytest

from firmware_protocol import _firmware
from tests.firmware_protocol.bench import CODEC, CONFIG, MS, Bench, sealed

lib, ffi = _firmware.lib, _firmware.ffi
KEYS = CODEC.choices("PARAM_REQUEST", "key")
DEFAULTS = {
    "OVER_CURRENT": CONFIG.over_current_a,
    "OVER_TEMPERATURE": CONFIG.over_temperature_c,
    "UNDER_VOLTAGE": CONFIG.under_voltage_v,
    "STOP_DECELERATION": CONFIG.stop_deceleration_rad_s2,
    "MAX_WHEEL_SPEED": CONFIG.max_wheel_speed_rad_s,
    "MAX_WHEEL_ACCELERATION": CONFIG.max_wheel_acceleration_rad_s2,
}
BOUNDS = {
    "OVER_CURRENT": (0.5, 200.0),
    "OVER_TEMPERATURE": (30.0, 120.0),
    "UNDER_VOLTAGE": (5.0, 60.0),
    "STOP_DECELERATION": (1.0, 655.0),
}


def request_parameter(bench, operation, key, value=0.0):
    bench.send("PARAM_REQUEST", operation=operation, key=key, value=value)
    bench.step()
    values = bench.messages("PARAM_RESPONSE")[-1].values
    return CODEC.choice_name("PARAM_RESPONSE", "status", values["status"]), values["key"], values["value"]


def test_every_key_of_the_table_can_be_read():
    assert set(KEYS.values()) == set(DEFAULTS)
    for key, name in KEYS.items():
        assert request_parameter(Bench(), "READ", key) == ("OK", key, pytest.approx(DEFAULTS[name]))


@pytest.mark.parametrize("name", BOUNDS)
def test_write_within_bounds_is_read_back(name):
    key = CODEC.choice_value("PARAM_REQUEST", "key", name)
    # A battery of so many volts that no other limit is in the way.
    bench = Bench(replace(CONFIG, over_voltage_v=100.0))
    for value in BOUNDS[name]:
        assert request_parameter(bench, "WRITE", key, value) == ("OK", key, value)
        assert request_parameter(bench, "READ", key) == ("OK", key, value)
    low, high = BOUNDS[name]
    for value in (low * 0.999, high * 1.001, -1.0):
        assert request_parameter(bench, "WRITE", key, value) == ("OUT_OF_RANGE", key, high)


def test_what_the_board_would_refuse_at_its_next_start_is_refused():
    key, bench = CODEC.choice_value("PARAM_REQUEST", "key", "UNDER_VOLTAGE"), Bench()
    highest = CONFIG.over_voltage_v
    assert request_parameter(bench, "WRITE", key, highest + 0.1) == ("OUT_OF_RANGE", key, CONFIG.under_voltage_v)
    assert request_parameter(bench, "WRITE", key, highest) == ("OK", key, highest)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_a_number_is_refused(value, bench):
    body = bytes((0x10, 1, 0)) + struct.pack("<f", value)
    bench.core.receive(bench.now_us, 0x160, sealed(0x160, body))
    bench.step()
    values = bench.messages("PARAM_RESPONSE")[-1].values
    assert CODEC.choice_name("PARAM_RESPONSE", "status", values["status"]) == "NOT_FINITE"
    assert values["value"] == CONFIG.over_current_a


@pytest.mark.parametrize("name", ["MAX_WHEEL_SPEED", "MAX_WHEEL_ACCELERATION"])
def test_hard_limits_are_read_only(name):
    key = CODEC.choice_value("PARAM_REQUEST", "key", name)
    assert request_parameter(Bench(), "WRITE", key, 1.0) == ("READ_ONLY", key, DEFAULTS[name])


def test_unknown_key_and_operation():
    assert request_parameter(Bench(), "READ", 99) == ("UNKNOWN_KEY", 99, 0.0)
    assert request_parameter(Bench(), "WRITE", 0, 1.0) == ("UNKNOWN_KEY", 0, 0.0)
    assert request_parameter(Bench(), 2, 1, 1.0) == ("UNKNOWN_OPERATION", 1, CONFIG.over_current_a)


@pytest.mark.parametrize("state", ["READY", "ARMED", "STOPPING", "moving ESTOP"])
def test_writing_is_refused_unless_disarmed(state):
    bench = Bench.in_state("ARMED" if state == "moving ESTOP" else state)
    if state == "moving ESTOP":
        bench.estop()
    assert request_parameter(bench, "WRITE", 4, 50.0)[0] == "REFUSED_ARMED"
    assert request_parameter(bench, "READ", 4)[2] == CONFIG.stop_deceleration_rad_s2


@pytest.mark.parametrize("state", ["FAULT", "ESTOP"])
def test_writing_is_allowed_in_a_state_that_does_not_move(state):
    assert request_parameter(Bench.in_state(state), "WRITE", 1, 60.0) == ("OK", 1, 60.0)


def test_a_written_value_is_in_force_and_told_in_limits(bench):
    bench.run(100)
    before = bench.now_us
    assert request_parameter(bench, "WRITE", 4, 40.0)[0] == "OK"
    bench.run(100)
    pages = [message.values for message in bench.messages("LIMITS", since_us=before)]
    assert [page["page"] for page in pages] == [0, 1]
    assert not [name for name in ("HELLO", "BUILD") if bench.messages(name, since_us=before)]
    assert pages[1]["stop_deceleration"] == 40.0
    bench.to_driving()
    start = bench.now_us
    bench.core.receive(bench.now_us, 0x080, b"")
    while bench.step().driver_enabled:
        pass
    assert bench.now_us - start == pytest.approx(100 * MS, abs=3 * MS)


def test_a_damaged_request_is_not_answered(bench):
    bench.core.receive(bench.now_us, 0x160, bytes(8))
    bench.step()
    assert bench.messages("PARAM_RESPONSE") == []
    assert bench.core.rejections["CRC"] == 1


RECORD = 32


def packed(**changes):
    config = lib.disco_config_default(2048, 8.0)
    for name, value in changes.items():
        setattr(config, name, value)
    record = ffi.new("uint8_t[]", b"\xee" * (RECORD + 4))
    lib.disco_record_pack(ffi.new("disco_config_t *", config), record)
    assert bytes(record[RECORD : RECORD + 4]) == b"\xee" * 4
    return bytearray(record[0:RECORD])


def unpacked(record):
    """The configuration that is left, and whether the record was taken."""
    config = ffi.new("disco_config_t *", lib.disco_config_default(2048, 8.0))
    is_accepted = lib.disco_record_unpack(bytes(record), config)
    return config, is_accepted


def sealed_record(record):
    record[30:] = lib.disco_crc16(bytes(record[:30]), 30).to_bytes(2, "little")
    return record


# Of which every byte is another than zero.
OTHER = {
    name: struct.unpack("<f", struct.pack("<f", value))[0]
    for name, value in {
        "over_current": 12.3, "over_temperature": 60.1, "under_voltage": 18.7, "stop_deceleration": 7.1,
    }.items()
}  # fmt: skip


def test_what_was_written_is_kept_over_a_restart_and_nothing_else():
    record = packed(**OTHER, max_wheel_speed=3.0)
    config, is_accepted = unpacked(record)
    assert is_accepted
    assert {name: getattr(config, name) for name in OTHER} == OTHER
    assert config.max_wheel_speed == 8.0
    assert record[0] == 1
    assert [int.from_bytes(record[at : at + 2], "little") for at in (1, 7, 13, 19)] == [1, 2, 3, 4]
    assert struct.unpack("<f", record[3:7]) == (OTHER["over_current"],)
    assert record[25:30] == bytes(5)


def test_a_record_is_sealed_with_the_crc_of_what_is_before_it():
    records = [packed(over_current=float(current)) for current in range(1, 30)]
    assert all(record == sealed_record(record[:]) for record in records)
    assert {record[30] & 1 for record in records} == {0, 1}


def test_a_record_with_any_bit_turned_is_not_taken():
    def became_of(bit):
        record = packed(**OTHER)
        record[bit // 8] ^= 1 << bit % 8
        config, is_accepted = unpacked(record)
        return is_accepted, config.over_current

    found = {bit: became_of(bit) for bit in range(8 * RECORD)}
    assert {bit: became for bit, became in found.items() if became != (False, 30.0)} == {}


@pytest.mark.parametrize("record", [bytes(RECORD), b"\xff" * RECORD], ids=["zeros", "erased flash"])
def test_what_was_never_written_is_not_taken(record):
    assert not unpacked(record)[1]


@pytest.mark.parametrize(
    ("at", "value"),
    [
        (0, b"\2"),
        (1, b"\x63\0"),
        (1, b"\1\1"),
        (1, b"\5\0"),
        (21, struct.pack("<f", math.nan)),
        (21, struct.pack("<f", math.inf)),
        (21, struct.pack("<f", 0.9)),
        (21, struct.pack("<f", 655.5)),
        (15, struct.pack("<f", 30.5)),
    ],
    ids=[
        "format",
        "unknown key",
        "high byte of the key",
        "read-only key",
        "nan",
        "inf",
        "too little",
        "too much",
        "least voltage above the largest",
    ],
)
def test_a_well_sealed_record_of_nonsense_changes_nothing(at, value):
    record = packed(**OTHER)
    record[at : at + len(value)] = value
    config, is_accepted = unpacked(sealed_record(record))
    assert not is_accepted
    assert config.over_current == 30.0


def test_a_record_of_fewer_parameters_is_taken():
    record = packed(**OTHER)
    record[7:30] = bytes(23)
    config, is_accepted = unpacked(sealed_record(record))
    assert is_accepted
    assert (config.over_current, config.over_temperature) == (OTHER["over_current"], 80.0)


def test_only_a_write_that_was_accepted_is_to_be_kept(bench):
    request_parameter(bench, "READ", 4)
    request_parameter(bench, "WRITE", 4, 1e6)
    request_parameter(bench, "WRITE", 5, 1.0)
    assert bench.core._core.parameter_writes == 0
    request_parameter(bench, "WRITE", 4, 5.0)
    assert bench.core._core.parameter_writes == 1
