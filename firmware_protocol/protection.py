"""Protection and authentication of frames: that they are intact and in order, and a host's proof that it sent them.

Protection is against accident, and every frame has it: CRC-8 with a data id, a 4-bit counter, and the receiver's
judgement of both. The CRC is AUTOSAR's CRC-8H2F (polynomial 0x2F, initial value and final xor 0xFF): over an 8-byte
frame with its data id it detects every error of up to three bits.

Proof is against strangers, where a robot has a key: a truncated AES-CMAC, in a frame of its own just before the one it
proves. AES-CMAC is RFC 4493's (NIST SP 800-38B). The MAC covers the robot's nonce (6 bytes), a freshness counter (8),
the CAN identifier (2) and the whole frame (8), little-endian; its first 48 bits go on the wire with the low 16 of the
counter.
"""

from __future__ import annotations

import binascii
import enum
import re
import struct
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from firmware_protocol.codec import Codec

# firmware_protocol/README.md: 4-bit counter; as few bad frames as these reject a sender, as few good ones bring it
# back.
COUNTER_MODULUS = 16
QUALIFY_AFTER = 3
DISQUALIFY_AT = 5
MAX_LOST = 2
# CRC-8 of AUTOSAR's profiles (CRC8H2F).
_POLYNOMIAL = 0x2F

# AES-128; a nonce as in MAC_CHALLENGE; a MAC that fills a frame with 16 bits of its counter.
KEY_LENGTH = 16
NONCE_LENGTH = 6
MAC_LENGTH = 6
# Chosen: so many wrong nonces in between do not make the right one's counters begin again.
REMEMBERED_NONCES = 8
PROVED = ("WHEEL_COMMAND", "HOST_STATE", "PARAM_REQUEST")
_KEY = re.compile(rf"[0-9a-fA-F]{{{2 * KEY_LENGTH}}}")


class EncodedFrame(NamedTuple):
    """A frame ready for any medium."""

    can_id: int
    data: bytes


def _crc_table() -> bytes:
    table = bytearray(256)
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = ((crc << 1) ^ _POLYNOMIAL if crc & 0x80 else crc << 1) & 0xFF
        table[byte] = crc
    return bytes(table)


_TABLE = _crc_table()


def data_id(can_id: int, major: int) -> int:
    """Return the 16-bit data id that ties a frame's CRC to its identifier and to the protocol's major version."""
    return (can_id ^ (major << 11)) & 0xFFFF


def crc8(protected: bytes, frame_data_id: int) -> int:
    """Return the CRC-8 over `protected` (bytes 1 to 7 of the frame) followed by the data id, little-endian."""
    return crc8h2f(protected + frame_data_id.to_bytes(2, "little"))


def crc8h2f(data: bytes) -> int:
    """Return AUTOSAR's CRC-8H2F of `data`; the check value of b"123456789" is 0xDF."""
    table = _TABLE
    crc = 0xFF
    for byte in data:
        crc = table[crc ^ byte]
    return crc ^ 0xFF


def challenge_answer(challenge: int, session: int, dbc_hash: int) -> int:
    """Return a host's answer to arm: CRC-16/CCITT-FALSE over challenge u16, session u8, hash u32, all little-endian.

    It is no secret: it proves that this very arming was meant, by an end that speaks this very DBC.
    """
    return binascii.crc_hqx(struct.pack("<HBI", challenge, session, dbc_hash), 0xFFFF)


class E2EStatus(enum.Enum):
    """Verdict of the receiver on one frame; only OK and OK_SOME_LOST may be used, and only while qualified."""

    INITIAL = 0
    OK = 1
    OK_SOME_LOST = 2
    REPEATED = 3
    WRONG_SEQUENCE = 4
    WRONG_CRC = 5


