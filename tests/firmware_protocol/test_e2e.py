import cantools.autosar.end_to_end as autosar
import crccheck.crc as oracle
import pytest
from hypothesis import strategies as st

from firmware_protocol import _firmware
from firmware_protocol.protection import E2EReceiver, E2EStatus, challenge_answer, crc8, crc8h2f, data_id
from tests.tables import examples

ffi, lib = _firmware.ffi, _firmware.lib
TIMEOUT_US = 500_000


def test_check_values():
    assert crc8h2f(b"123456789") == lib.disco_crc8(b"123456789", 9) == 0xDF
    assert lib.disco_crc16(b"123456789", 9) == 0x29B1


def test_the_major_version_is_in_the_data_id():
    assert data_id(0x110, 1) == 0x0910
    assert data_id(0x110, 2) == 0x1110
    assert data_id(0x7FF, 255) <= 0xFFFF


@examples(quick=60, every=100, data=st.binary(max_size=64))
def test_crcs_are_those_of_crccheck(data):
    assert crc8h2f(data) == lib.disco_crc8(data, len(data)) == oracle.Crc8Autosar.calc(data)
    assert lib.disco_crc16(data, len(data)) == oracle.Crc16CcittFalse.calc(data)


@examples(quick=60, every=100, body=st.binary(min_size=7, max_size=7), frame_data_id=st.integers(0, 0xFFFF))
def test_frame_crc_is_profile_2_with_a_second_byte_of_data_id(body, frame_data_id):
    expected = oracle.Crc8Autosar.calc(body + frame_data_id.to_bytes(2, "little"))
    assert crc8(body, frame_data_id) == lib.disco_e2e_crc(b"\0" + body, frame_data_id) == expected


@examples(quick=60, every=100, payload=st.binary(min_size=8, max_size=8), one_byte_id=st.integers(0, 255))
def test_crc_agrees_with_the_autosar_helper_of_cantools(payload, one_byte_id):
    """Profile 2 takes one byte of data id; ours is its CRC with the second byte left out."""
    assert crc8h2f(payload[1:] + bytes((one_byte_id,))) == autosar.compute_profile2_crc(payload, one_byte_id)


def test_all_errors_of_up_to_three_bits_in_sampled_frames_are_found():
    body, identifier = bytes.fromhex("306902B4FB2C01"), 0x910
    good = crc8(body, identifier)
    body_bits = int.from_bytes(body, "big")
    patterns = {1 << a | 1 << b | 1 << c for a in range(0, 56, 3) for b in range(56) for c in range(56)}
    for pattern in patterns - {0}:
        assert crc8((body_bits ^ pattern).to_bytes(7, "big"), identifier) != good


@examples(
    quick=60,
    every=100,
    challenge=st.integers(0, 0xFFFF),
    session=st.integers(0, 255),
    dbc_hash=st.integers(0, 0xFFFF_FFFF),
)
def test_challenge_answers_agree(challenge, session, dbc_hash):
    proof = challenge.to_bytes(2, "little") + bytes((session,)) + dbc_hash.to_bytes(4, "little")
    response = challenge_answer(challenge, session, dbc_hash)
    assert response == lib.disco_challenge_answer(challenge, session, dbc_hash) == oracle.Crc16CcittFalse.calc(proof)


class Twins:
    """The Python and the C receiver, fed alike and held to be alike."""

    def __init__(self):
        self.python = E2EReceiver(TIMEOUT_US)
        self.c = ffi.new("disco_e2e_receiver_t *")
        lib.disco_e2e_init(self.c, TIMEOUT_US)
        self.now_us = 0

    def check(self, counter, crc_ok=True, after_us=10_000):
        self.now_us += after_us
        status = self.python.check(counter, crc_ok, self.now_us)
        assert lib.disco_e2e_check(self.c, counter, crc_ok, self.now_us) == status.value
        assert self.c.qualified == self.python.qualified
        return status

    @property
    def qualified(self):
        return self.python.qualified


def qualified_twins():
    twins = Twins()
    for counter in range(4):
        twins.check(counter)
    assert twins.qualified
    return twins


def test_three_good_frames_after_the_first_qualify():
    twins = Twins()
    for counter, status in ((14, E2EStatus.INITIAL), (15, E2EStatus.OK), (0, E2EStatus.OK), (1, E2EStatus.OK)):
        assert not twins.qualified
        assert twins.check(counter) is status
    assert twins.qualified


@pytest.mark.parametrize(
    ("delta", "status"),
    [(0, E2EStatus.REPEATED), (1, E2EStatus.OK), (2, E2EStatus.OK_SOME_LOST), (3, E2EStatus.OK_SOME_LOST)]
    + [(delta, E2EStatus.WRONG_SEQUENCE) for delta in range(4, 16)],
)
@pytest.mark.parametrize("start", [0, 7, 15])
def test_every_step_of_the_counter(delta, status, start):
    twins = Twins()
    twins.check(start)
    assert twins.check((start + delta) % 16) is status


def test_a_bad_frame_breaks_the_row_of_good_ones():
    twins = Twins()
    for counter in (0, 1, 2):
        twins.check(counter)
    assert twins.check(2) is E2EStatus.REPEATED
    for counter in (3, 4):
        twins.check(counter)
        assert not twins.qualified
    twins.check(5)
    assert twins.qualified


def test_wrong_crcs_say_nothing_of_the_counter():
    twins = qualified_twins()
    assert twins.check(9, crc_ok=False) is E2EStatus.WRONG_CRC
    assert twins.check(4) is E2EStatus.OK


@pytest.mark.parametrize("bad_before_a_good_one", [1, 4])
def test_a_good_frame_makes_up_for_a_bad_one_and_five_more_bad_than_good_ones_disqualify(bad_before_a_good_one):
    twins = qualified_twins()
    for _ in range(bad_before_a_good_one):
        twins.check(0, crc_ok=False)
    twins.check(4)
    for _ in range(5 - bad_before_a_good_one):
        assert twins.qualified
        twins.check(0, crc_ok=False)
    assert twins.qualified
    twins.check(0, crc_ok=False)
    assert not twins.qualified


def test_the_score_saturates_and_three_good_frames_qualify_again():
    twins = qualified_twins()
    for _ in range(20):
        twins.check(0, crc_ok=False)
    for counter in (4, 5):
        twins.check(counter)
        assert not twins.qualified
    twins.check(6)
    assert twins.qualified
    for _ in range(4):
        twins.check(0, crc_ok=False)
    assert twins.qualified


def test_silence_disqualifies_just_after_the_timeout():
    twins = qualified_twins()
    for after_us, is_alive in ((TIMEOUT_US, True), (TIMEOUT_US + 1, False)):
        assert twins.python.expire(twins.now_us + after_us) == is_alive
        assert lib.disco_e2e_expire(twins.c, twins.now_us + after_us) == is_alive
    assert twins.check(4, after_us=TIMEOUT_US + 1) is E2EStatus.INITIAL


def test_bad_frames_do_not_feed_the_timeout():
    twins = qualified_twins()
    for _ in range(3):
        twins.check(3, after_us=TIMEOUT_US // 3)
    assert twins.qualified
    twins.check(0, crc_ok=False, after_us=TIMEOUT_US // 3)
    assert not twins.qualified


@examples(
    quick=60,
    every=100,
    frames=st.lists(st.tuples(st.integers(0, 15), st.sampled_from([True, True, True, False]), st.integers(0, 600_000))),
)
def test_python_and_c_receivers_are_alike(frames):
    twins = Twins()
    for frame in frames:
        twins.check(*frame)
