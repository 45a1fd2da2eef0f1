"""Python codec against the generated C, against cantools, and against what the wire may bring."""

import math
import struct

import cantools
import pytest
from hypothesis import strategies as st

from firmware_protocol import _firmware
from firmware_protocol.codec import (
    PROTOCOL,
    PROTOCOL_MAJOR,
    PROTOCOL_MINOR,
    Codec,
    Decoded,
    DecodeFault,
    FaultReason,
    packaged_dbc,
)
from firmware_protocol.protection import crc8
from tests.tables import examples

ffi, lib = _firmware.ffi, _firmware.lib
CODEC = Codec()
ORACLE = cantools.database.load_string(packaged_dbc(), database_format="dbc")
MESSAGES = PROTOCOL.messages
PAGES = [
    (message, page)
    for message in MESSAGES
    for page in sorted({signal.page for signal in message.signals if signal.page is not None} or {None})
]
IDS = [message.name + ("" if page is None else f"-{page}") for message, page in PAGES]


def signals_of(message, page):
    return [signal for signal in message.signals if signal.page in (None, page)]


def raw_bounds(signal):
    if signal.signed:
        return -(1 << (signal.width - 1)), (1 << (signal.width - 1)) - 1
    return 0, (1 << signal.width) - 1


def boundary_values(signal):
    if signal.is_float:
        smallest = 2.0**-149
        largest = struct.unpack("<f", struct.pack("<f", 3.3999999e38))[0]
        return [0.0, 1.0, -1.0, smallest, -smallest, largest, -largest]
    low, high = raw_bounds(signal)
    ones = [1 << bit for bit in range(signal.width - signal.signed)]
    return sorted({low, low + 1, -1 if signal.signed else 0, 0, 1, high - 1, high, *ones})


def base_values(message, page):
    values = {signal.name: 0 for signal in signals_of(message, page)}
    if message.page_signal:
        values[message.page_signal] = page
    return values


def protected(message):
    return message.data_id is not None


def pack_in_c(message, raw):
    name = message.name.lower()
    frame = ffi.new(f"struct disco_robot_{name}_t *", raw)
    data = ffi.new("uint8_t[8]")
    assert getattr(lib, f"disco_robot_{name}_pack")(data, frame, 8) == message.length
    if protected(message):
        data[0] = lib.disco_e2e_crc(data, message.data_id)
    return bytes(data)[: message.length]


def unpack_in_c(message, page, data):
    name = message.name.lower()
    frame = ffi.new(f"struct disco_robot_{name}_t *")
    assert getattr(lib, f"disco_robot_{name}_unpack")(frame, data, len(data)) == 0
    return {signal.name: getattr(frame, signal.name) for signal in signals_of(message, page)}


def check_everything(message, page, raw):
    """Raw values through Python, C and cantools: the same bytes, and back the same values."""
    counter = raw.get("counter", 0)
    scaled = {
        signal.name: raw[signal.name] * (1 if signal.is_float else signal.scale)
        for signal in signals_of(message, page)
        if not (protected(message) and signal.name in {"crc", "counter"})
    }
    can_id, data = CODEC.encode(message.name, counter, **scaled)
    assert can_id == message.can_id
    assert data == pack_in_c(message, raw)
    complete = dict(scaled, crc=data[0], counter=counter) if protected(message) else scaled
    assert data == ORACLE.encode_message(message.name, complete, strict=False)
    decoded = CODEC.decode(can_id, data)
    assert isinstance(decoded, Decoded)
    assert decoded.name == message.name
    oracle = ORACLE.decode_message(message.name, data, decode_choices=False)
    if protected(message):
        assert decoded.counter == oracle.pop("counter") == counter
        assert data[0] == oracle.pop("crc")
    assert decoded.values == pytest.approx(oracle, rel=1e-15)
    unpacked = unpack_in_c(message, page, data)
    for signal in signals_of(message, page):
        if signal.name in decoded.values:
            assert decoded.values[signal.name] == unpacked[signal.name] * (1 if signal.is_float else signal.scale)


@pytest.mark.parametrize(("message", "page"), PAGES, ids=IDS)
def test_boundary_values_of_every_signal_are_bit_equal_in_python_c_and_cantools(message, page):
    for signal in signals_of(message, page):
        if signal.name in {"crc", message.page_signal}:
            continue
        for value in boundary_values(signal):
            check_everything(message, page, base_values(message, page) | {signal.name: value})
    for pick in (0, -1):
        values = {signal.name: boundary_values(signal)[pick] for signal in signals_of(message, page)}
        fixed = {message.page_signal: page} if message.page_signal else {}
        check_everything(message, page, values | fixed | ({"crc": 0} if protected(message) else {}))


@st.composite
def messages_with_values(draw):
    message, page = draw(st.sampled_from(PAGES))
    values = base_values(message, page)
    for signal in signals_of(message, page):
        if signal.name in {message.page_signal, "crc"}:
            continue
        if signal.is_float:
            values[signal.name] = draw(st.floats(width=32, min_value=-(2.0**127), max_value=2.0**127))
        else:
            values[signal.name] = draw(st.integers(*raw_bounds(signal)))
    return message, page, values


@examples(quick=60, every=100, case=messages_with_values())
def test_random_values_are_bit_equal_in_python_c_and_cantools(case):
    check_everything(*case)


@examples(
    quick=60,
    every=100,
    can_id=st.one_of(st.sampled_from([m.can_id for m in MESSAGES]), st.integers(0, 0x7FF)),
    data=st.binary(max_size=12),
)
def test_whatever_the_wire_brings_the_answer_is_a_value(can_id, data):
    assert isinstance(CODEC.decode(can_id, data), Decoded | DecodeFault)
    for layout in MESSAGES:
        if layout.can_id == can_id and layout.data_id is not None:
            protected = bytes((crc8(data[1:], layout.data_id),)) + data[1:]
            assert isinstance(CODEC.decode(can_id, protected), Decoded | DecodeFault)


