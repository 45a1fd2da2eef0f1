"""The live page's buttons: each sends one request to the daemon's control socket, which decides."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import viser

from disco_hw.daemon.control_client import send_request
from disco_hw.emergency import stop_robot
from disco_hw.errors import InputError, WorkError

ESTOP_COLOUR = (205, 20, 20)
ESTOP_LABEL = "E-STOP"
BUTTONS = {"Arm": "arm", "Start": "start", "Stop": "stop", "Disarm": "disarm", "Reset": "reset"}
_TIMEOUT_S = 1.0
_ESTOP_TIMEOUT_S = 0.5

_LARGE = (
    "<style>button[style*='--button-bg: #{:02x}{:02x}{:02x}']"
    "{{height: 4.5em !important; font-size: 1.6em; font-weight: 800;}}</style>"
).format(*ESTOP_COLOUR)
"""Makes every button of the e-stop's colour a large one."""

Ask = Callable[[str], str]


def asking(socket: Path) -> Ask:
    """A function that sends one request and returns the daemon's answer in words; it never raises."""

    def ask(action: str) -> str:
        try:
            return in_words(action, send_request(socket, {"do": action}, _TIMEOUT_S))
        except WorkError as error:
            return f"{action}: {error}"

    return ask


def estop_asking(socket: Path, robot_file: Path) -> Ask:
    """As `asking`, for the e-stop: without an answer from the daemon the robot is stopped on its link as well."""

    def ask(action: str) -> str:
        try:
            reply = send_request(socket, {"do": action}, _ESTOP_TIMEOUT_S)
            if reply.get("ok"):
                return in_words(action, reply)
            refused = str(reply.get("error"))
        except WorkError as error:
            refused = str(error)
        try:
            return f"{refused}; {stop_robot(robot_file).as_text()}"
        except InputError as error:
            return f"{refused}; NOT SENT: {error}"

    return ask


def in_words(action: str, reply: dict[str, Any]) -> str:
    """The daemon's answer for a person."""
    return f"{action}: {reply.get('text', 'done')}" if reply.get("ok") else f"{action} refused: {reply.get('error')}"


def add_estop(gui: viser.GuiApi, ask: Ask, show: Callable[[str], None]) -> None:
    """A large red button above all else in the panel that is being filled."""
    gui.add_html(_LARGE)
    button = gui.add_button(ESTOP_LABEL, color=ESTOP_COLOUR, hint="Stop the robot now; the stop latches")

    @button.on_click
    def _(_: Any) -> None:
        show(ask("estop"))


def add_buttons(gui: viser.GuiApi, ask: Ask, show: Callable[[str], None]) -> None:
    """Arm, start, stop, disarm and reset."""
    group = gui.add_button_group("", tuple(BUTTONS))

    @group.on_click
    def _(event: Any) -> None:
        show(ask(BUTTONS[event.target.value]))
