"""Watches the wheels of a virtual robot and what reaches its controller; shares no code with what it watches.

Its proofs are written from firmware_protocol/README.md: CRC-8H2F from its polynomial, the layout of WHEEL_COMMAND, the
rules for motion. `see` is called once per cycle of the controller.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field

from drivers.types import Frame
from firmware_protocol.firmware_core import FirmwareOutputs

WHEEL_COMMAND = 0x100
MAJOR = 1
SPEED_MODE = 1
MAY_TURN = ("ARMED", "STOPPING", "ESTOP")
TINY = 1e-4
ENOUGH_VIOLATIONS = 20
# Limits that the robot was built with.
MAX_SPEED_RAD_S = 8.0
MAX_ACCELERATION_RAD_S2 = 20.0
COMMAND_TIMEOUT_S = 0.1
DRIVE_OFF_S = 0.5
# From 8 rad/s the plant's wheels, with a lag of 0.06 s, need this long to stand once zero is asked for.
SETTLING_S = 0.6
STATIONARY_RAD_S = 0.05


Pair = tuple[float, float]
"""Left and right, rad/s."""


@dataclass(frozen=True)
class SeenCommand:
    """A WHEEL_COMMAND as this monitor reads it."""

    counter: int
    mode: int
    speeds: Pair
    session: int


@dataclass
class WheelMonitor:
    """Collects violations as sentences; an empty list is what must come out."""

    violations: list[str] = field(default_factory=list)
    commands_seen: int = 0
    commands_accepted: int = 0
    _last: FirmwareOutputs | None = None
    _last_us: int = 0
    _targets: tuple[Pair, ...] = ((0.0, 0.0),)
    _accepted_us: int | None = None
    _armed_us: int = 0
    _zero_since_us: int | None = None
    _last_counter: int | None = None
    _falling_bound: float | None = None
    _ended_sessions: dict[int, int] = field(default_factory=dict)

    def restarted(self) -> None:
        """The controller was restarted: it has forgotten everything."""
        self._last = None
        self._accepted_us = None
        self._last_counter = None
        self._falling_bound = None

    def see(self, now_us: int, frames: Sequence[Frame], outputs: FirmwareOutputs, wheel_speeds: Pair) -> None:
        """Check one cycle of the controller.

        It gets the frames that reached the controller since the last one, its outputs after it, true speeds.
        """
        before = self._last
        if before is None:
            self._last, self._last_us = outputs, now_us
            self._zero_since_us = now_us
            return
        dt_s = (now_us - self._last_us) * 1e-6
        commands = [f for f in frames if f.can_id == WHEEL_COMMAND]
        good = [c for f in commands if (c := read_command(f.can_id, f.data))]
        self.commands_seen += len(commands)
        accepted = outputs.accepted_commands - before.accepted_commands
        if accepted:
            self._check_accepted(now_us, accepted, good, before, outputs)
        if good:
            self._last_counter = good[-1].counter
        if before.state in ("READY", "ARMED") and outputs.state not in ("READY", "ARMED") and before.session:
            self._ended_sessions[before.session] = now_us
        if before.session != outputs.session and outputs.session:
            self._ended_sessions.pop(outputs.session, None)
        self._check_limits(now_us, dt_s, before, outputs)
        self._check_time(now_us, dt_s, before, outputs)
        self._check_wheels(now_us, _setpoints(outputs), wheel_speeds)
        self._last, self._last_us = outputs, now_us

    def _check_accepted(
        self, now_us: int, accepted: int, good: list[SeenCommand], before: FirmwareOutputs, outputs: FirmwareOutputs
    ) -> None:
        self.commands_accepted += accepted
        fitting = [c for c in good if c.session in (before.session, outputs.session)]
        if len(fitting) < accepted:
            self._report(now_us, f"{accepted} commands accepted, {len(fitting)} of those that came have a proof")
            return
        for command in fitting:
            if command.session in self._ended_sessions:
                self._report(now_us, f"a command of the ended session {command.session} was accepted")
            if command.counter == self._last_counter:
                self._report(now_us, "a repeated command was accepted")
        states = (before.state, outputs.state)
        if "ARMED" not in states and any(c.mode == SPEED_MODE and any(c.speeds) for c in fitting[-accepted:]):
            self._report(now_us, f"a command to move was accepted in {before.state}")
        # Of more commands in a cycle than were accepted, any may have been the last that was.
        self._targets = tuple(self._scaled(c) for c in (fitting if len(fitting) > accepted else fitting[-1:]))
        self._accepted_us = now_us

    def _scaled(self, command: SeenCommand) -> Pair:
        """Return the command's wheel speeds within the limits."""
        if command.mode != SPEED_MODE:
            return (0.0, 0.0)
        scale = min(1.0, MAX_SPEED_RAD_S / max(*map(abs, command.speeds), 1e-9))
        return (command.speeds[0] * scale, command.speeds[1] * scale)

    def _check_limits(self, now_us: int, dt_s: float, before: FirmwareOutputs, outputs: FirmwareOutputs) -> None:
        setpoints, earlier = _setpoints(outputs), _setpoints(before)
        turning = any(setpoints)
        for side, name in enumerate(("left", "right")):
            value, last = setpoints[side], earlier[side]
            if not abs(value) <= MAX_SPEED_RAD_S + TINY:
                self._report(now_us, f"{name} setpoint {value} rad/s is beyond {MAX_SPEED_RAD_S}")
            if value == last:
                continue
            if not outputs.driver_enabled and value == 0.0:
                continue
            if not abs(value - last) <= MAX_ACCELERATION_RAD_S2 * dt_s + TINY:
                self._report(now_us, f"{name} setpoint went from {last} to {value} rad/s in {dt_s} s")
            # Towards the last command that had a proof, or towards standstill; never past, never elsewhere.
            targets = [target[side] for target in self._targets]
            armed = "ARMED" in (before.state, outputs.state)
            if not ((armed and _towards(value, last, targets)) or _towards(value, last, [0.0])):
                self._report(now_us, f"{name} setpoint {last} -> {value} rad/s in {outputs.state}; asked was {targets}")
        if turning and outputs.state not in MAY_TURN:
            self._report(now_us, f"setpoints {setpoints} in {outputs.state}")
        if turning and not outputs.driver_enabled:
            self._report(now_us, f"setpoints {setpoints} with the driver off")

    def _check_time(self, now_us: int, dt_s: float, before: FirmwareOutputs, outputs: FirmwareOutputs) -> None:
        age_s = float("inf") if self._accepted_us is None else (now_us - self._accepted_us) * 1e-6
        longest_s = COMMAND_TIMEOUT_S + 2.0 * dt_s
        if outputs.state == "ARMED" != before.state:
            self._armed_us = now_us
            if age_s > longest_s:
                self._report(now_us, f"armed {age_s:.3f} s after the last accepted command")
        # The watchdog runs from the instant of arming, then from the last accepted command.
        if outputs.state == "ARMED" and min(age_s, (now_us - self._armed_us) * 1e-6) > longest_s:
            self._report(now_us, f"ARMED {age_s:.3f} s after the last accepted command")
        if outputs.driver_enabled and age_s > DRIVE_OFF_S + 2.0 * dt_s:
            self._report(now_us, f"the driver is on {age_s:.3f} s after the last accepted command")
        fastest = max(map(abs, _setpoints(outputs)))
        if outputs.state == "ARMED" or fastest == 0.0:
            self._falling_bound = None
        else:
            bound = max(map(abs, _setpoints(before))) if self._falling_bound is None else self._falling_bound
            # The wheels are slowed down together, so the faster one sets the pace; one cycle of grace.
            if self._falling_bound is None:
                bound += MAX_ACCELERATION_RAD_S2 * dt_s
            bound = max(0.0, bound - MAX_ACCELERATION_RAD_S2 * dt_s)
            if fastest > bound + 0.02 + MAX_ACCELERATION_RAD_S2 * dt_s:
                self._report(now_us, f"setpoint {fastest} rad/s in {outputs.state} where {bound:.2f} is due")
            self._falling_bound = bound

    def _check_wheels(self, now_us: int, setpoints: Pair, wheel_speeds: Pair) -> None:
        if any(setpoints):
            self._zero_since_us = None
        elif self._zero_since_us is None:
            self._zero_since_us = now_us
        zero_s = 0.0 if self._zero_since_us is None else (now_us - self._zero_since_us) * 1e-6
        fastest = max(map(abs, wheel_speeds))
        if zero_s > SETTLING_S and fastest > STATIONARY_RAD_S:
            self._report(now_us, f"the wheels turn at {fastest:.3f} rad/s {zero_s:.2f} s after zero was asked for")

    def _report(self, now_us: int, text: str) -> None:
        if len(self.violations) < ENOUGH_VIOLATIONS:
            self.violations.append(f"{now_us * 1e-6:.3f} s: {text}")


