"""Driving by hand or by script, through the daemon's own loop: the seam of all sources, the gamepad, the live page.

A source says what a person asks for. Of the page, a pad in the browser: a hold counts from the newest stamp of this
loop that the browser has seen and sent back, not from when its message arrived. So what a stalled network, a frozen
page or a hidden tab delivers late is as old as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from disco_hw.runtime import State
from drivers.gamepad import Gamepad, GamepadError

# docs/safety.md names it: shorter stops for every pause of a source, longer drives on when its operator is gone.
INPUT_LIMIT_NS = 200_000_000


@dataclass(frozen=True, slots=True)
class ManualInput:
    """Wheel speeds wanted at `t_ns` (rad/s, left and right) and whether the deadman was held then.

    `t_ns` is when the driver was last known to want this, not when it was asked for.
    """

    t_ns: int
    left_rad_s: float
    right_rad_s: float
    deadman: bool


@dataclass(frozen=True, slots=True)
class RobotView:
    """State of the robot that a manual source may see.

    The daemon's state, whether the last tick drove the wheels by hand, and the wheels' measured speeds (rad/s, left and
    right), None where they are not known; the pose (m, rad), None where there is no valid one; whether the fence guard
    holds the robot.
    """

    state: State
    driving: bool
    wheels: tuple[float, float] | None = None
    pose: tuple[float, float, float] | None = None
    fence_stopped: bool = False


class ManualSource(Protocol):
    """Asked once a tick; it never waits."""

    @property
    def ended(self) -> str | None:
        """Reason why there will be no further input, in words; None while there may be."""

    @property
    def completed(self) -> bool:
        """Whether the source ended as it should."""

    @property
    def status_text(self) -> str:
        """Text for the operator on what is going on or to be done now."""

    @property
    def task(self) -> str:
        """Name of what is being carried out and what for; empty where the operator decides."""

    def poll(self, now_ns: int, robot: RobotView) -> ManualInput | None:
        """Return the newest input, however old; None when the device is gone."""

    def close(self) -> None:
        """Give the device back; safe to call twice."""


def wheel_speeds(forward: float, turn: float, top_rad_s: float) -> tuple[float, float]:
    """Left and right wheel speed (rad/s) of a forward and a left-turn share, each in [-1, 1], at most `top_rad_s`."""
    left, right = forward - turn, forward + turn
    scale = top_rad_s / max(1.0, abs(left), abs(right))
    return left * scale, right * scale


# Chosen: opening the device each tick would hold up the loop; a gamepad that is plugged in is found within this.
_RETRY_NS = 1_000_000_000


class GamepadSource:
    """Drives as the sticks say, while the deadman's button is held.

    A gamepad sends changes only: what the kernel holds is fresh as long as the device is there. But a pad whose radio
    fails silently would be held for ever, so input counts as new for `silence_s` after the last event only (0: for
    ever, for pads on a cable). A device that is gone is looked for once a second, by `open_pad(now_ns)`. So it never
    ends, and whenever the person ends the drive, it is complete.
    """

    ended: str | None = None
    completed, task = True, ""

    def __init__(
        self, pad: Gamepad, open_pad: Callable[[int], Gamepad], top_rad_s: float, turn_share: float, silence_s: float
    ) -> None:
        self._pad: Gamepad | None = pad
        self._open_pad = open_pad
        self._top_rad_s = top_rad_s
        self._turn_share = turn_share
        self._silence_ns = round(silence_s * 1e9)
        self._retry_ns = 0
        self._name = pad.name

    @property
    def status_text(self) -> str:
        """Text for the operator on what to hold, or to plug in."""
        if self._pad is None:
            return f"{self._name} is disconnected; plug it in again"
        advice = self._pad.refusal or "hold the deadman's button; Ctrl-C ends"
        return f"{self._name}: {advice}"

    def poll(self, now_ns: int, _robot: RobotView) -> ManualInput | None:
        """Return the sticks and the deadman now; None while the device is gone."""
        if self._pad is None:
            self._look_for_it(now_ns)
            return None
        state = self._pad.poll(now_ns)
        if state is None:
            self._pad.close()
            self._pad, self._retry_ns = None, now_ns + _RETRY_NS
            return None
        # Silence is suspicious while something is held; an open deadman stays known, so that the next press counts.
        silent = state.deadman and 0 < self._silence_ns < now_ns - state.event_ns
        left, right = wheel_speeds(state.forward, state.left * self._turn_share, self._top_rad_s)
        return ManualInput(state.event_ns if silent else now_ns, left, right, state.deadman)

    def close(self) -> None:
        """Close the gamepad if it is open."""
        if self._pad is not None:
            self._pad.close()
            self._pad = None

    def _look_for_it(self, now_ns: int) -> None:
        if now_ns < self._retry_ns:
            return
        self._retry_ns = now_ns + _RETRY_NS
        try:
            self._pad = self._open_pad(now_ns)
        except GamepadError:
            return
        self._name = self._pad.name


PAD_STATUS_TEXT = "page: hold the pad to drive; Ctrl-C ends"


@dataclass(frozen=True, slots=True)
class Steering:
    """Wishes of a page: shares of the largest forward speed and left turn in [-1, 1], and whether the pad is held.

    `stamp_ns` is the newest stamp that the page has got in a reply, 0 before the first.
    """

    forward: float
    left: float
    held: bool
    stamp_ns: int


def steering_from(arguments: Mapping[str, Any]) -> Steering:
    """Read a request's arguments; raises ValueError in words for the operator."""
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
        raise ValueError("stamp: must be the digits of the last reply's stamp")
    return Steering(float(forward), float(left), held, int(stamp))


