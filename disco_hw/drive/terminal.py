"""Driving at a terminal: its keyboard as a source, and what is shown while driving.

The loop itself must not touch the terminal: whoever writes to it at low priority holds its lock, and was seen to hold
up the loop for 18 and 43 ms. So a thread reads the keys, in raw mode, and puts the terminal back at the end; and a
process of its own writes: `python -m disco_hw.drive.terminal SOCKET` asks the daemon for its status and shows a table,
or a line a second where that is no terminal.

A terminal reports a key when it goes down and while it repeats, never when it comes up. So a key is held while its
repeats come, and each repeat carries deadman and direction at once: terminals repeat the last key pressed only.
"""

from __future__ import annotations

import contextlib
import enum
import os
import select
import sys
import termios
import threading
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from disco_hw.daemon import send_request
from disco_hw.daemon.loop import Clock
from disco_hw.drive import INPUT_LIMIT_NS, ManualInput, RobotView, wheel_speeds
from disco_hw.errors import InputError, WorkError

if TYPE_CHECKING:
    # The process that drives does without it.
    from rich.console import Console, Group

# A held key begins to repeat after 0.15 to 0.7 s, depending on the terminal.
_FIRST_REPEAT_NS = 1_000_000_000
# Shorter than this between two holds may be a stutter of the connection, and must not arm again.
_RELEASE_NS = 500_000_000
# Repeats of a key that does not count, after which the operator is warned.
_MAX_IGNORED_EVENTS = 10
# No hand and no terminal repeats faster; pasted text does.
_SHORTEST_REPEAT_NS = 10_000_000
# Chosen: terminals repeat a key every 30 ms, so a read that is late by less finds two. A notch of a mouse wheel, which
# tmux gets as arrow keys, is three or more; what a stalled connection delivers late soon is, too.
_MOST_REPEATS = 2

DIRECTIONS = {
    b"\x1b[A": (1.0, 0.0), b"\x1b[B": (-1.0, 0.0), b"\x1b[D": (0.0, 1.0), b"\x1b[C": (0.0, -1.0),
    b"\x1bOA": (1.0, 0.0), b"\x1bOB": (-1.0, 0.0), b"\x1bOD": (0.0, 1.0), b"\x1bOC": (0.0, -1.0),
    b"w": (1.0, 0.0), b"x": (-1.0, 0.0), b"a": (0.0, 1.0), b"d": (0.0, -1.0),
    b"q": (1.0, 0.5), b"e": (1.0, -0.5), b"z": (-1.0, 0.5), b"c": (-1.0, -0.5),
    b" ": (0.0, 0.0), b"s": (0.0, 0.0),
}  # fmt: skip
HELP = (
    "Hold arrows or w x a d to drive and turn, q e z c for curves, space to hold still; 1-9 speed; others stop; "
    "Ctrl-D ends."
)


def parse(data: bytes) -> list[bytes]:
    """Split what one read returned into keys: control sequences whole, everything else byte by byte."""
    keys = []
    at = 0
    while at < len(data):
        end = at + 1
        if data[at] == 0x1B and data[at + 1 : at + 2] in {b"[", b"O"}:
            end = at + 2
            while end < len(data) and not 0x40 <= data[end] <= 0x7E:
                end += 1
            end += 1
        keys.append(data[at:end])
        at = end
    return keys


class _Hold(enum.Enum):
    OPEN = "open"
    PRESSED = "pressed"
    HELD = "held"
    LAPSED = "lapsed"


