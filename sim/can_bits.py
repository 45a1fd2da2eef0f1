"""A classic CAN frame as bits on the wire: its exact length with stuff bits, and what decides arbitration.

Source: Bosch CAN specification 2.0 (1991), parts A and B; ISO 11898-1.
"""

from __future__ import annotations

from functools import lru_cache

from sim.can_frame import CanFrame

INTERFRAME_BITS = 3
"""Intermission: recessive bits between the end of a frame and the next start of frame."""
ACK_AND_END_BITS = 9
"""ACK slot, ACK delimiter and end of frame: sent after the CRC delimiter, never stuffed."""
ERROR_FLAG_BITS = 6
ERROR_DELIMITER_BITS = 8

_CRC_DELIMITER_BITS = 1
_TAIL_BITS = _CRC_DELIMITER_BITS + ACK_AND_END_BITS + INTERFRAME_BITS
_CRC_POLYNOMIAL = 0x4599
_CRC_BITS = 15


def _make_crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 7
        for _ in range(8):
            crc = (crc << 1) ^ (_CRC_POLYNOMIAL if crc & 0x4000 else 0)
        table.append(crc & 0x7FFF)
    return tuple(table)


def _make_stuffing_table(bits: int) -> tuple[int, ...]:
    """What `bits` more bits do, for [state << bits | value]: next state << 8 | stuff bits inserted.

    A state is the last bit << 2 | the length of its run - 1.
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


_CRC_TABLE = _make_crc_table()
_STUFFING_8 = _make_stuffing_table(8)
_STUFFING_7 = _make_stuffing_table(7)


def _head(can_id: int, extended: bool, remote: bool, length: int) -> tuple[int, int]:
    """The bits from start of frame to the length code as an integer (the first bits are 0), and how many they are."""
    if extended:
        # SOF, 11 high bits, SRR and IDE recessive, 18 low bits, RTR, r1 and r0 dominant, DLC.
        return (can_id >> 18) << 27 | 3 << 25 | (can_id & 0x3FFFF) << 7 | remote << 6 | length, 39
    return can_id << 7 | remote << 6 | length, 19


@lru_cache(maxsize=4096)
def _after_head(can_id: int, extended: bool, remote: bool, length: int) -> tuple[int, int, int]:
    """Where CRC and stuffing are after the head, which few frames do not share: bits, CRC, state << 8 | stuff bits."""
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
    """The bits on the wire from start of frame to the end of the CRC, stuff bits included, as '0' and '1'."""
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
    """The arbitration field as a number: of frames that start together the lowest wins (a dominant bit is 0)."""
    can_id = frame.can_id
    if frame.extended:
        return (can_id >> 18) << 21 | 3 << 19 | (can_id & 0x3FFFF) << 1 | frame.remote
    return can_id << 21 | frame.remote << 20
