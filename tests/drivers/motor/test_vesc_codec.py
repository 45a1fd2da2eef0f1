"""VESC's frames and packets: the examples of its documentation, what is refused, and that no bytes break a decoder."""

import pytest
from hypothesis import strategies as st

from drivers.motor import vesc_codec as codec
from drivers.types import Frame
from sim.devices.vesc_firmware import can_packet
from tests.tables import examples


def fragments(payload):
    """The frames in which controller 23 answers to 200."""
    return [Frame(each.can_id, each.data, extended=True) for each in can_packet(200, 23, payload, 1)]


def test_the_documented_frames():
    assert codec.command(23, "set_erpm", 3000) == Frame(0x317, bytes.fromhex("00000BB8"), extended=True)
    assert codec.command(23, "set_current", 51.0) == Frame(0x117, bytes.fromhex("0000C738"), extended=True)


def test_a_command_is_held_to_what_the_wire_can_say():
    assert codec.command(1, "set_current", 1e12).data.hex() == "7fffffff"
    assert codec.command(1, "set_current", -1e12).data.hex() == "80000000"


def test_status_is_read_in_its_units():
    status = codec.decode(Frame(9 << 8 | 23, bytes.fromhex("00000BB8FFDF0064"), extended=True))
    assert status is not None
    assert (status.node, status.name) == (23, "status")
    assert dict(status.values) == {"erpm": 3000, "current_a": -3.3, "duty": 0.1}
    other = codec.decode(Frame(27 << 8 | 23, bytes.fromhex("FFFFFFFA00F00000"), extended=True))
    assert other is not None
    assert dict(other.values) == {"tachometer": -6, "v_in": 24.0}


def test_a_status_of_11_bits_or_too_short_is_none():
    assert codec.decode(Frame(9 << 8 | 23, bytes(8))) is None
    assert codec.decode(Frame(9 << 8 | 23, bytes(7), extended=True)) is None


def test_a_pong_names_who_is_there():
    assert codec.ping(23, 200) == Frame(17 << 8 | 23, b"\xc8", extended=True)
    response = codec.decode(Frame(18 << 8 | 200, bytes((23, 0)), extended=True))
    assert response is not None
    assert (response.node, response.name) == (23, "pong")


def test_a_fault_is_read_from_an_answer_in_fragments():
    payload = bytes.fromhex("32002080000501")
    frames = fragments(payload)
    assert [frame.can_id >> 8 for frame in frames] == [5, 7]
    reassembly = codec.Reassembly(200)
    assert [reassembly.feed(frame) for frame in frames] == [None, (23, 1, payload)]
    assert codec.values(payload) == {"fault": 5, "status_byte": codec.TIMED_OUT}


def test_a_lost_fragment_is_no_packet():
    frames = fragments(bytes(range(1, 40)))
    reassembly = codec.Reassembly(200)
    assert [reassembly.feed(frame) for frame in (*frames[:2], *frames[3:])][-1] is None


@pytest.mark.parametrize("length", [1, 7, 255, 256, 512])
def test_a_packet_is_found_once_its_last_byte_is_there(length):
    payload = bytes(k % 251 for k in range(length))
    packet = codec.packet(payload)
    assert [codec.packets(packet[:n]) for n in range(len(packet))] == [[]] * len(packet)
    assert codec.packets(packet + packet) == [payload, payload]


@pytest.mark.parametrize("length", [0, 513])
def test_a_payload_that_no_packet_holds_is_refused(length):
    with pytest.raises(ValueError, match=str(length)):
        codec.packet(bytes(length))


@examples(quick=40, every=100, noise=st.binary(max_size=60))
def test_noise_costs_no_later_packet(noise):
    # However long a packet the noise has announced, zeros end it.
    assert codec.packets(noise + bytes(codec.MAX_PAYLOAD + 6) + codec.packet(b"\x1e"))[-1:] == [b"\x1e"]


@examples(
    quick=40,
    every=100,
    can_id=st.integers(0, 2**29 - 1),
    data=st.binary(max_size=8),
    extended=st.booleans(),
    payload=st.binary(max_size=80),
)
def test_no_bytes_break_a_decoder(can_id, data, extended, payload):
    frame = Frame(can_id, data, extended)
    codec.decode(frame)
    codec.Reassembly(can_id & 0xFF).feed(frame)
    codec.values(bytes([codec.GET_VALUES_SELECTIVE]) + payload)
    codec.packets(payload)
