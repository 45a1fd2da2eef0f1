"""Reads the packaged DBC, the one source of the wire layout, into flat tables that a codec can run on."""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING

import msgspec

from firmware_protocol.protection import data_id

if TYPE_CHECKING:
    import cantools.database.can

TABLES = "firmware/disco_robot.json"
_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|[^\s":;,|@()\[\]]+|[:;,|@()\[\]]')


@dataclass(frozen=True, slots=True)
class SignalLayout:
    """One little-endian signal: where it lies in the frame and what its raw value means (physical = scale * raw)."""

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
    """One message; `data_id` is None where it carries no E2E header, `page_signal` names the multiplexer if any.

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
    """Everything that the DBC says; `dbc_hash` is equal for two files that mean the same on the wire."""

    major: int
    minor: int
    dbc_hash: int
    messages: tuple[MessageLayout, ...]


@dataclass(frozen=True, slots=True)
class Tables:
    """What tools/generate_protocol.py writes for Python: the tables, and the CRC-32 of the DBC that they are of."""

    crc: int
    protocol: Protocol


def packaged_dbc() -> str:
    """Return the text of the DBC that this package speaks."""
    return resources.files("firmware_protocol").joinpath("disco_robot.dbc").read_text("utf-8")


def dbc_hash(text: str) -> int:
    """Return the CRC-32 of a DBC without its comments, with one blank between tokens.

    Both ends compare it in the handshake, so that two builds with different layouts or tables never move a wheel.
    """
    kept: list[str] = []
    in_comment = False
    for token in _TOKEN.findall(text):
        in_comment = in_comment or token == "CM_"
        if not in_comment:
            kept.append(token)
        elif token == ";":
            in_comment = False
    return zlib.crc32(" ".join(kept).encode())


@cache
def packaged_protocol() -> Protocol:
    """Return the tables of the packaged DBC, from what tools/generate_protocol.py wrote of them if that is current."""
    text = packaged_dbc()
    try:
        written = resources.files("firmware_protocol").joinpath(TABLES).read_bytes()
        tables = msgspec.json.decode(written, type=Tables)
    except (OSError, msgspec.MsgspecError):
        return load_protocol(text)
    return tables.protocol if tables.crc == zlib.crc32(text.encode()) else load_protocol(text)


def load_protocol(text: str) -> Protocol:
    """Read a DBC into tables.

    Raises ValueError for a DBC without protocol version, and for what this protocol does not use: big-endian signals
    and offsets.
    """
    # A third of a second that only a DBC other than the packaged one takes.
    import cantools.database.can  # noqa: PLC0415

    database = cantools.database.can.Database()
    database.add_dbc_string(text)
    attributes = database.dbc.attributes if database.dbc is not None else {}
    if not {"ProtocolMajor", "ProtocolMinor"} <= attributes.keys():
        raise ValueError("the DBC has no attributes ProtocolMajor and ProtocolMinor")
    major = int(attributes["ProtocolMajor"].value)
    return Protocol(
        major=major,
        minor=int(attributes["ProtocolMinor"].value),
        dbc_hash=dbc_hash(text),
        messages=tuple(_message_layout(message, major) for message in database.messages),
    )


def _message_layout(message: cantools.database.can.Message, major: int) -> MessageLayout:
    any_major = message.dbc.attributes.get("E2EAnyMajor") if message.dbc is not None else None
    data_id_major = 0 if any_major is not None and int(any_major.value) else major
    names = {signal.name for signal in message.signals}
    multiplexers = [signal.name for signal in message.signals if signal.is_multiplexer]
    return MessageLayout(
        name=message.name,
        can_id=message.frame_id,
        length=message.length,
        sender=message.senders[0],
        data_id=data_id(message.frame_id, data_id_major) if {"crc", "counter"} <= names else None,
        page_signal=multiplexers[0] if multiplexers else None,
        period_s=message.cycle_time / 1000.0 if message.cycle_time else None,
        signals=tuple(_signal_layout(signal) for signal in message.signals),
    )


def _signal_layout(signal: cantools.database.can.Signal) -> SignalLayout:
    if signal.byte_order != "little_endian" or signal.offset != 0:
        raise ValueError(f"signal {signal.name}: only little-endian signals without offset are used")
    raw_maximum = (1 << (signal.length - signal.is_signed)) - 1
    return SignalLayout(
        name=signal.name,
        shift=signal.start,
        width=signal.length,
        signed=signal.is_signed,
        is_float=signal.is_float,
        scale=signal.scale,
        minimum=signal.minimum if signal.minimum is not None else -(raw_maximum + 1) * signal.is_signed * signal.scale,
        maximum=signal.maximum if signal.maximum is not None else raw_maximum * signal.scale,
        unit=signal.unit or "",
        choices={int(value): str(name) for value, name in (signal.choices or {}).items()},
        page=signal.multiplexer_ids[0] if signal.multiplexer_ids else None,
    )
