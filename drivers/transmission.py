"""Makes the frames to send: each with its counter and its deadline, the cyclic ones when they are due."""

from __future__ import annotations

from collections.abc import Sequence

from drivers.types import Frame, OutgoingFrame
from firmware_protocol.authentication import Prover
from firmware_protocol.codec import Codec, EncodedFrame
from firmware_protocol.e2e import COUNTER_MODULUS


class FrameTransmission:
    """Encodes frames, proves them if there is a key (16 bytes), and remembers when each message was last sent."""

    def __init__(self, codec: Codec, key: bytes | None = None) -> None:
        self._codec = codec
        self._prover = Prover(key, codec) if key is not None else None
        self._counters: dict[str, int] = {}
        self._sent_ns: dict[str, int] = {}

    def due(self, name: str, now_ns: int, period_ns: int) -> bool:
        """Whether a message was last sent a period ago or never."""
        sent_ns = self._sent_ns.get(name)
        return sent_ns is None or now_ns - sent_ns >= period_ns

    def forget(self) -> None:
        """Make every cyclic message due; the counters go on, so that no old frame can pass for a new one."""
        self._sent_ns.clear()
        if self._prover is not None:
            self._prover.forget()

    def challenge(self, nonce: int) -> None:
        """Take in the robot's nonce, to which proofs are bound."""
        if self._prover is not None:
            self._prover.challenge(nonce)

    def proved(self, frames: Sequence[OutgoingFrame]) -> tuple[OutgoingFrame, ...]:
        """Put its proof before each frame that needs one; what cannot be proved yet is left out."""
        prover = self._prover
        if prover is None:
            return tuple(frames)
        proved = []
        for outgoing in frames:
            frame = EncodedFrame(outgoing.frame.can_id, outgoing.frame.data)
            if prover.needs_proof(frame.can_id):
                if not prover.ready:
                    continue
                proved.append(OutgoingFrame(Frame(*prover.prove(frame)), outgoing.deadline_ns))
            proved.append(outgoing)
        return tuple(proved)

    def frame(self, name: str, now_ns: int, valid_for_ns: int, **signals: float | str) -> OutgoingFrame:
        """Return a frame that must have left `valid_for_ns` from now. Raises ValueError as `Codec.encode` does."""
        counter = self._counters.get(name, 0)
        encoded = self._codec.encode(name, counter, **signals)
        self._counters[name] = (counter + 1) % COUNTER_MODULUS
        self._sent_ns[name] = now_ns
        return OutgoingFrame(Frame(encoded.can_id, encoded.data), now_ns + valid_for_ns)
