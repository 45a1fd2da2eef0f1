"""The effect of the faults in force on frames, sensors, motors and battery.

Pure: time enters through `FrameFaults.fate` and `RobotFaults`. `sim.fault_player` walks the schedule.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from msgspec.structs import replace

from firmware_protocol.firmware_core import FirmwareInputs
from sim import ROBOT_NODE
from sim.bus import UNHARMED, FrameOutcome
from sim.can_protocol import CanFrame
from sim.fault_schedule import ScheduledFault, Site
from sim.sensors import PoseMeasurement

# ISO 11898-1: 8 data bytes and an 11-bit identifier, without stuff bits, with the intermission.
LONGEST_FRAME_BITS = 111
# Chosen: so large that a stalled motor shows in the reading.
STALL_CURRENT_A = 18.0
_SIDES = ("left", "right")
_OF_ONE_WHEEL = (
    "motor_stall", "motor_runaway", "encoder_stuck", "encoder_disconnected", "encoder_wrap", "encoder_reversed",
)  # fmt: skip
_FLOATING_TICKS = 3
"""A line that hangs in the air makes the count tremble by so much at most."""


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
        self._active: tuple[ScheduledFault, ...] = ()
        self._since_ns: dict[int, int] = {}

    def set_active(self, active: Sequence[ScheduledFault]) -> None:
        """Take those of `active` that concern frames as the faults in force."""
        self._active = tuple(f for f in active if f.kind.site is Site.FRAMES or f.kind.name == "one_way")

    def outcome(self, now_ns: int, sender: str, frame: CanFrame) -> FrameOutcome:
        """Return what happens to one frame; frames of the node "robot" go to the host, all others to the robot."""
        if self.break_next:
            self.break_next, self.broken = False, True
            return FrameOutcome(wire_error_bit=LONGEST_FRAME_BITS // 2, cut=True)
        for fault in self._active:
            to = "host" if sender == ROBOT_NODE else "robot"
            if fault["to"] not in (to, "both"):
                continue
            if fault.kind.site is Site.FRAMES and not self._picks(fault, frame):
                continue
            self.struck[fault.number] = self.struck.get(fault.number, 0) + 1
            return self._outcome(now_ns, fault, to, frame)
        return UNHARMED

    def _picks(self, fault: ScheduledFault, frame: CanFrame) -> bool:
        return fault["id"] in (-1, frame.can_id) and self._chance.random() < fault["probability"]

    def _outcome(self, now_ns: int, fault: ScheduledFault, to: str, frame: CanFrame) -> FrameOutcome:
        chance = self._chance
        match fault.kind.name:
            case "drop" | "one_way":
                return FrameOutcome(lost=True) if to == "host" else FrameOutcome(lost_at=(ROBOT_NODE,))
            case "duplicate":
                return FrameOutcome(copies=2)
            case "delay":
                lasted_ns = now_ns - self._since_ns.setdefault(fault.number, now_ns)
                return FrameOutcome(delay_ns=round(fault["delay_s"] * 1e9 + fault["growth"] * lasted_ns))
            case "reorder":
                return FrameOutcome(delay_ns=round(chance.random() * fault["window_s"] * 1e9))
            case "flip_before_crc":
                return FrameOutcome(wire_error_bit=chance.randrange(LONGEST_FRAME_BITS))
            case "flip_after_crc" if frame.data:
                data = bytearray(frame.data)
                data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
                return FrameOutcome(data=bytes(data))
            case "wrong_length":
                length = chance.choice([n for n in range(9) if n != len(frame.data)])
                return FrameOutcome(data=frame.data[:length] + bytes(max(0, length - len(frame.data))))
        return UNHARMED


@dataclass(slots=True)
class _Encoder:
    """One encoder's count is `offset + sign * ticks` unless it is stuck; the count never jumps unasked."""

    offset: int = 0
    sign: int = 1
    stuck_at: int | None = None
    modulus: int | None = None

    def count(self, ticks: int) -> int:
        count = self.offset + self.sign * ticks if self.stuck_at is None else self.stuck_at
        return count if self.modulus is None else count % self.modulus

    def set(self, ticks: int, *, reversed_: bool, stuck: bool, modulus: int | None) -> None:
        now = self.offset + self.sign * ticks if self.stuck_at is None else self.stuck_at
        self.sign = -1 if reversed_ else 1
        self.offset = now - self.sign * ticks
        self.stuck_at = now if stuck else None
        self.modulus = modulus


