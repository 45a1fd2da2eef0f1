"""Positions of a GPS receiver that speaks NMEA 0183, on a serial port or over TCP: what the daemon sees of them.

The receiver is read by a process of its own (`drivers.pose.nmea_reader`), as ports and networks block.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import socket
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import msgspec

from drivers.pose.convention import PoseSourceError
from drivers.pose.udp import LONGEST_DATAGRAM, MOST_A_TICK, pose_of
from drivers.types import PoseSample

SOURCE = "nmea"
_READER = "drivers.pose.nmea_reader"
_END_TIMEOUT_S = 1.0


class Words(msgspec.Struct, frozen=True):
    """A sentence of the reader for a person."""

    said: str


_WORDS = msgspec.json.Decoder(Words)


def make_pose_source(
    *,
    device: str = "",
    baud: int = 115_200,
    datum: tuple[float, float] | None = None,
    heading_std_rad: float = 0.02,
    **_of_other_sources: Any,
) -> NmeaPoses:
    """By the fields of [pose]. Raises PoseSourceError for a device that is not named, or the library not there."""
    if not device:
        raise PoseSourceError('no device; write pose.device = "/dev/serial/by-id/..." or "socket://HOST:PORT"')
    if importlib.util.find_spec("pynmeagps") is None:
        raise PoseSourceError("the library pynmeagps is not there; run `pip install 'disco-hw[rtk]'`")
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    settings = {"device": device, "baud": baud, "datum": datum, "heading_std_rad": heading_std_rad}
    with theirs:
        # In a session of its own: Ctrl-C is for the daemon alone.
        process = subprocess.Popen(
            [sys.executable, "-m", _READER, str(theirs.fileno()), json.dumps(settings)],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
    return NmeaPoses(ours, process)


class NmeaPoses:
    """Satisfies `drivers.types.PoseSource` and `drivers.types.SaysWhy`."""

    def __init__(self, opened: socket.socket, process: subprocess.Popen[bytes]) -> None:
        self._socket = opened
        self._process = process
        self._ended = False
        self._said: list[str] = []

    def receive(self, now_ns: int, from_robot: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """What came since the last call, oldest first; never waits and never raises."""
        poses = []
        with contextlib.suppress(BlockingIOError):
            for _ in range(MOST_A_TICK):
                message = b"" if self._ended else self._received()
                if not message:
                    break
                pose = pose_of(message, now_ns)
                if pose is not None:
                    poses.append(pose)
                else:
                    self._keep_words(message)
        return poses

    def news(self) -> Sequence[str]:
        """What a person should know since the last call."""
        said, self._said = self._said, []
        return said

    def close(self) -> None:
        """End the reader; safe to call twice."""
        self._socket.close()
        self._process.terminate()
        try:
            self._process.wait(_END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _received(self) -> bytes:
        try:
            message = self._socket.recv(LONGEST_DATAGRAM)
        except BlockingIOError:
            raise
        except OSError:
            message = b""
        if not message:
            self._ended = True
            self._said.append("the process that reads the GPS receiver has ended; restart the daemon")
        return message

    def _keep_words(self, message: bytes) -> None:
        with contextlib.suppress(msgspec.MsgspecError):
            self._said.append(_WORDS.decode(message).said)
