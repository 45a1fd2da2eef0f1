"""One case of a vector file, and what of it did not agree."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from drivers.types import Frame
from sim.can_protocol import CanFrame

Case = Mapping[str, Any]
_F32 = struct.Struct("<f")


@dataclass(slots=True)
class Comparison:
    """Comparison with a test vector: `differences` in words; `rounded`: something differed by rounding alone."""

    differences: list[str] = field(default_factory=list)
    rounded: bool = False

    def same(self, what: str, ours: object, theirs: object) -> None:
        """Note a difference unless both are the same; numbers as 32-bit floats, not-a-number equals itself."""
        if not equal(ours, theirs):
            self.differences.append(f"{what}: ours {ours!r}, theirs {theirs!r}")

    def within(self, what: str, ours: float, theirs: float, allowed: float) -> None:
        """Note a difference above `allowed`, and that there was one at all."""
        if equal(ours, theirs):
            return
        if abs(ours - theirs) <= allowed * (1.0 + 1e-6):
            self.rounded = True
        else:
            self.differences.append(f"{what}: ours {ours!r}, theirs {theirs!r}, more than {allowed:g} apart")


def number(value: object) -> Any:
    """A value of a case: the words for what JSON has no number for become floats."""
    constants = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}
    return constants[value] if isinstance(value, str) and value in constants else value


def f32(value: float) -> float:
    """Round to what a 32-bit float holds; beyond it, to infinity."""
    try:
        return float(_F32.unpack(_F32.pack(value))[0])
    except OverflowError:
        return math.copysign(math.inf, value)


def equal(ours: object, theirs: object) -> bool:
    """Whether two values of a case are the same."""
    ours, theirs = number(ours), number(theirs)
    if isinstance(ours, Mapping) and isinstance(theirs, Mapping):
        return ours.keys() == theirs.keys() and all(equal(ours[key], theirs[key]) for key in ours)
    if _is_list(ours) and _is_list(theirs):
        return len(ours) == len(theirs) and all(map(equal, ours, theirs))
    if isinstance(ours, float) or isinstance(theirs, float):
        if not isinstance(ours, int | float) or not isinstance(theirs, int | float):
            return False
        if math.isnan(ours) or math.isnan(theirs):
            return math.isnan(ours) and math.isnan(theirs)
        return f32(ours) == f32(theirs)
    return bool(ours == theirs)


def on_bus(frame: Mapping[str, Any]) -> CanFrame:
    """A frame of a case as one on the simulated bus."""
    remote = bool(frame.get("rtr"))
    return CanFrame(frame["id"], bytes.fromhex(frame["data"]), frame["extended"], remote, False, frame.get("dlc", 0))


def of_driver(frame: Mapping[str, Any]) -> Frame:
    """A frame of a case as a driver has it."""
    return Frame(frame["id"], bytes.fromhex(frame["data"]), frame["extended"])


def as_case(frame: Frame | CanFrame) -> dict[str, object]:
    """A frame as a case writes it."""
    return {"id": frame.can_id, "extended": frame.extended, "data": frame.data.hex()}


def as_cases(frames: Sequence[Frame | CanFrame]) -> list[dict[str, object]]:
    """Frames as a case writes them."""
    return [as_case(frame) for frame in frames]


def _is_list(value: object) -> bool:
    return isinstance(value, list | tuple)
