"""AgileX's CAN protocol v2 of Scout, Scout Mini, Bunker and Tracer: frames and what they mean.

11-bit identifiers, big-endian, 500 kbit/s. Source: the vendor's ugv_sdk (protocol_v2) and the Scout manual. The error
word is that of the SDK; the manual fills its first byte alone.

What robot.toml says of a base follows the frames, with e-stop, bus load and safety card.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any

from msgspec import Meta

from drivers.motor.vendor_parts import BodySettings
from drivers.types import CyclicFrame, Frame, SafetyCard, SettingsFault

# Identifiers of protocol v2 (ugv_sdk).
MOTION_COMMAND, LIGHT_COMMAND, BRAKE, CONTROL_MODE, STATE_RESET = 0x111, 0x121, 0x131, 0x421, 0x441
SYSTEM_STATE, MOTION_STATE, LIGHT_STATE, RC_STATE, ODOMETRY = 0x211, 0x221, 0x231, 0x241, 0x311
VERSION, MOTOR_SPEED = 0x4A1, 0x281
STANDBY, CAN_MODE, UART_MODE, RC_MODE = range(4)
NORMAL, EMERGENCY_STOP, EXCEPTION = range(3)
# Speeds are 16-bit integers on the wire.
_I16 = (-32768, 32767)


@dataclass(frozen=True, slots=True)
class Layout:
    """Layout of a message: its name, the bytes by `struct`, and each field with what one step of it is worth."""

    name: str
    body: str
    fields: tuple[tuple[str, float], ...]


def _fields(text: str) -> tuple[tuple[str, float], ...]:
    pairs = (item.partition(":") for item in text.split())
    return tuple((name, float(scale) if scale else 1.0) for name, _, scale in pairs)


_MOTION = _fields("linear_m_s:0.001 angular_rad_s:0.001 lateral_m_s:0.001 steering_rad:0.001")
_LIGHT = _fields("enable front_mode front_value rear_mode rear_value")
_LAYOUTS: dict[int, Layout] = {
    MOTION_COMMAND: Layout("motion_command", "hhhh", _MOTION),
    LIGHT_COMMAND: Layout("light_command", "BBBBBxxx", _LIGHT),
    CONTROL_MODE: Layout("control_mode_config", "B", _fields("mode")),
    STATE_RESET: Layout("state_reset", "B", _fields("error_clear_byte")),
    SYSTEM_STATE: Layout("system_state", "BBhHxx", _fields("vehicle_state control_mode battery_v:0.1 error_code")),
    MOTION_STATE: Layout("motion_state", "hhhh", _MOTION),
    LIGHT_STATE: Layout("light_state", "BBBBBxxx", _LIGHT),
    RC_STATE: Layout(
        "rc_state", "Bbbbbbxx", _fields("switches stick_right_h stick_right_v stick_left_v stick_left_h var_a")
    ),
    ODOMETRY: Layout("odometry", "ii", _fields("left_mm right_mm")),
    0x361: Layout("bms_basic", "BBHhh", _fields("soc_percent soh_percent bms_v:0.1 bms_a:0.1 bms_deg_c:0.1")),
    0x362: Layout("bms_extended", "BBBB4x", _fields("alarm_1 alarm_2 warn_1 warn_2")),
    MOTOR_SPEED: Layout("motor_speed", "hhhh", _fields("m1_m_s:0.001 m2_m_s:0.001 m3_m_s:0.001 m4_m_s:0.001")),
    VERSION: Layout("version_response", "8s", _fields("bytes")),
}
_LAYOUTS |= {
    first + motor: Layout(name, body, _fields(names))
    for motor in range(8)
    for first, name, body, names in (
        (0x251, "actuator_high_speed", "hhi", "rpm current_a:0.1 pulses"),
        (0x261, "actuator_low_speed", "HhbBxx", "driver_v:0.1 driver_deg_c motor_deg_c driver_state"),
    )
}
LAYOUTS: Mapping[int, Layout] = MappingProxyType(_LAYOUTS)


@dataclass(frozen=True, slots=True)
class Decoded:
    """A message by its name; `motor` counts from 0 for those that each motor sends."""

    name: str
    values: Mapping[str, float | int | bytes]
    motor: int | None = None


def motion(linear_m_s: float, angular_rad_s: float) -> Frame:
    """Return the motion command: held to what the wire can say, rounded to 0.001."""
    low, high = _I16
    steps = (min(max(round(1000.0 * value), low), high) for value in (linear_m_s, angular_rad_s))
    return Frame(MOTION_COMMAND, struct.pack(">hhhh", *steps, 0, 0))


def control_mode(mode: int) -> Frame:
    """Ask the base to listen to nobody (`STANDBY`) or to CAN (`CAN_MODE`); 8 bytes, as the vendor's SDK sends."""
    return Frame(CONTROL_MODE, bytes([mode]).ljust(8, b"\0"))


