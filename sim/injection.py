"""Faults at run time, as text: what a person or a test does to the robot and its link while it runs."""

from __future__ import annotations

from collections.abc import Callable

from drivers.types import Frame
from firmware_protocol.firmware_core import ResetCause
from sim.robot_link import LinkFaultError, RobotLink
from sim.truth import truth_row
from sim.virtual_robot import VirtualRobot

COMMANDS = """\
bus_off [host|robot]          controllers of all hosts (default), or the robot's, leave the bus
unplug SECONDS                break the line for so long
estop_button on|off           press or release the button on the robot
kidnap DX_M DY_M DYAW_RAD     carry the robot off
babble ID RATE_HZ             another node sends frames of zeros under this identifier; RATE_HZ 0 ends it
reboot [watchdog|brown_out]   restart the robot's controller
state                         answer with the true state, as a line of the truth table
"""

MAX_BABBLE_HZ = 100_000.0
MAX_UNPLUG_S = 3600.0
_BABBLE_DATA = bytes(8)


class CommandError(Exception):
    """A command that cannot be obeyed; the message is one line."""


class Injection:
    """Executes `COMMANDS` on a robot and its link, and keeps up what goes on over time."""

    def __init__(self, robot: VirtualRobot, link: RobotLink) -> None:
        self.refused = 0
        self._robot = robot
        self._link = link
        self._babble: Frame | None = None
        self._babble_period_ns = 0.0
        self._babble_since_ns = 0
        self._babble_count = 0
        self._handlers: dict[str, Callable[[list[str], int], str]] = {
            "bus_off": self._bus_off,
            "unplug": self._unplug,
            "estop_button": self._estop_button,
            "kidnap": self._kidnap,
            "babble": self._start_babble,
            "reboot": self._reboot,
            "state": self._state,
        }

    def execute(self, text: str, now_ns: int) -> str:
        """Obey one command; return "ok", what was asked for, or "error: " and why."""
        name, *arguments = text.split() or [""]
        try:
            handler = self._handlers.get(name)
            if handler is None:
                raise CommandError(f"{name!r} is no command; say one of {', '.join(self._handlers)}")
            return handler(arguments, now_ns)
        except (CommandError, LinkFaultError) as error:
            self.refused += 1
            return f"error: {error}"

    def step(self, now_ns: int) -> None:
        """Let the babbling node send what is due."""
        if self._babble is None:
            return
        due = int((now_ns - self._babble_since_ns) / self._babble_period_ns)
        for _ in range(due - self._babble_count):
            self._link.babble(self._babble)
        self._babble_count = max(due, self._babble_count)

    def _bus_off(self, arguments: list[str], _now_ns: int) -> str:
        _expect("bus_off", arguments, 0, 1)
        self._link.force_bus_off(arguments[0] if arguments else "host")
        return "ok"

    def _unplug(self, arguments: list[str], now_ns: int) -> str:
        _expect("unplug", arguments, 1, 1)
        self._link.unplug(now_ns + round(_number("unplug", arguments[0], 0.0, MAX_UNPLUG_S) * 1e9))
        return "ok"

    def _estop_button(self, arguments: list[str], _now_ns: int) -> str:
        _expect("estop_button", arguments, 1, 1)
        if arguments[0] not in ("on", "off"):
            raise CommandError(f"estop_button {arguments[0]}: say on or off")
        self._robot.estop_button = arguments[0] == "on"
        return "ok"

    def _kidnap(self, arguments: list[str], _now_ns: int) -> str:
        _expect("kidnap", arguments, 3, 3)
        dx_m, dy_m, dyaw_rad = (_number("kidnap", argument, -1000.0, 1000.0) for argument in arguments)
        self._robot.kidnap(dx_m, dy_m, dyaw_rad)
        return "ok"

    def _start_babble(self, arguments: list[str], now_ns: int) -> str:
        _expect("babble", arguments, 2, 2)
        try:
            can_id = int(arguments[0], 0)
        except ValueError:
            raise CommandError(f"babble {arguments[0]}: not an identifier; write it as 0x100 or 256") from None
        if not 0 <= can_id <= 0x7FF:
            raise CommandError(f"babble {arguments[0]}: an identifier has 11 bits")
        rate_hz = _number("babble", arguments[1], 0.0, MAX_BABBLE_HZ)
        self._babble = None
        if rate_hz > 0.0:
            frame = Frame(can_id, _BABBLE_DATA)
            self._link.babble(frame)
            self._babble, self._babble_period_ns = frame, 1e9 / rate_hz
            self._babble_since_ns, self._babble_count = now_ns, 0
        return "ok"

    def _reboot(self, arguments: list[str], _now_ns: int) -> str:
        _expect("reboot", arguments, 0, 1)
        causes = {"power_on": ResetCause.POWER_ON, "watchdog": ResetCause.WATCHDOG, "brown_out": ResetCause.BROWN_OUT}
        cause = causes.get(arguments[0] if arguments else "power_on")
        if cause is None:
            raise CommandError(f"reboot {arguments[0]}: say one of {', '.join(causes)}")
        self._robot.reboot(cause)
        return "ok"

    def _state(self, arguments: list[str], now_ns: int) -> str:
        _expect("state", arguments, 0, 0)
        return truth_row(self._robot, now_ns)


def _expect(name: str, arguments: list[str], least: int, most: int) -> None:
    if not least <= len(arguments) <= most:
        usage = next(line.split("  ")[0] for line in COMMANDS.splitlines() if line.startswith(name))
        raise CommandError(f"{name}: {len(arguments)} arguments given; usage: {usage}")


def _number(name: str, text: str, least: float, most: float) -> float:
    try:
        value = float(text)
    except ValueError:
        raise CommandError(f"{name} {text}: not a number") from None
    if not least <= value <= most:
        raise CommandError(f"{name} {text}: not within {least:g} to {most:g}")
    return value
