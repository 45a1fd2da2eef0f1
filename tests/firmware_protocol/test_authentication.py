"""AES-CMAC in Python and in C against the published vectors and each other; the proof of a frame."""

import pytest
from hypothesis import strategies as st

from firmware_protocol import _firmware
from firmware_protocol.codec import Codec
from firmware_protocol.protection import PROVED, EncodedFrame, Prover, aes_cmac, parse_key, truncated_mac
from tests.tables import examples

ffi, lib = _firmware.ffi, _firmware.lib
CODEC = Codec()
COMMAND = EncodedFrame(0x100, bytes.fromhex("C913EE0289FE3207"))


def c_key(key):
    c = ffi.new("disco_cmac_key_t *")
    lib.disco_cmac_init(c, key)
    return c


def c_cmac(key, message):
    tag = ffi.new("uint8_t[16]")
    lib.disco_cmac(c_key(key), message, len(message), tag)
    return bytes(tag)


# RFC 4493 section 4; the same are NIST's SP 800-38B D.1 for AES-128.
RFC_KEY = bytes.fromhex("2b7e151628aed2a6abf7158809cf4f3c")
RFC_MESSAGE = bytes.fromhex(
    "6bc1bee22e409f96e93d7e117393172aae2d8a571e03ac9c9eb76fac45af8e51"
    "30c81c46a35ce411e5fbc1191a0a52eff69f2445df4f9b17ad2b417be66c3710"
)


@pytest.mark.parametrize(
    ("length", "tag"),
    [
        (0, "bb1d6929e95937287fa37d129b756746"),
        (16, "070a16b46b4d4144f79bdd9dd04a287c"),
        # NIST's newer list of examples has 20 bytes where the RFC has 40.
        (20, "7d85449ea6ea19c823a7bf78837dfade"),
        (40, "dfa66747de9ae63030ca32611497c827"),
        (64, "51f0bebf7e3b9d92fc49741779363cfe"),
    ],
)
def test_published_vectors(length, tag):
    message = RFC_MESSAGE[:length]
    assert aes_cmac(RFC_KEY, message).hex() == c_cmac(RFC_KEY, message).hex() == tag


def test_published_subkeys_and_the_key_schedule_of_fips_197():
    """FIPS 197, appendix A.1: the first and the last word made of the key."""
    c = c_key(RFC_KEY)
    assert bytes(c.whole).hex() == "fbeed618357133667c85e08f7236a8de"
    assert bytes(c.padded).hex() == "f7ddac306ae266ccf90bc11ee46d513b"
    assert bytes(c.round_keys)[16:20].hex() == "a0fafe17"
    assert bytes(c.round_keys)[-4:].hex() == "b6630ca6"


@examples(quick=60, every=100, key=st.binary(min_size=16, max_size=16), message=st.binary(max_size=80))
def test_c_and_python_agree_at_every_length(key, message):
    assert c_cmac(key, message) == aes_cmac(key, message)


def test_every_byte_goes_through_the_s_box_alike():
    for value in range(256):
        key = bytes([value]) * 16
        assert c_cmac(key, bytes([value])) == aes_cmac(key, bytes([value]))


@pytest.mark.parametrize("length", [0, 15, 17, 32])
def test_a_key_of_another_length_is_refused(length):
    with pytest.raises(ValueError, match="a key of"):
        aes_cmac(bytes(length), b"")


@pytest.mark.parametrize("text", ["", "00" * 15, "00" * 17, "zz" * 16, "00 " * 16, "0x" + "00" * 15])
def test_what_is_no_key(text):
    with pytest.raises(ValueError, match="32 hexadecimal digits"):
        parse_key(text)


def test_a_key_in_hexadecimal():
    assert parse_key(" 2B7e151628aed2a6abf7158809cf4f3c\n") == RFC_KEY


def c_authentication(key=RFC_KEY, entropy=1):
    c = ffi.new("disco_authentication_t *")
    lib.disco_authentication_init(c, True, key, entropy)
    return c


def prover_for(c):
    prover = Prover(RFC_KEY, CODEC)
    prover.challenge(int.from_bytes(bytes(c.nonce), "little"))
    return prover


def c_holds(c, index, proof, frame):
    lib.disco_authentication_offer(c, index, proof.data)
    return lib.disco_authentication_holds(c, index, frame.can_id, frame.data)


def command_holds(c, freshness):
    """Whether COMMAND is taken with a proof of this freshness, of which a proof carries the low 16 bits."""
    mac = truncated_mac(RFC_KEY, bytes(c.nonce), freshness, COMMAND)
    proof = EncodedFrame(0x0F0, (freshness & 0xFFFF).to_bytes(2, "little") + mac)
    return c_holds(c, lib.DISCO_PROOF_WHEEL_COMMAND, proof, COMMAND)


def test_the_nonce_is_a_mac_of_entropy_and_count():
    c = c_authentication(entropy=0x0123456789ABCDEF)
    message = bytes.fromhex("efcdab8967452301" + "0100000000000000")
    assert bytes(c.nonce) == aes_cmac(RFC_KEY, message)[:6]
    lib.disco_authentication_renew(c)
    assert bytes(c.nonce) == aes_cmac(RFC_KEY, message[:8] + bytes((2,)) + bytes(7))[:6]


