"""A serial line (UART, USB adapter, pseudo-terminal, socket): CAN frames tunnelled with COBS framing, or exchanges."""

from __future__ import annotations

import array
import contextlib
import errno
import fcntl
import queue
import socket
import termios
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import serial
from serial.urlhandler import protocol_socket

from drivers.transport.reconnecting import (
    MUTE_AFTER_S,
    Connection,
    LinkMuteError,
    ReconnectingTransport,
    TransmitBusyError,
    TransportCounters,
)
from drivers.types import Exchange, Frame, ReceivedFrame
from firmware_protocol.serial_framing import BITS_PER_BYTE, FrameDecoder, encode_frame

_GONE = (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EIO)
KIND = "serial"
# Chosen: how soon the reading thread notices that the link is to be closed, on CAN too.
READ_TIMEOUT_S = 0.1
# Chosen: longer than a full buffer of the adapter takes to make room for one frame; then the frame is given back to the
# queue.
WRITE_TIMEOUT_S = 0.05
# Chosen: how soon a reply's end is noticed; longer delays the next request, shorter wakes the thread for nothing.
EXCHANGE_READ_S = 0.002
# Above the longest packet of a VESC, 512 bytes and its frame: what is longer is noise.
_LONGEST_REPLY = 600
_FULL = "the line accepts no more bytes; check that the other end reads"
_DELIMITER = b"\0"
_TCP, _UNIX = "socket://", "unix://"
# Chosen: longer than a connection over a radio link takes.
_CONNECT_S = 5.0


def create_transport(
    *,
    port: str = "/dev/ttyUSB0",
    baud: int = 921_600,
    dtr: bool = False,
    rts: bool = False,
    exchange: Exchange | None = None,
    **_of_other_media: Any,
) -> ReconnectingTransport:
    """Make a link over a serial port by the fields of robot.toml's [link]; `baud` in bit/s.

    `exchange`: how its driver speaks; None in frames tunnelled.
    """
    medium = SerialMedium(port, baud, dtr, rts, exchange)
    return ReconnectingTransport(medium, mute_after_s=MUTE_AFTER_S, carries_packets=exchange is not None)


@dataclass(frozen=True, slots=True)
class SerialMedium:
    """A serial port by its device name or pyserial URL, at `baud` bit/s, 8 data bits, no parity, 1 stop bit.

    `unix://PATH` is a serial line over a Unix socket. `dtr`, `rts`: the levels of these lines while the port is open.
    """

    port: str
    baud: int
    dtr: bool = False
    rts: bool = False
    exchange: Exchange | None = None

    @property
    def name(self) -> str:
        """Name of the port with its speed."""
        return f"serial {self.port} at {self.baud} Bd"

    def connect(self, counters: TransportCounters) -> Connection:
        """Open the port for this process alone. Raises what pyserial raises."""
        timeout_s = READ_TIMEOUT_S if self.exchange is None else EXCHANGE_READ_S
        port = open_port(self, timeout_s=timeout_s, write_timeout_s=WRITE_TIMEOUT_S, exclusive=True)
        request_low_latency(port)
        if self.exchange is not None:
            return ExchangeConnection(port, counters, self.exchange)
        return SerialConnection(port, counters)

    def explain(self, error: Exception) -> str:
        """Say in one line what the error means and what to do."""
        if isinstance(error, LinkMuteError):
            return (
                f"{self.port}: {error}; check that the robot is switched on and that this is its port. The numbers of "
                "adapters change: use the name in /dev/serial/by-id. Some USB boards send only with link.dtr = true"
            )
        return explain_port(self.port, error)


