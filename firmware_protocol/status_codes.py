"""Meaning of the codes in a robot's status, and what to do about each: faults, causes of a stop, refusals, e-stops.

Codes and names are the DBC's value tables, and how a fault ends is a bit of its code; the remedies stand here alone.
The page, `ctl`, `check`, the log's events and the table in README.md take their words from this file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from firmware_protocol.codec import PROTOCOL

THEN_RESET, THEN_RESTART, BY_ITSELF = "then reset", "then restart the controller", "it clears by itself"
"""What ends a fault in the robot once its cause is gone: the last words of its advice."""

# Bits of the fault's code (firmware_protocol/README.md).
_LATCHING = 0x0800
_PERMANENT = 0x0400

_REMEDIES: Mapping[str, str] = {
    "UNDER_VOLTAGE": "charge or change the battery",
    "OVER_VOLTAGE": "braking feeds back more than the battery can take: brake more gently, check battery and charger",
    "OVER_TEMPERATURE_LEFT": "let the left motor cool down and drive more gently",
    "OVER_TEMPERATURE_RIGHT": "let the right motor cool down and drive more gently",
    "OVER_CURRENT_LEFT": "free what blocks the left wheels, look for a short or a dragging brake",
    "OVER_CURRENT_RIGHT": "free what blocks the right wheels, look for a short or a dragging brake",
    "STALL_LEFT": "free the left wheels, check their motor's cable",
    "STALL_RIGHT": "free the right wheels, check their motor's cable",
    "ENCODER_MISSING_LEFT": "check the left encoder's plug and cable",
    "ENCODER_MISSING_RIGHT": "check the right encoder's plug and cable",
    "ENCODER_JUMP_LEFT": "check the left encoder's cable, shield and magnet",
    "ENCODER_JUMP_RIGHT": "check the right encoder's cable, shield and magnet",
    "WRONG_DIRECTION_LEFT": "swap two wires of the left motor or the channels of its encoder",
    "WRONG_DIRECTION_RIGHT": "swap two wires of the right motor or the channels of its encoder",
    "BUS_OFF": "check the bus: wiring, termination, bit rate",
    "DBC_HASH_MISMATCH": "flash the firmware built from this version of disco-hw",
    "PROTOCOL_MAJOR_MISMATCH": "flash firmware that uses this host's protocol version",
    "CLOCK_MISMATCH": "check the controller's clock source, and that its control loop keeps the period it is built for",
    "CONFIG_INVALID": "correct the controller's configuration and flash it again",
    "ENTROPY_INVALID": "give the controller another random number, other than 0, at each start",
    "WATCHDOG_RESET": "the controller hung and restarted: look for the cause in its firmware",
    "BROWN_OUT_RESET": "the controller lost its supply and restarted: check battery, fuse and wiring",
    "SELF_TEST_FAILED": "the controller failed its own test: if it does so again, do not drive, replace it",
}
_STOP_CAUSES: Mapping[str, str] = {
    "REQUESTED": "a stop was requested",
    "COMMAND_TIMEOUT": "no wheel command arrived in time: the link or this host was too slow; check the load of both",
    "COMMAND_EXPIRED": "the last wheel command had expired: the link or this host was too slow; check the load of both",
    "E2E_DISQUALIFIED": "too many damaged or repeated frames from this host; check the link",
    "HOST_FAULT": "this host reported a fault",
    "HOST_SILENT": "this host sent nothing; check the link",
    "FAULT": "the robot has a fault",
    "ESTOP": "emergency stop",
    "SESSION_CHANGED": "another session was opened; check that no second host is connected",
}
_REJECT_REASONS: Mapping[str, str] = {
    "LENGTH": "a frame had the wrong length",
    "CRC": "a frame's checksum was wrong",
    "REPEATED": "a frame was repeated; check that no second host is connected",
    "SEQUENCE": "frames were lost or out of order",
    "NOT_QUALIFIED": "the robot has not yet received enough good frames in a row",
    "SESSION": "a command belonged to another session; check that no second host is connected",
    "STATE": "a command arrived in a state in which the robot accepts none",
    "MODE": "a command had an unknown mode",
    "VALIDITY": "a command had a validity of zero",
    "NONZERO_BEFORE_ARMED": "a command requested motion before arming; check that no second host is connected",
    "CHALLENGE": "the host's answer to the robot's challenge was wrong; check that both use the same DBC",
    "HANDSHAKE": "the handshake was refused; check that both ends use the same DBC",
    "AUTHENTICATION": "a command was not authenticated; check that link.key_file holds the robot's key",
}
_BLOCKERS: Mapping[str, str] = {
    "FAULT": "the robot has a fault",
    "ESTOP": "the robot's emergency stop is active",
    "WHEELS_MOVING": "the wheels are turning",
    "HANDSHAKE": "the handshake is not complete",
    "HOST_STATE": "the robot does not accept this host's frames yet",
    "SESSION": "the session is not new",
    "CHALLENGE": "the robot's challenge is not answered yet",
    "ZERO_COMMANDS": "the robot has not yet received enough zero commands in a row",
}
_ESTOP_SOURCES: Mapping[str, str] = {
    "FRAME": "emergency stop by a frame on the link; reset when it is safe",
    "BUTTON": "emergency stop button pressed; release it, then reset",
    "LINE": "emergency stop line open; close it, then reset",
}


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of the value table of SYSTEM_STATE.fault; `hint` is what to do about its cause."""

    code: int
    name: str
    hint: str

    @property
    def latches(self) -> bool:
        """Whether the fault stays when its cause is gone."""
        return bool(self.code & _LATCHING)

    @property
    def permanent(self) -> bool:
        """Whether no reset clears it."""
        return bool(self.code & _PERMANENT)

    @property
    def ending(self) -> str:
        """Text on what ends the fault once its cause is gone."""
        if self.permanent:
            return THEN_RESTART
        return THEN_RESET if self.latches else BY_ITSELF

    @property
    def advice(self) -> str:
        """Text on what to do, from the cause to the end of the fault."""
        return f"{self.hint}; {self.ending}"


