"""A fault schedule as it runs: which faults are in force, and what they make of each frame.

Pure: time enters through `FaultTimeline.step` and `FrameFaults.fate`. The hands are in `sim.fault_player`.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import NamedTuple

from sim.bus import UNHARMED, FrameFate
from sim.can_frame import CanFrame
from sim.fault_schedule import Fault, FaultSchedule, Room

ROBOT_NODE = "robot"
LONGEST_FRAME_BITS = 111


class Step(NamedTuple):
    """What changes at one instant."""

    begun: tuple[Fault, ...]
    ended: tuple[Fault, ...]


_NOTHING = Step((), ())


class FaultTimeline:
    """Walks a schedule; `active` holds the faults in force, `done` says that nothing more will happen."""

    def __init__(self, schedule: FaultSchedule) -> None:
        self.active: tuple[Fault, ...] = ()
        self._coming = list(reversed(schedule.faults))
        self._next_ns = self._find_next_ns()

    @property
    def done(self) -> bool:
        """Whether all faults are over."""
        return self._next_ns is None

    def step(self, now_ns: int) -> Step:
        """Move on to `now_ns` of the schedule's time; a fault that lasts no time begins and ends in one step."""
        if self._next_ns is None or now_ns < self._next_ns:
            return _NOTHING
        begun: list[Fault] = []
        while self._coming and self._coming[-1].begin_ns <= now_ns:
            begun.append(self._coming.pop())
        held = (*self.active, *begun)
        ended = tuple(fault for fault in held if fault.end_ns <= now_ns)
        self.active = tuple(fault for fault in held if fault.end_ns > now_ns)
        self._next_ns = self._find_next_ns()
        return Step(tuple(begun), ended)

    def _find_next_ns(self) -> int | None:
        times = [fault.end_ns for fault in self.active]
        if self._coming:
            times.append(self._coming[-1].begin_ns)
        return min(times) if times else None


class FrameFaults:
    """Decides what becomes of each frame; satisfies `sim.bus.BusFault` and serves serial lines as well.

    `struck` counts the frames touched, by the number of the fault. A frame that more than one fault touches gets the
    first one's fate. `break_next` lets the line break in the middle of the next frame, which sets `broken`.
    """

    def __init__(self, seed: int) -> None:
        self.struck: dict[int, int] = {}
        self.break_next = False
        self.broken = False
        self._chance = random.Random(seed)
        self._active: tuple[Fault, ...] = ()
        self._since_ns: dict[int, int] = {}

    def set_active(self, active: Sequence[Fault]) -> None:
        """Take those of `active` that concern frames as the faults in force."""
        self._active = tuple(f for f in active if f.kind.room is Room.FRAMES or f.kind.name == "one_way")

    def fate(self, now_ns: int, sender: str, frame: CanFrame) -> FrameFate:
        """What becomes of one frame on its way; frames of the node "robot" go to the host, all others to the robot."""
        if self.break_next:
            self.break_next, self.broken = False, True
            return FrameFate(wire_error_bit=LONGEST_FRAME_BITS // 2, cut=True)
        for fault in self._active:
            to = "host" if sender == ROBOT_NODE else "robot"
            if fault["to"] not in (to, "both"):
                continue
            if fault.kind.room is Room.FRAMES and not self._picks(fault, frame):
                continue
            self.struck[fault.number] = self.struck.get(fault.number, 0) + 1
            return self._fate(now_ns, fault, to, frame)
        return UNHARMED

    def _picks(self, fault: Fault, frame: CanFrame) -> bool:
        return fault["id"] in (-1, frame.can_id) and self._chance.random() < fault["probability"]

    def _fate(self, now_ns: int, fault: Fault, to: str, frame: CanFrame) -> FrameFate:
        chance = self._chance
        match fault.kind.name:
            case "drop" | "one_way":
                return FrameFate(lost=True) if to == "host" else FrameFate(lost_at=(ROBOT_NODE,))
            case "duplicate":
                return FrameFate(copies=2)
            case "delay":
                lasted_ns = now_ns - self._since_ns.setdefault(fault.number, now_ns)
                return FrameFate(delay_ns=round(fault["delay_s"] * 1e9 + fault["growth"] * lasted_ns))
            case "reorder":
                return FrameFate(delay_ns=round(chance.random() * fault["window_s"] * 1e9))
            case "flip_before_crc":
                return FrameFate(wire_error_bit=chance.randrange(LONGEST_FRAME_BITS))
            case "flip_after_crc" if frame.data:
                data = bytearray(frame.data)
                data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
                return FrameFate(data=bytes(data))
            case "wrong_length":
                length = chance.choice([n for n in range(9) if n != len(frame.data)])
                return FrameFate(data=frame.data[:length] + bytes(max(0, length - len(frame.data))))
        return UNHARMED
