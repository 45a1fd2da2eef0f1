import can
import pytest
from can.interfaces.socketcan.socketcan import build_can_frame, dissect_can_frame
from hypothesis import given
from hypothesis import strategies as st

from sim.can_protocol import (
    CanFrame,
    arbitration_key,
    bus_off_frame,
    candump_line,
    controller_error_frame,
    frame_bits,
    pack_frame,
    receive_overflow_frame,
    stuffed_bits,
    unpack_frame,
)
from tests.tables import examples


@st.composite
def frames(draw):
    extended = draw(st.booleans())
    can_id = draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF))
    if draw(st.booleans()):
        return CanFrame(can_id, b"", extended, remote=True, remote_length=draw(st.integers(0, 8)))
    return CanFrame(can_id, draw(st.binary(max_size=8)), extended)


@examples(quick=40, every=100, frame=frames())
def test_bytes_are_those_of_socketcan(frame):
    message = can.Message(
        arbitration_id=frame.can_id,
        is_extended_id=frame.extended,
        is_remote_frame=frame.remote,
        data=None if frame.remote else frame.data,
        dlc=frame.remote_length if frame.remote else len(frame.data),
    )
    expected = bytearray(build_can_frame(message))
    expected[7] = 0  # python-can writes the length again into a field that means "9 to 15" only
    packed = pack_frame(frame)
    assert packed == bytes(expected)
    assert unpack_frame(packed) == frame


@pytest.mark.parametrize("frame", [bus_off_frame(), receive_overflow_frame(), controller_error_frame(300, 7, 0x20)])
def test_error_frames_survive_the_bytes(frame):
    can_id, length, _, data = dissect_can_frame(pack_frame(frame))
    assert (can_id, length, data) == (0x20000000 | frame.can_id, 8, frame.data)
    assert unpack_frame(pack_frame(frame)) == frame


def test_controller_error_frame_carries_the_counters():
    frame = controller_error_frame(300, 7, 0x20)
    assert (frame.can_id, frame.data) == (0x204, bytes((0, 0x20, 0, 0, 0, 0, 255, 7)))


@examples(quick=40, every=100, packet=st.binary(max_size=40))
def test_any_bytes_are_a_frame_or_none(packet):
    frame = unpack_frame(packet)
    assert frame is None or (len(packet) == 16 and len(frame.data) <= 8)


def test_length_beyond_eight_is_no_frame():
    assert unpack_frame(bytes((1, 0, 0, 0, 9)) + bytes(11)) is None


@pytest.mark.parametrize(
    "frame",
    [
        CanFrame(0x800),
        CanFrame(-1),
        CanFrame(0x20000000, extended=True),
        CanFrame(1, bytes(9)),
        CanFrame(1, remote=True, remote_length=9),
    ],
)
def test_what_does_not_fit_is_refused(frame):
    with pytest.raises(ValueError, match="not a classic CAN frame"):
        pack_frame(frame)


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (CanFrame(0x110, bytes.fromhex("8d300102")), "110#8D300102"),
        (CanFrame(0x5, b""), "005#"),
        (CanFrame(0x5, b"\x01", extended=True), "00000005#01"),
        (CanFrame(0x123, remote=True, remote_length=4), "123#R4"),
        (bus_off_frame(), "20000040#0000000000000000"),
    ],
)
def test_candump_line(frame, text):
    assert candump_line(1_000_270_999, "can0", frame) == f"(1.000270) can0 {text}"


def test_candump_line_is_read_by_python_can(tmp_path):
    path = tmp_path / "bus.log"
    frame = CanFrame(0x110, bytes(range(8)))
    path.write_text(candump_line(2_500_000_000, "can0", frame) + "\n")
    (message,) = can.LogReader(path)
    assert (message.timestamp, message.channel) == (2.5, "can0")
    assert (message.arbitration_id, bytes(message.data), message.is_extended_id) == (0x110, frame.data, False)


