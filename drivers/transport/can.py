"""Any CAN bus that python-can can open: classic frames with 11-bit identifiers."""

from __future__ import annotations

import errno
import socket
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import can

from drivers.transport.can_errors import decode_error_frame
from drivers.transport.counters import Counters
from drivers.transport.explain import error_number, explain_can
from drivers.transport.own_frames import OwnFrames
from drivers.transport.reconnecting import LinkLostError, LinkMuteError, TransmitBusyError
from drivers.types import Frame, ReceivedFrame
from firmware_protocol.serial_framing import MAX_CAN_ID, MAX_DATA

READ_TIMEOUT_S = 0.1
WRITE_TIMEOUT_S = 0.05
MAX_STAMP_AGE_S = 1.0
GARBAGE_LIMIT = 50
_INTERFACE_UP_FLAG = 0x1
_PROBE_TIMEOUT_S = 1.0
_ECHO_OPTION = "receive_own_messages"
_ECHOING_INTERFACES = frozenset({"udp_multicast"})


@dataclass(frozen=True, slots=True)
class CanMedium:
    """A CAN bus by python-can's interface name: "socketcan", "slcan", "unixcan", "virtual" and all others.

    `bitrate` is in bit/s; a socketcan interface has its own, set by `ip link`. `options` go to the python-can interface
    as they are.
    """

    interface: str
    channel: str
    bitrate: int
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Interface and channel."""
        return f"{self.interface} {self.channel}"

    def connect(self, counters: Counters) -> CanConnection:
        """Open the bus. Raises what python-can raises, LinkLostError for a socketcan interface that cannot work yet."""
        options: dict[str, Any] = {}
        if self.interface == "socketcan":
            require_working_interface(self.channel)
        else:
            options["bitrate"] = self.bitrate
        if self.interface == "slcan":
            # Its default is two seconds for boards that restart when the port opens; it polls at 1 kHz as well.
            options |= {"sleep_after_open": 0.0, "timeout": READ_TIMEOUT_S}
        options |= self.options
        if self.interface == "socketcand":
            require_server(str(options["host"]), int(options["port"]))
        # Without ignore_config a file in the user's home could change what is opened.
        bus = can.Bus(interface=self.interface, channel=self.channel, ignore_config=True, **options)
        echoes = self.interface in _ECHOING_INTERFACES or bool(self.options.get(_ECHO_OPTION))
        return CanConnection(bus, counters, OwnFrames() if echoes else None)

    def explain(self, error: Exception) -> str:
        """Say in one line what the error means and what to do."""
        if isinstance(error, LinkMuteError):
            where = "the adapter (its number may have changed: name it as in /dev/serial/by-id)"
            return f"{self.name}: {error}; check the robot's power, the bit rate and {where}"
        if isinstance(error, LinkLostError):
            return f"{self.name}: {error}"
        return explain_can(self.interface, self.channel, self.bitrate, error)


class CanConnection:
    """An open python-can bus; satisfies `drivers.transport.reconnecting.Connection`.

    Whether a frame "is_rx" is not asked: on a virtual CAN every frame of another local process says it is not.
    """

    def __init__(self, bus: can.BusABC, counters: Counters, own: OwnFrames | None = None) -> None:
        """`own`: of a bus that hands a sender its own frames, which then are not received."""
        self._bus = bus
        self._counters = counters
        self._own = own
        self._garbage = 0

    def read(self) -> Sequence[ReceivedFrame]:
        """Wait 0.1 s at most for a frame; raises LinkLostError at bus-off, and what python-can raises."""
        try:
            message = self._bus.recv(READ_TIMEOUT_S)
        except (ValueError, IndexError) as error:
            self._take_garbage(error)
            return ()
        except can.CanError as error:
            # slcan: a byte that is no text makes every later call fail until the buffer is flushed.
            if not isinstance(error.__cause__, ValueError):
                raise
            self._take_garbage(error)
            return ()
        if message is None:
            return ()
        now_ns, wall_now_ns = time.monotonic_ns(), time.time_ns()
        if message.is_error_frame:
            self._take_error_frame(message)
            return ()
        data = bytes(message.data)
        if (
            message.is_extended_id
            or message.is_remote_frame
            or message.is_fd
            or message.arbitration_id > MAX_CAN_ID
            or len(data) > MAX_DATA
            or len(data) != message.dlc
        ):
            self._counters.add(malformed=1)
            return ()
        self._garbage = 0
        frame = Frame(message.arbitration_id, data)
        if self._own is not None and self._own.is_echo(now_ns, frame):
            return ()
        return (ReceivedFrame(monotonic_stamp_ns(message.timestamp, wall_now_ns, now_ns), frame),)

    def write(self, frame: Frame) -> None:
        """Send one frame, waiting 0.05 s at most; raises TransmitBusyError if there was no room."""
        message = can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False, check=True)
        if self._own is not None:
            self._own.sent(time.monotonic_ns(), frame)
        try:
            self._bus.send(message, timeout=WRITE_TIMEOUT_S)
        except (can.CanError, OSError) as error:
            if self._own is not None:
                self._own.not_sent(frame)
            if is_busy(error):
                raise TransmitBusyError(str(error)) from error
            raise

    def close(self) -> None:
        """Shut the bus down; may raise what python-can raises on a device that is gone."""
        try:
            self._bus.shutdown()
        finally:
            # slcan gives up before it closes the port, and a tty still held comes back under another name.
            port = getattr(self._bus, "serialPortOrig", None)
            if port is not None:
                port.close()

    def _take_garbage(self, error: Exception) -> None:
        flush = getattr(self._bus, "flush", None)
        if flush is not None:
            flush()
        self._counters.add(malformed=1)
        self._garbage += 1
        if self._garbage >= GARBAGE_LIMIT:
            raise LinkLostError(
                f"nothing but garbage arrives ({error}); check the adapter's firmware and serial speed"
            ) from error

    def _take_error_frame(self, message: can.Message) -> None:
        bus_error = decode_error_frame(message.arbitration_id, bytes(message.data))
        self._counters.add(
            bus_off=int(bus_error.bus_off),
            bus_errors=int(bus_error.harmful and not bus_error.bus_off),
            receive_overflow=int(bus_error.receive_overflow),
        )
        if bus_error.bus_off:
            raise LinkLostError(f"{bus_error.text}; check wiring, termination and bit rate")


def monotonic_stamp_ns(timestamp_s: float, wall_now_ns: int, now_ns: int) -> int:
    """Turn python-can's stamp of a frame (seconds, the wall clock where the kernel stamps) into monotonic nanoseconds.

    The wall clock is read together with the monotonic one on reception, so a later step of it does no harm. A stamp
    that is not of the last second is of another clock (or the clock was stepped): then the reception counts.
    """
    age_ns = wall_now_ns - round(timestamp_s * 1e9)
    if 0 <= age_ns <= MAX_STAMP_AGE_S * 1e9:
        return now_ns - age_ns
    return now_ns


def is_busy(error: Exception) -> bool:
    """Tell whether a send failed only for want of room in a queue, so that a later attempt may succeed."""
    if error_number(error) == errno.ENOBUFS or isinstance(error, TimeoutError):
        return True
    seen: BaseException | None = error
    while seen is not None:
        # socketcan has no error number for a full socket buffer, pyserial none for a write timeout.
        if "Transmit buffer full" in str(seen) or "Write timeout" in str(seen):
            return True
        seen = seen.__cause__
    return False


def require_server(host: str, port: int) -> None:
    """Raise OSError where nothing listens; python-can would try again without a pause for ten seconds."""
    socket.create_connection((host, port), _PROBE_TIMEOUT_S).close()


def require_working_interface(channel: str, sysfs: Path = Path("/sys/class/net")) -> None:
    """Refuse a socketcan interface on which nothing can be sent: one that is absent, down, or in bus-off.

    After bus-off the kernel swallows what is sent without an error, so an open socket there says nothing.
    Raises OSError (ENODEV, ENETDOWN) or LinkLostError.
    """
    try:
        socket.if_nametoindex(channel)
    except OSError:
        raise OSError(errno.ENODEV, "no such CAN interface") from None
    try:
        up = int((sysfs / channel / "flags").read_text(), 16) & _INTERFACE_UP_FLAG
        carrier = (sysfs / channel / "carrier").read_text().strip() != "0" if up else False
    except (OSError, ValueError):
        return
    if not up:
        raise OSError(errno.ENETDOWN, "the interface is down")
    if not carrier:
        raise LinkLostError(
            f"the interface is in bus-off; check wiring, termination and bit rate, then run: "
            f"sudo ip link set {channel} type can restart (or set it up with restart-ms 100)"
        )