class KeyHold:
    """Turns key events into wheel speeds and a deadman.

    Held: an event of a driving key less than 200 ms after the one before. The first repeat may come later, so a tap
    holds nothing, nor does pasted text, which comes faster than any repeat. Only a key that was read alone begins a
    hold, and more than two that were read at once end it. After a hold has ended, half a second without any key must
    pass before the next one counts. Holding another key changes the direction; where the terminal
    waits longer than 200 ms before it repeats that one, the hold ends.
    """

    def __init__(self, top_rad_s: float) -> None:
        self._top_rad_s = top_rad_s
        self._share = 0.5
        self._state = _Hold.LAPSED
        self._direction = (0.0, 0.0)
        self._last_ns: int | None = None
        self._ignored = 0

    @property
    def is_ignored(self) -> bool:
        """Whether a key has been held for a while that does not count before all keys were released."""
        return self._ignored >= _MAX_IGNORED_EVENTS

    @property
    def status_text(self) -> str:
        """The speed that is chosen, and what to do where a held key does not count."""
        lapsed = "; release all keys for half a second" if self._state is _Hold.LAPSED else ""
        return f"keyboard, {self._share:.0%} speed{lapsed}"

    def press(self, t_ns: int, key: bytes, count: int = 1) -> None:
        """Take in one of the `count` keys that one read has returned, which stands for all of them."""
        if key in DIRECTIONS and count <= _MOST_REPEATS:
            self._state = self._after(t_ns, count)
            self._direction = DIRECTIONS[key]
        else:
            self._state = _Hold.LAPSED
            if key in _DIGITS:
                self._share = int(key) / 9.0
        self._ignored = self._ignored + 1 if self._state is _Hold.LAPSED and key in DIRECTIONS else 0
        self._last_ns = t_ns

    def at(self, now_ns: int) -> ManualInput:
        """Return the wheel speeds and the deadman at a time."""
        if self._last_ns is None:
            self._last_ns = now_ns
        if self._state is _Hold.HELD and now_ns - self._last_ns > INPUT_LIMIT_NS:
            self._state = _Hold.LAPSED
        if self._state is _Hold.LAPSED and now_ns - self._last_ns >= _RELEASE_NS:
            self._state, self._ignored = _Hold.OPEN, 0
        if self._state is not _Hold.HELD:
            return ManualInput(now_ns, 0.0, 0.0, deadman=False)
        forward, turn = self._direction
        left, right = wheel_speeds(forward * self._share, turn * self._share, self._top_rad_s)
        return ManualInput(self._last_ns, left, right, deadman=True)

    def _after(self, t_ns: int, count: int) -> _Hold:
        """Return the state after a read of so many driving keys at `t_ns`."""
        gap_ns = _FIRST_REPEAT_NS if self._last_ns is None else t_ns - self._last_ns
        match self._state:
            case _Hold.PRESSED if gap_ns < _SHORTEST_REPEAT_NS or count > 1:
                return _Hold.PRESSED
            case _Hold.HELD | _Hold.PRESSED if gap_ns <= INPUT_LIMIT_NS:
                return _Hold.HELD
            case _Hold.PRESSED:
                return _Hold.PRESSED
            case _Hold.HELD:
                return _Hold.LAPSED
            case _:
                return _Hold.PRESSED if gap_ns >= _RELEASE_NS else _Hold.LAPSED


_DIGITS = frozenset(b"%d" % digit for digit in range(1, 10))


# Chosen: above what is typed between two readings; more is read at once afterwards.
_MOST_BYTES = 4096
# Chosen: the newest letters that no question has read yet.
_MOST_TYPED = 16
# Chosen: the thread is woken and ends at once, unless the terminal holds it.
_JOIN_TIMEOUT_S = 1.0


class Keyboard:
    """Reads keys from the terminal at `descriptor`; Ctrl-C still is a signal, and what is written looks as before.

    Each key carries the time at which it came. Raises InputError if that is no terminal. A terminal that closes ends
    the source. To be made before the process takes on real time, so that its thread does not.
    """

    # The operator decides.
    task = ""

    def __init__(self, descriptor: int, hold: KeyHold, clock: Clock) -> None:
        self._descriptor = descriptor
        self._hold = hold
        self._clock = clock
        self._arrived: deque[tuple[int, bytes]] = deque()
        self.ended: str | None = None
        """Reason why there will be no further input: Ctrl-D, or the terminal has closed."""
        self._gone = False
        self._typed = ""
        try:
            self._former: list[Any] | None = termios.tcgetattr(descriptor)
        except termios.error:
            raise InputError(
                "the keyboard: standard input is not a terminal; use a terminal, --gamepad or --script with "
                "--unattended"
            ) from None
        raw = termios.tcgetattr(descriptor)
        # Without IXON, as a stray Ctrl-S would hold what is written.
        raw[0] &= ~termios.IXON
        raw[3] &= ~(termios.ICANON | termios.ECHO)
        raw[6][termios.VMIN], raw[6][termios.VTIME] = 1, 0
        # Ctrl-Z would freeze the daemon, and leave the terminal as it is.
        raw[6][termios.VSUSP] = b"\0"
        # Keys typed before this moment were meant for somebody else.
        termios.tcsetattr(descriptor, termios.TCSAFLUSH, raw)
        self._wake_in, self._wake_out = os.pipe()
        self._reader = threading.Thread(target=self._read, name="keyboard", daemon=True)
        self._reader.start()

    @property
    def completed(self) -> bool:
        """Whether the terminal is still there: a person drives for as long as they like."""
        return not self._gone

    @property
    def status_text(self) -> str:
        """The speed chosen, and what keeps a held key from counting."""
        return self._hold.status_text

    @property
    def is_ignored(self) -> bool:
        """Whether a key is held that does not count before all keys were released for half a second."""
        return self._hold.is_ignored

    def poll(self, now_ns: int, _robot: RobotView) -> ManualInput | None:
        """Return the wheel speeds and the deadman after all keys typed so far; None once the terminal is gone."""
        self._handle(now_ns)
        if self._gone:
            return None
        held = self._hold.at(now_ns)
        return held if self.ended is None else ManualInput(now_ns, 0.0, 0.0, deadman=False)

    def typed(self) -> str:
        """Return the printable keys that drive nothing, typed since it was asked last and seen by a poll."""
        typed, self._typed = self._typed, ""
        return typed

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

    def _handle(self, now_ns: int) -> None:
        """Act on what has arrived: one event for each read, which keeps a poll short however much was typed."""
        while self._arrived and self.ended is None:
            t_ns, data = self._arrived.popleft()
            keys = parse(data)
            if not data:
                self._gone, self.ended = True, "the terminal was closed"
            elif b"\x04" in keys:
                self.ended = "the operator ended the drive at the keyboard"
            else:
                # Any other key among them wins: it means stop.
                odd = [key for key in keys if key not in DIRECTIONS]
                answers = "".join(key.decode("ascii", "ignore") for key in odd if len(key) == 1 and key.isalnum())
                self._typed = (self._typed + answers)[-_MOST_TYPED:]
                # What came after this tick began counts as of its beginning.
                self._hold.press(min(t_ns, now_ns), odd[-1] if odd else keys[-1], len(keys))

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