def _setpoints(outputs: FirmwareOutputs) -> Pair:
    return outputs.left_setpoint_rad_s, outputs.right_setpoint_rad_s


def _towards(value: float, last: float, targets: list[float]) -> bool:
    """Whether `value` is on the way from `last` to one of the targets, or between them."""
    return min(last, *targets) - TINY <= value <= max(last, *targets) + TINY


def read_command(can_id: int, data: bytes) -> SeenCommand | None:
    """Return the WHEEL_COMMAND in these bytes, or None if its length or its proof is wrong."""
    if can_id != WHEEL_COMMAND or len(data) != 8:
        return None
    if crc8h2f(data[1:] + struct.pack("<H", can_id ^ (MAJOR << 11))) != data[0]:
        return None
    left, right = struct.unpack_from("<hh", data, 2)
    return SeenCommand(data[1] & 0x0F, data[1] >> 4, (left * SPEED_LSB, right * SPEED_LSB), data[7])


SPEED_LSB = 0.002


def _after_eight_bits(crc: int) -> int:
    for _ in range(8):
        crc = ((crc << 1) ^ 0x2F if crc & 0x80 else crc << 1) & 0xFF
    return crc


_AFTER_A_BYTE = bytes(map(_after_eight_bits, range(256)))


def crc8h2f(data: bytes) -> int:
    """Return the CRC-8H2F (AUTOSAR): polynomial 0x2F, initial value and final xor 0xFF; 0xDF over b"123456789"."""
    crc = 0xFF
    for byte in data:
        crc = _AFTER_A_BYTE[crc ^ byte]
    return crc ^ 0xFF
