"""Driver of a toy controller, with three frames on CAN, each with a checksum in its first byte.

0x210 to the robot: request (0 stand by, 2 arm, 3 reset), session, time it holds (ms), left and right speed (mrad/s).
0x211 from the robot: state (0 idle, 1 armed, 2 fault, 3 e-stop), session, cause, ticks per turn, top speed (mrad/s).
0x212 from the robot: left and right speed (mrad/s), left and right ticks modulo 4096.
A frame 0x010 stops it in any state.
"""

import math
import secrets
import struct
import zlib

from drivers.motor import vendor_parts as parts
from drivers.motor.permit import Controllers, Stage
from drivers.motor.vendor_driver import (
    IMPLAUSIBLE,
    REJECTED_LENGTH,
    UNKNOWN,
    FrameReport,
    Objection,
    Pending,
    Port,
    Source,
    Table,
    VendorDriver,
)
from drivers.types import CyclicFrame, Frame, Identity, Limit, Limits, MotorDriver, Request, SafetyCard

STOP_ID, COMMAND_ID, STATE_ID, WHEELS_ID = 0x010, 0x210, 0x211, 0x212
IDLE, ARMED, FAULT, ESTOP = range(4)
STAND_BY, ARM, RESET = 0, 2, 3
HOLDS_MS = 100
SILENT_NS, GONE_NS = 200_000_000, 500_000_000
DECELERATION_RAD_S2 = 20.0


