"""ODrive's CAN Simple in firmware 0.5 and 0.6: frames and what they mean, in turns as on the wire.

Identifier: node << 5 | command. All little-endian. Whoever sends an empty frame with the identifier of a telemetry
message asks for that message. Source: the vendor's odrive-cansimple.dbc 0.5.6 and ODriveArduino 0.10.9.

What robot.toml says of the axes follows the frames, with e-stop, bus load and safety card; then what idle nodes are
asked before they are driven.
"""

from __future__ import annotations

import enum
import struct
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from drivers.motor.vendor_parts import Decoded, Layout, Nodes, Sign, all_of, by_number, in_sides, layouts, nodes_fault
from drivers.types import CyclicFrame, Frame, SafetyCard, SettingsFault

# CAN Simple: six bits of node, of which 0x3F is no axis, and five of command.
LARGEST_NODE = 0x3E
_NODE_SHIFT, _COMMAND_MASK = 5, 0x1F
Value = float | int
Firmware = Literal["0.5", "0.6"]
"""Generations of the firmware; 0.6 and later use the same protocol."""


class AxisState(enum.IntEnum):
    """The states that a driver may meet; all others calibrate, search or spin the motor by themselves."""

    UNDEFINED = 0
    IDLE = 1
    CLOSED_LOOP = 8


# ControlMode and InputMode of ODrive's API.
VELOCITY_CONTROL = 2
PASSTHROUGH = 1


_COMMON_COMMANDS = (
    ("Estop", 0x02, "", ""),
    ("Set_Axis_State", 0x07, "I4x", "state"),
    ("Set_Controller_Mode", 0x0B, "II", "control_mode input_mode"),
    ("Set_Input_Vel", 0x0D, "ff", "vel_turns_s torque_nm"),
)
COMMANDS: Mapping[Firmware, Mapping[str, Layout]] = MappingProxyType(
    {
        "0.5": layouts("<", *_COMMON_COMMANDS, ("Clear_Errors", 0x18, "", "")),
        "0.6": layouts("<", *_COMMON_COMMANDS, ("Clear_Errors", 0x18, "B", "identify")),
    }
)
"""What the driver sends; a host may send more."""

_VERSION_FIELDS = "protocol hw_major hw_minor hw_variant fw_major fw_minor fw_revision fw_unreleased"
_COMMON_TELEMETRY = (
    ("Get_Encoder_Estimates", 0x09, "ff", "pos_turns vel_turns_s"),
    ("Get_Iq", 0x14, "ff", "iq_setpoint_a iq_measured_a"),
    ("Get_Bus_Voltage_Current", 0x17, "ff", "bus_v bus_a"),
)
TELEMETRY: Mapping[Firmware, Mapping[str, Layout]] = MappingProxyType(
    {
        "0.5": layouts(
            "<",
            *_COMMON_TELEMETRY,
            ("Heartbeat", 0x01, "IBBBB", "axis_error axis_state motor_flags encoder_flags controller_flags"),
            ("Get_Motor_Error", 0x03, "Q", "motor_error"),
            ("Get_Encoder_Error", 0x04, "I4x", "encoder_error"),
            ("Get_Sensorless_Error", 0x05, "I4x", "sensorless_error"),
            ("Get_Encoder_Count", 0x0A, "ii", "shadow_count count_in_cpr"),
            ("Get_Sensorless_Estimates", 0x15, "ff", "sensorless_pos sensorless_vel"),
            ("Get_Controller_Error", 0x1D, "I4x", "controller_error"),
        ),
        "0.6": layouts(
            "<",
            *_COMMON_TELEMETRY,
            ("Get_Version", 0x00, "8B", _VERSION_FIELDS),
            ("Heartbeat", 0x01, "IBBBx", "axis_error axis_state procedure_result trajectory_done"),
            ("Get_Error", 0x03, "II", "active_errors disarm_reason"),
            ("Get_Temperature", 0x15, "ff", "fet_deg_c motor_deg_c"),
            ("Get_Torques", 0x1C, "ff", "torque_target_nm torque_estimate_nm"),
            ("Get_Powers", 0x1D, "ff", "electrical_w mechanical_w"),
        ),
    }
)
# Get_Version of CAN Simple in firmware 0.6; 0.5 has no such command.
GET_VERSION = 0x00
_BY_NUMBER = {firmware: by_number(table) for firmware, table in TELEMETRY.items()}
_SDO_VALUES = MappingProxyType({"f32": "f", "u32": "I", "i32": "i", "u16": "H", "u8": "B", "bool": "?"})
_SDO_HEAD = struct.Struct("<BHB")
# RxSdo and TxSdo of CAN Simple in firmware 0.6, as the node names them.
SDO_REQUEST, SDO_REPLY = 0x04, 0x05


