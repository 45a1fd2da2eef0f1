"""What a person beside the robot should do about its state; every fault of the protocol has its sentence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

ESTOP_REMEDY = "The stop is latched. Make the place safe, release the robot's own button, then press Reset."
_CURRENT = "Free what blocks the wheel, look for a short or a dragging brake, then press Reset."
_HEAT = "Let the motor cool down and drive more gently, then press Reset."
_STALL = "The wheel is asked to turn and does not: free it, check its motor cable, then press Reset."
_ENCODER = "Check the encoder's plug and cable, then press Reset."
_DIRECTION = "The wheel turns against its command: swap the motor's wires or the encoder's channels, then press Reset."
_FILES = "Robot and computer speak different protocols: build the firmware from this version, flash it, restart."
_RESTARTED = "The controller restarted by itself: look at its supply and its firmware, then press Reset."

FAULTS: Mapping[str, str] = {
    "UNDER_VOLTAGE": "Charge or change the battery; it clears by itself.",
    "OVER_VOLTAGE": "Braking feeds back more than the battery takes: brake more gently, check the charger.",
    "OVER_TEMPERATURE_LEFT": _HEAT,
    "OVER_TEMPERATURE_RIGHT": _HEAT,
    "OVER_CURRENT_LEFT": _CURRENT,
    "OVER_CURRENT_RIGHT": _CURRENT,
    "STALL_LEFT": _STALL,
    "STALL_RIGHT": _STALL,
    "ENCODER_MISSING_LEFT": _ENCODER,
    "ENCODER_MISSING_RIGHT": _ENCODER,
    "ENCODER_JUMP_LEFT": _ENCODER,
    "ENCODER_JUMP_RIGHT": _ENCODER,
    "WRONG_DIRECTION_LEFT": _DIRECTION,
    "WRONG_DIRECTION_RIGHT": _DIRECTION,
    "BUS_OFF": "The robot left the CAN bus: check termination, bit rate and cable, then restart it.",
    "DBC_HASH_MISMATCH": _FILES,
    "PROTOCOL_MAJOR_MISMATCH": _FILES,
    "CONFIG_INVALID": "The robot's stored settings are not valid: write them again, then restart it.",
    "WATCHDOG_RESET": _RESTARTED,
    "BROWN_OUT_RESET": _RESTARTED,
    "SELF_TEST_FAILED": "The controller failed its own test: switch it off and on; if it stays, do not drive.",
}
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
        remedy = FAULTS.get(fault, "Look it up in firmware_protocol/README.md, mend it, then press Reset.")
        said.append(f"{in_words(fault)}. {remedy}")
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


def in_words(code: str) -> str:
    """A code of the protocol as a person reads it: STALL_LEFT becomes Stall left."""
    return code.replace("_", " ").capitalize()
