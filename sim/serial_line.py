"""A serial line to the virtual robot: a pseudo-terminal that takes its time as a UART does.

Linux pseudo-terminals carry bytes at once whatever baud rate is set; here a frame arrives when its last bit has passed,
one that the host does not take in time is lost, and with different baud rates at the two ends only garbage arrives.
A frame from the host in which a fault turns a bit is counted as garbled and lost, as the framing's CRC-16 sees it.
"""

from __future__ import annotations

import errno
import os
import random
import select
import termios
import tty
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.types import Frame, ReceivedFrame
from firmware_protocol.serial_framing import BITS_PER_BYTE, FrameDecoder, encode_frame
from sim import ROBOT_NODE, LinkFaultError
from sim.bus import UNHARMED, BusFault, FrameOutcome
from sim.can_protocol import CanFrame, candump_line

# Chosen: below the 5 % or so at which a UART misses the stop bit.
BAUD_TOLERANCE = 0.03
# Chosen: above what a line brings between two reads.
READ_BYTES = 4096

_BAUD_OF_CODE = {
    getattr(termios, name): int(name[1:]) for name in dir(termios) if name.startswith("B") and name[1:].isdigit()
}
_HANG_UP = select.POLLHUP | select.POLLERR


class SerialPathError(Exception):
    """The path for the link to the port cannot be used; the message is one line for the user."""


@dataclass(slots=True)
class SerialLineStats:
    """Counters since the line was made; bytes that were dropped are under `bytes_lost`."""

    opened: int = 0
    frames_in: int = 0
    frames_out: int = 0
    bytes_lost: int = 0
    garbled_bytes: int = 0


