"""A CAN bus in simulated time: bit-exact durations, arbitration, bounded queues, error confinement, injected faults.

Pure: time enters only through `CanBus.advance`. Source: Bosch CAN specification 2.0 (1991); ISO 11898-1.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import msgspec
from msgspec.structs import replace

from sim.can_protocol import (
    ACK_AND_END_BITS,
    ERROR_DELIMITER_BITS,
    ERROR_FLAG_BITS,
    INTERFRAME_BITS,
    BusNode,
    CanFrame,
    ErrorState,
    TransmitOrder,
    candump_line,
    frame_bits,
    protocol_error_frame,
    stuffed_bits,
)

# ISO 11898-1: recovery from bus-off, and what an error-passive node waits after its own frame.
RECOVERY_SEQUENCES = 128
RECESSIVE_SEQUENCE_BITS = 11
SUSPEND_TRANSMISSION_BITS = 8

# In a second.
_NANOSECONDS = 1_000_000_000
_LOG_CHANNEL = "can0"


@dataclass(frozen=True, slots=True)
class FrameOutcome:
    """Effect of a fault on one transmission; the default is none.

    `wire_error_bit` inverts that bit of the stuffed frame: an error frame follows, and the sender tries again. All
    others happen behind the receivers' CRC check, so the sender never learns of them: `lost` for all or `lost_at` the
    named nodes, `copies` of it, a delay, and `data` (of any length up to 8) in place of what was sent. `cut` with
    `wire_error_bit`: the line breaks there; on a bus the same, on a serial line the rest of the frame is missing.
    """

    wire_error_bit: int | None = None
    lost: bool = False
    lost_at: tuple[str, ...] = ()
    copies: int = 1
    delay_ns: int = 0
    data: bytes | None = None
    cut: bool = False


UNHARMED = FrameOutcome()
"""Nothing happens to it: the one that is carried fastest."""


class BusFault(Protocol):
    """Decides the fate of each transmission, retransmissions included."""

    def outcome(self, now_ns: int, sender: str, frame: CanFrame) -> FrameOutcome:
        """Return what happens to `frame`; called once when it starts on the wire."""


class DeliveredFrame(msgspec.Struct, frozen=True, gc=False):
    """A frame that `receivers` have at `t_ns`; for a node's own error frames `sender` is that node."""

    t_ns: int
    sender: BusNode
    frame: CanFrame
    receivers: tuple[BusNode, ...]


class _Transmission(msgspec.Struct, frozen=True, gc=False):
    end_ns: int
    senders: list[BusNode]
    frame: CanFrame
    outcome: FrameOutcome
    intact: bool
    acknowledged: bool


# Looked at with every frame; through the enum each look is a call of a function in Python 3.11.
_BUS_OFF, _PASSIVE = ErrorState.BUS_OFF, ErrorState.PASSIVE


