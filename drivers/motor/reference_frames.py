"""Frames in and out: which received ones may be believed; counters, deadlines and proofs of those to send."""

from __future__ import annotations

from collections.abc import Sequence

from drivers.types import Frame, OutgoingFrame, ReceivedFrame
from firmware_protocol.authentication import Prover
from firmware_protocol.codec import PROTOCOL, Codec, Decoded, DecodeFault, EncodedFrame, FaultReason
from firmware_protocol.e2e import COUNTER_MODULUS, E2EReceiver, E2EStatus

TIMEOUT_NS = 500_000_000
SLOW_TIMEOUT_NS = 5_000_000_000
_SLOW = frozenset({"POWER", "LINK_HEALTH"})
# Asked for one by one, so that there is no row of good frames to wait for; hearing one twice does no harm.
_ANSWERS = frozenset({"HELLO", "BUILD", "LIMITS", "TIME_RESPONSE", "PARAM_RESPONSE", "MAC_CHALLENGE"})
_SENDERS = {layout.name: layout.sender for layout in PROTOCOL.messages}
_USABLE = (E2EStatus.OK, E2EStatus.OK_SOME_LOST)
_REJECTED = (E2EStatus.REPEATED, E2EStatus.WRONG_SEQUENCE)
_AFTER_A_GAP = (E2EStatus.INITIAL, E2EStatus.OK_SOME_LOST, E2EStatus.WRONG_SEQUENCE)


class FrameReception:
    """Decodes frames, checks their end-to-end protection per identifier and counts all that is not used."""

    def __init__(self, codec: Codec) -> None:
        self._codec = codec
        self._receivers: dict[str, E2EReceiver] = {}
        self._counters: dict[str, int] = {}
        self.accepted = 0
        self.rejected_crc = 0
        self.rejected_sequence = 0
        self.rejected_length = 0
        self.unknown_id = 0
        self.lost = 0
        self.foreign: str | None = None
        self.outside_stop_ns: int | None = None

    def reset(self) -> None:
        """Forget the senders, as at a new link; the counts stay."""
        self._receivers.clear()
        self._counters.clear()
        self.foreign = None
        self.outside_stop_ns = None

    def accept(self, received: ReceivedFrame) -> Decoded | None:
        """Return the decoded frame if it may be believed, None otherwise; whatever the wire brings, nothing is raised.

        `foreign` names the last message seen that only a host sends: somebody else commands this robot. An e-stop does
        not count as that, as anybody may send one: `outside_stop_ns` is when the last was received.
        """
        if received.frame.extended:
            self.unknown_id += 1
            return None
        decoded = self._codec.decode(received.frame.can_id, received.frame.data)
        if isinstance(decoded, DecodeFault):
            self._count(decoded, received.t_ns)
            return None
        if decoded.name == "ESTOP":
            self.outside_stop_ns = received.t_ns
            return None
        if _SENDERS[decoded.name] != "ROBOT":
            self.foreign = decoded.name
            self.unknown_id += 1
            return None
        if decoded.name not in _ANSWERS:
            receiver = self._receiver(decoded.name)
            status = receiver.check(decoded.counter, True, received.t_ns)
            self._count_lost(decoded, status)
            if status in _REJECTED:
                self.rejected_sequence += 1
            if not (receiver.qualified and status in _USABLE):
                return None
        self.accepted += 1
        return decoded

    def _receiver(self, name: str) -> E2EReceiver:
        receiver = self._receivers.get(name)
        if receiver is None:
            receiver = self._receivers[name] = E2EReceiver(SLOW_TIMEOUT_NS if name in _SLOW else TIMEOUT_NS)
        return receiver

    def _count(self, fault: DecodeFault, received_ns: int) -> None:
        match fault.reason:
            case FaultReason.UNKNOWN_ID:
                self.unknown_id += 1
            case FaultReason.CRC:
                self.rejected_crc += 1
                self._receiver(fault.name).check(0, False, received_ns)
            case FaultReason.LENGTH | FaultReason.PAGE:
                self.rejected_length += 1

    def _count_lost(self, decoded: Decoded, status: E2EStatus) -> None:
        previous = self._counters.get(decoded.name)
        self._counters[decoded.name] = decoded.counter
        if previous is not None and status in _AFTER_A_GAP:
            # At least: whole turns of the counter do not show.
            self.lost += (decoded.counter - previous - 1) % COUNTER_MODULUS


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
