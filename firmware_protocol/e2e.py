"""End-to-end protection of a frame: CRC-8 with a data id, a 4-bit counter, and the receiver's judgement of both.

The CRC is AUTOSAR's CRC-8H2F (polynomial 0x2F, initial value and final xor 0xFF): over an 8-byte frame with its data id
it detects every error of up to three bits.
"""

import binascii
import enum
import struct

COUNTER_MODULUS = 16
QUALIFY_AFTER = 3
DISQUALIFY_AT = 5
MAX_LOST = 2
_POLYNOMIAL = 0x2F


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
    """What the receiver thinks of one frame; only OK and OK_SOME_LOST may be used, and only while qualified."""

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
