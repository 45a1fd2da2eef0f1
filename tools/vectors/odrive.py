"""Test vectors of ODrive: firmware 0.5.6 and the 0.6 message layouts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from drivers.motor import odrive_protocol as protocol
from drivers.motor.odrive_protocol import Firmware
from sim.devices.odrive import CHECKS_PER_MS, Axis, OdriveBoard
from tools.vectors.comparison import Case, Comparison, as_case, as_cases, equal, number, of_driver, on_bus

_STATE = tuple(each.name for each in fields(Axis) if each.name not in ("fed", "watchdog_left", "obeyed_states"))
_OF_AXIS = {"shadow_count": "encoder_count", "active_errors": "axis_error"}
_OF_HEARTBEAT = {"motor_error_flag": "motor_flags", "encoder_error_flag": "encoder_flags"}
_SILENT = 0x1F


def check_05(case: Case) -> Comparison:
    """A case of odrive056."""
    found = Comparison()
    given, then = case.get("given", {}), case.get("then", {})
    match case["kind"], case["case"].partition(":")[0]:
        case "sequence", "cyclic_schedule":
            _check_schedule(found, given, then)
        case "sequence", "watchdog":
            _check_watchdog(found, given, then)
        case "sequence", _:
            _check_story(found, case)
        case "device_to_host", _:
            _check_telemetry(found, case, "0.5")
        case kind, _:
            if kind == "host_to_device":
                _check_command(found, case, "0.5")
            _check_effect(found, case)
    return found


def check_06(case: Case) -> Comparison:
    """A case of odrive06."""
    found = Comparison()
    given, then = case.get("given", {}), case.get("then", {})
    match case["kind"], case["case"].partition(":")[0]:
        case "host_to_device", "sdo_write":
            board = OdriveBoard("0.6", [given["node"]])
            board.parameters[given["endpoint"]] = bytes(4)
            board.receive(on_bus(case["frames"][0]))
            found.same("parameter", board.parameters[given["endpoint"]].hex(), case["frames"][0]["data"][8:])
        case "host_to_device", _:
            _check_command(found, case, "0.6")
            _check_obeyed(found, case)
        case "device_to_host", "sdo_read":
            _check_parameter(found, case)
        case "device_to_host", _:
            _check_telemetry(found, case, "0.6")
        case "malformed", "short_telemetry":
            frame = of_driver(case["frames"][0])
            found.same("a short frame", protocol.decode("0.6", frame), None)
            padded = protocol.decode("0.6", type(frame)(frame.can_id, frame.data.ljust(8, b"\0")))
            values = {} if padded is None else padded.values
            found.same("its bytes", values, {name: then[name] for name in values})
        case "malformed", "unknown_or_unasked":
            # The library hears only what it has asked for; ours knows every telemetry message.
            decoded = protocol.decode("0.6", of_driver(case["frames"][0]))
            known = {layout.command for layout in protocol.TELEMETRY["0.6"].values()}
            found.same("known", decoded is not None, given["command_id"] in known)
        case "malformed", _:
            received = [protocol.decode("0.6", of_driver(frame)) for frame in case["frames"]]
            found.same("from the node", [d for d in received if d is not None and d.node == given["node"]], [])
        case _:
            _check_steps(found, case)
    return found


def _check_command(found: Comparison, case: Case, firmware: Firmware) -> None:
    """Compare what our codec writes; other commands and forms that the device takes are the simulator's alone."""
    given = case["given"]
    name, frame = given["command"], case["frames"][0]
    layout = protocol.COMMANDS[firmware].get(name)
    if layout is None or frame.get("rtr") or 2 * layout.length != len(frame["data"]):
        return
    values = {field: number(given[field]) for field in layout.fields}
    ours_frame = protocol.encode(firmware, given["node"], name, **values)
    found.same("frame", as_case(ours_frame), {key: frame[key] for key in ("id", "extended", "data")})