class SerialConnection:
    """An open serial port; satisfies `drivers.transport.reconnecting.Connection`."""

    def __init__(self, port: serial.Serial, counters: TransportCounters) -> None:
        self._port = port
        self._counters = counters
        self._decoder = FrameDecoder()
        self._malformed = 0
        # The other end may hold half a frame of whoever wrote before; the delimiter ends it.
        self._line_is_clean = False

    def read(self) -> Sequence[ReceivedFrame]:
        """Wait 0.1 s at most for bytes; a frame's time stamp is when its last byte was read. Raises when unplugged."""
        received = self._port.read(max(1, self._port.in_waiting))
        t_ns = time.monotonic_ns()
        if not received:
            return ()
        frames = self._decoder.feed(received)
        malformed = self._decoder.stats.malformed
        self._counters.add(malformed=malformed - self._malformed)
        self._malformed = malformed
        return [ReceivedFrame(t_ns, Frame(can_id, data)) for can_id, data in frames]

    def write(self, frame: Frame) -> None:
        """Send one frame, waiting 0.05 s at most; raises TransmitBusyError if the line takes no more."""
        encoded = encode_frame(frame.can_id, frame.data)
        try:
            self._port.write(encoded if self._line_is_clean else _DELIMITER + encoded)
        except serial.SerialTimeoutException as error:
            self._line_is_clean = False
            raise TransmitBusyError(_FULL) from error
        self._line_is_clean = True

    def close(self) -> None:
        """Close the serial port."""
        self._port.close()


class ExchangeConnection:
    """An open serial port with one request at a time under way; satisfies `drivers.transport.reconnecting.Connection`.

    Who writes also waits for the reply: the next request leaves when that is there or will not come any more. After one
    that did not come, nothing is said for `exchange.quiet_s`, and what comes until then belongs to nobody.
    """

    def __init__(self, port: serial.Serial, counters: TransportCounters, exchange: Exchange) -> None:
        self._port = port
        self._counters = counters
        self._exchange = exchange
        self._replies: queue.SimpleQueue[ReceivedFrame] = queue.SimpleQueue()
        # Whoever held the port before may have left half a packet, and half a reply.
        self._quiet_until_ns = 0
        self._rest()

    def read(self) -> Sequence[ReceivedFrame]:
        """Wait 0.1 s at most for a reply; its time stamp is when its last byte was read."""
        try:
            return [self._replies.get(timeout=READ_TIMEOUT_S)]
        except queue.Empty:
            return ()

    def write(self, frame: Frame) -> None:
        """Send one request and wait for its reply, which `read` returns. Raises when unplugged."""
        reply = self.exchange(frame)
        if reply is not None:
            self._replies.put(ReceivedFrame(time.monotonic_ns(), reply))

    def exchange(self, frame: Frame, timeout_s: float | None = None) -> Frame | None:
        """Send one request and wait for its reply; one that does not come in the protocol's time, or this, is counted.

        Raises TransmitBusyError if the line takes no more, and what pyserial raises when unplugged.
        """
        left_ns = self._quiet_until_ns - time.monotonic_ns()
        if left_ns > 0:
            time.sleep(left_ns * 1e-9)
        self._port.reset_input_buffer()
        request = self._exchange.request(frame)
        try:
            self._port.write(request)
        except serial.SerialTimeoutException as error:
            self._rest()
            raise TransmitBusyError(_FULL) from error
        if not self._exchange.is_answered(frame):
            return None
        reply = self._wait_for_reply(frame, len(request), timeout_s or self._exchange.timeout_s)
        if reply is None:
            self._rest()
        return reply

    def close(self) -> None:
        """Close the serial port."""
        self._port.close()

    def _rest(self) -> None:
        self._quiet_until_ns = time.monotonic_ns() + round(self._exchange.quiet_s * 1e9)

    def _wait_for_reply(self, frame: Frame, sent_bytes: int, timeout_s: float) -> Frame | None:
        received = b""
        byte_s = BITS_PER_BYTE / self._port.baudrate
        deadline = time.monotonic() + timeout_s + sent_bytes * byte_s
        latest = deadline + _LONGEST_REPLY * byte_s
        while time.monotonic() < deadline and len(received) <= _LONGEST_REPLY:
            more = self._port.read(max(1, self._port.in_waiting))
            if not more:
                continue
            # What is still on its way when bytes come is no reason to give up.
            deadline = min(max(deadline, time.monotonic() + self._exchange.quiet_s), latest)
            received += more
            reply = self._exchange.reply(frame, received)
            if reply is not None:
                return reply
        self._counters.add(**{"malformed" if received else "receive_errors": 1})
        return None