def crc15(bits):
    """Shift register as drawn in the Bosch specification, one bit at a time."""
    register = [0] * 15
    for bit in bits:
        feedback = bit ^ register[14]
        register = [0, *register[:14]]
        for place in (0, 3, 4, 7, 8, 10, 14):  # x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1
            register[place] ^= feedback
    return register[::-1]


def number(value, width):
    return [value >> place & 1 for place in reversed(range(width))]


def fields(frame):
    """Unstuffed bits from start of frame to the end of the CRC, written field by field."""
    length = frame.remote_length if frame.remote else len(frame.data)
    bits = [0]
    if frame.extended:
        bits += [*number(frame.can_id >> 18, 11), 1, 1, *number(frame.can_id & 0x3FFFF, 18), int(frame.remote), 0, 0]
    else:
        bits += [*number(frame.can_id, 11), int(frame.remote), 0, 0]
    bits += number(length, 4)
    for byte in frame.data:
        bits += number(byte, 8)
    return bits + crc15(bits)


def stuff(bits):
    """Groups of equal bits; after each five of a group, counting stuff bits as well, the opposite bit."""
    out, run = [], 0
    for bit in bits:
        run = run + 1 if out and out[-1] == bit else 1
        out.append(bit)
        if run == 5:
            out.append(1 - bit)
            run = 1
    return out


@examples(quick=40, every=100, frame=frames())
def test_length_equals_that_of_a_bit_by_bit_frame(frame):
    wire = stuff(fields(frame))
    assert stuffed_bits(frame) == "".join(map(str, wire))
    assert frame_bits(frame) == len(wire) + 1 + 2 + 7 + 3


@given(st.integers(0, 8), st.booleans(), st.data())
def test_no_frame_is_beyond_the_published_worst_case(length, extended, data):
    frame = CanFrame(data.draw(st.integers(0, 0x7FF)), data.draw(st.binary(min_size=length, max_size=length)), extended)
    worst = 80 + 10 * length if extended else 55 + 10 * length
    assert frame_bits(frame) <= worst


@pytest.mark.parametrize(
    ("frame", "bits"),
    [
        (CanFrame(0x327, bytes.fromhex("f15e96c35c22ad35")), 111),  # no five equal bits anywhere
        (CanFrame(0x41E, bytes.fromhex("3c35fe0ff878787c")), 130),  # groups of four all along
        (CanFrame(0x000), 47 + 34 // 5),  # 34 zeros up to the CRC, which is zero as well
    ],
)
def test_known_lengths(frame, bits):
    assert frame_bits(frame) == bits


@pytest.mark.parametrize(
    ("winner", "loser"),
    [
        (CanFrame(0x080), CanFrame(0x100)),
        (CanFrame(0x100), CanFrame(0x100, remote=True)),
        (CanFrame(0x100), CanFrame(0x100 << 18, extended=True)),
        (CanFrame(0x100, remote=True), CanFrame(0x100 << 18, extended=True)),
        (CanFrame(0x100 << 18, extended=True), CanFrame(0x101)),
        (CanFrame(5, extended=True), CanFrame(5, extended=True, remote=True)),
        (CanFrame(5, extended=True, remote=True), CanFrame(6, extended=True)),
    ],
)
def test_arbitration_order(winner, loser):
    assert arbitration_key(winner) < arbitration_key(loser)


@examples(quick=40, every=100, one=frames(), other=frames())
def test_the_frame_with_the_first_dominant_bit_wins(one, other):
    """A node that sends recessive and reads dominant leaves: with different keys that settles it within the field."""
    if arbitration_key(one) == arbitration_key(other):
        return
    winner, loser = sorted((one, other), key=arbitration_key)
    first = next(i for i, (a, b) in enumerate(zip(fields(winner), fields(loser), strict=False)) if a != b)
    assert fields(winner)[first] == 0
    assert first <= 32