def _table() -> dict[str, Fault]:
    signals = next(message.signals for message in PROTOCOL.messages if message.name == "SYSTEM_STATE")
    names = next(signal.choices for signal in signals if signal.name == "fault")
    return {name: Fault(code, name, _REMEDIES[name]) for code, name in names.items() if code}


FAULTS: Mapping[str, Fault] = _table()
"""Every fault of the DBC by its name."""


def advice(name: str) -> str:
    """Return what to do about a fault; empty for one that this version does not know, and for none."""
    fault = FAULTS.get(name)
    return "" if fault is None else fault.advice


def fault(name: str) -> str:
    """Return a fault of SYSTEM_STATE.fault and what to do about it.

    The name alone for one that this version does not know.
    """
    todo = advice(name)
    return f"{name}: {todo}" if todo else name


def stop_cause(name: str) -> str:
    """Return why the robot stopped by itself, by the name in SYSTEM_STATE.stop_cause."""
    return _STOP_CAUSES.get(name, name)


def reject_reason(name: str) -> str | None:
    """Return why the robot last rejected a frame, by the name in SYSTEM_STATE.reject_reason; None if it never did."""
    return None if name == "NONE" else _REJECT_REASONS.get(name, name)


def blocker(name: str) -> str:
    """Return what keeps the robot from the next step towards motion, by a name in SESSION_STATE.blockers."""
    return _BLOCKERS.get(name, name)


def estop(source: str) -> str:
    """Return who stopped the robot, by the name in SYSTEM_STATE.estop_source, and what to do about it."""
    return _ESTOP_SOURCES.get(source, "emergency stop; reset when it is safe")
