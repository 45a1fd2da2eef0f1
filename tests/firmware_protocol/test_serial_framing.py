"""Serial framing, the host's in Python and the controller's in C: one behaviour, tested on both."""

import random

import pytest
from cobs import cobs
from hypothesis import strategies as st

from firmware_protocol import _firmware, serial_framing
from firmware_protocol.serial_framing import MAX_FRAME, crc16
from tests.firmware_protocol import c_framing
from tests.tables import examples, thinned

FRAMES = [(0x010, bytes.fromhex("0201020300")), (0x080, b""), (0x100, bytes(8)), (0x7FF, b"\xff" * 8), (0, b"\0")]


BOTH = [serial_framing, c_framing]


@pytest.fixture(params=BOTH, ids=["python", "c"])
def framing(request):
    return request.param


@pytest.fixture
def decode(framing):
    def decoded(*pieces):
        decoder = framing.FrameDecoder()
        return [frame for piece in pieces for frame in decoder.feed(piece)], decoder.stats

    return decoded


@pytest.fixture
def encode_frame(framing):
    return framing.encode_frame


def raw_frame(body):
    return cobs.encode(body + crc16(body).to_bytes(2, "little")) + b"\0"


def test_check_value_vector_and_longest_frame(encode_frame):
    assert crc16(b"123456789") == _firmware.lib.disco_crc16(b"123456789", 9) == 0x29B1
    assert encode_frame(*FRAMES[0]) == bytes.fromhex("030110050201020303924800")
    assert len(encode_frame(0x7FF, b"\xff" * 8)) <= MAX_FRAME


@thinned("every", [17, 1], quick=1)
def test_a_frame_with_every_checksum_is_taken(decode, encode_frame, every):
    """Bytes of 0 among them, which the stuffing leaves out."""
    frames = [(0x100, number.to_bytes(2, "little")) for number in range(0, 1 << 16, every)]
    decoded, stats = decode(*(encode_frame(*frame) for frame in frames))
    assert decoded == frames
    assert stats.malformed == 0


@pytest.mark.parametrize(("can_id", "data"), FRAMES)
def test_every_split_point(decode, encode_frame, can_id, data):
    line = encode_frame(can_id, data) * 2
    for cut in range(len(line) + 1):
        for second in range(cut, len(line) + 1):
            frames, stats = decode(line[:cut], line[cut:second], line[second:])
            assert frames == [(can_id, data)] * 2
            assert (stats.frames, stats.malformed, stats.bytes) == (2, 0, len(line))


def test_byte_by_byte(decode, encode_frame):
    line = b"".join(encode_frame(*frame) for frame in FRAMES)
    frames, stats = decode(*(line[i : i + 1] for i in range(len(line))))
    assert frames == FRAMES
    assert stats.malformed == 0


@pytest.mark.parametrize(("can_id", "data"), FRAMES)
def test_every_single_byte_corruption_is_found_and_costs_no_later_frame(decode, encode_frame, can_id, data):
    good = encode_frame(can_id, data)
    for position in range(len(good)):
        for value in range(256):
            if value == good[position]:
                continue
            corrupt = good[:position] + bytes((value,)) + good[position + 1 :]
            frames, stats = decode(good, corrupt, good, good)
            # A corrupted delimiter joins two frames; every other corruption harms only its own.
            expected = 2 if position == len(good) - 1 else 3
            assert frames == [(can_id, data)] * expected
            assert stats.malformed >= 1


def test_every_lost_byte_is_found_and_costs_at_most_the_next_frame(decode, encode_frame):
    frame = (0x110, bytes.fromhex("8D306902B4FB2C01"))
    good = encode_frame(*frame)
    for position in range(len(good)):
        frames, _ = decode(good[:position] + good[position + 1 :], good, good)
        assert frames in ([frame], [frame] * 2)


@examples(
    quick=60,
    every=100,
    frames=st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8))),
    seed=st.integers(0, 2**32),
)
def test_round_trip_in_pieces_of_any_size(frames, seed):
    for sender in BOTH:
        for receiver in BOTH:
            generator = random.Random(seed)
            line = b"".join(sender.encode_frame(*frame) for frame in frames)
            decoder, received = receiver.FrameDecoder(), []
            while line:
                size = generator.randint(1, 20)
                received += decoder.feed(line[:size])
                line = line[size:]
            assert received == frames


