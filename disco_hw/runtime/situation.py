"""How things are with the robot and what to do now, in words.

`run`, `check`, `ctl status`, the page and a replay all take their words from here, and those for faults from
`firmware_protocol.faults`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from drivers.types import DriverState, LinkState
from firmware_protocol import faults

Ask = Callable[[str], str]
"""How a person asks for an action, as "arm": in words that begin with a verb."""

ESTOP_REMEDY = "The stop is latched. Make the place safe, release the robot's own button, then {reset}."
_NEXT = {
    "DISCONNECTED": "Check the robot's power and the cable to it.",
    "HANDSHAKE": "The robot is being asked who it is; wait.",
    "READY": "{arm}; nothing moves yet.",
    "STOPPING": "Wait until the wheels stand still.",
    "FAULT": "Mend what is said above, then {reset}.",
}


def by_button(action: str) -> str:
    """How a person asks on the page."""
    return f"press {action.capitalize()}"


def by_command(robot: Path) -> Ask:
    """How a person asks in a terminal."""
    return lambda action: f"run `disco-hw ctl {robot} {action}`"


def connection(link: LinkState, link_error: str | None, driver: DriverState, driver_detail: str) -> str:
    """What stands between this host and a robot that answers, and what to do about it.

    `link_error` is the link's newest, with its remedy, or None.
    """
    if link is not LinkState.UP:
        return link_error or f"the link is {link.value}"
    # A link that is open and brings nothing has said more than that there is no answer.
    return link_error if link_error and driver is DriverState.HANDSHAKE else driver_detail


def headline(state: str, detail: str, running: bool, estop: bool, by_hand: bool = False) -> tuple[str, str]:
    """The state in a word or two, and the sentence after it."""
    head = "E-STOP" if estop else f"{state} · running" if running else state
    return head, "driven by hand" if by_hand else detail


def status_headline(status: Mapping[str, Any]) -> tuple[str, str]:
    """The same for a status of the daemon that is `ok`."""
    by_hand = "drive" in status and bool(status["drive"]["driving"])
    return headline(status["state"], status["detail"], status["running"], is_estop(status), by_hand)


def is_estop(status: Mapping[str, Any]) -> bool:
    """Whether a status is to be shown as an e-stop."""
    return bool(status["estop"]) or status["robot_state"] == "ESTOP"


def advice(status: Mapping[str, Any], ask: Ask = by_button) -> tuple[str, ...]:
    """Sentences on what to do now, the most urgent first, for a status of the daemon that is `ok`."""
    said = []
    if is_estop(status):
        said.append(f"E-STOP. {_asking(ESTOP_REMEDY, ask)}")
    fault = str(status["fault"])
    if fault not in {"NONE", "UNKNOWN"}:
        said.append(fault_sentence(fault))
    state = str(status["state"])
    if said:
        return tuple(said)
    if "drive" in status and state in {"READY", "ARMED"}:
        return (str(status["drive"]["words"]),)
    if state == "ARMED":
        sentence = "{stop} to hold still, or {disarm} to end." if status["running"] else "{start} to drive the task."
        return (_asking(sentence, ask),)
    return (_asking(_NEXT[state], ask),) if state in _NEXT else ()


def fault_sentence(name: str) -> str:
    """Return what a fault is and what to do about it."""
    todo = faults.advice(name) or "not known here: look it up where the robot's firmware comes from"
    return f"{in_words(name)}. {todo[0].upper()}{todo[1:]}."


def next_step(status: Mapping[str, Any]) -> str:
    """The action that leads on from here; empty where there is none."""
    state = str(status["state"])
    if "drive" in status and state in {"READY", "ARMED"}:
        return ""
    if state == "ARMED":
        return "stop" if status["running"] else "start"
    return {"READY": "arm", "FAULT": "reset"}.get(state, "")


def in_words(code: str) -> str:
    """A code of the protocol as a person reads it: STALL_LEFT becomes Stall left."""
    return code.replace("_", " ").capitalize()


def _asking(sentence: str, ask: Ask) -> str:
    words = sentence.format(**{action: ask(action) for action in ("arm", "start", "stop", "disarm", "reset")})
    return words[0].upper() + words[1:]