def identifier(node: int, command: int) -> int:
    """Return the CAN identifier. Raises ValueError for a node above 62."""
    if not 0 <= node <= LARGEST_NODE:
        raise ValueError(f"no ODrive node: {node}")
    return node << _NODE_SHIFT | command


def split(can_id: int) -> tuple[int, int]:
    """Node and command of an 11-bit identifier."""
    return can_id >> _NODE_SHIFT, can_id & _COMMAND_MASK


def encode(firmware: Firmware, node: int, name: str, **values: Value) -> Frame:
    """Return the frame of a command; `values` by the names of `COMMANDS`. Raises KeyError for one that is missing."""
    layout = COMMANDS[firmware][name]
    data = layout.pack(*(values[field] for field in layout.fields))
    return Frame(identifier(node, layout.command), data)


def request_frame(node: int, command: int) -> Frame:
    """Return the frame that asks for a telemetry message once; on 0.5 it feeds the watchdog."""
    return Frame(identifier(node, command), b"")


def decode(firmware: Firmware, frame: Frame) -> Decoded | None:
    """Return what a node says; None for what is no telemetry, or not of its full length."""
    node, command = split(frame.can_id)
    known = _BY_NUMBER[firmware].get(command)
    if frame.extended or known is None or node > LARGEST_NODE or len(frame.data) != known.length:
        return None
    values = known.unpack(frame.data)
    if firmware == "0.6" and known.name == "Heartbeat":
        values["trajectory_done"] = int(values["trajectory_done"]) & 1
    return Decoded(known.name, values, node)


def read_parameter(node: int, endpoint: int) -> Frame:
    """Return the request (0.6) for a parameter; its number is of that very firmware's flat_endpoints.json."""
    return Frame(identifier(node, SDO_REQUEST), _SDO_HEAD.pack(0, endpoint, 0) + bytes(4))


def parameter(frame: Frame, node: int, endpoint: int, kind: str) -> Value | None:
    """Return the value in a reply (0.6); None for a frame that does not answer for this node and endpoint."""
    if frame.extended or frame.can_id != identifier(node, SDO_REPLY) or len(frame.data) != 8:
        return None
    _, replied, _ = _SDO_HEAD.unpack(frame.data[:4])
    value: Value = struct.unpack_from("<" + _SDO_VALUES[kind], frame.data, 4)[0]
    return value if replied == endpoint else None


WATCHDOG_ERROR = {"0.5": 0x800, "0.6": 0x0100_0000}
EXAMPLE = """nodes = [3, 5]
direction = [1, -1]
gear = 8.0
watchdog_s = 0.1
vel_limit_turns_s = 15.0
heartbeat_s = 0.02
"""
ESTOP_ERROR = {"0.5": 0x4000, "0.6": 0x0200_0000}
ERRORS: Mapping[Firmware, Mapping[int, str]] = MappingProxyType(
    {
        "0.5": {
            0x1: "invalid state: calibrate it with odrivetool first",
            0x40: "the motor failed; read its error with odrivetool",
            0x80: "the sensorless estimator failed",
            0x100: "the encoder failed; check its cable and calibration",
            0x200: "the controller failed, such as by overspeed",
            0x800: "its watchdog expired: no command came in time",
            0x1000: "an end stop was pressed",
            0x2000: "an end stop was pressed",
            0x4000: "emergency stop",
            0x40000: "too hot; let it cool",
        },
        "0.6": {
            0x1: "still starting",
            0x4: "it missed its own control deadlines",
            0x8: "no position or velocity estimate; check the encoder",
            0x10: "its configuration is invalid; correct it with odrivetool",
            0x20: "the gate driver failed",
            0x40: "an input is missing",
            0x100: "the supply's voltage is too high",
            0x200: "the supply's voltage is too low",
            0x400: "the supply's current is too high",
            0x1000: "the motor's current is too high",
            0x2000: "the motor is too hot; let it cool",
            0x4000: "the inverter is too hot; let it cool",
            0x8000: "it turns faster than its limit",
            0x0100_0000: "its watchdog expired: no command came in time",
            0x0200_0000: "emergency stop",
            0x0400_0000: "the encoder contradicts the motor (spin-out)",
            0x4000_0000: "calibration failed",
        },
    }
)

# Chosen: so many of each message of a node are no chance on a bus of another vendor.
_RECEIVED = 3
_Endpoint = Annotated[int, Meta(ge=0, le=65535)]


class OdriveSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of ODrives in [link]: left before right; `gear` is motor turns per wheel turn.

    `watchdog_s`, `vel_limit_turns_s` (of the motor), `heartbeat_s` and `firmware` are what the controller is set to.
    `watchdog_endpoints`: of `axis0.config.enable_watchdog` and `axis0.config.watchdog_timeout` in the
    flat_endpoints.json of that very firmware (0.6), to read the watchdog back; None: it is declared.
    """

    nodes: tuple[Nodes, Nodes]
    watchdog_s: Annotated[float, Meta(gt=0.0, le=0.5)]
    vel_limit_turns_s: Annotated[float, Meta(gt=0.0, le=1000.0)]
    firmware: Firmware = "0.6"
    direction: tuple[Sign, Sign] = (1, 1)
    gear: Annotated[float, Meta(gt=0.0, le=1000.0)] = 1.0
    heartbeat_s: Annotated[float, Meta(ge=0.005, le=0.2)] = 0.1
    watchdog_endpoints: tuple[_Endpoint, _Endpoint] | None = None
    stop_deceleration_rad_s2: Annotated[float, Meta(gt=0.0, le=655.0)] = 10.0

    def fault(self) -> SettingsFault | None:
        """Return what is wrong with the fields taken together, or None."""
        if self.watchdog_endpoints is not None and self.firmware != "0.6":
            return SettingsFault("watchdog_endpoints", "firmware 0.5 has none that CAN could read", "remove it")
        return nodes_fault(self.nodes, LARGEST_NODE)


def cyclic_frames(settings: OdriveSettings, command_rate_hz: float, _authenticated: bool) -> tuple[CyclicFrame, ...]:
    """Velocities, heartbeats and encoder estimates (each 10 ms) of every node."""
    frames: list[CyclicFrame] = []
    for node in all_of(settings.nodes):
        frames += [
            CyclicFrame(f"Set_Input_Vel of {node}", "HOST", 8, command_rate_hz),
            CyclicFrame(f"Heartbeat of {node}", "ROBOT", 8, 1.0 / settings.heartbeat_s),
            CyclicFrame(f"Get_Encoder_Estimates of {node}", "ROBOT", 8, 100.0),
        ]
    return tuple(frames)


def recognise(frames: Sequence[Frame]) -> dict[str, Any] | None:
    """Return the nodes whose heartbeats and estimates were received, split into left and right as they are numbered.

    None if there are none: heartbeats alone could be another vendor's frames.
    """
    decoded = [one for frame in frames if (one := decode("0.6", frame)) is not None]
    beats, estimates = (
        [one.node for one in decoded if one.name == name] for name in ("Heartbeat", "Get_Encoder_Estimates")
    )
    nodes = sorted({node for node in beats if min(beats.count(node), estimates.count(node)) >= _RECEIVED})
    return {"nodes": in_sides(nodes)} if len(nodes) > 1 else None


def safety_card(settings: OdriveSettings) -> SafetyCard:
    """Return the safety card of ODrives."""
    watchdog = f"watchdog ({settings.watchdog_s:g} s), " if settings.watchdog_endpoints is None else ""
    return SafetyCard(
        host_silent=f"each axis, {settings.watchdog_s:g} s after the last frame, by its watchdog: the axis idles",
        stops_by="coasting: an ODrive in idle does not brake",
        reaction_s=settings.watchdog_s,
        brakes=False,
        estop="a frame to each axis (0x02): the axis idles and coasts; the stop is latched and reported in its "
        "heartbeat",
        wheel_fault="each axis idles at once, without torque: it coasts",
        unverified=(
            f"{watchdog}velocity limit and heartbeat period are declared in robot.toml and were not read back; any "
            "frame to an axis may feed its watchdog",
            "not tested on hardware: the driver was tested against a simulator made from the vendor's source",
        ),
        setup=(
            f"odrv0.axis0.config.watchdog_timeout = {settings.watchdog_s:g}",
            "odrv0.axis0.config.enable_watchdog = True",
            f"odrv0.axis0.controller.config.vel_limit = {settings.vel_limit_turns_s:g}",
            "heartbeat 10 to 100 ms, encoder 10 ms (axis0.config.can.*_rate_ms or *_msg_rate_ms); the same on axis1",
            "odrv0.save_configuration()",
        ),
    )


# Chosen: with _PERIOD_NS, 0.3 s for the version, which firmware 0.5 never answers, and 0.5 s for the watchdog, which
# 0.6 must.
VERSION_TRIES = 3
WATCHDOG_TRIES = 5
# Chosen: longer than a reply takes on a loaded bus.
_PERIOD_NS = 100_000_000
# Questions feed an idle node's watchdog, so often enough for a short one.
_ALIVE_PERIOD_NS = 30_000_000
# Without it a board forgets what was set when it is switched off.
_SAVE = "call odrv0.save_configuration() (odrivetool)"
# Chosen: equal but for the rounding of a number that was typed in.
_SAME_TIMEOUT_S = 0.002


class Questions:
    """Questions to all nodes and their replies since the last start; pure.

    First their version, which firmware 0.5 does not know, so that its silence is the answer; then, where robot.toml
    says at which endpoints, their watchdogs; then what keeps those from running out.

    `known`: all has been answered as robot.toml declares. `refusal`: why they are not driven.
    """

    def __init__(self, settings: OdriveSettings) -> None:
        self._settings = settings
        self._nodes = all_of(settings.nodes)
        self.reset_state(0)

    def reset_state(self, now_ns: int) -> None:
        """Clear everything that is known of the nodes."""
        self.known, self.version = False, ""
        self.refusal: str | None = None
        self._message: str | None = None
        self._is_met = False
        # Of the nodes that have reported their watchdog: whether it is on, and its timeout (s).
        self._is_on: dict[int, bool] = {}
        self._timeouts_s: dict[int, float] = {}
        self._version_tries = self._watchdog_tries = 0
        self._requested_ns = now_ns - _PERIOD_NS

    def new_messages(self) -> str | None:
        """Return what is to be said, once."""
        message, self._message = self._message, None
        return message

    def due(self, now_ns: int, all_are_received: bool) -> list[Frame]:
        """Return the questions that are due now; only of nodes that idle, as each feeds their watchdogs."""
        waits = self.known or self.refusal is not None
        if now_ns - self._requested_ns < (_ALIVE_PERIOD_NS if waits else _PERIOD_NS):
            return []
        if not (waits or self._is_met or all_are_received):
            return []
        self._requested_ns = now_ns
        if waits:
            number = TELEMETRY[self._settings.firmware]["Get_Bus_Voltage_Current"].command
            return [request_frame(node, number) for node in self._nodes]
        return self._for_watchdogs() if self._is_met else self._for_version()

    def handle_version(self, values: Mapping[str, float]) -> None:
        """Handle a reply with the version."""
        if self._settings.firmware == "0.5":
            self.refusal = 'the nodes report their version, which firmware 0.5 does not; write link.firmware = "0.6"'
        elif not self._is_met:
            version = ".".join(str(values[f"fw_{part}"]) for part in ("major", "minor", "revision"))
            self._complete_handshake(version)

    def handle_parameter(self, frame: Frame) -> bool:
        """Whether the frame answers for a watchdog, which is then judged."""
        node, _ = split(frame.can_id)
        if node not in self._nodes or self._settings.watchdog_endpoints is None or not self._is_met:
            return False
        enabled, timeout = self._settings.watchdog_endpoints
        is_on = parameter(frame, node, enabled, "bool")
        timeout_s = parameter(frame, node, timeout, "f32")
        if is_on is None and timeout_s is None:
            return False
        if is_on is not None:
            self._is_on[node] = bool(is_on)
        if timeout_s is not None:
            self._timeouts_s[node] = float(timeout_s)
        configured_s = self._settings.watchdog_s
        found_s = self._timeouts_s.get(node, configured_s)
        if not self._is_on.get(node, True):
            self.refusal = f"node {node}: its watchdog is off; set axis0.config.enable_watchdog and {_SAVE}"
        elif not abs(found_s - configured_s) <= _SAME_TIMEOUT_S:
            self.refusal = (
                f"node {node}: its watchdog is set to {found_s:g} s; set it to {configured_s:g} s and {_SAVE}"
            )
        elif not self.known and all(self._is_on.get(one) and one in self._timeouts_s for one in self._nodes):
            self._announce(f", watchdog {configured_s:g} s")
        return True

    def _for_version(self) -> list[Frame]:
        self._version_tries += 1
        if self._version_tries <= VERSION_TRIES:
            return [request_frame(node, GET_VERSION) for node in self._nodes]
        if self._settings.firmware == "0.5":
            # That generation does not know the question.
            self._complete_handshake()
        else:
            self.refusal = 'the nodes do not report their version as firmware 0.6 does; write link.firmware = "0.5"'
        return []

    def _for_watchdogs(self) -> list[Frame]:
        """Return the questions until every node has reported whether its watchdog is on and how long it waits."""
        self._watchdog_tries += 1
        endpoints = self._settings.watchdog_endpoints or ()
        waiting = [node for node in self._nodes if node not in self._is_on or node not in self._timeouts_s]
        if self._watchdog_tries > WATCHDOG_TRIES:
            self.refusal = f"node {waiting[0]} does not report its watchdog; correct link.watchdog_endpoints"
            return []
        return [read_parameter(node, number) for node in waiting for number in endpoints]

    def _complete_handshake(self, version: str = "") -> None:
        self._is_met, self.version = True, version
        if self._settings.watchdog_endpoints is None:
            self._announce()

    def _announce(self, watchdog: str = "") -> None:
        self.known = True
        nodes = ", ".join(map(str, self._nodes))
        version = self.version and f", firmware {self.version}"
        self._message = f"nodes {nodes} are there: ODrive {self._settings.firmware}{version}{watchdog}"
