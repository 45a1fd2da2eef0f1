"""Packs and unpacks the frames of `disco_robot.dbc`, their end-to-end header included.

The codec runs on flat tables, which tools/generate/protocol.py makes of the DBC, the one source of the wire layout.
"""

from __future__ import annotations

import enum
import math
import struct
from importlib import resources

import msgspec

from firmware_protocol import protection
from firmware_protocol.layout import MessageLayout, Protocol, SignalLayout
from firmware_protocol.protection import EncodedFrame


def packaged_dbc() -> str:
    """Return the text of the DBC that this package speaks."""
    return resources.files("firmware_protocol").joinpath("disco_robot.dbc").read_text("utf-8")


def _packaged_protocol() -> Protocol:
    written = resources.files("firmware_protocol").joinpath("firmware/disco_robot.json").read_bytes()
    return msgspec.json.decode(written, type=Protocol)


_FLOAT = struct.Struct("<f")
# Data bytes of a classic CAN frame.
_MAX_DATA = 8

PROTOCOL = _packaged_protocol()
PROTOCOL_MAJOR = PROTOCOL.major
PROTOCOL_MINOR = PROTOCOL.minor


class Decoded(msgspec.Struct, frozen=True, gc=False):
    """A frame that is well-formed; physical values in the DBC's units, `counter` -1 where the frame carries none."""

    name: str
    can_id: int
    counter: int
    values: dict[str, float]


class FaultReason(enum.Enum):
    """Reasons why a frame could not be decoded."""

    UNKNOWN_ID = "unknown_id"
    LENGTH = "length"
    CRC = "crc"
    PAGE = "page"


class DecodeFault(msgspec.Struct, frozen=True, gc=False):
    """A frame that must not be used; `name` is empty for an identifier that is not in the DBC."""

    reason: FaultReason
    name: str
    can_id: int


class _Plan(msgspec.Struct, frozen=True):
    """Precomputed decoding of one message: per page, (name, shift, mask, sign bit, scale) rows."""

    layout: MessageLayout
    crc_suffix: bytes
    page_shift: int
    page_mask: int
    rows: dict[int, tuple[tuple[str, int, int, int, float], ...]]
    float_rows: tuple[tuple[str, int], ...]


class _Slot(msgspec.Struct, frozen=True):
    """Precomputed encoding of one signal; raw values lie between `least` and `most`."""

    signal: SignalLayout
    name: str
    page: int | None
    shift: int
    least: int
    most: int
    values: dict[str, int]


class Codec:
    """The packaged DBC as an encoder and a decoder; it has no state between frames."""

    __slots__ = ("_by_id", "_by_name", "_slots", "dbc_hash")

    def __init__(self) -> None:
        self.dbc_hash = PROTOCOL.dbc_hash
        self._by_id = {layout.can_id: _plan(layout) for layout in PROTOCOL.messages}
        self._by_name = {layout.name: layout for layout in PROTOCOL.messages}
        self._slots = {layout.name: _slots(layout) for layout in PROTOCOL.messages}

    def can_id(self, name: str) -> int:
        """Return the CAN identifier of a message. Raises ValueError for a name that is not in the DBC."""
        return self._layout(name).can_id

    def choice_name(self, message: str, signal: str, value: float) -> str:
        """Return the name of a value in a signal's value table, or "UNKNOWN(value)" if the table does not have it."""
        return self._signal(message, signal).choices.get(int(value), f"UNKNOWN({int(value)})")

    def choices(self, message: str, signal: str) -> dict[int, str]:
        """Return a signal's value table."""
        return dict(self._signal(message, signal).choices)

    def choice_value(self, message: str, signal: str, name: str) -> int:
        """Return the value of a name in a signal's value table. Raises ValueError if the table does not have it."""
        values = _choice_values(self._signal(message, signal))
        if name not in values:
            raise ValueError(f"signal {signal} has no value named {name!r}")
        return values[name]

    def encode(self, name: str, counter: int = 0, **signals: float | str) -> EncodedFrame:
        """Pack physical values (or names of a value table) and fill in the E2E header where the message has one.

        Every signal of the message (of the chosen page, where there are pages) must be given. Raises ValueError for an
        unknown message, a missing or unknown signal, and a value that is not finite or out of the DBC's range:
        nothing is clipped here.
        """
        layout = self._layout(name)
        page = signals.get(layout.page_signal) if layout.page_signal else None
        remaining = dict(signals)
        bits = 0
        for slot in self._slots[name]:
            if slot.page is not None and slot.page != page:
                continue
            try:
                value = remaining.pop(slot.name)
            except KeyError:
                raise ValueError(f"{name}: signal {slot.name} is missing") from None
            bits |= _raw(name, slot, value) << slot.shift
        if remaining:
            raise ValueError(f"{name}: no such signal: {', '.join(remaining)}")
        if layout.data_id is None:
            return EncodedFrame(layout.can_id, bits.to_bytes(layout.length, "little"))
        protected = (bits >> 8 | counter % protection.COUNTER_MODULUS).to_bytes(layout.length - 1, "little")
        return EncodedFrame(layout.can_id, bytes((protection.crc8(protected, layout.data_id),)) + protected)

    def decode(self, can_id: int, data: bytes) -> Decoded | DecodeFault:
        """Unpack one received frame; whatever the wire brings, the answer is a value and never an exception.

        A message without E2E header (the emergency stop) is accepted with any length; missing bytes read as zero.
        The counter is returned, not judged: that is `protection.E2EReceiver`'s part.
        """
        plan = self._by_id.get(can_id)
        if plan is None:
            return DecodeFault(FaultReason.UNKNOWN_ID, "", can_id)
        layout = plan.layout
        counter = -1
        if plan.crc_suffix:
            if len(data) != layout.length:
                return DecodeFault(FaultReason.LENGTH, layout.name, can_id)
            if protection.crc8h2f(data[1:] + plan.crc_suffix) != data[0]:
                return DecodeFault(FaultReason.CRC, layout.name, can_id)
            counter = data[1] & 0x0F
        elif len(data) > _MAX_DATA:
            return DecodeFault(FaultReason.LENGTH, layout.name, can_id)
        bits = int.from_bytes(data, "little")
        rows = plan.rows.get(bits >> plan.page_shift & plan.page_mask)
        if rows is None:
            return DecodeFault(FaultReason.PAGE, layout.name, can_id)
        values: dict[str, float] = {
            name: (((bits >> shift & mask) ^ sign) - sign) * scale for name, shift, mask, sign, scale in rows
        }
        for name, offset in plan.float_rows:
            values[name] = _FLOAT.unpack_from(data, offset)[0]
        return Decoded(layout.name, can_id, counter, values)

    def _layout(self, name: str) -> MessageLayout:
        try:
            return self._by_name[name]
        except KeyError:
            raise ValueError(f"no message {name!r} in the DBC") from None

    def _signal(self, message: str, signal: str) -> SignalLayout:
        for layout in self._layout(message).signals:
            if layout.name == signal:
                return layout
        raise ValueError(f"{message}: no such signal: {signal}")


