"""The virtual robot on any bus that python-can can open: a virtual CAN interface, an adapter, another hub."""

from __future__ import annotations

import contextlib
import sys
from collections import deque
from collections.abc import Sequence
from typing import Any

import can

from drivers.types import Frame, ReceivedFrame
from sim import LinkFaultError
from sim.bus import BusFault

# Chosen: soon enough for an adapter that is plugged in again, and no load while it is away.
RETRY_NS = 500_000_000
# Chosen: a flood of frames must not hold up the plant's steps.
MAX_FRAMES_PER_READ = 64


class PythonCanLink:
    """A node on `interface` `channel`; satisfies `sim.RobotLink`. It opens the bus again when that breaks.

    `options`: what else the interface takes.
    A frame counts as received when it is read. Raises `can.CanError`, OSError or ValueError if it cannot be opened.
    """

    def __init__(self, interface: str, channel: str, now_ns: int, *, bitrate: int = 500_000, **options: Any) -> None:
        self._interface = interface
        self._options = options
        self._channel = channel
        self._bitrate = bitrate
        self._now_ns = now_ns
        self._retry_ns: int | None = None
        self._waiting: deque[Frame] = deque()
        self.frames_in = 0
        self.frames_out = 0
        self.ignored = 0
        self.errors = 0
        self.send_failures = 0
        self._bus: can.BusABC | None = self._open()

    @property
    def address(self) -> str:
        """Address as interface and channel."""
        return f"{self._interface} {self._channel}"

    @property
    def error_counters(self) -> tuple[int, int]:
        """Not known through python-can."""
        return 0, 0

    def filenos(self) -> list[int]:
        """Return the bus's descriptor where it has one; without it the bus is looked at in every step."""
        with contextlib.suppress(NotImplementedError, can.CanError, OSError):
            if self._bus is not None:
                descriptor = self._bus.fileno()
                return [descriptor] if descriptor >= 0 else []
        return []

    def next_event_ns(self) -> int | None:
        """Return when the bus is opened again."""
        return self._retry_ns

    def collect(self, now_ns: int) -> int:
        """Read what has come."""
        self._now_ns = now_ns
        if self._retry_ns is not None and now_ns >= self._retry_ns:
            self._reopen(now_ns)
        for _ in range(MAX_FRAMES_PER_READ):
            message = self._receive()
            if message is None:
                break
            if message.is_error_frame or message.is_remote_frame or message.is_fd:
                self.ignored += 1
                continue
            self.frames_in += 1
            self._waiting.append(Frame(message.arbitration_id, bytes(message.data), message.is_extended_id))
        return len(self._waiting)

    def advance(self, now_ns: int, admit: int | None = None) -> list[ReceivedFrame]:
        """Hand over the oldest `admit` frames (None: all)."""
        self._now_ns = now_ns
        count = len(self._waiting) if admit is None else admit
        return [ReceivedFrame(now_ns, self._waiting.popleft()) for _ in range(count)]

    def send(self, frames: Sequence[Frame]) -> None:
        """Send frames without waiting; what the bus does not take is counted and lost."""
        for frame in frames:
            if self._bus is None:
                self.send_failures += 1
                continue
            try:
                self._bus.send(
                    can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=frame.extended), timeout=0
                )
                self.frames_out += 1
            except (can.CanError, OSError) as error:
                self.send_failures += 1
                if "buffer" not in str(error).lower():
                    self._lose(error)

    def unplug(self, until_ns: int) -> None:
        """Leave the bus until then."""
        self._shut_down()
        self._waiting.clear()
        self._retry_ns = until_ns

    def force_bus_off(self, who: str) -> None:
        """Raise LinkFaultError, because a controller cannot be made to fail through python-can."""
        raise LinkFaultError(f"bus_off {who}: only on the simulator's own bus (interface unixcan)")

    def babble(self, frame: Frame) -> None:
        """Send `frame` as if it came from another node."""
        self.send((frame,))

    def set_bus_fault(self, fault: BusFault) -> None:
        """Raise LinkFaultError, because the frames of a foreign bus cannot be changed."""
        raise LinkFaultError("faults: only on the simulator's own bus (interface unixcan) or a serial line")

    def summary(self) -> str:
        """Counters in one line."""
        return (
            f"in={self.frames_in} out={self.frames_out} ignored={self.ignored} errors={self.errors} "
            f"send_failures={self.send_failures}"
        )

    def close(self) -> None:
        """Leave the CAN bus."""
        self._shut_down()

    def _open(self) -> can.BusABC:
        rate: dict[str, Any] = {} if self._interface == "socketcan" else {"bitrate": self._bitrate}
        return can.Bus(interface=self._interface, channel=self._channel, ignore_config=True, **rate, **self._options)

    def _reopen(self, now_ns: int) -> None:
        try:
            self._bus = self._open()
            self._retry_ns = None
        except (can.CanError, OSError, ValueError):
            self.errors += 1
            self._retry_ns = now_ns + RETRY_NS

    def _receive(self) -> can.Message | None:
        if self._bus is None:
            return None
        try:
            return self._bus.recv(0)
        except (can.CanError, OSError, ValueError, IndexError) as error:
            self._lose(error)
            return None

    def _lose(self, error: Exception) -> None:
        self.errors += 1
        print(f"{self.address}: {error}; opening it again", file=sys.stderr)
        self._shut_down()
        self._retry_ns = self._now_ns + RETRY_NS

    def _shut_down(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            try:
                bus.shutdown()
            except (can.CanError, OSError):
                self.errors += 1
