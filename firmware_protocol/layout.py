"""Tables of the wire layout, which tools/generate/protocol.py makes of the DBC; it needs nothing that reads them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SignalLayout:
    """Layout of one little-endian signal: its place in the frame and its raw value (physical = scale * raw)."""

    name: str
    shift: int
    width: int
    signed: bool
    is_float: bool
    scale: float
    minimum: float
    maximum: float
    unit: str
    choices: dict[int, str]
    page: int | None


@dataclass(frozen=True, slots=True)
class MessageLayout:
    """Layout of one message; `data_id` is None without an E2E header, `page_signal` names the multiplexer if any.

    `period_s` is None for what is sent only when there is something to say.
    """

    name: str
    can_id: int
    length: int
    sender: str
    data_id: int | None
    page_signal: str | None
    period_s: float | None
    signals: tuple[SignalLayout, ...]


@dataclass(frozen=True, slots=True)
class Protocol:
    """Protocol as the DBC defines it; `dbc_hash` is equal for two files that mean the same on the wire."""

    major: int
    minor: int
    dbc_hash: int
    messages: tuple[MessageLayout, ...]
