"""Frames and packets of each vendor: its documentation's examples, what is refused, and bytes that break no decoder."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.motor import agilex_protocol as agilex
from drivers.motor import create_driver
from drivers.motor import odrive_protocol as odrive
from drivers.motor import roboclaw_protocol as roboclaw
from drivers.motor import vesc_codec as vesc
from drivers.types import Frame, ReceivedFrame
from sim.devices.vesc_firmware import can_packet
from tests.tables import examples

OLD, NEW = "0.5", "0.6"
ENCODERS = bytes.fromhex("00000001fffffffffb04")
ENCODED = {
    "odrive, a velocity": (
        lambda: odrive.encode(OLD, 3, "Set_Input_Vel", vel_turns_s=1.5, torque_nm=0.0),
        Frame(0x06D, bytes.fromhex("0000C03F00000000")),
    ),
    "odrive, velocity control": (
        lambda: odrive.encode(NEW, 3, "Set_Controller_Mode", control_mode=2, input_mode=1),
        Frame(0x06B, bytes.fromhex("0200000001000000")),
    ),
    "odrive, closed loop": (
        lambda: odrive.encode(NEW, 3, "Set_Axis_State", state=8),
        Frame(0x067, bytes.fromhex("0800000000000000")),
    ),
    "odrive, e-stop": (lambda: odrive.encode(NEW, 3, "Estop"), Frame(0x062, b"")),
    "odrive 0.5, clear errors": (lambda: odrive.encode(OLD, 3, "Clear_Errors"), Frame(0x078, b"")),
    "odrive 0.6, clear errors": (lambda: odrive.encode(NEW, 3, "Clear_Errors", identify=0), Frame(0x078, b"\0")),
    "odrive, read": (lambda: odrive.read_parameter(3, 0x102), Frame(0x064, bytes.fromhex("0002010000000000"))),
    "agilex, motion in thousandths": (
        lambda: agilex.motion(0.15, -0.2),
        Frame(0x111, bytes.fromhex("0096ff3800000000")),
    ),
    "agilex, motion held": (lambda: agilex.motion(40.0, -40.0), Frame(0x111, bytes.fromhex("7fff800000000000"))),
    "agilex, mode": (lambda: agilex.control_mode(agilex.CAN_MODE), Frame(0x421, b"\1" + bytes(7))),
    "vesc, speed": (lambda: vesc.command(23, "set_erpm", 3000), Frame(0x317, bytes.fromhex("00000BB8"), True)),
    "vesc, current": (lambda: vesc.command(23, "set_current", 51.0), Frame(0x117, bytes.fromhex("0000C738"), True)),
    "vesc, most current": (lambda: vesc.command(1, "set_current", 1e12), Frame(0x101, bytes.fromhex("7fffffff"), True)),
    "vesc, least current": (lambda: vesc.command(1, "set_current", -1e12), Frame(0x101, b"\x80\0\0\0", True)),
    "vesc, ping": (lambda: vesc.ping(23, 200), Frame(17 << 8 | 23, b"\xc8", True)),
    "roboclaw, both speeds": (
        lambda: roboclaw.setting(0x80, "speed_m1m2", speed_m1_counts_s=1000, speed_m2_counts_s=-1000),
        Frame(0x8025, bytes.fromhex("8025000003e8fffffc188290")),
    ),
    "roboclaw, question": (lambda: roboclaw.query(0x80, "encoders"), Frame(0x804E, b"\x80\x4e")),
}
NOT_DECODED = {
    **{f"odrive, {n} bytes": lambda n=n: odrive.decode(OLD, Frame(3 << 5 | 9, bytes(n))) for n in (0, 4, 7)},
    "odrive, 29 bits": lambda: odrive.decode(OLD, Frame(3 << 5 | 9, bytes(8), extended=True)),
    **{f"agilex {n:x}, 7 bytes": lambda n=n: agilex.decode(Frame(n, bytes(7))) for n in (0x211, 0x221, 0x311)},
    "agilex, 29 bits": lambda: agilex.decode(Frame(0x211, bytes(8), extended=True)),
    "vesc, 11 bits": lambda: vesc.decode(Frame(9 << 8 | 23, bytes(8))),
    "vesc, 7 bytes": lambda: vesc.decode(Frame(9 << 8 | 23, bytes(7), extended=True)),
    "roboclaw, another board": lambda: roboclaw.reply(0x81, "encoders", ENCODERS),
    "roboclaw, another question": lambda: roboclaw.reply(0x80, "speeds", ENCODERS),
    **{f"roboclaw, {n} bytes": lambda n=n: roboclaw.reply(0x80, "encoders", ENCODERS[:n]) for n in range(10)},
}


@pytest.mark.parametrize(("encode", "expected"), ENCODED.values(), ids=ENCODED)
def test_a_command_is_the_documented_frame_held_to_what_the_wire_can_say(encode, expected):
    assert encode() == expected


@pytest.mark.parametrize("decode", NOT_DECODED.values(), ids=NOT_DECODED)
def test_what_is_too_short_or_somebody_elses_is_none(decode):
    assert decode() is None


@pytest.mark.parametrize(
    ("encode", "expected_error"),
    [
        (lambda: odrive.encode(OLD, 63, "Estop"), "63"),
        (lambda: roboclaw.query(0x7F, "status"), "0x7f"),
        (lambda: vesc.packet(b""), "0"),
        (lambda: vesc.packet(bytes(513)), "513"),
    ],
    ids=["odrive node", "roboclaw address", "vesc, empty", "vesc, long"],
)
def test_what_no_wire_can_carry_is_refused(encode, expected_error):
    with pytest.raises(ValueError, match=expected_error):
        encode()


@examples(
    quick=80,
    every=200,
    can_id=st.one_of(st.integers(0, 0x7FF), st.integers(0, 2**29 - 1)),
    data=st.binary(max_size=8),
    extended=st.booleans(),
    firmware=st.sampled_from((OLD, NEW)),
    received=st.binary(max_size=80),
    name=st.sampled_from(sorted(roboclaw.GETTERS)),
)
def test_no_bytes_break_a_decoder(can_id, data, extended, firmware, received, name):
    frame = Frame(can_id, data, extended)
    decoded = odrive.decode(firmware, frame)
    assert decoded is None or (decoded.node == can_id >> 5 and len(data) == 8)
    agilex.decode(frame)
    vesc.decode(frame)
    vesc.Reassembly(can_id & 0xFF).feed(frame)
    vesc.values(bytes([vesc.GET_VALUES_SELECTIVE]) + received)
    vesc.packets(received)
    read = roboclaw.reply(0x80, name, received)
    assert read is None or read[1] <= len(received)


def test_an_odrives_heartbeat_says_other_things_in_each_generation():
    frame = Frame(3 << 5 | 1, struct.pack("<IBBBB", 0x800, 1, 1, 0, 0x80))
    old, new = odrive.decode(OLD, frame), odrive.decode(NEW, frame)
    assert (old.node, old.values["axis_error"], old.values["axis_state"]) == (3, 0x800, 1)
    assert (old.values["motor_flags"], old.values["controller_flags"]) == (1, 0x80)
    assert (new.values["procedure_result"], new.values["trajectory_done"]) == (1, 0)


def test_an_odrives_parameter_is_read_only_from_the_answer_to_its_own_endpoint():
    response = Frame(0x065, bytes.fromhex("00020100") + struct.pack("<f", 0.1))
    assert odrive.parameter(response, 3, 0x102, "f32") == pytest.approx(0.1)
    assert odrive.parameter(response, 3, 0x103, "f32") is None
    assert odrive.parameter(response, 4, 0x102, "f32") is None


@given(st.floats(width=32, allow_nan=False), st.integers(0, odrive.LARGEST_NODE))
def test_what_an_odrive_says_is_read_as_it_was_meant(turns, node):
    decoded = odrive.decode(OLD, Frame(node << 5 | 9, struct.pack("<ff", turns, -turns)))
    assert decoded.values["pos_turns"] == turns
    assert math.copysign(1.0, decoded.values["vel_turns_s"]) == -math.copysign(1.0, turns)


def test_an_agilexs_state_and_odometry_are_read():
    assert agilex.decode(Frame(0x211, bytes.fromhex("010301080004002a"))).values == {
        "vehicle_state": agilex.EMERGENCY_STOP,
        "control_mode": agilex.RC_MODE,
        "battery_v": pytest.approx(26.4),
        "error_code": 4,
    }
    odometry = agilex.decode(Frame(0x311, bytes.fromhex("01000001ffffffff")))
    assert odometry.values == {"left_mm": 2**24 + 1, "right_mm": -1}


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        (Frame(0x254, bytes(8)), "frames_accepted"),
        (Frame(0x362, bytes(8)), "frames_accepted"),
        (Frame(0x254, bytes(7)), "rejected_length"),
        (Frame(0x211, bytes(7)), "rejected_length"),
        (Frame(0x259, bytes(8)), "unknown_id"),
        (Frame(0x254, bytes(8), extended=True), "unknown_id"),
    ],
)
def test_an_agilexs_messages_without_a_use_are_known_all_the_same(frame, expected):
    measures = {"wheel_radius_m": 0.06, "track_m": 0.31, "max_speed_m_s": 1.5, "max_turn_rad_s": 2.5}
    driver = create_driver("agilex", agilex.AgilexSettings(**measures))
    driver.link_up(0)
    driver.receive(0, [ReceivedFrame(0, frame)])
    assert getattr(driver.stats, expected) == 1


@pytest.mark.parametrize(
    ("can_id", "data", "node", "name", "expected_values"),
    [
        (9 << 8 | 23, "00000BB8FFDF0064", 23, "status", {"erpm": 3000, "current_a": -3.3, "duty": 0.1}),
        (27 << 8 | 23, "FFFFFFFA00F00000", 23, "status5", {"tachometer": -6, "v_in": 24.0}),
        (18 << 8 | 200, "1700", 23, "pong", None),
    ],
    ids=["status", "status 5", "a pong, which names who is there"],
)
def test_a_vescs_status_is_read_in_its_units(can_id, data, node, name, expected_values):
    decoded = vesc.decode(Frame(can_id, bytes.fromhex(data), extended=True))
    assert (decoded.node, decoded.name) == (node, name)
    assert expected_values is None or dict(decoded.values) == expected_values


def fragments(payload):
    """The frames in which VESC 23 answers to 200."""
    return [Frame(each.can_id, each.data, extended=True) for each in can_packet(200, 23, payload, 1)]


def test_a_vescs_fault_is_read_from_an_answer_in_fragments():
    payload = bytes.fromhex("32002080000501")
    frames = fragments(payload)
    assert [frame.can_id >> 8 for frame in frames] == [5, 7]
    reassembly = vesc.Reassembly(200)
    assert [reassembly.feed(frame) for frame in frames] == [None, (23, 1, payload)]
    assert vesc.values(payload) == {"fault": 5, "status_byte": vesc.TIMED_OUT}


@pytest.mark.parametrize(
    ("length", "kinds"), [(6, {8}), (7, {5, 7}), (259, {5, 7}), (260, {5, 6, 7}), (512, {5, 6, 7})]
)
def test_a_vescs_packet_comes_whole_out_of_its_fragments(length, kinds):
    """Up to 6 bytes in one frame, then in fragments of 7 that begin before byte 255, then of 6."""
    payload = bytes((7 * k + k // 256) % 256 for k in range(length))
    reassembly, frames = vesc.Reassembly(200), fragments(payload)
    assert {frame.can_id >> 8 for frame in frames} == kinds
    assert [reassembly.feed(frame) for frame in frames] == [*[None] * (len(frames) - 1), (23, 1, payload)]


@pytest.mark.parametrize(
    ("length", "head"), [(1, "0201"), (255, "02ff"), (256, "030100"), (512, "030200")], ids=["1", "255", "256", "512"]
)
def test_a_vescs_serial_packet_says_its_length_in_as_few_bytes_as_it_can(length, head):
    payload = bytes(range(256)) * 2
    sent = vesc.packet(payload[:length])
    assert sent.startswith(bytes.fromhex(head) + b"\0")
    assert vesc.packets(b"\1" + sent + sent[:5]) == [payload[:length]]


def test_an_answer_with_no_value_is_one_and_a_shorter_one_is_none():
    answers = [vesc.values(bytes.fromhex(answer)) for answer in ("3200000000", "32000000", "3300000000")]
    assert answers == [{}, None, None]


def test_a_lost_fragment_is_no_packet():
    frames = fragments(bytes(range(1, 40)))
    reassembly = vesc.Reassembly(200)
    assert [reassembly.feed(frame) for frame in (*frames[:2], *frames[3:])][-1] is None


@pytest.mark.parametrize("length", [1, 7, 255, 256, 512])
def test_a_vescs_packet_is_found_once_its_last_byte_is_there(length):
    payload = bytes(k % 251 for k in range(length))
    packet = vesc.packet(payload)
    assert [vesc.packets(packet[:n]) for n in range(len(packet))] == [[]] * len(packet)
    assert vesc.packets(packet + packet) == [payload, payload]


@examples(quick=40, every=100, noise=st.binary(max_size=60))
def test_noise_costs_no_later_packet_of_a_vesc(noise):
    # However long a packet the noise has announced, zeros end it.
    assert vesc.packets(noise + bytes(vesc.MAX_PAYLOAD + 6) + vesc.packet(b"\x1e"))[-1:] == [b"\x1e"]


def test_a_roboclaws_value_is_held_to_what_the_wire_can_say():
    assert roboclaw.setting(0x80, "duty_m1m2", duty_m1=40000, duty_m2=-40000).data[2:6].hex() == "7fff8000"


def test_a_roboclaws_answer_is_read_with_its_sign_and_its_status_may_have_two_bytes():
    assert roboclaw.reply(0x80, "encoders", ENCODERS) == ({"encoder_m1": 1, "encoder_m2": -1}, 10)
    for status, length, meant in ((b"\x01\x05", 4, 0x10041), (b"\0\0\x40\x01", 6, 0x4001)):
        received = roboclaw.with_crc(b"\x80\x5a" + status)[2:]
        assert roboclaw.reply(0x80, "status", received) == ({"status_u32": meant}, length)