class PageSource:
    """Drives as the page says that holds the pad; of several pages one at a time.

    A page must have been heard with its pad open, not longer ago than a hold may be silent, before its hold counts.
    While one holds, the others are refused. It never ends, as a page can come back, and whenever the person ends the
    drive, it is complete.
    """

    ended: str | None = None
    completed, task = True, ""

    def __init__(self, top_rad_s: float, turn_share: float, status_text: str = PAD_STATUS_TEXT) -> None:
        self.status_text = status_text
        self._top_rad_s = top_rad_s
        self._turn_share = turn_share
        self._open_ns: dict[int, int] = {}
        self._holder: int | None = None
        self._newest: ManualInput | None = None

    def steer(self, now_ns: int, page: int, steering: Steering) -> str | None:
        """Take in what one page wants; return why it is refused, in words, or None if it is accepted."""
        if not steering.held:
            self._handle_open(now_ns, page)
            return None
        if steering.stamp_ns > now_ns:
            return "the stamp is from another daemon; release the pad and hold it again"
        if self._holder is None:
            if now_ns - self._open_ns.get(page, -INPUT_LIMIT_NS - 1) > INPUT_LIMIT_NS:
                return "release the pad and hold it again"
            self._holder = page
        if self._holder != page:
            return "another page is driving"
        left, right = wheel_speeds(steering.forward, steering.left * self._turn_share, self._top_rad_s)
        self._newest = ManualInput(steering.stamp_ns, left, right, deadman=True)
        return None

    def poll(self, now_ns: int, _robot: RobotView) -> ManualInput | None:
        """Return the newest input of the page that holds its pad; zero speeds with the deadman released without one."""
        newest = self._newest
        if newest is not None and now_ns - newest.t_ns <= INPUT_LIMIT_NS:
            return newest
        if self._holder is not None:
            # Reported once with its age, so that the stop has its reason; the next hold begins with an open pad.
            self._holder, self._newest = None, None
            self._open_ns.clear()
            return newest
        return ManualInput(now_ns, 0.0, 0.0, deadman=False)

    def close(self) -> None:
        """Do nothing, because the source holds no resources."""

    def _handle_open(self, now_ns: int, page: int) -> None:
        """Note that a page has reported its pad released, and end its hold if it had one."""
        self._open_ns = {one: at for one, at in self._open_ns.items() if now_ns - at <= INPUT_LIMIT_NS}
        self._open_ns[page] = now_ns
        if self._holder == page:
            self._holder, self._newest = None, None
