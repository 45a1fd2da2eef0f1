import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.can_bits import arbitration_key, frame_bits, stuffed_bits
from sim.can_frame import CanFrame
from tests.sim.test_can_frame import frames


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


@given(frames())
def test_length_equals_that_of_a_bit_by_bit_frame(frame):
    wire = stuff(fields(frame))
    assert stuffed_bits(frame) == "".join(map(str, wire))
    assert frame_bits(frame) == len(wire) + 1 + 2 + 7 + 3


@given(st.binary(min_size=8, max_size=8), st.integers(0, 0x7FF))
def test_standard_frame_of_eight_bytes_takes_111_to_135_bits(data, can_id):
    assert 111 <= frame_bits(CanFrame(can_id, data)) <= 135


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


@given(frames(), frames())
def test_the_frame_with_the_first_dominant_bit_wins(one, other):
    """A node that sends recessive and reads dominant leaves: with different keys that settles it within the field."""
    if arbitration_key(one) == arbitration_key(other):
        return
    winner, loser = sorted((one, other), key=arbitration_key)
    first = next(i for i, (a, b) in enumerate(zip(fields(winner), fields(loser), strict=False)) if a != b)
    assert fields(winner)[first] == 0
    assert first <= 32
