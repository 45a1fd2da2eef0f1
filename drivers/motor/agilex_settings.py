"""What robot.toml says of an AgileX base, and what follows from that alone: e-stop, bus load, safety card."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from drivers.motor import agilex_codec as codec
from drivers.types import CyclicFrame, Frame, SafetyCard, SettingsFault

TIMEOUT_S = 0.5
_HEARD = 3
STANDS_M_S, STANDS_RAD_S = 0.01, 0.02
EXAMPLE = """wheel_radius_m = 0.06
track_m = 0.31
max_speed_m_s = 1.5
"""


class AgilexSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Its fields in [link]: the base takes speeds of the body, which these turn wheel speeds into and back.

    `wheel_radius_m` and `track_m` are the nominal ones: write those of [robot], and leave them when the model learns
    others. `max_speed_m_s` is what the base can do.
    """

    wheel_radius_m: Annotated[float, Meta(gt=0.0, le=2.0)]
    track_m: Annotated[float, Meta(gt=0.0, le=5.0)]
    max_speed_m_s: Annotated[float, Meta(gt=0.0, le=10.0)]
    stop_deceleration_rad_s2: Annotated[float, Meta(gt=0.0, le=655.0)] = 10.0

    def fault(self) -> SettingsFault | None:
        """Nothing that a single field does not show."""
        return None


def stop_frames(_settings: AgilexSettings) -> tuple[Frame, ...]:
    """Zero and standby: the base has no e-stop by frame."""
    return codec.motion(0.0, 0.0), codec.control_mode(codec.STANDBY)


def stop_confirmation(_settings: AgilexSettings) -> Callable[[Frame], bool]:
    """Return what says, frame by frame heard, whether the base is in no mode that CAN can drive, and stands."""
    said = {"stands": False, "left": False}

    def heard(frame: Frame) -> bool:
        decoded = codec.decode(frame)
        if decoded is not None and decoded.name == "system_state":
            said["left"] = decoded.values["control_mode"] != codec.CAN_MODE
        elif decoded is not None and decoded.name == "motion_state":
            said["stands"] = stands(decoded)
        return all(said.values())

    return heard


def stands(motion: codec.Decoded) -> bool:
    """Whether the base says that it does not move."""
    speed, turn = motion.values["linear_m_s"], motion.values["angular_rad_s"]
    return abs(float(speed)) < STANDS_M_S and abs(float(turn)) < STANDS_RAD_S


def cyclic_frames(_settings: AgilexSettings, command_rate_hz: float, _authenticated: bool) -> tuple[CyclicFrame, ...]:
    """The command, and what the base sends as its manual says."""
    sent = {"state": 10.0, "motion": 50.0, "odometry": 50.0, "motors": 200.0, "drivers": 40.0, "remote control": 50.0}
    return (
        CyclicFrame("motion command", "HOST", 8, command_rate_hz),
        *(CyclicFrame(name, "ROBOT", 8, rate) for name, rate in sent.items()),
    )


def recognise(frames: Sequence[Frame]) -> dict[str, Any] | None:
    """Nothing but that it is one: a base says who it is by its state and its motion, and nothing of its measures."""
    heard = [frame.can_id for frame in frames if codec.decode(frame) is not None]
    return {} if min(heard.count(codec.SYSTEM_STATE), heard.count(codec.MOTION_STATE)) >= _HEARD else None


def safety_card(settings: AgilexSettings) -> SafetyCard:
    """Who stops the robot when."""
    return SafetyCard(
        host_silent=f"the base {TIMEOUT_S:g} s after the last motion command; this cannot be changed",
        stops_by=f"slowing down by itself; at {settings.max_speed_m_s:g} m/s it has gone "
        f"{TIMEOUT_S * settings.max_speed_m_s:.2f} m before it begins",
        reaction_s=TIMEOUT_S,
        brakes=True,
        estop="no frame for it: zero speed and standby are sent, and nothing latches them but this driver; use the "
        "buttons on the base. Whoever holds the remote control comes first",
        unverified=(
            "how it slows down, and its time-out, are the manual's words",
            "not tried on hardware: the driver was tried against a simulator made from the manual and the vendor's SDK",
        ),
    )