class ToyPort(Port):
    """Port of `VendorDriver` for the toy controller."""

    def __init__(self):
        self.table = Table(stop_deceleration_rad_s2=DECELERATION_RAD_S2, zeros_to_arm=0)
        self._session = 0
        self._turned = (parts.Odometer(), parts.Odometer())
        self._ticks_per_rev, self._fastest_rad_s = 1, 0.0
        self.reset_state(0)

    @property
    def seen(self):
        return Controllers(
            missing="no answer; is the controller switched on?" if self._state_ns is None else None,
            stopped="emergency stop; release the button, then reset" if self._state == ESTOP else None,
            faulty=f"the controller reports fault {self._cause}" if self._state == FAULT else None,
            energised=self._state == ARMED,
        )

    @property
    def identity(self):
        return None if self._state_ns is None else Identity("toy", "", "robot.toml")

    @property
    def limits(self):
        return Limits(
            max_wheel_speed_rad_s=Limit(self._fastest_rad_s, "device"),
            ticks_per_rev=Limit(self._ticks_per_rev, "device"),
            command_timeout_s=Limit(1e-3 * HOLDS_MS, "fixed"),
            stop_deceleration_rad_s2=Limit(DECELERATION_RAD_S2, "fixed"),
        )

    @property
    def is_stopped(self):
        return self._state == ESTOP

    def reset_state(self, now_ns):
        self._state_ns, self._state, self._armed_session, self._cause = None, IDLE, 0, 0
        for side in self._turned:
            side.reset_state()

    def handle(self, received, permit):
        can_id, data = received.frame.can_id, received.frame.data
        if can_id == STOP_ID:
            return FrameReport(counts=("unknown_id",), is_stop=True)
        if can_id == COMMAND_ID:
            return FrameReport(counts=("unknown_id",), commanded="the controller")
        if can_id not in (STATE_ID, WHEELS_ID):
            return UNKNOWN
        if len(data) != 8:
            return REJECTED_LENGTH
        if data[0] != checksum(can_id, data[1:]):
            return FrameReport(counts=("rejected_crc",))
        if can_id == WHEELS_ID:
            return self._handle_wheels(data, received.t_ns, permit.looked_ns)
        _, state, self._armed_session, self._cause, self._ticks_per_rev, speed = struct.unpack("<BBBBHH", data)
        self._state, self._state_ns = state if state <= ESTOP else FAULT, received.t_ns
        self._ticks_per_rev, self._fastest_rad_s = max(1, self._ticks_per_rev), 1e-3 * speed
        return FrameReport(is_status=True)

    def sources(self):
        return (Source("the controller", self._state_ns, SILENT_NS, GONE_NS),)

    def objection(self, permit):
        if self._state == ESTOP:
            return Objection("the controller was stopped")
        if self._state == FAULT:
            return Objection(f"the controller reports fault {self._cause}")
        if permit.stage is Stage.ARMED and not self._is_ours:
            return Objection(f"disarmed: the controller stopped by itself, cause {self._cause}", is_fault=False)
        return None

    def prepare(self, now_ns, permit):
        if permit.lasts_ns(now_ns) == 0:
            # Each arming has a session of its own, so that no old frame arms it.
            self._session = (self._session + 1 + secrets.randbelow(254)) % 255
        why = "the controller did not arm; is a second host connected?"
        return None if self._is_ours else Pending(why=why, frames=(self._command(ARM),))

    def speeds(self, now_ns, left_rad_s, right_rad_s):
        return (self._command(ARM, left_rad_s, right_rad_s),)

    def brake(self, now_ns, lasts_ns):
        return (self._command(STAND_BY),), self._state != ARMED

    def rest(self, now_ns, permit):
        return (self._command(RESET if permit.target is Request.RESET else STAND_BY),)

    def stop_frames(self):
        return (Frame(STOP_ID, b""),)

    @property
    def _is_ours(self):
        return self._state == ARMED and self._armed_session == self._session

    def _command(self, request, left_rad_s=0.0, right_rad_s=0.0):
        speeds = round(1e3 * left_rad_s), round(1e3 * right_rad_s)
        payload = struct.pack("<BBBhh", request, self._session, HOLDS_MS, *speeds)
        return Frame(COMMAND_ID, bytes([checksum(COMMAND_ID, payload)]) + payload)

    def _handle_wheels(self, data, t_ns, looked_ns):
        if self._state_ns is None:
            return FrameReport()
        _, *speeds = struct.unpack("<Bhh", data[:5])
        ticks = divmod(int.from_bytes(data[5:]), 4096)
        per_tick = 2.0 * math.pi / self._ticks_per_rev
        fastest = 1.5 * self._fastest_rad_s / per_tick
        plausible = [
            side.add_wrapping(count, t_ns, looked_ns, fastest, 4.0, bits=12)
            for side, count in zip(self._turned, ticks, strict=True)
        ]
        for side, speed in zip(self._turned, speeds, strict=True):
            side.speed = 1e-3 * speed / per_tick
        wheels = parts.wheel_sample(t_ns, [[side] for side in self._turned], (1, 1), per_tick)
        return FrameReport(
            counts=FrameReport().counts if all(plausible) else IMPLAUSIBLE, wheels=wheels if all(plausible) else None
        )


def checksum(can_id, payload):
    return zlib.crc32(bytes([can_id & 0xFF]) + payload) & 0xFF


def stop_confirmation(_settings):
    def is_confirmation(received):
        frame = received.frame
        return frame.can_id == STATE_ID and len(frame.data) == 8 and frame.data[1] == ESTOP

    return is_confirmation


DRIVER = MotorDriver(
    "toy",
    lambda _settings, _key: VendorDriver(ToyPort()),
    stop_frames=lambda _settings: (Frame(STOP_ID, b""),),
    stop_confirmation=stop_confirmation,
    cyclic_frames=lambda _settings, rate_hz, _authenticated: (
        CyclicFrame("command", "HOST", 8, rate_hz), CyclicFrame("state", "ROBOT", 8, 100.0),
        CyclicFrame("wheels", "ROBOT", 8, 100.0),
    ),
    safety_card=lambda _settings: SafetyCard(
        "the controller after 0.1 s, by its watchdog", "braking", 0.1, True, "a frame; latched, in its state",
        "disarmed at once",
    ),
)  # fmt: skip
