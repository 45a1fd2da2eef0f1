"""Classic CAN frames in four forms (object, SocketCAN bytes, candump line, bits), and the state of one controller.

The bits give a frame's exact length with stuff bits and what decides arbitration. A controller has its transmit queue
and its error confinement; it reports errors in the frames that Linux can-dev gives to a socket. Source: Bosch CAN
specification 2.0 (1991), parts A and B, chapter 8 of part B for fault confinement; ISO 11898-1.
"""

from __future__ import annotations

import enum
import heapq
import struct
from dataclasses import dataclass, field
from functools import lru_cache

import msgspec

FRAME_BYTES = 16
"""Length of Linux `struct can_frame`."""
ECHO_OWN_FRAMES = b"\x01"
"""Packet by which a client of the hub asks for its own frames as well."""
# CAN_EFF_FLAG, CAN_RTR_FLAG, CAN_ERR_FLAG, CAN_EFF_MASK and CAN_SFF_MASK of linux/can.h.
_EXTENDED_FLAG = 0x8000_0000
_REMOTE_FLAG = 0x4000_0000
_ERROR_FLAG = 0x2000_0000
_EXTENDED_MASK = 0x1FFF_FFFF
_STANDARD_MASK = 0x7FF
_FRAME = struct.Struct("=IB3x8s")
INTERFRAME_BITS = 3
"""Intermission: recessive bits between the end of a frame and the next start of frame."""
ACK_AND_END_BITS = 9
"""ACK slot, ACK delimiter and end of frame: sent after the CRC delimiter, never stuffed."""
# ISO 11898-1: an active error flag, its delimiter, and the delimiter of the CRC.
ERROR_FLAG_BITS = 6
ERROR_DELIMITER_BITS = 8
_CRC_DELIMITER_BITS = 1
_TAIL_BITS = _CRC_DELIMITER_BITS + ACK_AND_END_BITS + INTERFRAME_BITS
# ISO 11898-1: CRC-15.
_CRC_POLYNOMIAL = 0x4599
_CRC_BITS = 15


class CanFrame(msgspec.Struct, frozen=True, gc=False):
    """One classic CAN frame; `remote_length` is the length code of a remote frame, which carries no data."""

    can_id: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False
    error: bool = False
    remote_length: int = 0


def pack_frame(frame: CanFrame) -> bytes:
    """Return the 16 bytes of Linux `struct can_frame` (include/uapi/linux/can.h), host byte order.

    Raises ValueError if the identifier or the data do not fit a classic frame.
    """
    can_id, data = frame.can_id, frame.data
    length = frame.remote_length if frame.remote else len(data)
    limit = _EXTENDED_MASK if frame.extended or frame.error else _STANDARD_MASK
    if not 0 <= can_id <= limit or length > 8 or len(data) > 8:
        raise ValueError(f"not a classic CAN frame: {frame}")
    if frame.extended:
        can_id |= _EXTENDED_FLAG
    if frame.remote:
        can_id |= _REMOTE_FLAG
    if frame.error:
        can_id |= _ERROR_FLAG
    return _FRAME.pack(can_id, length, data)


def unpack_frame(packet: bytes) -> CanFrame | None:
    """Return the frame in a `struct can_frame`, or None if these bytes are none."""
    if len(packet) != FRAME_BYTES:
        return None
    can_id, length, data = _FRAME.unpack(packet)
    if length > 8:
        return None
    extended = bool(can_id & _EXTENDED_FLAG)
    error = bool(can_id & _ERROR_FLAG)
    if can_id & _REMOTE_FLAG:
        return CanFrame(can_id & _EXTENDED_MASK, b"", extended, True, error, length)
    mask = _EXTENDED_MASK if extended or error else _STANDARD_MASK
    return CanFrame(can_id & mask, data[:length], extended, False, error)


def candump_line(t_ns: int, channel: str, frame: CanFrame) -> str:
    """Return the frame as `candump -L` writes it, for example `(0.000270) can0 110#8D300000`.

    `t_ns` is printed in seconds.
    """
    width = 8 if frame.extended or frame.error else 3
    can_id = frame.can_id | _ERROR_FLAG if frame.error else frame.can_id
    body = f"R{frame.remote_length}" if frame.remote else frame.data.hex().upper()
    seconds, rest_ns = divmod(t_ns, 1_000_000_000)
    return f"({seconds}.{rest_ns // 1000:06d}) {channel} {can_id:0{width}X}#{body}"


