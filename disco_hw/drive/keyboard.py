"""The keyboard of the terminal as a source: raw mode, a thread that reads, and the terminal put back at the end.

The loop itself must not touch the terminal: whoever writes to it at low priority holds its lock, and was seen to hold
up the loop for 18 and 43 ms.
"""

from __future__ import annotations

import contextlib
import os
import select
import termios
import threading
from collections import deque
from typing import Any

from disco_hw.daemon.clock import Clock
from disco_hw.drive.keys import DIRECTIONS, KeyEvent, KeyHold, parse
from disco_hw.drive.source import ManualInput, RobotView
from disco_hw.errors import InputError

_MOST_BYTES = 4096
_JOIN_TIMEOUT_S = 1.0


class Keyboard:
    """Reads keys from the terminal at `descriptor`; Ctrl-C still is a signal, and what is written looks as before.

    Each key carries the time at which it came. Raises InputError if that is no terminal. A terminal that closes ends
    the source. To be made before the process takes on real time, so that its thread does not.
    """

    def __init__(self, descriptor: int, hold: KeyHold, clock: Clock) -> None:
        self._descriptor = descriptor
        self._hold = hold
        self._clock = clock
        self._arrived: deque[tuple[int, bytes]] = deque()
        self._ended: str | None = None
        self._gone = False
        try:
            self._former: list[Any] | None = termios.tcgetattr(descriptor)
        except termios.error:
            raise InputError(
                "the keyboard: standard input is no terminal; use a terminal, --gamepad or --script with --unattended"
            ) from None
        raw = termios.tcgetattr(descriptor)
        # Without IXON, as a stray Ctrl-S would hold what is written.
        raw[0] &= ~termios.IXON
        raw[3] &= ~(termios.ICANON | termios.ECHO)
        raw[6][termios.VMIN], raw[6][termios.VTIME] = 1, 0
        # Keys typed before this moment were meant for somebody else.
        termios.tcsetattr(descriptor, termios.TCSAFLUSH, raw)
        self._wake_in, self._wake_out = os.pipe()
        self._reader = threading.Thread(target=self._read, name="keyboard", daemon=True)
        self._reader.start()

    @property
    def ended(self) -> str | None:
        """Why there will be no further input; Ctrl-D, or the terminal has closed."""
        return self._ended

    @property
    def completed(self) -> bool:
        """Whether the terminal is still there: a person drives for as long as they like."""
        return not self._gone

    @property
    def words(self) -> str:
        """The speed chosen, and what keeps a held key from counting."""
        return self._hold.words

    @property
    def task(self) -> str:
        """A person decides."""
        return ""

    def poll(self, now_ns: int, _robot: RobotView) -> ManualInput | None:
        """What is held, after all that has been typed."""
        self._take(now_ns)
        if self._gone:
            return None
        held = self._hold.at(now_ns)
        return held if self._ended is None else ManualInput(now_ns, 0.0, 0.0, deadman=False)

    def close(self) -> None:
        """Put the terminal back as it was."""
        former, self._former = self._former, None
        if former is None:
            return
        os.write(self._wake_out, b"\0")
        self._reader.join(_JOIN_TIMEOUT_S)
        os.close(self._wake_out)
        os.close(self._wake_in)
        # It may have closed meanwhile.
        with contextlib.suppress(termios.error):
            termios.tcsetattr(self._descriptor, termios.TCSANOW, former)

    def _take(self, now_ns: int) -> None:
        """Act on what has arrived: one event in all, which keeps a poll short however much was typed."""
        keys: list[bytes] = []
        t_ns = now_ns
        while self._arrived and self._ended is None:
            t_ns, data = self._arrived.popleft()
            if not data:
                self._gone, self._ended = True, "the terminal has closed"
            keys += parse(data)
            if b"\x04" in keys:
                self._ended = "ended from the keyboard"
        if keys and self._ended is None:
            # Any other key among them wins: it means stop.
            odd = [key for key in keys if key not in DIRECTIONS]
            # What came after this tick began counts as of its beginning.
            self._hold.press(KeyEvent(min(t_ns, now_ns), odd[-1] if odd else keys[-1]))

    def _read(self) -> None:
        """Wait for keys until there is no terminal, or `close()`; the thread's work."""
        while self._wake_in not in select.select([self._descriptor, self._wake_in], [], [])[0]:
            try:
                data = os.read(self._descriptor, _MOST_BYTES)
            except OSError:
                data = b""
            self._arrived.append((self._clock.now_ns(), data))
            if not data:
                return
