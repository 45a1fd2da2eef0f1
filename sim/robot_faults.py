"""What faults make of the robot's sensors, motors and battery, between the plant and the controller."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from msgspec.structs import replace

from firmware_protocol.firmware_core import FirmwareInputs
from sim.fault_schedule import Fault, Room
from sim.pose_sensor import PoseMeasurement

STALL_CURRENT_A = 18.0
_SIDES = ("left", "right")
_OF_ONE_WHEEL = ("motor_stall", "encoder_stuck", "encoder_wrap", "encoder_reversed")


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
        self.active: tuple[Fault, ...] = ()
        self._encoders = (_Encoder(), _Encoder())
        self._touched = False
        self._changed = False
        self._jumps: list[Fault] = []
        self._late: deque[tuple[int, PoseMeasurement]] = deque()
        self._last_pose: PoseMeasurement | None = None
        self._sort_out()

    def set_active(self, active: Sequence[Fault], begun: Sequence[Fault] = ()) -> None:
        """Take what concerns the robot out of `active`; of `begun`, what happens once."""
        self.active = tuple(f for f in active if f.kind.room in (Room.SENSORS, Room.ROBOT))
        self._jumps += [fault for fault in begun if fault.kind.name == "encoder_jump"]
        self._changed = True
        self._touched = self._touched or any(f.kind.name.startswith("encoder") for f in (*self.active, *begun))
        self._sort_out()

    def setpoints(self, left_rad_s: float, right_rad_s: float) -> tuple[float, float]:
        """What the motors make of the setpoints (rad/s)."""
        stalled = self._by_wheel["motor_stall"]
        return (0.0 if "left" in stalled else left_rad_s), (0.0 if "right" in stalled else right_rad_s)

    def poses(self, now_us: int, measured: Sequence[PoseMeasurement]) -> Sequence[PoseMeasurement]:
        """What becomes of the poses measured by `now_us` of robot time."""
        if not self.active and not self._late:
            if measured:
                self._last_pose = measured[-1]
            return measured
        for pose in measured:
            changed = self._changed_pose(pose)
            if changed is not None:
                self._late.append((now_us + self._delay_us, changed))
        due: list[PoseMeasurement] = []
        while self._late and self._late[0][0] <= now_us:
            due.append(self._late.popleft()[1])
        return due

    def inputs(self, inputs: FirmwareInputs, setpoints: tuple[float, float], driver_enabled: bool) -> FirmwareInputs:
        """What the controller measures; `setpoints` are what it asked for (rad/s)."""
        if not self._touched and not self.active:
            return inputs
        ticks = [inputs.left_ticks, inputs.right_ticks]
        speeds = [inputs.left_speed_rad_s, inputs.right_speed_rad_s]
        currents = [inputs.left_current_a, inputs.right_current_a]
        stalled, stuck, wrapped, backwards = (self._by_wheel[kind] for kind in _OF_ONE_WHEEL)
        for index, side in enumerate(_SIDES):
            encoder = self._encoders[index]
            if self._changed:
                bits = wrapped.get(side)
                encoder.set(
                    ticks[index],
                    reversed_=side in backwards,
                    stuck=side in stuck,
                    modulus=None if bits is None else 1 << bits["bits"],
                )
                encoder.offset += sum(jump["ticks"] for jump in self._jumps if jump["wheel"] == side)
            ticks[index] = encoder.count(ticks[index])
            speeds[index] *= 0.0 if side in stuck else encoder.sign
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

    def _sort_out(self) -> None:
        """What each cycle asks of the active faults, found once."""
        self._by_wheel = {
            kind: {fault["wheel"]: fault for fault in self.active if fault.kind.name == kind} for kind in _OF_ONE_WHEEL
        }
        self._delay_us = max((round(f["delay_s"] * 1e6) for f in self.active if f.kind.name == "pose_late"), default=0)
        self._drop_v = max((f["drop_v"] for f in self.active if f.kind.name == "battery_sag"), default=0.0)
