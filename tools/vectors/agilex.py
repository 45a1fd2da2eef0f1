"""Test vectors of AgileX, protocol v2."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

from drivers.motor import agilex_protocol as protocol
from drivers.types import Frame
from sim.devices.agilex import AgilexBase
from tools.vectors.comparison import Case, Comparison, of_driver, on_bus

_STEP = 1
_F32_STEP = 2.0**-24
_COUNTED = (protocol.SYSTEM_STATE, protocol.LIGHT_STATE, protocol.RC_STATE)


def check(case: Case) -> Comparison:
    """A case of agilex_v2."""
    found = Comparison()
    given, then = case.get("given", {}), case.get("then", {})
    match case["kind"], case["case"].partition(":")[0]:
        case "host_to_device", _:
            _check_command(found, case)
        case "device_to_host", _:
            _check_telemetry(found, case["frames"][0], then)
        case "malformed", "short":
            frame = of_driver(case["frames"][0])
            found.same("a short frame", protocol.decode(frame), None)
            _check_decoded(found, Frame(frame.can_id, frame.data.ljust(8, b"\0")), then)
        case "malformed", "unknown_state":
            _check_telemetry(found, case["frames"][0], then)
        case "malformed", _:
            on_wire = on_bus(case["frames"][0])
            decoded = None if on_wire.remote else protocol.decode(of_driver(case["frames"][0]))
            if decoded is not None:
                found.same("known", True, then["known"])
            base = AgilexBase(control_mode=1)
            found.same("taken", (base.receive(on_wire), base.obeyed), ([], []))
        case _:
            _check_story(found, given, case["steps"])
    return found


def _check_command(found: Comparison, case: Case) -> None:
    given, then, frame = case["given"], case["then"], case["frames"][0]
    can_id, data = frame["id"], bytes.fromhex(frame["data"])
    base = AgilexBase(control_mode=1)
    base.receive(on_bus(frame))
    arguments: tuple[int, ...] = (data[0],)
    if can_id == protocol.MOTION_COMMAND:
        arguments = struct.unpack(">hhhh", data)
        found.same("their steps", arguments, tuple(then["raw_i16"]))
        ours = struct.unpack(">hhhh", protocol.motion(given["linear_m_s"], given["angular_rad_s"]).data)
        beyond = [abs(1000 * given[name]) > 32767 for name in ("linear_m_s", "angular_rad_s")]
        for step, theirs, out_of_range in zip(ours, arguments, beyond, strict=False):
            # Out of range the SDK wraps; a driver holds to the limit.
            found.within("steps", abs(step) - 32767 if out_of_range else step, 0 if out_of_range else theirs, _STEP)
    elif can_id == protocol.CONTROL_MODE:
        ours_frame = protocol.control_mode(given["mode"])
        found.same("frame", ours_frame.data[: len(data)].hex(), frame["data"])
    elif can_id == protocol.STATE_RESET:
        if given["error_clear_byte"] == 0:
            found.same("frame", protocol.clear_errors().data.hex(), frame["data"][:2])
    elif can_id == protocol.LIGHT_COMMAND:
        arguments = tuple(data[:5])
    found.same("obeyed", base.obeyed, [(can_id, arguments)])


def _check_decoded(found: Comparison, frame: Frame, then: Mapping[str, Any]) -> None:
    decoded = protocol.decode(frame)
    if decoded is None:
        # What the driver has no use for is the simulator's alone.
        found.same("read by the driver", frame.can_id in protocol.LAYOUTS, False)
        return
    found.same("message", decoded.name, then["message"])
    for name, value in decoded.values.items():
        if isinstance(value, float) and isinstance(then[name], float):
            # The SDK multiplies 32-bit floats.
            found.within(name, value, then[name], 2.0 * _F32_STEP * abs(then[name]))
        else:
            found.same(name, value, then[name])


def _check_telemetry(found: Comparison, frame: Mapping[str, Any], then: Mapping[str, Any]) -> None:
    _check_decoded(found, of_driver(frame), then)
    base = AgilexBase()
    can_id, data = frame["id"], bytes.fromhex(frame["data"])
    _load(base, can_id, data)
    ours = base.message(can_id).data
    kept = 6 if can_id in _COUNTED else 8
    found.same("frame", ours[:kept].hex(), data[:kept].hex())


def _load(base: AgilexBase, can_id: int, data: bytes) -> None:
    """Put what a message says into the simulator; the layouts are read here, not by the protocol."""
    motor = (can_id & 0xF) - 1
    match can_id:
        case 0x211:
            base.vehicle_state, base.control_mode, base.battery_decivolt, base.error_code = struct.unpack(
                ">BBHH", data[:6]
            )
        case 0x221:
            base.speeds = struct.unpack(">hhhh", data)
        case 0x231:
            base.light = struct.unpack(">BBBBB", data[:5])
        case 0x241:
            base.rc_switches, *sticks = struct.unpack(">Bbbbbb", data[:6])
            base.rc_sticks = (sticks[0], sticks[1], sticks[2], sticks[3], sticks[4])
        case 0x281:
            base.motor_speeds = struct.unpack(">hhhh", data)
        case 0x311:
            base.odometry_mm = struct.unpack(">ii", data)
        case 0x361:
            base.bms = struct.unpack(">BBHhh", data)
        case 0x362:
            base.bms_alarms = struct.unpack(">BBBB", data[:4])
        case 0x4A1:
            base.version = data
        case _ if can_id >> 4 == 0x25:
            base.rpm[motor], base.current_deciampere[motor], base.pulses[motor] = struct.unpack(">hhi", data)
        case _:
            values = struct.unpack(">HhbB", data[:6])
            base.driver_decivolt[motor], base.driver_deg_c[motor], base.motor_deg_c[motor] = values[:3]
            base.driver_state[motor] = values[3]


def _check_story(found: Comparison, _given: Mapping[str, Any], steps: list[Any]) -> None:
    for step in steps:
        for frame in step.get("host_sends", ()):
            base = AgilexBase(control_mode=1)
            base.receive(on_bus(frame))
            found.same("taken", len(base.obeyed), 1)
        for frame in step.get("device_sends", ()):
            _check_telemetry(found, frame, step["then"])
