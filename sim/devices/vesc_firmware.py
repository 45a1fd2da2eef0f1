"""A VESC on CAN and on a serial line, as firmware 7.01 takes and says things, the weak parts included.

A command's length and RTR are not looked at, each set command moves the motor at once and feeds the timeout, and what
a serial payload lacks is read from what lies behind it. Source: vedderb/bldc, comm/comm_can.c, comm/commands.c,
comm/packet.c, timeout.c at 7.01, by what they do.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from sim.can_protocol import CanFrame

# Room for the longest payload, PACKET_MAX_PL_LEN (512) of packet.h, and some bytes.
BUFFER = 520
# APPCONF_SIGNATURE of a firmware's confgenerator.h; the driver skips it.
APPCONF_SIGNATURE = 3264926020
_APPCONF_REST = 300
"""Bytes of the application's settings that follow, of no meaning here."""
KILL_SWITCH_IGNORES_MS = 20
"""For so long after a check that found the kill switch active, commands do not reach the motor."""
# Period of the thread in timeout.c.
CHECK_MS = 10
_F32 = struct.Struct("<f")
_CAN_SET = {
    0: ("set_duty", 1e5),
    1: ("set_current", 1e3),
    2: ("set_brake_current", 1e3),
    3: ("set_erpm", 1.0),
    4: ("set_position", 1e6),
    10: ("set_current_rel", 1e5),
    11: ("set_brake_current_rel", 1e5),
    12: ("set_handbrake", 1e3),
    13: ("set_handbrake_rel", 1e5),
}
_PACKET_SET = {
    5: ("set_duty", 1e5),
    6: ("set_current", 1e3),
    7: ("set_brake_current", 1e3),
    8: ("set_erpm", 1.0),
    9: ("set_position", 1e6),
    10: ("set_handbrake", 1e3),
}


def f32(value: float) -> float:
    """Round to what a 32-bit float holds."""
    return float(_F32.unpack(_F32.pack(value))[0])


@dataclass(slots=True)
class VescValues:
    """Values that the controller measures."""

    t_fet_c: float = 30.0
    t_motor_c: float = 30.0
    current_motor_a: float = 0.0
    current_in_a: float = 0.0
    id_a: float = 0.0
    iq_a: float = 0.0
    duty: float = 0.0
    erpm: float = 0.0
    v_in: float = 24.0
    ah: float = 0.0
    ah_charged: float = 0.0
    wh: float = 0.0
    wh_charged: float = 0.0
    tachometer: int = 0
    tachometer_abs: int = 0
    fault: int = 0
    pid_pos_deg: float = 0.0
    t_mos_c: list[float] = field(default_factory=lambda: [30.0, 30.0, 30.0])
    vd_v: float = 0.0
    vq_v: float = 0.0
    adc1_v: float = 0.0
    adc2_v: float = 0.0
    adc3_v: float = 0.0
    ppm: float = 0.0


def _steps(value: float, scale: float, code: str, number: Callable[[float], float] = f32) -> bytes:
    """Encode a value as the vendor does: multiplied, as a 32-bit float or as `number` says, and cut off toward zero."""
    bits = 8 * struct.calcsize(">" + code)
    low, high = -(1 << bits - 1), (1 << bits - 1) - 1
    return struct.pack(">" + code, min(max(int(number(f32(value) * scale)), low), high))