class SerialLine:
    """The robot's end of the line; satisfies `sim.RobotLink`.

    `path` becomes a symbolic link to the port that a host opens; None leaves the port under its own name (`port`).
    `baud` is the robot's rate in bit/s (8 data bits, no parity, 1 stop bit).
    `log` gets a line for each frame whose last bit has passed, in either direction, as candump writes it.
    `framed`: whether the line carries frames in the reference protocol's framing; otherwise what comes goes on as it
    is, each piece as the data of a frame. `connected`: whether a host has the port open.
    Raises SerialPathError if `path` is taken by anything but a link to a terminal.
    """

    def __init__(
        self,
        path: Path | None,
        now_ns: int,
        *,
        baud: int = 921_600,
        log: Callable[[str], object] | None = None,
        framed: bool = True,
    ) -> None:
        self.stats = SerialLineStats()
        self._path = path
        self._baud = baud
        self._byte_ns = BITS_PER_BYTE * 1_000_000_000 // baud
        self._now_ns = now_ns
        self._plug_in_ns: int | None = None
        self._noise = random.Random(0)
        self._decoder = FrameDecoder()
        self._framed = framed
        self._waiting: deque[tuple[Frame, int]] = deque()
        self._to_robot: deque[ReceivedFrame] = deque()
        self._to_host: deque[tuple[int, bytes, Frame]] = deque()
        self._master = -1
        self.connected = False
        self._fault: BusFault | None = None
        self._log = log
        self._poll = select.poll()
        self.port = ""
        self._plug_in()

    @property
    def address(self) -> str:
        """The port to open."""
        return f"serial {self._path or self.port} at {self._baud} Bd"

    @property
    def error_counters(self) -> tuple[int, int]:
        """A serial line has none."""
        return 0, 0

    def filenos(self) -> list[int]:
        """Return the terminal while a host has it open: a closed one stays readable for ever."""
        return [self._master] if self.connected else []

    def next_event_ns(self) -> int | None:
        """Return when the next frame has passed or the line is plugged in again."""
        times = [self._plug_in_ns] if self._plug_in_ns is not None else []
        if self._to_robot:
            times.append(self._to_robot[0].t_ns)
        if self._to_host:
            times.append(self._to_host[0][0])
        return min(times) if times else None

    def collect(self, now_ns: int) -> int:
        """Notice a host that opens or closes the port, and read what it wrote."""
        if self._plug_in_ns is not None and now_ns >= self._plug_in_ns:
            self._plug_in()
        if self._master >= 0:
            events = self._poll.poll(0)
            flags = events[0][1] if events else 0
            if flags & select.POLLIN:
                # Also after the host has closed: what it wrote before, an e-stop perhaps, is on the line.
                self._read()
            if bool(flags & _HANG_UP) == self.connected:
                self._set_connected(not self.connected)
        return len(self._waiting)

    def advance(self, now_ns: int, admit: int | None = None) -> list[ReceivedFrame]:
        """Let frames pass in both directions up to `now_ns`."""
        for _ in range(len(self._waiting) if admit is None else admit):
            frame, size = self._waiting.popleft()
            outcome = self._outcome("host", frame)
            if outcome.wire_error_bit is not None:
                self.stats.garbled_bytes += 1
                continue
            if outcome.data is not None:
                frame = Frame(frame.can_id, outcome.data)
            for _ in range(0 if outcome.lost or ROBOT_NODE in outcome.lost_at else outcome.copies):
                begin_ns = max(now_ns, self._to_robot[-1].t_ns) if self._to_robot else now_ns
                self._to_robot.append(ReceivedFrame(begin_ns + outcome.delay_ns + size * self._byte_ns, frame))
        self._now_ns = now_ns
        while self._to_host and self._to_host[0][0] <= now_ns:
            end_ns, encoded, frame = self._to_host.popleft()
            self._write(encoded)
            self._note(end_ns, frame)
        received: list[ReceivedFrame] = []
        while self._to_robot and self._to_robot[0].t_ns <= now_ns:
            received.append(self._to_robot.popleft())
            self._note(received[-1].t_ns, received[-1].frame)
        return received

    def send(self, frames: Sequence[Frame]) -> None:
        """Put the robot's frames on the line, one after the other."""
        if not self.connected:
            return
        for frame in frames:
            outcome = self._outcome(ROBOT_NODE, frame)
            data = frame.data if outcome.data is None else outcome.data
            encoded = _damaged(self._encoded(frame.can_id, data), outcome)
            for _ in range(0 if outcome.lost else outcome.copies):
                begin_ns = max(self._now_ns, self._to_host[-1][0]) if self._to_host else self._now_ns
                self._to_host.append((begin_ns + outcome.delay_ns + len(encoded) * self._byte_ns, encoded, frame))
            self.stats.frames_out += 1

    def unplug(self, until_ns: int) -> None:
        """Take the port away, as a USB adapter that is pulled; a new one appears at `until_ns`."""
        if self._master >= 0:
            self._set_connected(False)
            os.close(self._master)
            self._master = -1
            self._remove_link()
        self._waiting.clear()
        self._to_robot.clear()
        self._plug_in_ns = until_ns

    def force_bus_off(self, who: str) -> None:
        """Raise LinkFaultError, because a serial line has no bus-off."""
        raise LinkFaultError(f"bus_off {who}: a serial line has no bus-off")

    def babble(self, frame: Frame) -> None:
        """Nobody else is on a serial line."""
        raise LinkFaultError(f"babble {frame.can_id:#x}: a serial line has two ends only")

    def set_bus_fault(self, fault: BusFault) -> None:
        """Let `fault` decide what becomes of each frame; a delayed one holds up those behind it."""
        self._fault = fault

    def summary(self) -> str:
        """Counters in one line."""
        return f"{self.stats} {self._decoder.stats}"

    def close(self) -> None:
        """Remove the port and the link to it."""
        self.unplug(self._now_ns)

    def _note(self, t_ns: int, frame: Frame) -> None:
        if self._log is not None:
            self._log(candump_line(t_ns, "serial", CanFrame(frame.can_id, frame.data)))

    def _outcome(self, sender: str, frame: Frame) -> FrameOutcome:
        if self._fault is None:
            return UNHARMED
        return self._fault.outcome(self._now_ns, sender, CanFrame(frame.can_id, frame.data))

    def _plug_in(self) -> None:
        self._plug_in_ns = None
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.fchmod(slave, 0o600)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(slave)
        # A terminal that was never open looks open; once closed it says so.
        os.close(slave)
        self._poll = select.poll()
        self._poll.register(self._master, select.POLLIN)
        if self._path is not None:
            self._create_link(self._path)

    def _set_connected(self, connected: bool) -> None:
        self.connected = connected
        if connected:
            self.stats.opened += 1
            return
        # What this host left unread or half written is not for the next one; only the port's own end can drop it.
        self._to_host.clear()
        slave = os.open(self.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        termios.tcflush(slave, termios.TCIFLUSH)
        os.close(slave)
        self._decoder.feed(b"\0")

    def _read(self) -> None:
        try:
            received = os.read(self._master, READ_BYTES)
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EIO):
                raise
            return
        if self._baud_differs():
            self.stats.garbled_bytes += len(received)
            received = self._garbled(received)
        for can_id, data in self._decoder.feed(received) if self._framed else ((0, received),):
            self.stats.frames_in += 1
            self._waiting.append((Frame(can_id, data), len(self._encoded(can_id, data))))

    def _encoded(self, can_id: int, data: bytes) -> bytes:
        return encode_frame(can_id, data) if self._framed else data

    def _write(self, encoded: bytes) -> None:
        if self._baud_differs():
            self.stats.garbled_bytes += len(encoded)
            encoded = self._garbled(encoded)
        try:
            written = os.write(self._master, encoded)
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EIO):
                raise
            written = 0
        self.stats.bytes_lost += len(encoded) - written

    def _baud_differs(self) -> bool:
        host_baud = _BAUD_OF_CODE.get(termios.tcgetattr(self._master)[5], self._baud)
        return abs(host_baud - self._baud) > BAUD_TOLERANCE * self._baud

    def _garbled(self, data: bytes) -> bytes:
        return bytes(self._noise.randrange(256) for _ in data)

    def _create_link(self, path: Path) -> None:
        if path.is_symlink():
            if not os.readlink(path).startswith("/dev/pts/"):
                raise SerialPathError(f"{path}: links to something else; remove it or choose another path")
        elif path.exists():
            raise SerialPathError(f"{path}: exists and is no link to a port; remove it or choose another path")
        fresh = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            fresh.symlink_to(self.port)
            fresh.replace(path)
        except OSError as error:
            raise SerialPathError(f"{path}: cannot be made ({error.strerror}); choose another path") from None

    def _remove_link(self) -> None:
        if self._path is not None and self._path.is_symlink() and os.readlink(self._path) == self.port:
            self._path.unlink()


def _damaged(encoded: bytes, outcome: FrameOutcome) -> bytes:
    """Return the bytes of an encoded frame that reach the other end: all, one bit turned, or its beginning."""
    if outcome.wire_error_bit is None:
        return encoded
    place = outcome.wire_error_bit % (8 * len(encoded))
    if outcome.cut:
        return encoded[: place // 8]
    damaged = bytearray(encoded)
    damaged[place // 8] ^= 1 << place % 8
    return bytes(damaged)