def controller_error_frame(tec: int, rec: int, state: int) -> CanFrame:
    """Error frame CAN_ERR_CRTL | CAN_ERR_CNT: `state` is the CAN_ERR_CRTL_* bits, the counters go to bytes 6 and 7."""
    return CanFrame(0x204, bytes((0, state, 0, 0, 0, 0, min(tec, 255), min(rec, 255))), error=True)


def bus_off_frame() -> CanFrame:
    """Return the error frame CAN_ERR_BUSOFF: this node has left the bus."""
    return CanFrame(0x040, bytes(8), error=True)


def restarted_frame() -> CanFrame:
    """Return the error frame CAN_ERR_RESTARTED: this node has come back from bus-off."""
    return CanFrame(0x100, bytes(8), error=True)


def protocol_error_frame() -> CanFrame:
    """Error frame CAN_ERR_PROT | CAN_ERR_BUSERROR: a frame was destroyed on the wire."""
    return CanFrame(0x088, bytes(8), error=True)


def receive_overflow_frame() -> CanFrame:
    """Error frame CAN_ERR_CRTL with CAN_ERR_CRTL_RX_OVERFLOW: this reader was too slow and frames are lost."""
    return CanFrame(0x004, bytes((0, 0x01, 0, 0, 0, 0, 0, 0)), error=True)


def _crc_table() -> tuple[int, ...]:
    """Build the table that advances the CRC-15 of CAN by one byte."""
    table = []
    for byte in range(256):
        crc = byte << 7
        for _ in range(8):
            crc = (crc << 1) ^ (_CRC_POLYNOMIAL if crc & 0x4000 else 0)
        table.append(crc & 0x7FFF)
    return tuple(table)


def _stuffing_table(bits: int) -> tuple[int, ...]:
    """Build the lookup table that advances bit stuffing by `bits` bits.

    Entry [state << bits | value] is next state << 8 | stuff bits inserted. A state is the last bit << 2 | the length of
    its run - 1.
    """
    table = []
    for state in range(8):
        for value in range(1 << bits):
            bit, run, stuffed = state >> 2, (state & 3) + 1, 0
            for shift in range(bits - 1, -1, -1):
                new = value >> shift & 1
                run = run + 1 if new == bit else 1
                bit = new
                if run == 5:
                    bit, run, stuffed = 1 - bit, 1, stuffed + 1
            table.append(bit << 10 | run - 1 << 8 | stuffed)
    return tuple(table)


_CRC_TABLE = _crc_table()
_STUFFING_8 = _stuffing_table(8)
_STUFFING_7 = _stuffing_table(7)


def _head(can_id: int, extended: bool, remote: bool, length: int) -> tuple[int, int]:
    """Return the bits from start of frame to the length code as an integer (leading zeros), and their number."""
    if extended:
        # SOF, 11 high bits, SRR and IDE recessive, 18 low bits, RTR, r1 and r0 dominant, DLC.
        return (can_id >> 18) << 27 | 3 << 25 | (can_id & 0x3FFFF) << 7 | remote << 6 | length, 39
    return can_id << 7 | remote << 6 | length, 19