class Vesc:
    """Model of one VESC controller.

    `pop_calls` returns the commands that reached its motor, by name and value.

    `kill_switch_pin`: its kill switch input. Like `timed_out`, the `kill_switch_active` that it reports is the result
    of the last check of the timeout thread (vedderb/bldc, timeout.c), not the state at the time of the request.
    """

    def __init__(self, controller_id: int, timeout_ms: int = 1000, timeout_brake_current_a: float = 0.0) -> None:
        self.controller_id = controller_id
        self.timeout_ms = timeout_ms
        self.timeout_brake_current_a = timeout_brake_current_a
        self.values = VescValues()
        self.status_ms: dict[int, int] = {}
        self.timed_out = False
        self.kill_switch_pin = False
        self.kill_switch_active = False
        self.fed = 0
        self.last_fed_ms = 0
        self.last_command: tuple[str, float] = ("set_current", 0.0)
        self.firmware = b"\x07\x01" + b"sim\0" + bytes(12) + b"\0\1" + bytes(12)
        self._now_ms = 0
        self._ignores_until_ms = 0
        self._calls: list[tuple[str, float]] = []
        self._fragments = bytearray(BUFFER)
        self._serial = _PacketParser()
        self._serial_out = bytearray()

    def pop_calls(self) -> list[tuple[str, float]]:
        """Return the commands that reached the motor since the last call."""
        calls, self._calls = self._calls, []
        return calls

    def receive(self, frame: CanFrame) -> list[CanFrame]:
        """Take in one CAN frame; return the replies."""
        command, to = frame.can_id >> 8, frame.can_id & 0xFF
        if not frame.extended or frame.error or to not in (self.controller_id, 255):
            return []
        data = frame.data
        if command in _CAN_SET:
            self._set_from_can(command, data)
        elif command == 17:
            # A ping to all is answered with 255 as the sender.
            reply = bytes((to, 0))
            return [CanFrame(18 << 8 | (data[0] if data else 0), reply, extended=True)]
        elif command == 5 and len(data) >= 1:
            self._fragments[data[0] : data[0] + len(data) - 1] = data[1:]
        elif command == 6 and len(data) >= 2:
            at = int.from_bytes(data[:2])
            if at + len(data) - 2 <= BUFFER:
                self._fragments[at : at + len(data) - 2] = data[2:]
        elif command == 8 and len(data) >= 2:
            return self._packet_from_can(data[0], data[1], data[2:])
        elif command == 7:
            sender, mode, length, checksum = struct.unpack(">BBHH", data[:6].ljust(6, b"\0"))
            payload = bytes(self._fragments[:length])
            if len(payload) == length and binascii.crc_hqx(payload, 0) == checksum:
                return self._packet_from_can(sender, mode, payload)
        return []

    def receive_bytes(self, received: bytes) -> tuple[bytes, list[CanFrame]]:
        """Take in bytes from the serial line; return those it answers and the frames it sends on CAN."""
        frames: list[CanFrame] = []
        self._serial_out.clear()
        for payload, behind in self._serial.feed(received):
            reply, forwarded = self._obey(payload, behind)
            frames += forwarded
            if reply is not None:
                self._serial_out += serial_packet(reply)
        return bytes(self._serial_out), frames

    def handle_packet_reply(self, frame: CanFrame) -> bytes:
        """Return the bytes for the serial line after a fragment of another controller's reply to a forwarded packet."""
        command, to = frame.can_id >> 8, frame.can_id & 0xFF
        if not frame.extended or to != self.controller_id:
            return b""
        if command in (5, 6):
            self.receive(frame)
        elif command == 8:
            return serial_packet(frame.data[2:])
        elif command == 7:
            length, checksum = struct.unpack_from(">HH", frame.data, 2)
            payload = bytes(self._fragments[:length])
            if binascii.crc_hqx(payload, 0) == checksum:
                return serial_packet(payload)
        return b""

    def check_timeout(self, now_ms: int) -> float | None:
        """Run the check of every 10 ms; return the brake current (A) that it applies, None while all is well.

        While the kill switch is active the timeout is neither found nor ended, and commands are ignored.
        """
        self._now_ms = now_ms
        expired = 0 < self.timeout_ms < now_ms - self.last_fed_ms
        self.kill_switch_active = self.kill_switch_pin
        if self.kill_switch_active:
            self._ignores_until_ms = now_ms + KILL_SWITCH_IGNORES_MS
        else:
            self.timed_out = expired
        if not (expired or self.kill_switch_active):
            return None
        self.last_command = ("set_brake_current", self.timeout_brake_current_a)
        return self.timeout_brake_current_a

    def step(self, now_ms: int) -> list[CanFrame]:
        """Go through one millisecond; return the status messages that are due."""
        self._now_ms = now_ms
        if now_ms % CHECK_MS == 0:
            self.check_timeout(now_ms)
        return [self.status(number) for number, period in self.status_ms.items() if period and now_ms % period == 0]

    def status(self, number: int) -> CanFrame:
        """Return a status message by its command number."""
        v = self.values
        parts: dict[int, tuple[tuple[float, float, str], ...]] = {
            9: ((v.erpm, 1, "i"), (v.current_motor_a, 10, "h"), (v.duty, 1000, "h")),
            14: ((v.ah, 1e4, "i"), (v.ah_charged, 1e4, "i")),
            15: ((v.wh, 1e4, "i"), (v.wh_charged, 1e4, "i")),
            16: ((v.t_fet_c, 10, "h"), (v.t_motor_c, 10, "h"), (v.current_in_a, 10, "h"), (v.pid_pos_deg, 50, "h")),
            58: ((v.adc1_v, 1000, "h"), (v.adc2_v, 1000, "h"), (v.adc3_v, 1000, "h"), (v.ppm, 1000, "h")),
        }
        if number == 27:
            data = struct.pack(">i", wrapped(v.tachometer)) + _steps(v.v_in, 10, "h", float) + bytes(2)
        else:
            # The status messages are computed in double precision, the packets are not.
            data = b"".join(_steps(value, scale, code, float) for value, scale, code in parts[number])
        return CanFrame(number << 8 | self.controller_id, data, extended=True)

    def reply_values(self, mask: int) -> bytes:
        """Return the bytes of the values that the mask asks for."""
        v = self.values
        status = int(self.timed_out) | self.kill_switch_active << 1
        parts: tuple[Callable[[], bytes], ...] = (
            lambda: _steps(v.t_fet_c, 10, "h"),
            lambda: _steps(v.t_motor_c, 10, "h"),
            lambda: _steps(v.current_motor_a, 100, "i"),
            lambda: _steps(v.current_in_a, 100, "i"),
            lambda: _steps(v.id_a, 100, "i"),
            lambda: _steps(v.iq_a, 100, "i"),
            lambda: _steps(v.duty, 1000, "h"),
            lambda: _steps(v.erpm, 1, "i"),
            lambda: _steps(v.v_in, 10, "h"),
            lambda: _steps(v.ah, 1e4, "i"),
            lambda: _steps(v.ah_charged, 1e4, "i"),
            lambda: _steps(v.wh, 1e4, "i"),
            lambda: _steps(v.wh_charged, 1e4, "i"),
            lambda: struct.pack(">i", wrapped(v.tachometer)),
            lambda: struct.pack(">i", wrapped(v.tachometer_abs)),
            lambda: bytes([v.fault]),
            lambda: _steps(v.pid_pos_deg, 1e6, "i"),
            lambda: bytes([self.controller_id]),
            lambda: b"".join(_steps(each, 10, "h") for each in v.t_mos_c),
            lambda: _steps(v.vd_v, 1000, "i"),
            lambda: _steps(v.vq_v, 1000, "i"),
            # Firmware before 5.03 repeats the mask and does not send it.
            lambda: bytes([status]) if self.firmware[:2] >= b"\x05\x03" else b"",
        )
        return b"".join(part() for bit, part in enumerate(parts) if mask >> bit & 1)

    def _set_from_can(self, command: int, data: bytes) -> None:
        name, scale = _CAN_SET[command]
        with_delay = len(data) >= 6
        if command == 1 and with_delay:
            # This version reads the delay from where its own host writes the current.
            self._delay(data[:2])
            data = data[2:]
        self._set(name, struct.unpack(">i", data[:4].ljust(4, b"\0"))[0], scale)
        if command == 10 and with_delay:
            self._delay(data[4:6])

    def _delay(self, data: bytes) -> None:
        self._calls.append(("current_off_delay", f32(struct.unpack(">h", data)[0] / 1e3)))

    def _set(self, name: str, raw: int, scale: float) -> None:
        value = f32(f32(raw) / f32(scale))
        self._calls.append((name, value))
        # The layer below ignores it; the timeout is fed all the same.
        if self._now_ms >= self._ignores_until_ms:
            self.last_command = (name, value)
        self._feed()

    def _feed(self) -> None:
        self.fed += 1
        self.last_fed_ms = self._now_ms

    def at(self, now_ms: int) -> None:
        """Say what time it is before a frame is given."""
        self._now_ms = now_ms

    def _packet_from_can(self, sender: int, mode: int, payload: bytes) -> list[CanFrame]:
        if mode not in (0, 2):
            return []
        reply, frames = self._obey(payload, b"")
        if reply is None or mode != 0:
            return frames
        return [*frames, *can_packet(sender, self.controller_id, reply, send_mode=1)]

    def _obey(self, payload: bytes, behind: bytes) -> tuple[bytes | None, list[CanFrame]]:
        """Carry out a packet; `behind` is what lies in memory behind it. Returns reply and frames for CAN."""
        command, brake_a = payload[0] if payload else None, self.timeout_brake_current_a
        if command in _PACKET_SET:
            name, scale = _PACKET_SET[command]
            raw = (payload[1:] + behind).ljust(4, b"\0")[:4]
            self._set(name, struct.unpack(">i", raw)[0], scale)
        elif command == 30:
            self._feed()
        elif command == 0:
            return b"\0" + self.firmware, []
        elif command == 4:
            return b"\4" + self.reply_values((1 << 22) - 1), []
        elif command == 17:
            head = struct.pack(">BIBIf", 17, APPCONF_SIGNATURE, self.controller_id, self.timeout_ms, brake_a)
            return head + bytes(_APPCONF_REST), []
        elif command == 50:
            mask = int.from_bytes(payload[1:5].ljust(4, b"\0"))
            return b"\x32" + mask.to_bytes(4) + self.reply_values(mask), []
        elif command == 34 and len(payload) >= 2:
            return None, can_packet(payload[1], self.controller_id, payload[2:], send_mode=0)
        return None, []