# Chosen: what an eye follows on a terminal, and what a file of lines can bear.
_TABLE_PERIOD_S = 0.4
_LINE_PERIOD_S = 1.0
# Chosen: above the compiling of a planner; then the display ends.
_START_TIMEOUT_S = 60.0


def line(status: Mapping[str, Any]) -> str:
    """Return the state of the drive in one line."""
    drive = status["drive"]
    return f"{status['state']}: {drive['words']} | {drive['coverage_words']}"


def table(status: Mapping[str, Any]) -> Group:
    """Return the state of the drive as a picture for the terminal."""
    from rich.console import Group  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415
    from rich.text import Text  # noqa: PLC0415

    drive = status["drive"]
    items = Table("", "motion so far", "needed", "shows", box=None, pad_edge=False)
    for item in drive["coverage"]["items"]:
        mark = Text("done", "green") if item["covered"] else Text("missing", "yellow" if item["found"] else "red")
        unit = " s" if item["unit"] == "s" else ""
        amounts = f"{item['found']:.0f}{unit}", f"{item['wanted']:.0f}{unit}"
        items.add_row(mark, Text(f"{item['name']}  {amounts[0]}"), amounts[1], Text(item["purpose"]))
    wheels, command = status["wheels"], status["command"]
    measured = "none" if wheels is None else f"{wheels[0]:+.1f} {wheels[1]:+.1f}"
    return Group(
        Text(f"{status['state']}: {status['detail']}", "bold green" if drive["driving"] else "bold"),
        Text(f"command {command[0]:+.1f} {command[1]:+.1f}  wheels {measured} rad/s"),
        Text(drive["words"]),
        Text(drive["task"]),
        # The table is longer than a small terminal, which cuts off the end.
        *(Text(message, "dim") for message in drive["messages"]),
        Text(drive["coverage_words"]),
        items,
    )


def show(socket: Path, console: Console) -> None:
    """Show the drive until its daemon has gone."""
    from rich.live import Live  # noqa: PLC0415

    _wait_for(socket)
    if not console.is_terminal:
        while (status := _status(socket)) is not None:
            console.out(line(status), highlight=False)
            time.sleep(_LINE_PERIOD_S)
        return
    with Live(console=console, auto_refresh=False) as live:
        while (status := _status(socket)) is not None:
            live.update(table(status), refresh=True)
            time.sleep(_TABLE_PERIOD_S)


def _wait_for(socket: Path) -> None:
    deadline_s = time.monotonic() + _START_TIMEOUT_S
    while time.monotonic() < deadline_s and _status(socket) is None:
        time.sleep(_TABLE_PERIOD_S)


def _status(socket: Path) -> Mapping[str, Any] | None:
    """Return the daemon's status; None without a daemon that is driven by hand."""
    try:
        status = send_request(socket, {"do": "status"})
    except WorkError:
        return None
    return status if status.get("ok") and "drive" in status else None


if __name__ == "__main__":
    from rich.console import Console

    show(Path(sys.argv[1]), Console())
