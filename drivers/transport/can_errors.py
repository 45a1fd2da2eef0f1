"""What a CAN error frame says (Linux include/uapi/linux/can/error.h)."""

from __future__ import annotations

from dataclasses import dataclass

_TX_TIMEOUT = 0x001
_LOST_ARBITRATION = 0x002
_CONTROLLER = 0x004
_PROTOCOL = 0x008
_TRANSCEIVER = 0x010
_NO_ACK = 0x020
_BUS_OFF = 0x040
_BUS_ERROR = 0x080
_RESTARTED = 0x100
_COUNTERS = 0x200

_CLASSES = (
    (_TX_TIMEOUT, "transmit timeout"),
    (_LOST_ARBITRATION, "arbitration lost"),
    (_PROTOCOL, "protocol violation"),
    (_TRANSCEIVER, "transceiver fault (wiring)"),
    (_NO_ACK, "no acknowledgement: nobody else is on the bus, or at another bit rate"),
    (_BUS_ERROR, "bus error"),
)
_CONTROLLER_STATES = (
    (0x01, "receive overflow in the controller"),
    (0x02, "transmit overflow in the controller"),
    (0x04, "receive errors at warning level"),
    (0x08, "transmit errors at warning level"),
    (0x10, "receive errors at passive level"),
    (0x20, "transmit errors at passive level"),
)
_RECEIVE_OVERFLOW = 0x01


@dataclass(frozen=True, slots=True)
class CanBusError:
    """One error frame in words; the error counters are None where the adapter does not report them."""

    bus_off: bool
    harmful: bool
    receive_overflow: bool
    text: str
    tx_error_count: int | None
    rx_error_count: int | None


def decode_error_frame(error_class: int, data: bytes) -> CanBusError:
    """Return the meaning of an error frame from its class bits (its identifier) and data; any length is accepted.

    `harmful` is False for what only reports a recovery (controller active again, restarted) or counters.
    """
    detail = data.ljust(8, b"\0")
    controller = detail[1] if error_class & _CONTROLLER else 0
    words = [text for bit, text in _CLASSES if error_class & bit]
    words += [text for bit, text in _CONTROLLER_STATES if controller & bit]
    bus_off = bool(error_class & _BUS_OFF)
    if bus_off:
        words.insert(0, "bus-off: the controller has left the bus after too many errors")
    harmful = bool(words)
    if error_class & _RESTARTED:
        words.append("controller restarted")
    counted = bool(error_class & _COUNTERS)
    return CanBusError(
        bus_off=bus_off,
        harmful=harmful,
        receive_overflow=bool(controller & _RECEIVE_OVERFLOW),
        text=", ".join(words) or "controller is error-active",
        tx_error_count=detail[6] if counted else None,
        rx_error_count=detail[7] if counted else None,
    )
