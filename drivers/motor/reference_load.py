"""The cyclic frames of the reference protocol, by the DBC's cycle times."""

from __future__ import annotations

from drivers.types import CyclicFrame
from firmware_protocol.dbc import load_protocol

_COMMANDS = ("WHEEL_COMMAND", "WHEEL_COMMAND_MAC")
_AUTHENTICATION = ("WHEEL_COMMAND_MAC", "HOST_STATE_MAC", "MAC_CHALLENGE")


def cyclic_frames(dbc: str, command_rate_hz: float, *, authenticated: bool = False) -> tuple[CyclicFrame, ...]:
    """Return all frames with a cycle time (GenMsgCycleTime, ms) in the DBC's text, each page of a multiplexed one.

    The wheel command counts at the rate of the control loop; proofs and their challenge only if `authenticated`.
    """
    frames = []
    for message in load_protocol(dbc).messages:
        if message.period_s is not None and (authenticated or message.name not in _AUTHENTICATION):
            pages = {signal.page for signal in message.signals} - {None}
            rate_hz = command_rate_hz if message.name in _COMMANDS else 1.0 / message.period_s
            frames.append(CyclicFrame(message.name, message.sender, message.length, rate_hz * max(1, len(pages))))
    return tuple(frames)