@examples(quick=60, every=100, payloads=st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=20))
def test_the_robot_believes_each_proof_once_and_in_order(payloads):
    c = c_authentication()
    prover = prover_for(c)
    for payload in payloads:
        frame = EncodedFrame(0x101, payload)
        proof = prover.prove(frame)
        assert proof.can_id == 0x0F1
        assert c_holds(c, lib.DISCO_PROOF_HOST_STATE, proof, frame)
        assert not c_holds(c, lib.DISCO_PROOF_HOST_STATE, proof, frame)


@pytest.mark.parametrize("name", PROVED)
def test_every_bit_of_frame_and_proof_matters(name):
    index = PROVED.index(name)
    frame = EncodedFrame(CODEC.can_id(name), COMMAND.data)
    c = c_authentication()
    prover = prover_for(c)

    def accepted_with(bit):
        """What of these is taken: the frame, its proof and its identifier with this bit turned."""
        flip = (1 << bit).to_bytes(8, "little")

        def flipped(data):
            return bytes(a ^ b for a, b in zip(data, flip, strict=True))

        proof = prover.prove(frame)
        turned = {
            "frame": (proof, EncodedFrame(frame.can_id, flipped(frame.data))),
            "proof": (EncodedFrame(proof.can_id, flipped(proof.data)), frame),
            "identifier": (proof, EncodedFrame(frame.can_id ^ 1 << bit % 11, frame.data)),
        }
        accepted = [what for what, pair in turned.items() if c_holds(c, index, *pair)]
        assert c_holds(c, index, proof, frame), f"bit {bit}: what failed used nothing up"
        return accepted

    assert {bit: accepted for bit in range(64) if (accepted := accepted_with(bit))} == {}


def test_a_proof_of_another_key_nonce_or_kind_is_none():
    c = c_authentication()
    proof = prover_for(c).prove(COMMAND)
    assert not c_holds(c_authentication(key=bytes(16)), 0, proof, COMMAND)
    assert not c_holds(c_authentication(entropy=2), 0, proof, COMMAND)
    lib.disco_authentication_renew(c)
    assert not c_holds(c, 0, proof, COMMAND)


@pytest.mark.parametrize("dropped", [0, 1, 2, 0x7FFF, 0xFFFF - 1])
def test_lost_frames_do_no_harm_up_to_what_the_low_bits_can_tell(dropped):
    c = c_authentication()
    for freshness in (1, 2 + dropped, 3 + 2 * dropped, 4 + 3 * dropped):
        assert command_holds(c, freshness)
        assert c.proofs[0].freshness == freshness


def test_a_proof_from_behind_is_none_however_far():
    c = c_authentication()
    c.proofs[0].freshness = 2**33 + 5
    for freshness, is_fresh in ((2**33 + 5, False), (2**33 + 4, False), (6, False), (2**33 + 6, True)):
        assert command_holds(c, freshness) == is_fresh


def test_the_counters_of_the_kinds_are_their_own():
    c = c_authentication()
    prover = prover_for(c)
    state = EncodedFrame(0x101, COMMAND.data)
    first, second, other = prover.prove(COMMAND), prover.prove(COMMAND), prover.prove(state)
    assert c_holds(c, lib.DISCO_PROOF_WHEEL_COMMAND, second, COMMAND)
    assert c_holds(c, lib.DISCO_PROOF_HOST_STATE, other, state)
    assert not c_holds(c, lib.DISCO_PROOF_WHEEL_COMMAND, first, COMMAND)


def test_the_same_nonce_again_does_not_start_the_counters_anew():
    prover, proofs = Prover(RFC_KEY, CODEC), []
    for nonce in (5, 5, 6):
        prover.challenge(nonce)
        proofs.append(prover.prove(COMMAND))
    assert [proof.data[0] for proof in proofs] == [1, 2, 1]
    assert len({proof.data[2:] for proof in proofs}) == 3


@pytest.mark.parametrize("wrong", [1, 100])
def test_wrong_nonces_in_between_do_not_set_the_counters_back(wrong):
    """Anybody can send a MAC_CHALLENGE; the least used nonces are forgotten first."""
    c = c_authentication()
    prover = prover_for(c)
    for _ in range(20):
        proof = prover.prove(COMMAND)
    assert c_holds(c, lib.DISCO_PROOF_WHEEL_COMMAND, proof, COMMAND)
    for nonce in range(wrong):
        prover.challenge(nonce)
        prover.prove(COMMAND)
    prover.clear()
    prover.challenge(int.from_bytes(bytes(c.nonce), "little"))
    assert c_holds(c, lib.DISCO_PROOF_WHEEL_COMMAND, prover.prove(COMMAND), COMMAND)


def test_nothing_is_proved_without_a_nonce_or_need():
    prover = Prover(RFC_KEY, CODEC)
    with pytest.raises(ValueError, match="no nonce"):
        prover.prove(COMMAND)
    prover.challenge(1)
    with pytest.raises(ValueError, match="none needed"):
        prover.prove(EncodedFrame(0x150, bytes(8)))
    prover.clear()
    assert not prover.ready


def test_without_a_demand_everything_holds():
    c = ffi.new("disco_authentication_t *")
    lib.disco_authentication_init(c, False, RFC_KEY, 1)
    assert lib.disco_authentication_holds(c, 0, 0x100, bytes(8))
    assert c.proofs[0].freshness == 0
