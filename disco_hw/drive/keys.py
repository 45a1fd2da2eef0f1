"""Keys of a terminal: what their bytes mean, and when one counts as held; pure.

A terminal tells of a key when it goes down and while it repeats, never when it comes up. So a key is held while its
repeats come, and each repeat carries deadman and direction at once: terminals repeat the last key pressed only.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

from disco_hw.drive.source import INPUT_LIMIT_NS, ManualInput

# A held key begins to repeat after 0.15 to 0.7 s, depending on the terminal.
_FIRST_REPEAT_NS = 1_000_000_000
# Shorter than this between two holds may be a stutter of the connection, and must not arm again.
_RELEASE_NS = 500_000_000
# No hand and no terminal repeats faster; pasted text does.
_SHORTEST_REPEAT_NS = 10_000_000

DIRECTIONS = {
    b"\x1b[A": (1.0, 0.0), b"\x1b[B": (-1.0, 0.0), b"\x1b[D": (0.0, 1.0), b"\x1b[C": (0.0, -1.0),
    b"\x1bOA": (1.0, 0.0), b"\x1bOB": (-1.0, 0.0), b"\x1bOD": (0.0, 1.0), b"\x1bOC": (0.0, -1.0),
    b"w": (1.0, 0.0), b"x": (-1.0, 0.0), b"a": (0.0, 1.0), b"d": (0.0, -1.0),
    b"q": (1.0, 0.5), b"e": (1.0, -0.5), b"z": (-1.0, -0.5), b"c": (-1.0, 0.5),
    b" ": (0.0, 0.0), b"s": (0.0, 0.0),
}  # fmt: skip
HELP = "Hold arrows or w x a d to go and turn, q e z c for curves, space to stand; 1-9 speed; others stop; Ctrl-D ends."


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


def wheel_speeds(forward: float, turn: float, top_rad_s: float) -> tuple[float, float]:
    """Left and right wheel speed (rad/s) of a forward and a left-turn share, each in [-1, 1], at most `top_rad_s`."""
    left, right = forward - turn, forward + turn
    scale = top_rad_s / max(1.0, abs(left), abs(right))
    return left * scale, right * scale


class _Hold(enum.Enum):
    OPEN = "open"
    PRESSED = "pressed"
    HELD = "held"
    LAPSED = "lapsed"


@dataclass(frozen=True, slots=True)
class KeyEvent:
    """The newest key of those that came together, and when."""

    t_ns: int
    key: bytes


class KeyHold:
    """Turns key events into wheel speeds and a deadman.

    Held: an event of a driving key less than 200 ms after the one before. The first repeat may come later, so a tap
    holds nothing, nor does pasted text, which comes faster than any repeat. After a hold has ended, half a second
    without any key must pass before the next one counts. Holding another key changes the direction; where the terminal
    waits longer than 200 ms before it repeats that one, the hold ends.
    """

    def __init__(self, top_rad_s: float, limit_ns: int = INPUT_LIMIT_NS) -> None:
        self._top_rad_s = top_rad_s
        self._limit_ns = limit_ns
        self._share = 0.5
        self._state = _Hold.LAPSED
        self._direction = (0.0, 0.0)
        self._last_ns: int | None = None

    @property
    def words(self) -> str:
        """The speed that is chosen, and what to do where a held key does not count."""
        lapsed = "; release all keys for half a second" if self._state is _Hold.LAPSED else ""
        return f"keyboard, {self._share:.0%} speed{lapsed}"

    def press(self, event: KeyEvent) -> None:
        """Take in a key."""
        if event.key in DIRECTIONS:
            self._state = self._after(event.t_ns)
            self._direction = DIRECTIONS[event.key]
        else:
            self._state = _Hold.LAPSED
            if event.key in _DIGITS:
                self._share = int(event.key) / 9.0
        self._last_ns = event.t_ns

    def at(self, now_ns: int) -> ManualInput:
        """What is held now."""
        if self._last_ns is None:
            self._last_ns = now_ns
        if self._state is _Hold.HELD and now_ns - self._last_ns > self._limit_ns:
            self._state = _Hold.LAPSED
        if self._state is _Hold.LAPSED and now_ns - self._last_ns >= _RELEASE_NS:
            self._state = _Hold.OPEN
        if self._state is not _Hold.HELD:
            return ManualInput(now_ns, 0.0, 0.0, deadman=False)
        forward, turn = self._direction
        left, right = wheel_speeds(forward * self._share, turn * self._share, self._top_rad_s)
        return ManualInput(self._last_ns, left, right, deadman=True)

    def _after(self, t_ns: int) -> _Hold:
        """The state after a driving key at `t_ns`."""
        gap_ns = _FIRST_REPEAT_NS if self._last_ns is None else t_ns - self._last_ns
        match self._state:
            case _Hold.PRESSED if gap_ns < _SHORTEST_REPEAT_NS:
                return _Hold.PRESSED
            case _Hold.HELD | _Hold.PRESSED if gap_ns <= self._limit_ns:
                return _Hold.HELD
            case _Hold.PRESSED:
                return _Hold.PRESSED
            case _Hold.HELD:
                return _Hold.LAPSED
            case _:
                return _Hold.PRESSED if gap_ns >= _RELEASE_NS else _Hold.LAPSED


_DIGITS = frozenset(b"%d" % digit for digit in range(1, 10))
