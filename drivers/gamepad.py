"""Gamepads on Linux, through evdev: two axes and the deadman's button, without ever waiting.

A gamepad sends changes only, so what is held is what the kernel holds; a device that is unplugged, or whose receiver
takes it away, is noticed at the next poll.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from evdev import AbsInfo, InputDevice, InputEvent

# linux/input-event-codes.h.
_EV_SYN, _EV_KEY, _EV_ABS = 0, 1, 3
_SYN_REPORT, _SYN_DROPPED = 0, 3
# Chosen: more than a worn stick has at rest beyond its dead zone; a trigger at rest has 1.
_LARGEST_AT_REST = 0.2


class GamepadError(Exception):
    """Exception for no usable gamepad; the message is one line that says what to do."""


@dataclass(frozen=True, slots=True)
class GamepadMapping:
    """Mapping of the axes and button used, by evdev's names; an axis with a minus before it is reversed.

    Within `dead_zone` of its middle, as a share of half its range, an axis counts as 0.
    """

    forward_axis: str = "-ABS_Y"
    left_axis: str = "-ABS_X"
    deadman_button: str = "BTN_TL"
    dead_zone: float = 0.1


@dataclass(frozen=True, slots=True)
class GamepadState:
    """State of the gamepad: forward and left in [-1, 1], the deadman, and when the newest event came (host time)."""

    event_ns: int
    forward: float
    left: float
    deadman: bool


class Gamepad:
    """A gamepad that is open; `poll()` it in each tick.

    The deadman counts from a press with both axes at rest on: a trigger, or a stick that is held, is no sudden full
    speed. `refusal` says why the last press did not count; empty if it did.

    Raises GamepadError for a mapping with names that the device does not have.
    """

    def __init__(self, device: InputDevice[str], mapping: GamepadMapping, now_ns: int) -> None:
        self._device = device
        self.refusal = ""
        self._dead_zone = mapping.dead_zone
        self._forward = _axis(mapping.forward_axis)
        self._left = _axis(mapping.left_axis)
        self._button = _code(mapping.deadman_button, "BTN_")
        self._range: dict[int, tuple[int, int]] = {}
        self._raw: dict[int, float] = {}
        self._deadman = False
        self._event_ns = now_ns
        self._dropping = False
        self._gone = False
        self._names = tuple(name.removeprefix("-") for name in (mapping.forward_axis, mapping.left_axis))
        try:
            self._read_state()
        except OSError as error:
            raise GamepadError(f"{device.name}: cannot be read ({error.strerror}); plug it in again") from None
        self._was_held = self._deadman
        self._were_off = self._axes_off_rest()

    @property
    def name(self) -> str:
        """Name that the device reports."""
        return self._device.name

    def poll(self, now_ns: int) -> GamepadState | None:
        """Take in what came since the last poll; None once the device is gone."""
        if self._gone:
            return None
        try:
            events = list(self._device.read())
            self._gone = not events
            for event in events:
                self._handle(event)
                self._event_ns = now_ns
        except BlockingIOError:
            pass
        except OSError:
            self._gone = True
        if self._gone:
            return None
        held = self._deadman and not self.refusal
        return GamepadState(self._event_ns, self._value(self._forward), self._value(self._left), held)

    def close(self) -> None:
        """Close the gamepad's device."""
        self._device.close()

    def _handle(self, event: InputEvent) -> None:
        if event.type == _EV_SYN:
            if event.code == _SYN_REPORT:
                if self._dropping:
                    self._dropping = False
                    self._read_state()
                self._evaluate_press()
            # The kernel's queue ran over: what comes until the next report is of no use.
            self._dropping = self._dropping or event.code == _SYN_DROPPED
        elif self._dropping:
            return
        elif event.type == _EV_KEY and event.code == self._button:
            self._deadman = event.value != 0
        elif event.type == _EV_ABS and event.code in self._raw:
            self._raw[event.code] = self._share(event.code, event.value)

    def _evaluate_press(self) -> None:
        """Refuse a press of the deadman with an axis off its middle, both before and after the report that has it.

        Before the first report of some pads the kernel has 0 for an axis, which may be its end.
        """
        off = self._axes_off_rest()
        if self._deadman and not self._was_held:
            names = ", ".join(name for name in off if name in self._were_off)
            self.refusal = names and (
                f"{names} off the middle when the deadman was pressed; let go of the sticks and press again; "
                "for a trigger choose a stick in the [drive] section of robot.toml"
            )
        self._was_held, self._were_off = self._deadman, off

    def _axes_off_rest(self) -> tuple[str, ...]:
        axes = zip(self._names, (self._forward, self._left), strict=True)
        return tuple(name for name, axis in axes if abs(self._value(axis)) > _LARGEST_AT_REST)

    def _read_state(self) -> None:
        for code, _ in (self._forward, self._left):
            info: AbsInfo = self._device.absinfo(code)
            self._range[code] = (info.min, info.max)
            self._raw[code] = self._share(code, info.value)
        self._deadman = self._button in self._device.active_keys()

    def _share(self, code: int, value: int) -> float:
        """Return an axis' value as a share of half its range, from the middle."""
        low, high = self._range[code]
        return 0.0 if high <= low else min(1.0, max(-1.0, (value - low) / (0.5 * (high - low)) - 1.0))

    def _value(self, axis: tuple[int, float]) -> float:
        code, sign = axis
        share = self._raw[code]
        beyond = (abs(share) - self._dead_zone) / (1.0 - self._dead_zone)
        return 0.0 if beyond <= 0.0 else sign * (beyond if share > 0.0 else -beyond)