class SocketPort(protocol_socket.Serial):  # type: ignore[misc]  # pyserial has no types
    """A serial line over a socket, as serial servers and emulators have it: `socket://HOST:PORT` or `unix://PATH`.

    pyserial's own, which has no Unix sockets and never knows of more than one waiting byte: a call a byte.
    """

    _socket: socket.socket | None

    def open(self) -> None:
        """Connect to the socket of the line. Raises `serial.SerialException`."""
        if not self.portstr.startswith(_UNIX):
            super().open()
            return
        line = socket.socket(socket.AF_UNIX)
        line.settimeout(_CONNECT_S)
        try:
            line.connect(self.portstr.removeprefix(_UNIX))
        except OSError as error:
            line.close()
            raise serial.SerialException(f"could not connect: {error}") from error
        line.setblocking(False)
        self.logger, self._socket, self.is_open = None, line, True

    @property
    def in_waiting(self) -> int:
        """Bytes that have come and were not read."""
        if self._socket is None:
            raise serial.PortNotOpenError
        count = array.array("i", [0])
        fcntl.ioctl(self._socket, termios.FIONREAD, count)
        return count[0]

    def close(self) -> None:
        """Disconnect from the line; safe to call twice."""
        line, self._socket, self.is_open = self._socket, None, False
        if line is not None:
            line.close()


def open_port(medium: SerialMedium, *, timeout_s: float, write_timeout_s: float, exclusive: bool) -> serial.Serial:
    """Open the port with its lines as `medium` says. Raises what pyserial raises.

    The lines are set before it is opened: pyserial would raise both, and boards that take that as a reset restart.
    """
    if medium.port.startswith((_TCP, _UNIX)):
        port = SocketPort(baudrate=medium.baud)
        port.port = medium.port
    else:
        port = serial.serial_for_url(medium.port, do_not_open=True, baudrate=medium.baud)
    port.timeout, port.write_timeout, port.exclusive = timeout_s, write_timeout_s, exclusive
    port.dtr, port.rts = medium.dtr, medium.rts
    port.open()
    return port


def request_low_latency(port: serial.Serial) -> None:
    """Ask for delivery byte by byte: FTDI adapters otherwise hold received bytes back for 16 ms."""
    # Pseudo-terminals, CDC-ACM and network ports have no such mode, and no latency timer either.
    with contextlib.suppress(AttributeError, ValueError, OSError, NotImplementedError):
        port.set_low_latency_mode(True)


def error_number(error: BaseException) -> int | None:
    """Return the errno of an error or of what caused it; python-can and pyserial hide it in several places."""
    seen: BaseException | None = error
    while seen is not None:
        for attribute in ("error_code", "errno"):
            number = getattr(seen, attribute, None)
            if isinstance(number, int):
                return number
        seen = seen.__cause__ or seen.__context__
    return None


def explain_port(port: str, error: BaseException) -> str:
    """Say what went wrong with a serial port and what to do about it."""
    number = error_number(error)
    if port.startswith((_TCP, _UNIX)) and number in (*_GONE, errno.ECONNREFUSED):
        return f"{port}: nothing listens there; start the serial server or the emulator, or correct the port"
    if number in _GONE:
        return f"{port}: no such device; plug the adapter in, or correct the port (ls /dev/serial/by-id shows them)"
    if number in (errno.EACCES, errno.EPERM):
        return f"{port}: permission denied; run: sudo usermod -aG dialout $USER, then log in again"
    if number in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in str(error):
        return f"{port}: in use by another program; stop it (sudo fuser {port} shows which)"
    return f"{port}: {plain(error)}"


def plain(error: BaseException) -> str:
    """Return an error's own text, with that of its cause where it has one."""
    text = str(error) or type(error).__name__
    cause = error.__cause__
    return f"{text} ({cause})" if cause is not None and str(cause) else text