class E2EReceiver:
    """Judges the frames of one identifier: a pure function of its state, the frame and the time.

    Three good frames in a row qualify the sender; each bad frame adds one to a score that each good one lowers, and
    at a score of five, or when nothing good came for `timeout_ns`, the sender is disqualified.
    """

    __slots__ = ("_good", "_last_counter", "_last_good_ns", "_score", "_timeout_ns", "qualified")

    def __init__(self, timeout_ns: int) -> None:
        self._timeout_ns = timeout_ns
        self.qualified = False
        self._good = 0
        self._score = 0
        self._last_counter: int | None = None
        self._last_good_ns = 0

    def check(self, counter: int, crc_ok: bool, now_ns: int) -> E2EStatus:
        """Take in one received frame at `now_ns` and return what it is worth."""
        self.expire(now_ns)
        if not crc_ok:
            return self._bad(E2EStatus.WRONG_CRC)
        previous, self._last_counter = self._last_counter, counter
        if previous is None:
            self._last_good_ns = now_ns
            return E2EStatus.INITIAL
        delta = (counter - previous) % COUNTER_MODULUS
        if delta == 0:
            return self._bad(E2EStatus.REPEATED)
        if delta > 1 + MAX_LOST:
            return self._bad(E2EStatus.WRONG_SEQUENCE)
        self._last_good_ns = now_ns
        self._good = min(self._good + 1, QUALIFY_AFTER)
        self._score = max(self._score - 1, 0)
        if self._good == QUALIFY_AFTER and not self.qualified:
            self.qualified = True
            self._score = 0
        return E2EStatus.OK if delta == 1 else E2EStatus.OK_SOME_LOST

    def expire(self, now_ns: int) -> bool:
        """Disqualify the sender if nothing good came for the timeout; return whether it is qualified."""
        if self._last_counter is not None and now_ns - self._last_good_ns > self._timeout_ns:
            self.qualified = False
            self._good = 0
            self._score = 0
            self._last_counter = None
        return self.qualified

    def _bad(self, status: E2EStatus) -> E2EStatus:
        self._good = 0
        self._score = min(self._score + 1, DISQUALIFY_AT)
        if self._score == DISQUALIFY_AT:
            self.qualified = False
        return status


def parse_key(text: str) -> bytes:
    """Return the 16 bytes that 32 hexadecimal digits mean. Raises ValueError for anything else."""
    digits = text.strip()
    if not _KEY.fullmatch(digits):
        raise ValueError(f"not {2 * KEY_LENGTH} hexadecimal digits")
    return bytes.fromhex(digits)


def aes_cmac(key: bytes, message: bytes) -> bytes:
    """Return the 16-byte AES-CMAC of a message. Raises ValueError for a key that is not 16 bytes long."""
    if len(key) != KEY_LENGTH:
        raise ValueError(f"a key of {len(key)} bytes; AES-128 takes {KEY_LENGTH}")
    # Only robots with a key need it: it takes 12 MB of what a daemon locks.
    from cryptography.hazmat.primitives.ciphers.algorithms import AES  # noqa: PLC0415
    from cryptography.hazmat.primitives.cmac import CMAC  # noqa: PLC0415

    mac = CMAC(AES(key))
    mac.update(message)
    return mac.finalize()


def truncated_mac(key: bytes, nonce: bytes, freshness: int, frame: EncodedFrame) -> bytes:
    """Return the 6 bytes that prove `frame` under the robot's nonce (6 bytes), as number `freshness` of its kind."""
    return aes_cmac(key, nonce + struct.pack("<QH", freshness, frame.can_id) + frame.data)[:MAC_LENGTH]


class Prover:
    """Proves frames to one robot; pure. Without a nonce from the robot nothing can be proved."""

    def __init__(self, key: bytes, codec: Codec) -> None:
        """Create a prover with a `key` of 16 bytes."""
        # The library is loaded here, and not with the first command in the loop.
        aes_cmac(key, b"")
        self._key = key
        self._nonce: bytes | None = None
        self._freshness: dict[bytes, dict[int, int]] = {}
        self._mac_ids = {codec.can_id(name): codec.can_id(f"{name}_MAC") for name in PROVED}

    @property
    def ready(self) -> bool:
        """Whether the robot's nonce is known."""
        return self._nonce is not None

    def challenge(self, nonce: int) -> None:
        """Take in MAC_CHALLENGE's nonce; with a new one the counters begin again, with one told before they go on.

        Anybody can send a wrong nonce: were the right one's counters lost with it, the robot would hear nothing more
        until they had caught up with its own.
        """
        value = nonce.to_bytes(NONCE_LENGTH, "little")
        if value not in self._freshness and len(self._freshness) >= REMEMBERED_NONCES:
            del self._freshness[min(self._freshness, key=lambda known: sum(self._freshness[known].values()))]
        self._freshness.setdefault(value, {})
        self._nonce = value

    def clear(self) -> None:
        """Clear the nonce, because the robot may be another one."""
        self._nonce = None

    def needs_proof(self, can_id: int) -> bool:
        """Whether a frame of this identifier is heard only with a proof."""
        return can_id in self._mac_ids

    def prove(self, frame: EncodedFrame) -> EncodedFrame:
        """Return the frame to send just before `frame`; each call uses up one count of its freshness counter.

        Raises ValueError without a nonce, and for a frame that needs no proof.
        """
        if self._nonce is None or not self.needs_proof(frame.can_id):
            raise ValueError(f"no proof for 0x{frame.can_id:03X}: no nonce yet, or none needed")
        counters = self._freshness[self._nonce]
        freshness = counters[frame.can_id] = counters.get(frame.can_id, 0) + 1
        mac = truncated_mac(self._key, self._nonce, freshness, frame)
        return frame._replace(can_id=self._mac_ids[frame.can_id], data=(freshness & 0xFFFF).to_bytes(2, "little") + mac)
