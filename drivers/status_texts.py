"""The meaning of the codes in `RobotStatus`, with the remedy; codes are those of the DBC's value tables."""

from __future__ import annotations

from firmware_protocol import faults

_STOP_CAUSES = {
    "REQUESTED": "it was asked to",
    "COMMAND_TIMEOUT": "no wheel command arrived in time; the link or this host was too slow",
    "COMMAND_EXPIRED": "the last wheel command had expired; the link or this host was too slow",
    "E2E_DISQUALIFIED": "too many damaged or repeated frames from this host; check the link",
    "HOST_FAULT": "this host reported a fault",
    "HOST_SILENT": "this host was silent; check the link",
    "FAULT": "it has a fault",
    "ESTOP": "emergency stop",
    "SESSION_CHANGED": "another session was opened; is a second host connected?",
}

_REJECT_REASONS = {
    "LENGTH": "a frame had the wrong length",
    "CRC": "a frame's checksum was wrong",
    "REPEATED": "a frame was repeated; is a second host connected?",
    "SEQUENCE": "frames were lost or out of order",
    "NOT_QUALIFIED": "it has not yet seen enough good frames in a row",
    "SESSION": "a command was of another session; is a second host connected?",
    "STATE": "a command came in a state that takes none",
    "MODE": "a command had a mode that does not exist",
    "VALIDITY": "a command was valid for no time at all",
    "NONZERO_BEFORE_ARMED": "a command asked for motion before arming; is a second host connected?",
    "CHALLENGE": "the answer to its challenge was wrong; do both ends use the same DBC?",
    "HANDSHAKE": "the handshake was refused; do both ends use the same DBC?",
    "AUTHENTICATION": "a command was not proved with the robot's key; is it the same in link.key_file?",
}

_BLOCKERS = {
    "FAULT": "it has a fault",
    "ESTOP": "emergency stop",
    "WHEELS_MOVING": "the wheels are turning",
    "HANDSHAKE": "the handshake is not complete",
    "HOST_STATE": "it does not trust this host's frames yet",
    "SESSION": "the session is not a new one",
    "CHALLENGE": "its challenge is not answered yet",
    "ZERO_COMMANDS": "it has not yet seen enough zero commands in a row",
}

_ESTOP_SOURCES = {
    "FRAME": "emergency stop by a frame on the link; reset when it is safe",
    "BUTTON": "emergency stop button pressed; release it, then reset",
    "LINE": "emergency stop line open; close it, then reset",
}


def fault(name: str) -> str:
    """Say what a fault of the robot is and what to do about it."""
    advice = faults.advice(name)
    return f"{name}: {advice}" if advice else name


def stop_cause(name: str) -> str:
    """Say why the robot stopped by itself."""
    return _STOP_CAUSES.get(name, name)


def reject_reason(name: str) -> str | None:
    """Say why the robot last rejected a frame; None if it never did."""
    return None if name == "NONE" else _REJECT_REASONS.get(name, name)


def blocker(name: str) -> str:
    """Say what keeps the robot from the next step towards motion."""
    return _BLOCKERS.get(name, name)


def estop(source: str) -> str:
    """Say who stopped the robot and what to do about it."""
    return _ESTOP_SOURCES.get(source, "emergency stop; reset when it is safe")
