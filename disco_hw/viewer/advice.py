"""What a person beside the robot should do about its state; on faults `firmware_protocol.faults` has the word."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from firmware_protocol import faults

ESTOP_REMEDY = "The stop is latched. Make the place safe, release the robot's own button, then press Reset."
_NEXT = {
    "DISCONNECTED": "Check the robot's power and the cable to it.",
    "HANDSHAKE": "The robot is being asked who it is; wait.",
    "READY": "Press Arm; nothing moves yet.",
    "STOPPING": "Wait until the wheels stand still.",
}


def advice(status: Mapping[str, Any]) -> tuple[str, ...]:
    """Sentences on what to do now, the most urgent first, for a status of the daemon that is `ok`."""
    said = []
    if status["estop"] or status["robot_state"] == "ESTOP":
        said.append(f"E-STOP. {ESTOP_REMEDY}")
    fault = str(status["fault"])
    if fault not in {"NONE", "UNKNOWN"}:
        said.append(fault_sentence(fault))
    state = str(status["state"])
    if said:
        return tuple(said)
    if "drive" in status and state in {"READY", "ARMED"}:
        return (str(status["drive"]["words"]),)
    if state == "ARMED":
        return ("Press Stop to hold still, Disarm to end." if status["running"] else "Press Start to drive the task.",)
    if state == "FAULT":
        return ("Mend what is said above, then press Reset.",)
    return (_NEXT[state],) if state in _NEXT else ()


def next_step(status: Mapping[str, Any]) -> str:
    """The button that leads on from here; empty where there is none to press."""
    state = str(status["state"])
    if "drive" in status and state in {"READY", "ARMED"}:
        return ""
    if state == "ARMED":
        return "stop" if status["running"] else "start"
    return {"READY": "arm", "FAULT": "reset"}.get(state, "")


def fault_sentence(name: str) -> str:
    """Return what a fault is and what to do about it."""
    todo = faults.advice(name) or "not known here: look it up where the robot's firmware comes from"
    return f"{in_words(name)}. {todo[0].upper()}{todo[1:]}."


def in_words(code: str) -> str:
    """A code of the protocol as a person reads it: STALL_LEFT becomes Stall left."""
    return code.replace("_", " ").capitalize()