def open_gamepad(mapping: GamepadMapping, now_ns: int, path: str = "") -> Gamepad:
    """Open the gamepad at `path`, or the first one that has the axes and the button; raises GamepadError."""
    evdev = _evdev()
    needed = {name: (_EV_ABS, _axis(name)[0]) for name in (mapping.forward_axis, mapping.left_axis)}
    needed[mapping.deadman_button] = _EV_KEY, _code(mapping.deadman_button, "BTN_")
    unfit = []
    for candidate in [path] if path else evdev.list_devices(writable=False):
        try:
            device = evdev.InputDevice(candidate)
            # Asks the device, which may go in this very moment.
            found = device.capabilities(absinfo=False)
        except OSError as error:
            if path:
                raise GamepadError(
                    f"{path}: cannot be opened ({error.strerror}); check that it is plugged in and that you may read it"
                ) from None
            continue
        lacking = [name for name, (kind, code) in needed.items() if code not in found.get(kind, ())]
        if not lacking:
            return Gamepad(device, mapping, now_ns)
        device.close()
        # What has none of them is a keyboard, or a button of the computer.
        if path or len(lacking) < len(needed):
            unfit.append(f"{candidate} ({device.name}) lacks {', '.join(lacking)}")
    if path:
        raise GamepadError(f"{unfit[0]}; change the [drive] section of robot.toml")
    if unfit:
        raise GamepadError(
            f"no gamepad found: {'; '.join(unfit)}; plug one in, or change the [drive] section of robot.toml"
        )
    raise GamepadError("no gamepad found; plug one in, and let its user read /dev/input (group input)")


def _evdev() -> Any:
    try:
        # Linux alone has it, so it is an extra.
        import evdev  # noqa: PLC0415
    except ImportError:
        raise GamepadError("gamepads need evdev, on Linux: pip install 'disco-hw[gamepad]'") from None
    return evdev


def _axis(name: str) -> tuple[int, float]:
    """Return the code of an axis and the sign of its values."""
    return _code(name.removeprefix("-"), "ABS_"), -1.0 if name.startswith("-") else 1.0


def _code(name: str, prefix: str) -> int:
    codes = _evdev().ecodes.ecodes
    if not name.startswith(prefix) or name not in codes:
        raise GamepadError(f"{name}: evdev has no such name with {prefix}; see the [drive] section in docs/robot.md")
    return int(codes[name])