class CanBus:
    """The wire and the controllers on it.

    `bitrate` in bit/s. `log` gets each frame that ended on the wire, and each error frame, as a candump line;
    `error_frames` counts the latter.
    """

    def __init__(
        self,
        bitrate: int = 500_000,
        *,
        fault: BusFault | None = None,
        log: Callable[[str], object] | None = None,
        start_ns: int = 0,
    ) -> None:
        self.fault = fault
        self.error_frames = 0
        self._bitrate = bitrate
        self._log = log
        self._interframe_ns = self._bits_ns(INTERFRAME_BITS)
        self._now_ns = start_ns
        self._free_ns = start_ns
        self._idle_counted_ns = start_ns
        self._nodes: list[BusNode] = []
        self._recovering: list[BusNode] = []
        self._on_wire: _Transmission | None = None
        self._delayed: list[tuple[int, int, DeliveredFrame]] = []
        self._out: list[DeliveredFrame] = []
        self._sequence = 0

    @property
    def now_ns(self) -> int:
        """Simulated time that the bus has reached, in ns."""
        return self._now_ns

    @property
    def nodes(self) -> tuple[BusNode, ...]:
        """The nodes attached now."""
        return tuple(self._nodes)

    def attach(
        self,
        name: str,
        *,
        capacity: int = 32,
        order: TransmitOrder = TransmitOrder.PRIORITY,
        echo: bool = False,
    ) -> BusNode:
        """Return a new node with room for `capacity` waiting frames; with `echo` it receives its own frames as well."""
        node = BusNode(name, capacity, order, echo)
        self._nodes.append(node)
        return node

    def detach(self, node: BusNode) -> None:
        """Take a node off the bus with its waiting frames; a frame already on the wire ends."""
        self._nodes.remove(node)
        node.queue.clear()
        if node in self._recovering:
            self._recovering.remove(node)

    def send(self, node: BusNode, frame: CanFrame) -> bool:
        """Queue `frame` at the bus's present time; False, and a counter, when the queue is full or the node is bus-off.

        Raises ValueError for an error frame: controllers make those.
        """
        if frame.error:
            raise ValueError("an error frame cannot be sent")
        self._sequence += 1
        return node.push(self._sequence, frame)

    def force_bus_off(self, node: BusNode) -> None:
        """Put a node into bus-off; its waiting frames are lost, a frame already on the wire ends."""
        error_frame = node.force_bus_off()
        if error_frame is not None:
            self._report(node, error_frame)

    def request_recovery(self, node: BusNode) -> None:
        """Let a bus-off node come back after 128 sequences of 11 recessive bits; no effect in any other state."""
        if node.state is ErrorState.BUS_OFF and node.recessive_sequences is None:
            self._count_idle(self._now_ns)
            node.recessive_sequences = 0
            self._recovering.append(node)

    def next_event_ns(self) -> int | None:
        """Return when the bus next has something to do if no node sends anything more; None if never."""
        times = [self._delayed[0][0]] if self._delayed else []
        if self._out:
            times.append(self._now_ns)
        if self._on_wire is not None:
            times.append(self._on_wire.end_ns)
        else:
            start_ns = self._next_start_ns()
            if start_ns is not None:
                times.append(start_ns)
            if self._recovering:
                times.append(self._next_recovery_ns())
        return min(times) if times else None

    def advance(self, until_ns: int) -> list[DeliveredFrame]:
        """Let time pass up to `until_ns` and return what was received meanwhile, in order of time.

        Raises ValueError if `until_ns` is in the past.
        """
        if until_ns < self._now_ns:
            raise ValueError(f"the bus is at {self._now_ns} ns and cannot go back to {until_ns} ns")
        while self._happens_next(until_ns):
            pass
        self._now_ns = until_ns
        out, self._out = self._out, []
        if self._delayed:
            while self._delayed and self._delayed[0][0] <= until_ns:
                out.append(heapq.heappop(self._delayed)[2])
            out.sort(key=_delivery_time)
        return out

    def _happens_next(self, until_ns: int) -> bool:
        """Let the next event happen if it is due by `until_ns`; False if none is."""
        on_wire = self._on_wire
        if on_wire is not None:
            if on_wire.end_ns > until_ns:
                return False
            self._now_ns = on_wire.end_ns
            self._end(on_wire)
            return True
        start_ns = self._next_start_ns()
        if self._recovering:
            recovery_ns = self._next_recovery_ns()
            if start_ns is None or recovery_ns <= start_ns:
                if recovery_ns > until_ns:
                    return False
                self._now_ns = recovery_ns
                self._count_idle(recovery_ns)
                return True
        if start_ns is None or start_ns > until_ns:
            return False
        self._now_ns = start_ns
        self._start(start_ns)
        return True

    def _bits_ns(self, bits: int) -> int:
        return -(-bits * _NANOSECONDS // self._bitrate)

    def _next_start_ns(self) -> int | None:
        start_ns: int | None = None
        for node in self._nodes:
            if node.queue and (start_ns is None or node.eligible_ns < start_ns):
                start_ns = node.eligible_ns
        return None if start_ns is None else max(start_ns, self._free_ns, self._now_ns)

    def _start(self, now_ns: int) -> None:
        """Arbitrate among the heads of the queues and put the winner on the wire."""
        senders = [node for node in self._nodes if node.queue and node.eligible_ns <= now_ns]
        if len(senders) > 1:
            best = min([node.queue[0][2] for node in senders])
            senders = [node for node in senders if node.queue[0][2] == best]
        frames = [node.start() for node in senders]
        frame = frames[0]
        outcome = UNHARMED if self.fault is None else self.fault.outcome(now_ns, senders[0].name, frame)
        bits = frame_bits(frame)
        after_error_flag = ERROR_DELIMITER_BITS + INTERFRAME_BITS
        error_bit = _first_difference(frames) if len(frames) > 1 else None
        if error_bit is None:
            error_bit = outcome.wire_error_bit
        if error_bit is not None:
            error_bit = min(max(error_bit, 0), bits - INTERFRAME_BITS - 1)
            # The flag breaks the stuffing rule for the others, who answer with a flag of their own.
            bits = error_bit + 1 + 2 * ERROR_FLAG_BITS + after_error_flag
            acknowledged = True
        else:
            acknowledged = bool(self._listeners(senders))
            if not acknowledged:
                ack_slot = bits - INTERFRAME_BITS - ACK_AND_END_BITS
                bits = ack_slot + 1 + ERROR_FLAG_BITS + after_error_flag
        if self._recovering:
            self._count_idle(now_ns)
        end_ns = now_ns + self._bits_ns(bits - INTERFRAME_BITS)
        self._on_wire = _Transmission(end_ns, senders, frame, outcome, error_bit is None and acknowledged, acknowledged)

    def _end(self, transmission: _Transmission) -> None:
        """Count, deliver or requeue after the last bit of a frame or of an error delimiter."""
        end_ns, senders, intact = transmission.end_ns, transmission.senders, transmission.intact
        self._on_wire = None
        self._free_ns = end_ns + self._interframe_ns
        receivers = self._listeners(senders)
        for node in senders:
            changed = node.count_sent() if intact else node.count_transmit_error(transmission.acknowledged)
            if changed is not None:
                self._report(node, changed)
            if node.state is _PASSIVE:
                node.eligible_ns = self._free_ns + self._bits_ns(SUSPEND_TRANSMISSION_BITS)
        for node in receivers:
            changed = node.count_received() if intact else node.count_receive_error()
            if changed is not None:
                self._report(node, changed)
        if self._recovering:
            self._count_recessive_sequences(1)
        self._idle_counted_ns = self._free_ns
        if not intact:
            self.error_frames += 1
        if self._log is not None:
            self._log(candump_line(end_ns, _LOG_CHANNEL, transmission.frame if intact else protocol_error_frame()))
        if intact:
            receivers.extend([node for node in senders if node.echo])
            self._deliver(
                DeliveredFrame(end_ns, senders[0], transmission.frame, tuple(receivers)), transmission.outcome
            )

    def _listeners(self, senders: Sequence[BusNode]) -> list[BusNode]:
        """Return the nodes that receive what these nodes send, without the senders."""
        return [node for node in self._nodes if node.state is not _BUS_OFF and node not in senders]

    def _deliver(self, delivery: DeliveredFrame, outcome: FrameOutcome) -> None:
        receivers = delivery.receivers
        if outcome is UNHARMED:
            for node in receivers:
                node.received += 1
            if receivers:
                self._out.append(delivery)
            return
        frame = delivery.frame
        if outcome.data is not None:
            frame = replace(frame, data=outcome.data)
        receivers = () if outcome.lost else tuple(node for node in receivers if node.name not in outcome.lost_at)
        delivery = DeliveredFrame(delivery.t_ns + outcome.delay_ns, delivery.sender, frame, receivers)
        for node in receivers:
            node.received += outcome.copies
        for _ in range(outcome.copies if receivers else 0):
            if outcome.delay_ns > 0:
                self._sequence += 1
                heapq.heappush(self._delayed, (delivery.t_ns, self._sequence, delivery))
            else:
                self._out.append(delivery)

    def _report(self, node: BusNode, error_frame: CanFrame) -> None:
        self._out.append(DeliveredFrame(self._now_ns, node, error_frame, (node,)))

    def _next_recovery_ns(self) -> int:
        """Return when the first recovering node on an idle bus will have seen enough recessive bits."""
        seen = max(node.recessive_sequences or 0 for node in self._recovering)
        left_ns = self._bits_ns(RECESSIVE_SEQUENCE_BITS * (RECOVERY_SEQUENCES - seen))
        return max(self._idle_counted_ns + left_ns, self._now_ns)

    def _count_idle(self, now_ns: int) -> None:
        """Credit the recessive bits of an idle bus to the recovering nodes."""
        if self._on_wire is not None:
            return
        idle_ns = max(0, now_ns - self._idle_counted_ns)
        self._idle_counted_ns = max(now_ns, self._idle_counted_ns)
        self._count_recessive_sequences(idle_ns * self._bitrate // (RECESSIVE_SEQUENCE_BITS * _NANOSECONDS))

    def _count_recessive_sequences(self, count: int) -> None:
        for node in tuple(self._recovering):
            node.recessive_sequences = (node.recessive_sequences or 0) + count
            if node.recessive_sequences >= RECOVERY_SEQUENCES:
                self._recovering.remove(node)
                self._report(node, node.recover())


def _delivery_time(delivery: DeliveredFrame) -> int:
    return delivery.t_ns


def _first_difference(frames: list[CanFrame]) -> int | None:
    """Return the first bit in which frames sent at the same time under the same identifier differ.

    None if they are equal.
    """
    if all(frame == frames[0] for frame in frames):
        return None
    sent = [stuffed_bits(frame) for frame in frames]
    return next(i for i, bits in enumerate(zip(*sent, strict=False)) if len(set(bits)) > 1)