def _check_obeyed(found: Comparison, case: Case) -> None:
    """On 0.6, whose firmware did not run: that ours takes the value that the host meant."""
    given = case["given"]
    board = OdriveBoard("0.6", [given["node"]])
    for frame in case["frames"]:
        board.receive(on_bus(frame))
    axis = board.axes[0]
    found.same("command", [frame["id"] & 0x1F for frame in case["frames"]], [case["then"]["command_id"]])
    found.same("length", [len(frame["data"]) // 2 for frame in case["frames"]], [case["then"]["length"]])
    meant = {
        "vel_turns_s": axis.input_vel_turns_s,
        "torque_nm": axis.input_torque_nm,
        "state": axis.requested_state % 2**32,
    }
    for name, value in given.items():
        if name in meant:
            found.same(name, meant[name], value)


def _check_effect(found: Comparison, case: Case) -> None:
    given, then = case["given"], case["then"]
    board = OdriveBoard("0.5", given["nodes"])
    for axis in board.axes:
        # Values that nobody sends, so that whatever is written shows.
        for name in ("input_vel_turns_s", "input_torque_nm", "input_pos_turns", "requested_state", "control_mode"):
            setattr(axis, name, -77)
        axis.input_mode, axis.vel_limit_turns_s, axis.current_limit_a = -77, -77.0, -77.0
        axis.pos_gain = axis.vel_gain = axis.vel_integrator_gain = -77.0
        axis.traj_vel_limit = axis.traj_accel_limit = axis.traj_decel_limit = -77.0
    _set_errors(board, given.get("errors_before", {}))
    _check_frames(found, board, case["frames"], then)


def _check_frames(found: Comparison, board: OdriveBoard, frames: list[Any], then: Mapping[str, Any]) -> None:
    nodes = [axis.node_id for axis in board.axes]
    before = [{name: getattr(axis, name) for name in _STATE} for axis in board.axes]
    fed_before = [axis.fed for axis in board.axes]
    replies = [reply for frame in frames for reply in board.receive(on_bus(frame))]
    changed = {}
    for node, axis, old in zip(nodes, board.axes, before, strict=True):
        new = {name: getattr(axis, name) for name in _STATE if not _same(getattr(axis, name), old[name])}
        # The controller's own reaction to a change of mode is not the message layer's.
        if new:
            changed[str(node)] = new
    fed = [node for node, axis, old_fed in zip(nodes, board.axes, fed_before, strict=True) if axis.fed > old_fed]
    found.same("changed", changed, then["changed"])
    found.same("fed", fed, then["watchdog_fed_nodes"])
    found.same("replies", as_cases(replies), then["replies"])


def _same(ours: object, before: object) -> bool:
    return equal(ours, before) and type(ours) is type(before)


def _set_errors(board: OdriveBoard, errors: Mapping[str, Mapping[str, int]]) -> None:
    for axis in board.axes:
        for name, value in errors.get(str(axis.node_id), {}).items():
            setattr(axis, name, value)


def _check_telemetry(found: Comparison, case: Case, firmware: Firmware) -> None:
    given, then = case["given"], case["then"]
    node = given["node"]
    frame = case["frames"][0]
    decoded = protocol.decode(firmware, of_driver(frame))
    if decoded is None:
        found.differences.append("not decoded")
        return
    found.same("node", decoded.node, node)
    ours = _in_vendor_terms(decoded.values, firmware)
    found.same("meaning", ours, {name: then[name] for name in ours})
    board = OdriveBoard(firmware, given.get("nodes", [node]))
    axis = next(axis for axis in board.axes if axis.node_id == node)
    _load(board, axis, {**given, **then})
    if "request" in given:
        request = given["request"]
        command = request["id"] & _SILENT
        if not request.get("rtr") and not request["data"]:
            found.same("request", as_case(protocol.request_frame(node, command)), request)
        fed_before = axis.fed
        found.same("reply", as_cases(board.receive(on_bus(request))), case["frames"])
        found.same("fed", axis.fed > fed_before, "watchdog_fed_nodes" not in then or node in then["watchdog_fed_nodes"])
    else:
        found.same("frame", as_case(board.message(axis, frame["id"] & _SILENT)), frame)


def _in_vendor_terms(values: Mapping[str, Any], firmware: Firmware) -> dict[str, Any]:
    ours = dict(values)
    if firmware == "0.5" and "motor_flags" in ours:
        flags = ours.pop("controller_flags")
        ours |= {name: bool(ours.pop(field)) for name, field in _OF_HEARTBEAT.items()}
        ours |= {"controller_error_flag": bool(flags & 1), "trajectory_done": bool(flags & 0x80)}
    return ours


def _load(board: OdriveBoard, axis: Axis, values: Mapping[str, Any]) -> None:
    """Put the simulator into the state that a case's telemetry shows."""
    for name, value in values.items():
        field = _OF_AXIS.get(name, name)
        if field in _STATE:
            setattr(axis, field, number(value))
        elif field in ("bus_v", "bus_a"):
            setattr(board, field, number(value))
    names = protocol.TELEMETRY["0.6"]["Get_Version"].fields
    if names[0] in values:
        board.version = (*(values[name] for name in names),)  # type: ignore[assignment]


def _check_parameter(found: Comparison, case: Case) -> None:
    given, then = case["given"], case["then"]
    node, endpoint, kind = given["node"], given["endpoint"], given["type"]
    found.same("request", as_case(protocol.read_parameter(node, endpoint)), given["request"])
    answers_it = given.get("reply_endpoint") == endpoint
    for frame in case["frames"]:
        value = protocol.parameter(of_driver(frame), node, endpoint, kind)
        # The library does not compare the endpoint; ours takes no answer to another question.
        found.same("value", value, then["value"] if answers_it else None)
        board = OdriveBoard("0.6", [node])
        board.parameters[endpoint] = bytes.fromhex(frame["data"])[4:]
        if answers_it:
            found.same("reply", as_cases(board.receive(on_bus(given["request"]))), [frame])
    if not case["frames"]:
        found.same("reply", OdriveBoard("0.6", [node]).receive(on_bus(given["request"])), [])


def _check_story(found: Comparison, case: Case) -> None:
    board = OdriveBoard("0.5", case["given"]["nodes"])
    for step in case["steps"]:
        for node, values in step.get("harness_sets", {}).items():
            axis = next(axis for axis in board.axes if axis.node_id == int(node))
            names = {"state": "axis_state", "requested": "requested_state", "error": "axis_error"}
            for name, value in values.items():
                setattr(axis, names.get(name, name), value)
        if "host_sends" in step:
            _check_frames(found, board, step["host_sends"], step["then"])
        for frame in step.get("device_sends", ()):
            node, command = protocol.split(frame["id"])
            axis = next(axis for axis in board.axes if axis.node_id == node)
            found.same(f"at {step.get('t_ms')} ms", as_case(board.message(axis, command)), frame)
            found.same("decoded", protocol.decode("0.5", of_driver(frame)) is not None, True)


def _check_steps(found: Comparison, case: Case) -> None:
    """A story of 0.6: what the host sends is taken, what the device sends is understood."""
    node = case["given"]["node"]
    board = OdriveBoard("0.6", [node])
    for step in case["steps"]:
        for frame in step.get("host_sends", ()):
            fed = board.axes[0].fed
            board.receive(on_bus(frame))
            found.same("taken", board.axes[0].fed, fed + 1)
        for frame in step.get("device_sends", ()):
            decoded = protocol.decode("0.6", of_driver(frame))
            if decoded is None:
                found.differences.append(f"not decoded: {frame}")
            elif "sent_values" in step["then"]:
                found.same("values", list(decoded.values.values()), step["then"]["sent_values"])
            else:
                found.same("meaning", decoded.values, {name: step["then"][name] for name in decoded.values})


def _check_schedule(found: Comparison, given: Mapping[str, Any], then: Mapping[str, Any]) -> None:
    periods = {name.removesuffix("_ms"): value for name, value in given.items() if name.endswith("_ms")}
    names = {name.removesuffix("_rate"): value for name, value in periods.items()}
    names.pop("service_called_every", None)
    board = OdriveBoard("0.5", given["nodes"], names)
    expected = then["sent_ms_ids"]
    sent = [[ms, [frame.can_id for frame in board.cyclic(ms)]] for ms in range(1, expected[-1][0] + 1)]
    found.same("sent", [each for each in sent if each[1]], expected)


def _check_watchdog(found: Comparison, given: Mapping[str, Any], then: Mapping[str, Any]) -> None:
    board = OdriveBoard("0.5", given["nodes"])
    for axis in board.axes:
        axis.watchdog_enabled = given["watchdog_enabled"][str(axis.node_id)]
        axis.watchdog_timeout_s = given["watchdog_timeout_s"]
        axis.feed()
    frames = [(frame[0], *frame[1:3], "rtr" in frame[3:]) for frame in given["frames_ms_id_data"]]
    appeared: list[list[float]] = []
    for ms in range(given["fed_at_ms"], given["until_ms"]):
        for at, can_id, data, remote in frames:
            if at == ms:
                board.receive(on_bus({"id": can_id, "extended": False, "data": data, "rtr": remote}))
        for check in range(CHECKS_PER_MS):
            appeared += [[ms + check / CHECKS_PER_MS, axis.node_id, bits] for axis, bits in board.check_watchdogs()]
    theirs = then["errors_appear_ms_node_bits"]
    found.same("errors", [each[1:] for each in appeared], [each[1:] for each in theirs])
    for ours, their in zip(appeared, theirs, strict=False):
        found.within("time", ours[0], their[0], 1 / CHECKS_PER_MS)
