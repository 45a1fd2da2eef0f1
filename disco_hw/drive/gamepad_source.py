"""A gamepad as a source: sticks to wheel speeds, and a device that comes back after it was gone."""

from __future__ import annotations

from collections.abc import Callable

from disco_hw.drive.keyboard import wheel_speeds
from disco_hw.drive.source import ManualInput, RobotView
from drivers.gamepad import Gamepad, GamepadError

_RETRY_NS = 1_000_000_000


class GamepadSource:
    """Drives as the sticks say, while the deadman's button is held.

    A gamepad sends changes only: what the kernel holds is fresh as long as the device is there. But a pad whose radio
    fails silently would be held for ever, so input counts as new for `silence_s` after the last event only (0: for
    ever, for pads on a cable). A device that is gone is looked for once a second, by `open_pad(now_ns)`.
    """

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
    def ended(self) -> str | None:
        """It never ends: a gamepad can come back."""
        return None

    @property
    def completed(self) -> bool:
        """Whenever the person ends the drive, it is complete."""
        return True

    @property
    def words(self) -> str:
        """What to hold, or to plug in."""
        if self._pad is None:
            return f"{self._name} is gone; plug it in again"
        return f"{self._name}: hold the deadman's button; Ctrl-C ends"

    @property
    def task(self) -> str:
        """A person decides."""
        return ""

    def poll(self, now_ns: int, _robot: RobotView) -> ManualInput | None:
        """The sticks now; None while the device is gone."""
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
        """Close the device."""
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
