"""The daemon's side of the adapter: hands samples on and takes reports, and never waits for either.

What the two processes exchange: one msgpack message a packet, each small.
"""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
from dataclasses import dataclass
from typing import Protocol

import msgspec

from disco_hw.errors import LogError, WorkError
from disco_hw.processes import spawn_at_normal_priority

NAMES = ("x_icr_m", "wheel_radius_m", "axial_distance_m")
Triple = tuple[float, float, float]
Nine = tuple[float, float, float, float, float, float, float, float, float]


class WheelAngles(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """Cumulative wheel angles (rad) at a time."""

    t_ns: int
    left_rad: float
    right_rad: float


class PoseReading(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """A measured pose (m, rad) at the time when it was true."""

    t_ns: int
    x_m: float
    y_m: float
    yaw_rad: float


class Samples(msgspec.Struct, frozen=True, tag="samples", gc=False):
    """What came in with the tick at `now_ns`."""

    now_ns: int
    wheels: tuple[WheelAngles, ...] = ()
    poses: tuple[PoseReading, ...] = ()


class Range(msgspec.Struct, frozen=True, tag="range", gc=False):
    """What the network is to be trained for: geometry between `low` and `high` about `mean`, wheels up to a speed."""

    mean: Triple
    low: Triple
    high: Triple
    wheel_rad_s: float


class InForce(msgspec.Struct, frozen=True, tag="in_force", gc=False):
    """The belief over the geometry (order of `link.NAMES`) that the robot drives by from `now_ns` on.

    `adapted` is False for that of the model file; with `relearn`, what was learnt so far is to be forgotten.
    """

    now_ns: int
    mean: Triple
    covariance: Nine
    adapted: bool
    relearn: bool = False


class Proposal(msgspec.Struct, frozen=True, gc=False):
    """A belief over the geometry from driving up to `t_ns`; `data_s` of it. `doubt` says why it should not be used."""

    t_ns: int
    estimator: str
    mean: Triple
    covariance: Nine
    data_s: float
    doubt: str = ""


class Report(msgspec.Struct, frozen=True, tag="report", gc=False):
    """How learning goes, about once a second.

    `text` is one sentence. `advantage` is the log odds of the recent driving under the belief in force against that of
    the model file, 0 while that file's is in force.
    """

    now_ns: int
    text: str
    proposals: tuple[Proposal, ...] = ()
    advantage: float = 0.0


ToAdapter = Samples | InForce | Range
FromAdapter = Report


MAX_PACKET_BYTES = 65_536
_REPORTS_PER_POLL = 4
_BUFFER_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class LinkStats:
    """Counters since the link was made: packets handed on, `dropped` as the adapter did not keep up or is dead, reports
    taken, `garbled` ones, and how often the adapter died.
    """

    sent: int = 0
    dropped: int = 0
    reports: int = 0
    garbled: int = 0
    deaths: int = 0
    alive: bool = False


class AdapterLink(Protocol):
    """A way to the adapter; no call but `restart` and `close` waits for anything, and none raises."""

    @property
    def stats(self) -> LinkStats:
        """Counters."""

    def send(self, message: ToAdapter) -> None:
        """Hand a message on."""

    def receive(self) -> tuple[FromAdapter, ...]:
        """The reports that have come."""

    def restart(self) -> bool:
        """Start the adapter again if it has died; True if it was. Takes milliseconds. Raises WorkError."""

    def close(self) -> None:
        """End the adapter; safe to call twice."""


class ProcessLink:
    """The adapter in a process of its own, at normal priority and lower than everybody's.

    Make it before the loop enters real time. Raises WorkError if the process cannot be started.
    """

    def __init__(self) -> None:
        self._encode = msgspec.msgpack.Encoder().encode
        self._decode = msgspec.msgpack.Decoder(FromAdapter).decode
        self._sent = self._dropped = self._reports = self._garbled = self._deaths = 0
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None
        self._launch()

    @property
    def pid(self) -> int | None:
        """The adapter's process, None once it has ended."""
        return None if self._process is None else self._process.pid

    @property
    def stats(self) -> LinkStats:
        """Counters."""
        return LinkStats(
            self._sent, self._dropped, self._reports, self._garbled, self._deaths, self._process is not None
        )

    def send(self, message: ToAdapter) -> None:
        """Hand a message on, or drop it."""
        if self._socket is None:
            self._dropped += 1
            return
        try:
            self._socket.send(self._encode(message))
        except BlockingIOError:
            self._dropped += 1
        except OSError:
            self._dropped += 1
            self._lost()
        else:
            self._sent += 1

    def receive(self) -> tuple[FromAdapter, ...]:
        """Reports that have come, a few at most; notices the adapter's death."""
        found: list[FromAdapter] = []
        while self._socket is not None and len(found) < _REPORTS_PER_POLL:
            try:
                data = self._socket.recv(MAX_PACKET_BYTES)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if not data:
                self._lost()
                break
            try:
                found.append(self._decode(data))
            except msgspec.MsgspecError:
                self._garbled += 1
                break
        self._reports += len(found)
        return tuple(found)

    def restart(self) -> bool:
        """Start a dead adapter again."""
        if self._process is not None:
            return False
        self._launch()
        return True

    def close(self) -> None:
        """End the adapter."""
        process = self._process
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if process is not None:
            self._process = None
            # A stopped process does not see a request to end; nothing of it is worth waiting for.
            process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(1.0)

    def _lost(self) -> None:
        """The adapter has hung up: it is dead or as good as dead."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._process is not None:
            self._process.kill()
            self._process.poll()
            self._process = None
            self._deaths += 1

    def _launch(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            ours.setblocking(False)
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
            command = [sys.executable, "-m", "disco_hw.adaptation.adapter", str(theirs.fileno())]
            try:
                self._process = spawn_at_normal_priority(command, pass_fds=(theirs.fileno(),))
            except LogError as error:
                ours.close()
                raise WorkError(f"the adapter cannot be started: {error}") from None
        self._socket = ours