@lru_cache(maxsize=4096)
def _after_head(can_id: int, extended: bool, remote: bool, length: int) -> tuple[int, int, int]:
    """Return bits, CRC and stuffing (state << 8 | stuff bits) after the head; cached, as most frames repeat a head."""
    head, bits = _head(can_id, extended, remote, length)
    padding = -bits % 8
    crc = 0
    # Leading zeros leave a CRC that starts at zero unchanged.
    for byte in head.to_bytes((bits + padding) // 8):
        crc = (crc << 8 ^ _CRC_TABLE[crc >> 7 ^ byte]) & 0x7FFF
    # Padding in front with ...0101 inserts no stuff bit, and lets the start of frame begin a run of its own.
    state = stuffed = 0
    for byte in (head | (0x55 & (1 << padding) - 1) << bits).to_bytes((bits + padding) // 8):
        entry = _STUFFING_8[state | byte]
        state = entry & 0x700
        stuffed += entry & 0xFF
    return bits, crc, state | stuffed


def frame_bits(frame: CanFrame) -> int:
    """Bit times that a frame takes from start of frame to the end of the intermission, stuff bits counted exactly.

    A standard frame of 8 bytes takes 111 to 135. An error frame as given by SocketCAN is no frame and has no length.
    """
    data = b"" if frame.remote else frame.data
    length = frame.remote_length if frame.remote else len(data)
    bits, crc, entry = _after_head(frame.can_id, frame.extended, frame.remote, length)
    # The low byte of the sum is the number of stuff bits: there are 29 at most.
    total = entry
    for byte in data:
        crc = (crc << 8 ^ _CRC_TABLE[crc >> 7 ^ byte]) & 0x7FFF
        entry = _STUFFING_8[entry & 0x700 | byte]
        total += entry
    entry = _STUFFING_8[entry & 0x700 | crc >> 7]
    total += entry + _STUFFING_7[(entry & 0x700) >> 1 | crc & 0x7F]
    return bits + 8 * len(data) + _CRC_BITS + (total & 0xFF) + _TAIL_BITS


def stuffed_bits(frame: CanFrame) -> str:
    """Return the bits on the wire from start of frame to the end of the CRC, stuff bits included, as '0' and '1'."""
    data = b"" if frame.remote else frame.data
    length = frame.remote_length if frame.remote else len(data)
    value, bits = _head(frame.can_id, frame.extended, frame.remote, length)
    value, bits = value << 8 * len(data) | int.from_bytes(data), bits + 8 * len(data)
    crc = 0
    for byte in value.to_bytes((bits + 7) // 8):
        crc = (crc << 8 ^ _CRC_TABLE[crc >> 7 ^ byte]) & 0x7FFF
    sent: list[str] = []
    for bit in f"{value:0{bits}b}{crc:0{_CRC_BITS}b}":
        sent.append(bit)
        if sent[-5:] == [bit] * 5:
            sent.append("1" if bit == "0" else "0")
    return "".join(sent)


def arbitration_key(frame: CanFrame) -> int:
    """Return the arbitration field as a number: of frames that start together the lowest wins (a dominant bit is 0)."""
    can_id = frame.can_id
    if frame.extended:
        return (can_id >> 18) << 21 | 3 << 19 | (can_id & 0x3FFFF) << 1 | frame.remote
    return can_id << 21 | frame.remote << 20


# ISO 11898-1: counts of error-passive and bus-off; the warning is that of usual controllers.
WARNING_LIMIT = 96
PASSIVE_LIMIT = 128
BUS_OFF_LIMIT = 256

QueuedFrame = tuple[int, int, int, CanFrame]
"""Rank among this node's own frames, sequence number, arbitration key, frame."""


class TransmitOrder(enum.Enum):
    """Order in which a node sends its waiting frames: the lowest identifier (mailboxes) or the oldest (a queue)."""

    PRIORITY = "priority"
    FIFO = "fifo"


class ErrorState(enum.Enum):
    """Error confinement of a node; `WARNING` (a counter at 96) changes nothing on the wire."""

    ACTIVE = "error-active"
    WARNING = "error-warning"
    PASSIVE = "error-passive"
    BUS_OFF = "bus-off"


# Looked at with every frame; through the enum each look is a call of a function in Python 3.11.
_PRIORITY, _BUS_OFF = TransmitOrder.PRIORITY, ErrorState.BUS_OFF


@dataclass(slots=True, eq=False)
class BusNode:
    """State and counters of one controller; made by `CanBus.attach` and changed only by the bus.

    `tec` and `rec` are the transmit and receive error counters. `recessive_sequences` counts towards recovery from
    bus-off and is None when none was requested. The counting methods return the error frame that a change of state
    reports to this node, or None.
    """

    name: str
    capacity: int
    order: TransmitOrder
    echo: bool
    state: ErrorState = ErrorState.ACTIVE
    tec: int = 0
    rec: int = 0
    sent: int = 0
    received: int = 0
    refused_full: int = 0
    refused_bus_off: int = 0
    lost_by_bus_off: int = 0
    bus_off_count: int = 0
    queue: list[QueuedFrame] = field(default_factory=list)
    on_wire: QueuedFrame | None = None
    eligible_ns: int = 0
    recessive_sequences: int | None = None

    @property
    def pending(self) -> int:
        """Frames accepted and not yet on the bus as a whole."""
        return len(self.queue) + (self.on_wire is not None)

    def push(self, sequence: int, frame: CanFrame) -> bool:
        """Add a frame to the transmit queue; return False and count it if the queue is full or the node is bus-off."""
        if self.state is _BUS_OFF:
            self.refused_bus_off += 1
            return False
        if len(self.queue) + (self.on_wire is not None) >= self.capacity:
            self.refused_full += 1
            return False
        key = arbitration_key(frame)
        heapq.heappush(self.queue, (key if self.order is _PRIORITY else 0, sequence, key, frame))
        return True

    def start(self) -> CanFrame:
        """Move the head of the queue to the wire."""
        self.on_wire = heapq.heappop(self.queue)
        return self.on_wire[3]

    def count_sent(self) -> CanFrame | None:
        """Count the frame on the wire as sent; return an error frame where the error state changes."""
        self.sent += 1
        self.on_wire = None
        if not self.tec or self.state is _BUS_OFF:
            return None
        self.tec -= 1
        return self._confine()

    def count_transmit_error(self, acknowledged: bool) -> CanFrame | None:
        """Requeue the frame and add 8 to `tec`, unless an error-passive node only misses the acknowledgement."""
        item, self.on_wire = self.on_wire, None
        if self.state is ErrorState.BUS_OFF or item is None:
            self.lost_by_bus_off += 1
            return None
        heapq.heappush(self.queue, item)
        # An error-passive node does not count missing acknowledgements, or every unplugged node would go bus-off.
        if acknowledged or self.tec < PASSIVE_LIMIT:
            self.tec += 8
        return self._confine()

    def count_received(self) -> CanFrame | None:
        """Lower `rec` by 1, or to 120 from 128 and above; return an error frame if the state changes."""
        if not self.rec:
            return None
        self.rec = self.rec - 1 if self.rec < PASSIVE_LIMIT else 120
        return self._confine()

    def count_receive_error(self) -> CanFrame | None:
        """Raise the receive error count after a destroyed frame of another node."""
        self.rec = min(self.rec + 1, 255)
        return self._confine()

    def force_bus_off(self) -> CanFrame | None:
        """Go bus-off as if `tec` had overflowed; return the error frame, None if already bus-off."""
        self.tec = BUS_OFF_LIMIT
        return self._confine()

    def recover(self) -> CanFrame:
        """Come back from bus-off with clean counters."""
        self.recessive_sequences = None
        self.tec = self.rec = 0
        self.state = ErrorState.ACTIVE
        return restarted_frame()

    def _confine(self) -> CanFrame | None:
        """Derive the error state from the counters; on a change return its error frame, on bus-off empty the queue."""
        worst = max(self.tec, self.rec)
        if self.tec >= BUS_OFF_LIMIT:
            state = ErrorState.BUS_OFF
        elif worst >= PASSIVE_LIMIT:
            state = ErrorState.PASSIVE
        else:
            state = ErrorState.WARNING if worst >= WARNING_LIMIT else ErrorState.ACTIVE
        if state is self.state:
            return None
        self.state = state
        if state is not ErrorState.BUS_OFF:
            return controller_error_frame(self.tec, self.rec, _controller_bits(state, self.tec >= self.rec))
        self.bus_off_count += 1
        self.lost_by_bus_off += len(self.queue)
        self.queue.clear()
        return bus_off_frame()


def _controller_bits(state: ErrorState, transmit_side: bool) -> int:
    """CAN_ERR_CRTL_* for the state that a node has just entered."""
    if state is ErrorState.ACTIVE:
        return 0x40
    if state is ErrorState.WARNING:
        return 0x08 if transmit_side else 0x04
    return 0x20 if transmit_side else 0x10
