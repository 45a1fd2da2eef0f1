"""The live page as a source: a pad in the browser, whose every word comes over the daemon's control socket; pure.

A hold counts from the newest stamp of this loop that the browser has seen and sent back, not from when its message
arrived. So what a stalled network, a frozen page or a hidden tab delivers late is as old as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from disco_hw.drive.keyboard import wheel_speeds
from disco_hw.drive.source import INPUT_LIMIT_NS, ManualInput, RobotView

PAD_WORDS = "page: hold the pad to drive; Ctrl-C ends"


@dataclass(frozen=True, slots=True)
class Steering:
    """What a page wants: shares of the largest forward speed and left turn in [-1, 1], and whether the pad is held.

    `stamp_ns` is the newest stamp that the page has got in a reply, 0 before the first.
    """

    forward: float
    left: float
    held: bool
    stamp_ns: int


def steering_from(arguments: Mapping[str, Any]) -> Steering:
    """Read a request's arguments; raises ValueError in words for a person."""
    if set(arguments) != {"forward", "left", "held", "stamp"}:
        raise ValueError("drive takes forward, left, held and stamp")
    forward, left, held = arguments["forward"], arguments["left"], arguments["held"]
    for name, share in (("forward", forward), ("left", left)):
        if isinstance(share, bool) or not isinstance(share, int | float) or not -1.0 <= share <= 1.0:
            raise ValueError(f"{name}: not a number from -1 to 1")
    if not isinstance(held, bool):
        raise ValueError("held: not true or false")
    stamp = arguments["stamp"]
    # As text, since a browser's numbers would lose the last digits.
    if not (isinstance(stamp, str) and stamp.isascii() and stamp.isdigit() and len(stamp) < 20):
        raise ValueError("stamp: not the digits of the last reply's stamp")
    return Steering(float(forward), float(left), held, int(stamp))


class PageSource:
    """Drives as the page says that holds the pad; of several pages one at a time.

    A page must have been heard with its pad open, not longer ago than a hold may be silent, before its hold counts.
    While one holds, the others are refused.
    """

    def __init__(
        self, top_rad_s: float, turn_share: float, words: str = PAD_WORDS, limit_ns: int = INPUT_LIMIT_NS
    ) -> None:
        self._words = words
        self._top_rad_s = top_rad_s
        self._turn_share = turn_share
        self._limit_ns = limit_ns
        self._open_ns: dict[int, int] = {}
        self._holder: int | None = None
        self._newest: ManualInput | None = None

    @property
    def ended(self) -> str | None:
        """It never ends: a page can come back."""
        return None

    @property
    def completed(self) -> bool:
        """Whenever the person ends the drive, it is complete."""
        return True

    @property
    def words(self) -> str:
        """What to hold, and where."""
        return self._words

    @property
    def task(self) -> str:
        """A person decides."""
        return ""

    def steer(self, now_ns: int, page: int, wanted: Steering) -> str | None:
        """Take in what one page wants; returns why it does not count, in words."""
        if not wanted.held:
            self._hear_open(now_ns, page)
            return None
        if wanted.stamp_ns > now_ns:
            return "the stamp is from another daemon; release the pad and hold it again"
        if self._holder is None:
            if now_ns - self._open_ns.get(page, -self._limit_ns - 1) > self._limit_ns:
                return "release the pad and hold it again"
            self._holder = page
        if self._holder != page:
            return "another page is driving"
        left, right = wheel_speeds(wanted.forward, wanted.left * self._turn_share, self._top_rad_s)
        self._newest = ManualInput(wanted.stamp_ns, left, right, deadman=True)
        return None

    def poll(self, now_ns: int, _robot: RobotView) -> ManualInput | None:
        """The newest input of the page that holds; open while no page does."""
        newest = self._newest
        if newest is not None and now_ns - newest.t_ns <= self._limit_ns:
            return newest
        if self._holder is not None:
            # Told once with its age, so that the stop has its reason; the next hold begins with an open pad.
            self._holder, self._newest = None, None
            self._open_ns.clear()
            return newest
        return ManualInput(now_ns, 0.0, 0.0, deadman=False)

    def close(self) -> None:
        """Nothing is held open."""

    def _hear_open(self, now_ns: int, page: int) -> None:
        self._open_ns = {one: at for one, at in self._open_ns.items() if now_ns - at <= self._limit_ns}
        self._open_ns[page] = now_ns
        if self._holder == page:
            self._holder, self._newest = None, None
