"""The recorder's end of the channel to the keeper; only making one takes time."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time

import msgspec

from disco_hw.log.errors import LogError
from disco_hw.log.link import Ended, Launch, Start, Started
from disco_hw.log.spawn import spawn_at_normal_priority

_MESSAGE_BYTES = 65_536
_ANSWER_S = 5.0
_BUFFER_BYTES = 1 << 20


class KeeperLink:
    """A keeper process: starts writers that begin their logs with `start`. Raises LogError if it cannot be started.

    `pid` is the newest writer's, 0 until it is known; `code` how that one ended, negative for a signal.
    """

    def __init__(self, start: Start) -> None:
        self._start = start
        self._decode = msgspec.msgpack.Decoder(Started | Ended).decode
        self.pid = 0
        self.code: int | None = None
        self._asked_s: float | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None
        self._make()

    @property
    def alive(self) -> bool:
        """Whether the keeper has not hung up."""
        return self._channel is not None

    @property
    def process_pid(self) -> int | None:
        """The keeper's own process."""
        return self._process.pid if self._process is not None and self.alive else None

    def needs_renewal(self, now_s: float) -> bool:
        """Whether it is dead, or has not started a writer for long after it was asked to."""
        return not self.alive or (self._asked_s is not None and now_s - self._asked_s > _ANSWER_S)

    def launch(self, launch: Launch) -> socket.socket | None:
        """Ask for a writer; returns the recorder's end of the socket to it, or None without a keeper."""
        if self._channel is None:
            return None
        ours, theirs = socket.socketpair()
        with theirs:
            ours.setblocking(False)
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
            try:
                socket.send_fds(self._channel, [msgspec.msgpack.encode(launch)], [theirs.fileno()])
            except OSError:
                ours.close()
                self._hang_up()
                return None
        self.pid, self.code = 0, None
        self._asked_s = time.monotonic()
        return ours

    def read(self) -> None:
        """Take in what the keeper says, and notice its death."""
        while self._channel is not None:
            try:
                data = self._channel.recv(_MESSAGE_BYTES)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._hang_up()
                return
            word = self._decode(data)
            if isinstance(word, Started):
                self.pid, self._asked_s = word.pid, None
            elif word.pid == self.pid:
                self.code = word.code

    def renew(self) -> None:
        """Another keeper in place of this one; takes milliseconds. The writer lives on."""
        self._end_process()
        self._make()

    def close(self) -> None:
        """Let the keeper end; safe to call twice."""
        self._hang_up()
        if self._process is not None:
            try:
                self._process.wait(1.0)
            except subprocess.TimeoutExpired:
                self._end_process()
            if self._process is not None and self._process.stdout is not None:
                self._process.stdout.close()
            self._process = None

    def _make(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # The attachments are too long for a message, and the place for logs may have no room for a file.
        memory = os.memfd_create("log-start")
        try:
            with theirs, os.fdopen(memory, "wb", closefd=False) as file:
                ours.setblocking(False)
                file.write(msgspec.msgpack.encode(self._start))
                file.flush()
                descriptors = (theirs.fileno(), memory)
                command = [sys.executable, "-m", "disco_hw.log.keeper", *map(str, descriptors)]
                self._process = spawn_at_normal_priority(command, pass_fds=descriptors)
        except LogError:
            ours.close()
            raise
        finally:
            os.close(memory)
        self._channel = ours
        self._asked_s = None

    def _hang_up(self) -> None:
        if self._channel is not None:
            self._channel.close()
            self._channel = None

    def _end_process(self) -> None:
        self._hang_up()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            if self._process.stdout is not None:
                self._process.stdout.close()
            self._process = None