def wheel_command(**changes):
    values = {"mode": "SPEED", "left_speed": 1.0, "right_speed": -1.0, "valid_for": 0.1, "session": 3}
    return CODEC.encode("WHEEL_COMMAND", 5, **values | changes)


def test_every_wrong_length_single_bit_error_and_other_identifier_is_a_fault():
    can_id, data = wheel_command()
    for length in (*range(8), 9):
        wrong = data.ljust(9, b"\0")[:length]
        assert CODEC.decode(can_id, wrong) == DecodeFault(FaultReason.LENGTH, "WHEEL_COMMAND", can_id)
    for bit in range(64):
        flipped = (int.from_bytes(data, "little") ^ 1 << bit).to_bytes(8, "little")
        assert CODEC.decode(can_id, flipped) == DecodeFault(FaultReason.CRC, "WHEEL_COMMAND", can_id)
    assert CODEC.decode(0x101, data).reason is FaultReason.CRC


def test_an_unknown_identifier_or_page_is_a_fault():
    assert CODEC.decode(0x7FF, bytes(8)) == DecodeFault(FaultReason.UNKNOWN_ID, "", 0x7FF)
    body = bytes((0x20, 0, 0, 0, 0, 0, 0))
    limits = next(message for message in MESSAGES if message.name == "LIMITS")
    data = bytes((crc8(body, limits.data_id),)) + body
    assert CODEC.decode(limits.can_id, data) == DecodeFault(FaultReason.PAGE, "LIMITS", limits.can_id)


def test_estop_is_decoded_with_any_length_of_a_can_frame():
    for length in range(9):
        decoded = CODEC.decode(0x080, b"\x02" * length)
        assert (decoded.name, decoded.counter, decoded.values) == ("ESTOP", -1, {"reason": 2 if length else 0})
    assert CODEC.decode(0x080, bytes(9)).reason is FaultReason.LENGTH


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"left_speed": math.nan}, "not finite"),
        ({"left_speed": math.inf}, "not finite"),
        ({"left_speed": 65.536}, "not within"),
        ({"left_speed": -65.538}, "not within"),
        ({"valid_for": 0.512}, "not within"),
        ({"valid_for": -0.002}, "not within"),
        ({"mode": "FLY"}, "no value named 'FLY'"),
        ({"speed": 1.0}, "no such signal: speed"),
        ({"counter": 1}, "multiple values"),
    ],
)
def test_encode_clips_nothing_and_names_what_is_wrong(changes, complaint):
    with pytest.raises((ValueError, TypeError), match=complaint):
        wheel_command(**changes)


def test_encode_names_a_missing_signal_and_an_unknown_message():
    with pytest.raises(ValueError, match="TIME_REQUEST: signal sequence is missing"):
        CODEC.encode("TIME_REQUEST", 0)
    with pytest.raises(ValueError, match="no message 'NOTHING'"):
        CODEC.encode("NOTHING", 0)
    with pytest.raises(ValueError, match=r"PARAM_REQUEST\.value: 3\.402e\+38 is not within"):
        CODEC.encode("PARAM_REQUEST", 0, operation=0, key=1, value=3.402e38)


def test_the_counter_wraps_at_sixteen():
    assert CODEC.encode("TIME_REQUEST", 18, sequence=1) == CODEC.encode("TIME_REQUEST", 2, sequence=1)


def test_names_of_values():
    assert CODEC.choice_name("SYSTEM_STATE", "state", 3) == "ARMED"
    assert CODEC.choice_name("SYSTEM_STATE", "state", 9) == "UNKNOWN(9)"
    assert CODEC.choice_value("SYSTEM_STATE", "state", "ARMED") == 3
    assert CODEC.choices("WHEEL_COMMAND", "mode") == {0: "HOLD_ZERO", 1: "SPEED", 2: "BRAKE", 3: "COAST"}
    assert CODEC.can_id("ESTOP") == 0x080
    with pytest.raises(ValueError, match="no such signal: nothing"):
        CODEC.choice_name("SYSTEM_STATE", "nothing", 0)


def test_version_is_the_dbcs():
    attributes = ORACLE.dbc.attributes
    assert attributes["ProtocolMajor"].value == PROTOCOL_MAJOR
    assert attributes["ProtocolMinor"].value == PROTOCOL_MINOR


def test_handshake_frames_can_be_read_across_major_versions_and_no_others():
    ids = {message.name: (message.can_id, message.data_id) for message in MESSAGES if protected(message)}
    same = {name for name, (can_id, data_id) in ids.items() if can_id == data_id}
    assert same == {"HELLO_REQUEST", "HELLO"}
    assert all(d == c ^ PROTOCOL_MAJOR << 11 for name, (c, d) in ids.items() if name not in same)


def test_fault_codes_say_what_they_are():
    """Class in the high nibble, latching bit 0x0800, permanent bit 0x0400 only with it, numbers unique."""
    faults = {value: name for value, name in CODEC.choices("SYSTEM_STATE", "fault").items() if value}
    assert {value >> 12 for value in faults} <= {1, 2, 3, 4, 6, 7}
    permanent = {value: name for value, name in faults.items() if value & 0x0400}
    assert all(value & 0x03FF for value in faults), faults
    assert all(value & 0x0800 for value in permanent), permanent
    assert set(permanent.values()) == {"CONFIG_INVALID", "ENTROPY_INVALID", "SELF_TEST_FAILED"}