def clear_errors(which: int = 0) -> Frame:
    """Clear all errors (0) or those of motor 1 to 4."""
    return Frame(STATE_RESET, bytes([which]))


def decode(frame: Frame) -> Decoded | None:
    """Return what a frame says; None for an unknown one, and for one not of its full length.

    CONTROL_MODE and STATE_RESET may have 1 or 8 bytes: the manual and the SDK disagree.
    """
    layout = LAYOUTS.get(frame.can_id)
    if frame.extended or layout is None:
        return None
    length = struct.calcsize(">" + layout.body)
    if len(frame.data) != length and not (length == 1 and len(frame.data) == 8):
        return None
    raw = struct.unpack_from(">" + layout.body, frame.data)
    values = {
        name: value * scale if scale != 1.0 else value for (name, scale), value in zip(layout.fields, raw, strict=True)
    }
    motor = (frame.can_id & 0xF) - 1 if frame.can_id >> 4 in (0x25, 0x26) else None
    return Decoded(layout.name, MappingProxyType(values), motor)


# By the manual; the base offers no way to change or read it.
TIMEOUT_S = 0.5
# Chosen: so many frames of both kinds are no chance on a bus of another vendor.
_RECEIVED = 3
# Chosen: some steps of 0.001 on the wire, so that noise does not keep a base that stands from standing by.
STATIONARY_M_S, STATIONARY_RAD_S = 0.01, 0.02
EXAMPLE = """wheel_radius_m = 0.06
track_m = 0.31
max_speed_m_s = 1.5
"""


class AgilexSettings(BodySettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of AgileX bases in [link], which turn wheel speeds into speeds of the body and back."""

    stop_deceleration_rad_s2: Annotated[float, Meta(gt=0.0, le=655.0)] = 10.0

    def fault(self) -> SettingsFault | None:
        """Return None, because each field shows its own faults."""
        return None


def stop_frames(_settings: AgilexSettings) -> tuple[Frame, ...]:
    """Return the frames for zero and standby, because the base has no e-stop by frame."""
    return motion(0.0, 0.0), control_mode(STANDBY)


def is_stationary(motion: Decoded) -> bool:
    """Whether the base says that it does not move."""
    speed, turn = motion.values["linear_m_s"], motion.values["angular_rad_s"]
    return abs(float(speed)) < STATIONARY_M_S and abs(float(turn)) < STATIONARY_RAD_S


def cyclic_frames(_settings: AgilexSettings, command_rate_hz: float, _authenticated: bool) -> tuple[CyclicFrame, ...]:
    """Return the frames of each period: the command, and what the base sends as its manual says."""
    sent = {"state": 10.0, "motion": 50.0, "odometry": 50.0, "motors": 200.0, "drivers": 40.0, "remote control": 50.0}
    return (
        CyclicFrame("motion command", "HOST", 8, command_rate_hz),
        *(CyclicFrame(name, "ROBOT", 8, rate) for name, rate in sent.items()),
    )


def recognise(frames: Sequence[Frame]) -> dict[str, Any] | None:
    """Return an empty dict if an AgileX base answers, else None: it shows its kind, but none of its measures."""
    received = [frame.can_id for frame in frames if decode(frame) is not None]
    return {} if min(received.count(SYSTEM_STATE), received.count(MOTION_STATE)) >= _RECEIVED else None


def safety_card(settings: AgilexSettings) -> SafetyCard:
    """Return the safety card of AgileX bases."""
    return SafetyCard(
        host_silent=f"the base, {TIMEOUT_S:g} s after the last motion command; this time cannot be changed",
        stops_by=f"slowing down by itself; at {settings.max_speed_m_s:g} m/s the base drives "
        f"{TIMEOUT_S * settings.max_speed_m_s:.2f} m before it begins to slow down",
        reaction_s=TIMEOUT_S,
        brakes=True,
        stops_by_own_ramp=True,
        estop="no e-stop frame exists: zero speed and standby are sent, and only this driver latches them; use the "
        "buttons on the base. The remote control has priority",
        wheel_fault="zero speed and standby at once; no frame takes the torque off the motors, and how the base "
        "reacts to a lost encoder is up to the base: use the buttons on it",
        unverified=(
            "how the base slows down, and its time-out, are taken from the manual",
            "not tested on hardware: the driver was tested against a simulator made from the manual and the "
            "vendor's SDK",
        ),
    )