def can_packet(to: int, sender: int, payload: bytes, send_mode: int) -> list[CanFrame]:
    """Return a packet in fragments."""
    if len(payload) <= 6:
        return [CanFrame(8 << 8 | to, bytes((sender, send_mode)) + payload, extended=True)]
    frames = [
        CanFrame(5 << 8 | to, bytes([at]) + payload[at : at + 7], extended=True)
        for at in range(0, min(len(payload), 255), 7)
    ]
    first_long = 7 * len(frames)
    frames += [
        CanFrame(6 << 8 | to, at.to_bytes(2) + payload[at : at + 6], extended=True)
        for at in range(first_long, len(payload), 6)
    ]
    end = struct.pack(">BBHH", sender, send_mode, len(payload), binascii.crc_hqx(payload, 0))
    return [*frames, CanFrame(7 << 8 | to, end, extended=True)]


def serial_packet(payload: bytes) -> bytes:
    """Return the bytes of a packet on the serial line."""
    size = bytes((2, len(payload))) if len(payload) < 256 else b"\3" + len(payload).to_bytes(2)
    return size + payload + binascii.crc_hqx(payload, 0).to_bytes(2) + b"\3"


def wrapped(count: int) -> int:
    """Return a count as a signed 32-bit number that wraps."""
    return (count + 2**31) % 2**32 - 2**31


class _PacketParser:
    """Finds packets in bytes; where one does not check, it looks again one byte further on."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def feed(self, received: bytes) -> list[tuple[bytes, bytes]]:
        """Payloads, each with the four bytes behind it."""
        self._bytes += received
        found = []
        while self._bytes:
            size = self._bytes[0]
            if size not in (2, 3):
                del self._bytes[0]
                continue
            if len(self._bytes) < size:
                break
            length = int.from_bytes(self._bytes[1:size])
            if length < (1, 255)[size - 2] or length > 512:
                del self._bytes[0]
                continue
            end = size + length + 3
            if len(self._bytes) < end:
                break
            payload = bytes(self._bytes[size : size + length])
            if self._bytes[end - 1] != 3 or binascii.crc_hqx(payload, 0) != int.from_bytes(
                self._bytes[end - 3 : end - 1]
            ):
                del self._bytes[0]
                continue
            found.append((payload, bytes(self._bytes[size + length : size + length + 4])))
            del self._bytes[:end]
        return found