class RobotFaults:
    """Stands between plant and firmware; `active` are the faults of sensors and robot in force.

    A reversed encoder turns the reported speed as well; the loop of the motor controller is taken to be sound.
    """

    def __init__(self) -> None:
        self.active: tuple[ScheduledFault, ...] = ()
        self._encoders = (_Encoder(), _Encoder())
        self._chance = random.Random(0)
        self._touched = False
        self._changed = False
        self._jumps: list[ScheduledFault] = []
        self._delayed: deque[tuple[int, PoseMeasurement]] = deque()
        self._last_pose: PoseMeasurement | None = None
        self._classify()

    def set_active(self, active: Sequence[ScheduledFault], begun: Sequence[ScheduledFault] = ()) -> None:
        """Take what concerns the robot out of `active`; of `begun`, what happens once."""
        self.active = tuple(f for f in active if f.kind.site in (Site.SENSORS, Site.ROBOT))
        self._jumps += [fault for fault in begun if fault.kind.name == "encoder_jump"]
        self._changed = True
        self._touched = self._touched or any(f.kind.name.startswith("encoder") for f in (*self.active, *begun))
        self._classify()

    def setpoints(self, left_rad_s: float, right_rad_s: float, *, is_driven: bool) -> tuple[float, float]:
        """Return what the motors make of the setpoints (rad/s); one runs away only while its controller drives it."""
        if not self.active:
            return left_rad_s, right_rad_s
        stalled, runaway = self._by_wheel["motor_stall"], self._by_wheel["motor_runaway"]
        made = {"left": left_rad_s, "right": right_rad_s}
        for side in stalled:
            made[side] = 0.0
        for side, fault in runaway.items() if is_driven else ():
            made[side] = fault["speed_rad_s"]
        return made["left"], made["right"]

    def poses(self, now_us: int, measured: Sequence[PoseMeasurement]) -> Sequence[PoseMeasurement]:
        """Return the poses that the faults let through by `now_us` of robot time, changed or delayed."""
        if not self.active and not self._delayed:
            if measured:
                self._last_pose = measured[-1]
            return measured
        for pose in measured:
            changed = self._changed_pose(pose)
            if changed is not None:
                self._delayed.append((now_us + self._delay_us, changed))
        due: list[PoseMeasurement] = []
        while self._delayed and self._delayed[0][0] <= now_us:
            due.append(self._delayed.popleft()[1])
        return due

    def inputs(self, inputs: FirmwareInputs, setpoints: tuple[float, float], driver_enabled: bool) -> FirmwareInputs:
        """Return the measurements of the controller under the faults; `setpoints` are what it requested (rad/s)."""
        if not self._touched and not self.active:
            return inputs
        ticks = [inputs.left_ticks, inputs.right_ticks]
        speeds = [inputs.left_speed_rad_s, inputs.right_speed_rad_s]
        currents = [inputs.left_current_a, inputs.right_current_a]
        stalled, stuck = self._by_wheel["motor_stall"], self._by_wheel["encoder_stuck"]
        wrapped, backwards = self._by_wheel["encoder_wrap"], self._by_wheel["encoder_reversed"]
        floating = self._by_wheel["encoder_disconnected"]
        for index, side in enumerate(_SIDES):
            encoder = self._encoders[index]
            if self._changed:
                bits = wrapped.get(side)
                encoder.set(
                    ticks[index],
                    reversed_=side in backwards,
                    stuck=side in stuck or side in floating,
                    modulus=None if bits is None else 1 << bits["bits"],
                )
                encoder.offset += sum(jump["ticks"] for jump in self._jumps if jump["wheel"] == side)
            ticks[index] = encoder.count(ticks[index])
            speeds[index] *= 0.0 if side in stuck or side in floating else encoder.sign
            if side in floating:
                ticks[index] += self._chance.randint(-_FLOATING_TICKS, _FLOATING_TICKS)
            if side in stalled and driver_enabled and setpoints[index] != 0.0:
                currents[index] = math.copysign(STALL_CURRENT_A, setpoints[index])
        self._changed = False
        self._jumps.clear()
        return replace(
            inputs,
            left_ticks=ticks[0],
            right_ticks=ticks[1],
            left_speed_rad_s=speeds[0],
            right_speed_rad_s=speeds[1],
            left_current_a=currents[0],
            right_current_a=currents[1],
            voltage_v=max(0.0, inputs.voltage_v - self._drop_v),
        )

    def _changed_pose(self, pose: PoseMeasurement) -> PoseMeasurement | None:
        for fault in self.active:
            match fault.kind.name:
                case "pose_silent":
                    return None
                case "pose_frozen" if self._last_pose is not None:
                    old = self._last_pose
                    return replace(pose, x_m=old.x_m, y_m=old.y_m, yaw_rad=old.yaw_rad)
                case "pose_jump":
                    yaw_rad = math.remainder(pose.yaw_rad + fault["dyaw_rad"], 2.0 * math.pi)
                    return replace(pose, x_m=pose.x_m + fault["dx_m"], y_m=pose.y_m + fault["dy_m"], yaw_rad=yaw_rad)
                case "pose_swapped":
                    return replace(pose, x_m=pose.y_m, y_m=pose.x_m)
                case "pose_nan":
                    return replace(pose, x_m=math.nan, yaw_rad=math.nan)
        return pose

    def _classify(self) -> None:
        """Look up, once for all cycles, what each cycle needs of the active faults."""
        self._by_wheel = {
            kind: {fault["wheel"]: fault for fault in self.active if fault.kind.name == kind} for kind in _OF_ONE_WHEEL
        }
        self._delay_us = max((round(f["delay_s"] * 1e6) for f in self.active if f.kind.name == "pose_late"), default=0)
        self._drop_v = max((f["drop_v"] for f in self.active if f.kind.name == "battery_sag"), default=0.0)