@examples(quick=60, every=100, can_id=st.integers(0, 0x7FF), data=st.binary(max_size=8))
def test_both_write_the_same_bytes(can_id, data):
    assert c_framing.encode_frame(can_id, data) == serial_framing.encode_frame(can_id, data)


LINES = (
    st.binary(max_size=100)
    | st.lists(st.integers(0, 3), max_size=100).map(bytes)
    | st.binary(max_size=12).map(raw_frame)
)


@examples(quick=60, every=100, pieces=st.lists(LINES))
def test_both_make_the_same_of_anything(pieces):
    """Pieces end where the line has a zero or the reader an end: of garbage, of little codes, and well sealed."""
    outcomes = []
    for framing in BOTH:
        decoder = framing.FrameDecoder()
        frames = [decoder.feed(piece) for piece in [*pieces, b"\0"]]
        counted = ("frames", "stuffing_errors", "crc_errors", "length_errors", "unknown_kind", "bytes")
        outcomes.append((frames, *(getattr(decoder.stats, name) for name in counted)))
    assert outcomes[0] == outcomes[1]


@pytest.mark.parametrize("length", [61, 62, 63, 64, 65, 66])
def test_both_drop_what_is_too_long_from_the_same_length_on(length):
    body = b"\1\x10\0" + b"a" * length
    counted = []
    for framing in BOTH:
        decoder = framing.FrameDecoder()
        decoder.feed(cobs.encode(body)[:length] + b"\0")
        counted.append((decoder.stats.length_errors, decoder.stats.stuffing_errors))
    assert counted[0] == counted[1] == ((0, 1) if length < MAX_FRAME else (1, 0))


@examples(quick=60, every=100, pieces=st.lists(st.binary(max_size=200)))
def test_garbage_gives_no_frame_and_no_exception_and_after_a_delimiter_all_is_well(pieces):
    for framing in BOTH:
        decoder = framing.FrameDecoder()
        for piece in pieces:
            assert decoder.feed(piece) == []
        decoder.feed(b"\0")
        assert decoder.feed(framing.encode_frame(0x100, b"\1\2")) == [(0x100, b"\1\2")]


def test_garbage_between_frames_is_counted(decode, encode_frame):
    good = encode_frame(0x100, b"\1\2")
    frames, stats = decode(good, b"\x11garbage\0", good)
    assert len(frames) == 2
    assert stats.stuffing_errors == 1


def test_an_endless_frame_is_dropped_and_takes_no_memory(framing):
    decoder = framing.FrameDecoder()
    for _ in range(1000):
        decoder.feed(b"\x01" * 100)
        assert len(decoder._pending) < MAX_FRAME
    assert decoder.feed(b"\0" + framing.encode_frame(1, b"")) == [(1, b"")]
    assert decoder.stats.length_errors == 1


@pytest.mark.parametrize(
    ("body", "counter"),
    [
        (b"\2\x10\0abc", "unknown_kind"),
        (b"\1\0\x08", "length_errors"),
        (b"\1\x10\0" + bytes(9), "length_errors"),
        (b"\1\x10", "length_errors"),
        (bytes(70), "length_errors"),
    ],
    ids=["kind", "29-bit id", "9 bytes", "no header", "too long"],
)
def test_well_sealed_nonsense_is_counted(decode, body, counter):
    frames, stats = decode(raw_frame(body))
    assert frames == []
    assert stats.malformed == getattr(stats, counter) == 1


def test_a_wrong_crc_is_counted_and_delimiters_alone_are_silence(decode):
    frames, stats = decode(cobs.encode(b"\1\x10\0abc\0\0") + b"\0")
    assert (frames, stats.crc_errors, stats.malformed) == ([], 1, 1)
    frames, stats = decode(b"\0" * 100)
    assert (frames, stats.malformed, stats.bytes) == ([], 0, 100)


def test_what_is_no_can_frame_is_not_encoded():
    with pytest.raises(ValueError, match="0x800"):
        serial_framing.encode_frame(0x800, b"")
    with pytest.raises(ValueError, match="9 bytes"):
        serial_framing.encode_frame(0x100, bytes(9))
