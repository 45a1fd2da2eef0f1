"""What robot.toml says of ODrive controllers, and what follows from that alone: e-stop, bus load, safety card."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from drivers.motor import odrive_codec as codec
from drivers.motor.odrive_codec import Generation
from drivers.motor.vendor_parts import Nodes, Sign, in_sides, sides_of
from drivers.types import CyclicFrame, Frame, SafetyCard, SettingsFault

WATCHDOG_ERROR = {Generation.V05: 0x800, Generation.V06: 0x0100_0000}
EXAMPLE = """nodes = [3, 5]
direction = [1, -1]
gear = 8.0
watchdog_s = 0.1
vel_limit_turns_s = 15.0
heartbeat_s = 0.02
"""
ESTOP_ERROR = {Generation.V05: 0x4000, Generation.V06: 0x0200_0000}
_ERRORS: Mapping[Generation, Mapping[int, str]] = MappingProxyType(
    {
        Generation.V05: {
            0x1: "invalid state: calibrate it with odrivetool first",
            0x40: "the motor failed; read its error with odrivetool",
            0x80: "the sensorless estimator failed",
            0x100: "the encoder failed; check its cable and calibration",
            0x200: "the controller failed, such as by overspeed",
            0x800: "its watchdog ran out: no command came in time",
            0x1000: "an end stop was pressed",
            0x2000: "an end stop was pressed",
            0x4000: "emergency stop",
            0x40000: "too hot; let it cool",
        },
        Generation.V06: {
            0x1: "still starting",
            0x4: "it missed its own deadlines",
            0x8: "no position or velocity estimate; check the encoder",
            0x10: "its configuration is bad; mend it with odrivetool",
            0x20: "the gate driver failed",
            0x40: "an input is missing",
            0x100: "the supply's voltage is too high",
            0x200: "the supply's voltage is too low",
            0x400: "the supply's current is too high",
            0x1000: "the motor's current is too high",
            0x2000: "the motor is too hot; let it cool",
            0x4000: "the inverter is too hot; let it cool",
            0x8000: "it turns faster than its limit",
            0x0100_0000: "its watchdog ran out: no command came in time",
            0x0200_0000: "emergency stop",
            0x0400_0000: "the encoder contradicts the motor (spin-out)",
            0x4000_0000: "calibration failed",
        },
    }
)

_HEARD = 3
_Endpoint = Annotated[int, Meta(ge=0, le=65535)]


class OdriveSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Its fields in [link]: left before right; `gear` is motor turns per wheel turn.

    `watchdog_s`, `vel_limit_turns_s` (of the motor), `heartbeat_s` and `firmware` are what the controller is set to.
    `watchdog_endpoints`: of `axis0.config.enable_watchdog` and `axis0.config.watchdog_timeout` in the
    flat_endpoints.json of that very firmware (0.6), to read the watchdog back; None: it is declared.
    """

    nodes: tuple[Nodes, Nodes]
    watchdog_s: Annotated[float, Meta(gt=0.0, le=0.5)]
    vel_limit_turns_s: Annotated[float, Meta(gt=0.0, le=1000.0)]
    firmware: Literal["0.5", "0.6"] = "0.6"
    direction: tuple[Sign, Sign] = (1, 1)
    gear: Annotated[float, Meta(gt=0.0, le=1000.0)] = 1.0
    heartbeat_s: Annotated[float, Meta(ge=0.005, le=0.2)] = 0.1
    watchdog_endpoints: tuple[_Endpoint, _Endpoint] | None = None
    stop_deceleration_rad_s2: Annotated[float, Meta(gt=0.0, le=655.0)] = 10.0

    @property
    def sides(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """The nodes on the left and on the right."""
        return sides_of(self.nodes)

    @property
    def all_nodes(self) -> tuple[int, ...]:
        """Every node, left before right."""
        return (*self.sides[0], *self.sides[1])

    @property
    def generation(self) -> Generation:
        """Of the firmware."""
        return Generation(self.firmware)

    def fault(self) -> SettingsFault | None:
        """What no single field shows."""
        nodes = self.all_nodes
        if not all(self.sides):
            return SettingsFault("nodes", "a side has no node", "write [left, right], such as [3, 5]")
        if any(not 0 <= node <= codec.LARGEST_NODE for node in nodes):
            return SettingsFault("nodes", f"a node is outside 0 to {codec.LARGEST_NODE}", "write those of odrivetool")
        if self.watchdog_endpoints is not None and self.firmware != "0.6":
            return SettingsFault("watchdog_endpoints", "firmware 0.5 has none that CAN could read", "remove it")
        if len(set(nodes)) != len(nodes):
            return SettingsFault("nodes", "a node stands there twice", "write each motor's own")
        return None


def error_words(generation: Generation, error: int) -> str:
    """What the bits of an axis' error mean, for a person."""
    said = [text for bit, text in _ERRORS[generation].items() if error & bit]
    return "; ".join(said) or f"error {error:#x}"


def stop_frames(settings: OdriveSettings) -> tuple[Frame, ...]:
    """The e-stop to every node: it idles with an error that stays until it is cleared."""
    return tuple(codec.encode(settings.generation, node, "Estop") for node in settings.all_nodes)


def stop_confirmation(settings: OdriveSettings) -> Callable[[Frame], bool]:
    """Return what says, frame by frame heard, whether every node has reported the e-stop."""
    waiting = set(settings.all_nodes)

    def heard(frame: Frame) -> bool:
        decoded = codec.decode(settings.generation, frame)
        beat = decoded if decoded is not None and decoded.name == "Heartbeat" else None
        if beat is not None and int(beat.values["axis_error"]) & ESTOP_ERROR[settings.generation]:
            waiting.discard(beat.node)
        return not waiting

    return heard


def cyclic_frames(settings: OdriveSettings, command_rate_hz: float, _authenticated: bool) -> tuple[CyclicFrame, ...]:
    """Velocities, heartbeats and encoder estimates (each 10 ms) of every node."""
    frames: list[CyclicFrame] = []
    for node in settings.all_nodes:
        frames += [
            CyclicFrame(f"Set_Input_Vel of {node}", "HOST", 8, command_rate_hz),
            CyclicFrame(f"Heartbeat of {node}", "ROBOT", 8, 1.0 / settings.heartbeat_s),
            CyclicFrame(f"Get_Encoder_Estimates of {node}", "ROBOT", 8, 100.0),
        ]
    return tuple(frames)


def recognise(frames: Sequence[Frame]) -> dict[str, Any] | None:
    """The nodes whose heartbeats and estimates were heard, split into left and right as they are numbered.

    None if there are none: heartbeats alone could be another vendor's frames.
    """
    told = [one for frame in frames if (one := codec.decode(Generation.V06, frame)) is not None]
    beats, estimates = (
        [one.node for one in told if one.name == name] for name in ("Heartbeat", "Get_Encoder_Estimates")
    )
    nodes = sorted({node for node in beats if min(beats.count(node), estimates.count(node)) >= _HEARD})
    return {"nodes": in_sides(nodes)} if len(nodes) > 1 else None


def safety_card(settings: OdriveSettings) -> SafetyCard:
    """Who stops the robot when."""
    return SafetyCard(
        host_silent=f"each axis after {settings.watchdog_s:g} s without a frame, by its watchdog: it idles",
        stops_by="coasting: an ODrive in idle does not brake",
        reaction_s=settings.watchdog_s,
        brakes=False,
        estop="a frame to each axis (0x02): it idles and coasts, latched, reported in its heartbeat",
        unverified=(
            f"watchdog ({settings.watchdog_s:g} s), velocity limit and heartbeat period are declared in robot.toml "
            "and were not read back; any frame to an axis may feed its watchdog",
            "not tried on hardware: the driver was tried against a simulator made from the vendor's source",
        ),
        setup=(
            f"odrv0.axis0.config.watchdog_timeout = {settings.watchdog_s:g}",
            "odrv0.axis0.config.enable_watchdog = True",
            f"odrv0.axis0.controller.config.vel_limit = {settings.vel_limit_turns_s:g}",
            "heartbeat 10 to 100 ms, encoder 10 ms (axis0.config.can.*_rate_ms or *_msg_rate_ms); the same on axis1",
        ),
    )
