"""The host's proof that a frame is its own: a truncated AES-CMAC, in a frame of its own just before the one it proves.

AES-CMAC is RFC 4493's (NIST SP 800-38B). The MAC covers the robot's nonce (6 bytes), a freshness counter (8), the CAN
identifier (2) and the whole frame (8), little-endian; its first 48 bits go on the wire with the counter's low 16.
"""

import re
import struct

from firmware_protocol.codec import Codec, EncodedFrame

KEY_LENGTH = 16
NONCE_LENGTH = 6
MAC_LENGTH = 6
REMEMBERED_NONCES = 8
PROVED = ("WHEEL_COMMAND", "HOST_STATE", "PARAM_REQUEST")
_KEY = re.compile(rf"[0-9a-fA-F]{{{2 * KEY_LENGTH}}}")


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
        """`key`: 16 bytes."""
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
        """Take in MAC_CHALLENGE's nonce; with a new one the counters begin anew, with one told before they go on.

        Anybody can send a wrong nonce: were the right one's counters lost with it, the robot would hear nothing more
        until they had caught up with its own.
        """
        value = nonce.to_bytes(NONCE_LENGTH, "little")
        if value not in self._freshness and len(self._freshness) >= REMEMBERED_NONCES:
            del self._freshness[min(self._freshness, key=lambda known: sum(self._freshness[known].values()))]
        self._freshness.setdefault(value, {})
        self._nonce = value

    def forget(self) -> None:
        """Forget the nonce: the robot may be another one."""
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
        return EncodedFrame(self._mac_ids[frame.can_id], (freshness & 0xFFFF).to_bytes(2, "little") + mac)
