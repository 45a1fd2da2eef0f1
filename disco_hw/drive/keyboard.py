"""The keyboard of the terminal as a source: raw mode, reads that never wait, and the terminal put back at the end."""

from __future__ import annotations

import contextlib
import os
import select
import termios
from typing import Any

from disco_hw.drive.keys import DIRECTIONS, KeyEvent, KeyHold, parse
from disco_hw.drive.source import ManualInput, RobotView
from disco_hw.errors import InputError

_MOST_BYTES = 4096


class Keyboard:
    """Reads keys from the terminal at `descriptor`; Ctrl-C still is a signal, and what is written looks as before.

    Raises InputError if that is no terminal. A terminal that closes ends the source.
    """

    def __init__(self, descriptor: int, hold: KeyHold) -> None:
        self._descriptor = descriptor
        self._hold = hold
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
        """Read what has been typed."""
        if self._ended is None:
            self._read(now_ns)
        if self._gone:
            return None
        held = self._hold.at(now_ns)
        return held if self._ended is None else ManualInput(now_ns, 0.0, 0.0, deadman=False)

    def close(self) -> None:
        """Put the terminal back as it was."""
        former, self._former = self._former, None
        if former is not None:
            # It may have closed meanwhile.
            with contextlib.suppress(termios.error):
                termios.tcsetattr(self._descriptor, termios.TCSADRAIN, former)

    def _read(self, now_ns: int) -> None:
        ready, _, trouble = select.select([self._descriptor], [], [self._descriptor], 0.0)
        if not ready and not trouble:
            return
        try:
            data = os.read(self._descriptor, _MOST_BYTES)
        except OSError:
            data = b""
        if not data:
            self._gone, self._ended = True, "the terminal has closed"
            return
        keys = parse(data)
        if b"\x04" in keys:
            self._ended = "ended from the keyboard"
            return
        # Any other key in it wins: it means stop.
        odd = [key for key in keys if key not in DIRECTIONS]
        self._hold.press(KeyEvent(now_ns, odd[-1] if odd else keys[-1]))
