"""Test vectors of VESC on CAN and on a serial line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from drivers.motor import vesc_codec as codec
from drivers.types import Frame
from sim.can_protocol import CanFrame
from sim.devices.vesc_firmware import CHECK_MS, Vesc
from tools.vectors.comparison import Case, Comparison, as_case, as_cases, of_driver, on_bus

_OF_VALUES = {"current_a": "current_motor_a"}
_STEP = 1
_GET_VALUES = 4
_F32_STEP = 2.0**-23


def check_can(case: Case) -> Comparison:
    """A case of vesc_can."""
    found = Comparison()
    given, then = case["given"], case["then"]
    topic = case["case"].partition(":")[0]
    device = _device(given)
    match case["kind"]:
        case "sequence":
            _check_timeout(found, device, given, then)
        case "device_to_host" if "request" in given:
            _check_reply(found, device, case)
        case "device_to_host":
            _check_status(found, device, case)
        case _ if topic == "short_status":
            frame = of_driver(case["frames"][0])
            found.same("a short status", codec.decode(frame), None)
            padded = codec.decode(Frame(frame.can_id, frame.data.ljust(8, b"\0"), extended=True))
            found.same("its bytes", dict(padded.values) if padded else {}, then)
        case kind:
            if kind == "host_to_device":
                _check_host(found, case)
            _check_effect(found, device, case)
    return found


def check_uart(case: Case) -> Comparison:
    """A case of vesc_uart."""
    found = Comparison()
    given, then = case["given"], case["then"]
    device = _device(given)
    match case["kind"]:
        case "sequence":
            _check_timeout(found, device, given, then)
        case "device_to_host":
            _check_serial_reply(found, device, case)
        case _ if "packets" in then:
            received = bytes.fromhex(case["bytes"])
            found.same("packets", [each.hex() for each in codec.packets(received)], then["packets"])
            if case["kind"] == "host_to_device":
                sendable = [bytes.fromhex(each) for each in then["packets"]]
                found.same("bytes", b"".join(map(codec.packet, sendable)).hex(), case["bytes"])
        case _ if "payload_bytes" in given:
            try:
                sent = codec.packet(bytes(given["payload_bytes"])).hex()
            except ValueError:
                sent = ""
            found.same("sent", sent, then["sent"])
        case kind:
            if kind == "host_to_device":
                _check_serial_host(found, case)
            reply, frames = device.receive_bytes(bytes.fromhex(case["bytes"]))
            _check_motor(found, device, then)
            found.same("reply", reply.hex(), then["reply"])
            if "can_frames" in then:
                found.same("frames on CAN", as_cases(frames), then["can_frames"])
    return found


def _device(given: Mapping[str, Any]) -> Vesc:
    device = Vesc(given.get("controller_id", 0))
    for name, value in given.get("device_values", {}).items():
        setattr(device.values, _OF_VALUES.get(name, name), value)
    return device


def _check_host(found: Comparison, case: Case) -> None:
    given, frames = case["given"], case["frames"]
    to = given.get("to", given["controller_id"])
    if "host_id" in given:
        if "payload" in given:
            payload = bytes.fromhex(given["payload"])
            if len(frames) == 1 and not given.get("send_mode"):
                found.same("packet", as_case(codec.packet_frame(to, given["host_id"], payload)), frames[0])
        elif not {"comm", "erpm", "milliampere"} & given.keys():
            found.same("ping", as_case(codec.ping(to, given["host_id"])), frames[0])
    elif given.get("command") not in codec.COMMANDS:
        # The device takes more commands than our driver sends.
        return
    elif "value" in given and "off_delay_s" not in given:
        _check_value(found, codec.command(to, given["command"], given["value"]), frames[0])
    elif "off_delay_s" not in given and "raw_i32" not in given:
        theirs = int.from_bytes(bytes.fromhex(frames[0]["data"])[:4], signed=True)
        number, _, steps = codec.COMMANDS[given["command"]]
        found.same("number", frames[0]["id"] >> 8, number)
        _check_value(found, codec.command(to, given["command"], theirs / steps), frames[0])


def _check_value(found: Comparison, ours: Frame, theirs: Mapping[str, Any]) -> None:
    found.same("identifier", {**as_case(ours), "data": ""}, {**theirs, "data": ""})
    value = int.from_bytes(bytes.fromhex(theirs["data"]), signed=True)
    found.within("steps", int.from_bytes(ours.data, signed=True), value, _STEP)


def _check_effect(found: Comparison, device: Vesc, case: Case) -> None:
    then = case["then"]
    replies = [reply for frame in case["frames"] for reply in device.receive(on_bus(frame))]
    _check_motor(found, device, then)
    if "replies" in then:
        found.same("replies", as_cases(replies), then["replies"])


def _check_motor(found: Comparison, device: Vesc, then: Mapping[str, Any]) -> None:
    found.same("motor", device.pop_calls(), then["motor_calls"])
    found.same("fed", device.fed > 0, then["timeout_fed"])


def _check_status(found: Comparison, device: Vesc, case: Case) -> None:
    frame, then = case["frames"][0], case["then"]
    found.same("frame", as_case(device.status(frame["id"] >> 8)), frame)
    decoded = codec.decode(of_driver(frame))
    for name, value in then.items():
        # The vendor's host keeps 32-bit floats.
        ours = decoded.values[name] if decoded else float("nan")
        found.within(name, ours, value, _F32_STEP * abs(value))


def _check_reply(found: Comparison, device: Vesc, case: Case) -> None:
    given, then = case["given"], case["then"]
    mask = given.get("mask")
    payload = bytes([_GET_VALUES]) if mask is None else codec.request_values(mask)
    found.same(
        "request", as_case(codec.packet_frame(given["controller_id"], given["host_id"], payload)), given["request"]
    )
    found.same("answer", as_cases(device.receive(on_bus(given["request"]))), case["frames"])
    found.same("fed", device.fed > 0, then["timeout_fed"])
    reassembly = codec.Reassembly(given["host_id"])
    packets = [packet for frame in case["frames"] if (packet := reassembly.feed(of_driver(frame)))]
    found.same(
        "whole", [(packet[0], packet[2].hex()) for packet in packets], [(given["controller_id"], then["payload"])]
    )
    for packet in packets:
        _check_values(found, packet[2], given)


def _check_values(found: Comparison, payload: bytes, given: Mapping[str, Any]) -> None:
    if given.get("mask", -1) & ~codec.ALL_OF_A_MOTOR:
        # Of other values only the simulator's answer is compared.
        return
    read = codec.values(payload)
    if read is None:
        found.differences.append(f"no values in {payload.hex()}")
        return
    measured = given.get("device_values", {})
    for name, value in read.items():
        if name in measured:
            found.within(name, value, measured[name], 1.0 + _F32_STEP * abs(value))


def _check_serial_host(found: Comparison, case: Case) -> None:
    given = case["given"]
    if given.get("command") in codec.COMMANDS:
        _, number, _ = codec.COMMANDS[given["command"]]
        ours, theirs = codec.command(0, given["command"], given["value"]).data, bytes.fromhex(given["payload"])
        found.within("steps", int.from_bytes(ours, signed=True), int.from_bytes(theirs[1:], signed=True), _STEP)
        found.same("number", number, theirs[0])
        found.same("bytes", codec.packet(theirs).hex(), case["bytes"])
    elif "forward_to" in given:
        payload = codec.forward(given["forward_to"], bytes.fromhex(given["inner_payload"]))
        found.same("bytes", codec.packet(payload).hex(), case["bytes"])
    elif "payload" in given:
        found.same("bytes", codec.packet(bytes.fromhex(given["payload"])).hex(), case["bytes"])


def _check_serial_reply(found: Comparison, device: Vesc, case: Case) -> None:
    given, then = case["given"], case["then"]
    payload = bytes.fromhex(then["payload"])
    request = bytes.fromhex(given["request"])
    if "far_id" in given:
        found.same(
            "request", codec.packet(codec.forward(given["far_id"], codec.request_values(given["mask"]))), request
        )
        far = Vesc(given["far_id"])
        far.values = device.values
        _, frames = device.receive_bytes(request)
        replies = [reply for frame in frames for reply in far.receive(frame)]
        found.same("on CAN", as_cases(replies), given["can_frames_of_far_vesc"])
        reply = b"".join(device.handle_packet_reply(frame) for frame in replies)
    else:
        if "mask" in given:
            found.same("request", codec.packet(codec.request_values(given["mask"])), request)
        device.firmware = payload[1:] if payload[:1] == b"\0" else device.firmware
        device.timed_out = bool(then.get("status_byte", 0) & codec.TIMED_OUT)
        device.kill_switch_active = bool(then.get("status_byte", 0) & codec.KILL_SWITCH)
        reply, _ = device.receive_bytes(request)
    found.same("answer", reply.hex(), case["bytes"])
    found.same("packets", [each.hex() for each in codec.packets(reply)], [then["payload"]])
    if payload[:1] != b"\0":
        _check_values(found, payload, given)
        read = codec.values(payload) or {}
        for name in ("fault", "controller_id", "status_byte"):
            if name in then and name in read:
                found.same(name, read[name], then[name])


def _check_timeout(found: Comparison, device: Vesc, given: Mapping[str, Any], then: Mapping[str, Any]) -> None:
    """What is sent, on CAN or on the serial line, is obeyed and answered in its millisecond; the timeout stops it.

    What arrives in a millisecond comes before that millisecond's check: the timeout thread sleeps until then.
    """
    device.timeout_ms = given["timeout_ms"]
    device.timeout_brake_current_a = given["timeout_brake_current_a"]
    device.last_fed_ms = given["last_fed_at_ms"]
    is_serial = "sent_ms_bytes" in given
    events: list[list[object]] = []
    changes: list[list[object]] = []
    brakes: list[list[float]] = []
    for ms in range(given["until_ms"]):
        device.at(ms)
        for at, *sent in given["sent_ms_bytes" if is_serial else "sent_ms_id_data"]:
            if at != ms:
                continue
            data, reply = bytes.fromhex(sent[-1]), b""
            if is_serial:
                reply, _ = device.receive_bytes(data)
            else:
                device.receive(CanFrame(sent[0], data, extended=True))
            events += [[ms, *call] for call in device.pop_calls()]
            events += [[ms, "reply", reply.hex()]] if reply else []
        if ms % CHECK_MS:
            continue
        was_timed_out, current = device.timed_out, device.check_timeout(ms)
        if device.timed_out != was_timed_out:
            changes.append([ms, device.timed_out])
        if current is not None and brakes and brakes[-1][1:] == [ms - CHECK_MS, current]:
            brakes[-1][1] = ms
        elif current is not None:
            brakes.append([ms, ms, current])
    found.same("timed out", changes, then["has_timeout_changes_ms"])
    found.same("brake", brakes, then["brake_calls_from_to_ms_value"])
    found.same("events", events, then["events_ms" if is_serial else "obeyed_ms_call_value"])
