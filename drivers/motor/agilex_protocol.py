"""AgileX's CAN protocol v2 of Scout, Scout Mini, Bunker and Tracer: frames and what they mean.

11-bit identifiers, big-endian, 500 kbit/s. Source: the vendor's ugv_sdk (protocol_v2) and the Scout manual. The error
word is that of the SDK; the manual fills its first byte alone.

What robot.toml says of a base follows the frames, with e-stop, bus load and safety card.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated, Any

from msgspec import Meta

from drivers.motor.body_port import BodySettings
from drivers.motor.vendor_parts import Decoded, by_number, layouts
from drivers.types import CyclicFrame, Frame, SafetyCard, SettingsFault

# Identifiers of protocol v2 (ugv_sdk).
MOTION_COMMAND, LIGHT_COMMAND, BRAKE, CONTROL_MODE, STATE_RESET = 0x111, 0x121, 0x131, 0x421, 0x441
SYSTEM_STATE, MOTION_STATE, LIGHT_STATE, RC_STATE, ODOMETRY = 0x211, 0x221, 0x231, 0x241, 0x311
VERSION, MOTOR_SPEED, BATTERY = 0x4A1, 0x281, (0x361, 0x362)
STANDBY, CAN_MODE, UART_MODE, RC_MODE = range(4)
NORMAL, EMERGENCY_STOP, EXCEPTION = range(3)
# Speeds are 16-bit integers on the wire.
_I16 = (-32768, 32767)


LAYOUTS = by_number(
    layouts(
        ">",
        ("system_state", SYSTEM_STATE, "BBhHxx", "vehicle_state control_mode battery_v:10 error_code"),
        ("motion_state", MOTION_STATE, "hhhh", "linear_m_s:1000 angular_rad_s:1000 lateral_m_s:1000 steering_rad:1000"),
        ("odometry", ODOMETRY, "ii", "left_mm right_mm"),
    )
)
IGNORED = frozenset(
    {LIGHT_COMMAND, LIGHT_STATE, RC_STATE, VERSION, MOTOR_SPEED, *BATTERY, *range(0x251, 0x259), *range(0x261, 0x269)}
)
"""Messages of 8 bytes that say nothing to the driver; the last two of each motor: its speed, and its temperatures."""


def motion(linear_m_s: float, angular_rad_s: float) -> Frame:
    """Return the motion command: held to what the wire can say, rounded to 0.001."""
    low, high = _I16
    steps = (min(max(round(1000.0 * value), low), high) for value in (linear_m_s, angular_rad_s))
    return Frame(MOTION_COMMAND, struct.pack(">hhhh", *steps, 0, 0))


def control_mode(mode: int) -> Frame:
    """Ask the base to listen to nobody (`STANDBY`) or to CAN (`CAN_MODE`); 8 bytes, as the vendor's SDK sends."""
    return Frame(CONTROL_MODE, bytes([mode]).ljust(8, b"\0"))


def clear_errors() -> Frame:
    """Clear the errors of the base and of all motors."""
    return Frame(STATE_RESET, b"\0")


def decode(frame: Frame) -> Decoded | None:
    """Return what a base says; None for another message than those of `LAYOUTS`, or not of its full length."""
    found = LAYOUTS.get(frame.can_id)
    if frame.extended or found is None or len(frame.data) != found.length:
        return None
    return Decoded(found.name, found.unpack(frame.data))


# By the manual; the base offers no way to change or read it.
TIMEOUT_S = 0.5
# Chosen: so many frames of both kinds are no chance on a bus of another vendor.
_RECEIVED = 3
EXAMPLE = """wheel_radius_m = 0.06
track_m = 0.31
max_speed_m_s = 1.5
max_turn_rad_s = 2.5
"""


class AgilexSettings(BodySettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of AgileX bases in [link], which turn wheel speeds into speeds of the body and back."""

    max_turn_rad_s: Annotated[float, Meta(gt=0.0, le=20.0)]

    def fault(self) -> SettingsFault | None:
        """Return None, because each field shows its own faults."""
        return None


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