def _plan(layout: MessageLayout) -> _Plan:
    page_signal = next((signal for signal in layout.signals if signal.name == layout.page_signal), None)
    pages = sorted({signal.page for signal in layout.signals if signal.page is not None}) or [0]
    protected = layout.data_id is not None
    return _Plan(
        layout=layout,
        crc_suffix=layout.data_id.to_bytes(2, "little") if layout.data_id is not None else b"",
        page_shift=page_signal.shift if page_signal else 0,
        page_mask=(1 << page_signal.width) - 1 if page_signal else 0,
        rows={
            page: tuple(
                (signal.name, signal.shift, (1 << signal.width) - 1, signal.signed << (signal.width - 1), signal.scale)
                for signal in layout.signals
                if signal.page in (None, page)
                and not signal.is_float
                and not (protected and signal.name in {"crc", "counter"})
            )
            for page in pages
        },
        float_rows=tuple((signal.name, signal.shift // 8) for signal in layout.signals if signal.is_float),
    )


def _slots(layout: MessageLayout) -> tuple[_Slot, ...]:
    filled_in = {"crc", "counter"} if layout.data_id is not None else set()
    return tuple(
        _Slot(
            signal=signal,
            name=signal.name,
            page=signal.page,
            shift=signal.shift,
            least=round(signal.minimum / signal.scale),
            most=round(signal.maximum / signal.scale),
            values=_choice_values(signal),
        )
        for signal in layout.signals
        if signal.name not in filled_in
    )


def _choice_values(signal: SignalLayout) -> dict[str, int]:
    return {name: value for value, name in signal.choices.items()}


def _raw(message: str, slot: _Slot, value: float | str) -> int:
    """Return the signal's bits, unshifted; rounds halves up, as the C core does."""
    signal = slot.signal
    if isinstance(value, str):
        if value not in slot.values:
            raise ValueError(f"signal {slot.name} has no value named {value!r}")
        value = slot.values[value]
    if not math.isfinite(value):
        raise ValueError(f"{message}.{slot.name}: {value} is not finite")
    if signal.is_float:
        if not signal.minimum <= value <= signal.maximum:
            raise ValueError(f"{message}.{slot.name}: {value} is not within {signal.minimum} to {signal.maximum}")
        return int.from_bytes(_FLOAT.pack(value), "little")
    raw = math.floor(value / signal.scale + 0.5)
    if not slot.least <= raw <= slot.most:
        raise ValueError(
            f"{message}.{slot.name}: {value} {signal.unit} is not within {signal.minimum} to {signal.maximum}"
        )
    return raw & ((1 << signal.width) - 1)
