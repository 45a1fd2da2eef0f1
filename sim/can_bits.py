"""A classic CAN frame as bits on the wire: its exact length with stuff bits, and what decides arbitration.

Source: Bosch CAN specification 2.0 (1991), parts A and B; ISO 11898-1.
"""

from __future__ import annotations

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


def _make_crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 7
        for _ in range(8):
            crc = (crc << 1) ^ (_CRC_POLYNOMIAL if crc & 0x4000 else 0)
        table.append(crc & 0x7FFF)
    return tuple(table)


def _make_stuffing_table() -> tuple[int, ...]:
    """For [state << 8 | byte]: stuff bits inserted << 3 | next state; a state is last bit << 2 | its run length - 1."""
    table = []
    for state in range(8):
        for byte in range(256):
            bit, run, stuffed = state >> 2, (state & 3) + 1, 0
            for shift in range(7, -1, -1):
                new = byte >> shift & 1
                run = run + 1 if new == bit else 1
                bit = new
                if run == 5:
                    bit, run, stuffed = 1 - bit, 1, stuffed + 1
            table.append(stuffed << 3 | bit << 2 | run - 1)
    return tuple(table)


_CRC_TABLE = _make_crc_table()
_STUFFING_TABLE = _make_stuffing_table()


def _head_and_data(frame: CanFrame) -> tuple[int, int]:
    """The bits from start of frame to the end of data as an integer (the first bits are 0), and how many they are."""
    can_id, data, extended, remote, _, remote_length = frame
    length = remote_length if remote else len(data)
    if extended:
        # SOF, 11 high bits, SRR and IDE recessive, 18 low bits, RTR, r1 and r0 dominant, DLC.
        head = (can_id >> 18) << 27 | 3 << 25 | (can_id & 0x3FFFF) << 7 | remote << 6 | length
        bits = 39
    else:
        head = can_id << 7 | remote << 6 | length
        bits = 19
    if remote or not data:
        return head, bits
    size = 8 * len(data)
    return head << size | int.from_bytes(data), bits + size


def _with_crc(frame: CanFrame) -> tuple[int, int]:
    """The bits from start of frame to the end of the CRC, unstuffed, and how many they are."""
    value, bits = _head_and_data(frame)
    crc = 0
    # Leading zeros leave a CRC that starts at zero unchanged.
    for byte in value.to_bytes((bits + 7) // 8):
        crc = (crc << 8 ^ _CRC_TABLE[crc >> 7 ^ byte]) & 0x7FFF
    return value << 15 | crc, bits + 15


def frame_bits(frame: CanFrame) -> int:
    """Bit times that a frame takes from start of frame to the end of the intermission, stuff bits counted exactly.

    A standard frame of 8 bytes takes 111 to 135. An error frame as given by SocketCAN is no frame and has no length.
    """
    value, bits = _with_crc(frame)
    # Padding in front with ...0101 inserts no stuff bit, and lets the start of frame begin a run of its own.
    padding = -bits % 8
    value |= (0x55 & (1 << padding) - 1) << bits
    table = _STUFFING_TABLE
    state = 0
    stuffed = 0
    for byte in value.to_bytes((bits + 7) // 8):
        entry = table[state << 8 | byte]
        stuffed += entry >> 3
        state = entry & 7
    return bits + stuffed + _TAIL_BITS


def stuffed_bits(frame: CanFrame) -> str:
    """The bits on the wire from start of frame to the end of the CRC, stuff bits included, as '0' and '1'."""
    value, bits = _with_crc(frame)
    sent: list[str] = []
    for bit in f"{value:0{bits}b}":
        sent.append(bit)
        if sent[-5:] == [bit] * 5:
            sent.append("1" if bit == "0" else "0")
    return "".join(sent)


def arbitration_key(frame: CanFrame) -> int:
    """The arbitration field as a number: of frames that start together the lowest wins (a dominant bit is 0)."""
    can_id, _, extended, remote, _, _ = frame
    if extended:
        return (can_id >> 18) << 21 | 3 << 19 | (can_id & 0x3FFFF) << 1 | remote
    return can_id << 21 | remote << 20
