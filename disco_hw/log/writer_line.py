"""The recorder's end of the socket to a writer; no call waits."""

from __future__ import annotations

import socket
import time
from contextlib import suppress

import msgspec

from disco_hw.log.link import END, WriterStatus, frame

_STATUS_BYTES = 65_536


class WriterLine:
    """Sends frames, of which one may be on its way in part, and keeps the newest status.

    `heard`: a status has come. `ended`: the writer has hung up. `ending`: it has been sent the end. `full`: it cannot
    take more now.
    """

    def __init__(self, connection: socket.socket, path: str, part: int) -> None:
        self.status = WriterStatus("recording", path, part)
        self.heard = False
        self.ended = False
        self.ending = False
        self._connection = connection
        self._rest = memoryview(b"")
        self._received = b""
        self._decode = msgspec.json.Decoder(WriterStatus).decode
        self._heard_s = time.monotonic()

    @property
    def full(self) -> bool:
        """Whether a frame is on its way in part."""
        return bool(self._rest)

    @property
    def silent_s(self) -> float:
        """Time since anything came."""
        return time.monotonic() - self._heard_s

    def fileno(self) -> int:
        """For `select`."""
        return self._connection.fileno()

    def send(self, data: bytes) -> bool:
        """Send a frame, the rest of it later if need be; False if no other can follow it now."""
        self._rest = memoryview(data)
        return self.send_rest()

    def send_rest(self) -> bool:
        """Send what is left of the last frame; True if nothing is left."""
        while self._rest and not self.ended:
            try:
                sent = self._connection.send(self._rest)
            except BlockingIOError:
                return False
            except OSError:
                # What it said last may still be waiting to be read; that it has gone is found there.
                return False
            self._rest = self._rest[sent:]
        return not self._rest

    def send_end(self, payload: bytes) -> None:
        """Send the last frame, once."""
        if not self.ending:
            self.ending = True
            self.send(frame(END, payload))

    def read(self) -> bool:
        """Take in what the writer says; True if it said something."""
        if self.ended:
            return False
        try:
            data = self._connection.recv(_STATUS_BYTES)
        except BlockingIOError:
            return False
        except OSError:
            data = b""
        if not data:
            self.ended = True
            return False
        self._heard_s = time.monotonic()
        *lines, self._received = (self._received + data).split(b"\n")
        for line in lines[-1:]:
            with suppress(msgspec.MsgspecError):
                self.status = self._decode(line)
                self.heard = True
        return bool(lines)

    def close(self) -> None:
        """Hang up."""
        self._connection.close()
