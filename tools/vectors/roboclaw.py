"""Test vectors of RoboClaw packet serial."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from drivers.motor import roboclaw_protocol as protocol
from sim.devices.roboclaw import Roboclaw
from tools.vectors.comparison import Case, Comparison

_SETTER_BY_NUMBER = {layout.command: name for name, layout in protocol.SETTERS.items()}


def check(case: Case) -> Comparison:
    """A case of roboclaw."""
    found = Comparison()
    given, then = case["given"], case["then"]
    match case["kind"], case["case"].partition(":")[0]:
        case "host_to_device", _:
            _check_setter(found, case)
        case "device_to_host", _:
            _check_getter(found, case)
        case "malformed", "acknowledge":
            _check_setter(found, case)
            # Only the vendor's stricter host: a byte that is not 0xFF acknowledges nothing.
            is_acknowledged = bytes.fromhex(given["acknowledge"])[:1] == protocol.ACKNOWLEDGE
            found.same(
                "acknowledged", is_acknowledged, then["arduino"]["accepted"] and then["arduino"]["requests_sent"] == 1
            )
        case "malformed", _:
            _check_replies(found, case)
        case _:
            _check_delayed_reply(found, case)
    return found


def _check_setter(found: Comparison, case: Case) -> None:
    given = case["given"]
    name = _SETTER_BY_NUMBER[given["command"]]
    values = {field: _raw(field, given) for field in protocol.SETTERS[name].fields}
    packet = protocol.setting(given["address"], name, **values).data
    found.same("bytes", packet.hex(), case["bytes"])
    board = Roboclaw(given["address"])
    acknowledge = board.receive(0, bytes.fromhex(case["bytes"]))
    found.same("acknowledge", acknowledge.hex(), case["then"].get("acknowledge_expected", "ff"))
    found.same("obeyed", board.obeyed, [(given["command"], tuple(values.values()))])
    other = Roboclaw(protocol.FIRST_ADDRESS + (given["address"] - protocol.FIRST_ADDRESS + 1) % 8)
    found.same("another board", (other.receive(0, packet), other.obeyed), (b"", []))


def _raw(field: str, given: Mapping[str, Any]) -> int:
    """A field as it is on the wire."""
    match field:
        case "p" | "i" | "d":
            return int(given[field] * protocol.GAIN_STEPS)
        case "timeout_ds":
            return int(given["timeout_s"] * 10)
        case "key":
            return int(given["key"], 16)
    return int(given[field])


def _check_getter(found: Comparison, case: Case) -> None:
    given = case["given"]
    name = protocol.getter_name(given["command"])
    if name is None:
        found.differences.append(f"command {given['command']} is not known")
        return
    address, received = given["address"], bytes.fromhex(case["bytes"])
    found.same("request", protocol.query(address, name).data.hex(), given["request"])
    verdict = case["then"].get("both") or case["then"]["python"]
    read = protocol.reply(address, name, received)
    found.same("accepted", read is not None, verdict["accepted"])
    if read is None:
        return
    values, length = read
    found.same("unread bytes", len(received) - length, verdict["unread_bytes"])
    ours = _in_vendor_terms(values, verdict["values"])
    found.same("values", ours, verdict["values"])
    board = Roboclaw(address)
    _load(board, name, values)
    found.same("reply", board.receive(0, bytes.fromhex(given["request"])).hex(), case["bytes"])


def _in_vendor_terms(values: Mapping[str, Any], theirs: Mapping[str, Any]) -> dict[str, Any]:
    """Counts unsigned, gains and times in their units, as the vendor's hosts return them."""
    ours: dict[str, Any] = {}
    for name, value in values.items():
        if name in ("p", "i", "d"):
            ours[name] = value / protocol.GAIN_STEPS
        elif name == "timeout_ds":
            ours["timeout_s"] = value / 10
        elif name in theirs and isinstance(value, int) and value < 0 <= theirs[name]:
            ours[name] = value % 2**32
        else:
            ours[name] = value
    return ours


def _load(board: Roboclaw, name: str, values: Mapping[str, Any]) -> None:
    """Put what a reply says into the simulator's registers."""
    registers = board.registers
    match name:
        case "velocity_pid_m1" | "velocity_pid_m2":
            setattr(registers, name.removeprefix("velocity_"), tuple(values.values()))
        case "encoder_m1" | "encoder_m2":
            setattr(registers, name, values["encoder"])
            setattr(registers, f"{name}_status", values["status"])
        case "speed_of_m1" | "speed_of_m2" | "raw_speed_of_m1" | "raw_speed_of_m2":
            motor = name[-2:]
            setattr(registers, name.replace("_of", ""), values["speed"])
            setattr(registers, f"encoder_{motor}_status", values["status"])
        case "temperature_1" | "temperature_2":
            setattr(registers, name, values["temperature_decidegree"])
        case "status":
            registers.status = values["status_u32"]
        case _:
            for field, value in values.items():
                setattr(registers, field, value)


def _check_replies(found: Comparison, case: Case) -> None:
    """A driver reads each answer once, and throws away what is left before it asks again."""
    given, then = case["given"], case["then"]
    name = protocol.getter_name(given["command"])
    if name is None:
        found.differences.append(f"command {given['command']} is not known")
        return
    verdict = then.get("both") or then["python"]
    replies = [case["bytes"]] if "bytes" in case else case["replies"][: verdict["requests_sent"]]
    read = [protocol.reply(given["address"], name, bytes.fromhex(each)) for each in replies]
    good = [each[0] for each in read if each is not None]
    if case["case"].startswith("u16_status"):
        # The vendor's hosts wait for four bytes; ours takes the two of older firmware, of a layout of their own.
        board = Roboclaw(given["address"])
        board.registers.short_status = True
        for each in good:
            _load(board, "status", each)
        found.same("older status", board.receive(0, bytes.fromhex(given["request"])).hex(), case["bytes"])
        return
    found.same("accepted", bool(good), verdict["accepted"])
    if good and verdict["accepted"]:
        found.same("values", _in_vendor_terms(good[0], verdict["values"]), verdict["values"])


def _check_delayed_reply(found: Comparison, case: Case) -> None:
    """A late reply does not pass for the answer to the next question; after a flush the next one does."""
    address = case["given"]["address"]
    delayed = b""
    for step in case["steps"]:
        if "late_bytes" in step:
            delayed = bytes.fromhex(step["late_bytes"])
            continue
        if "host_sends_speeds" in step:
            speeds = dict(zip(protocol.SETTERS["speed_m1m2"].fields, step["host_sends_speeds"], strict=True))
            sent = protocol.setting(address, "speed_m1m2", **speeds).data.hex()
            found.same("speeds", [sent] * len(step["requests"]), step["requests"])
            found.same("late bytes acknowledge", delayed[:1] == protocol.ACKNOWLEDGE, step["then"]["accepted"])
            delayed = b""
            continue
        name = protocol.getter_name(step["host_asks"]) or ""
        for request in step["requests"]:
            found.same("request", protocol.query(address, name).data.hex(), request)
        for reply in step["replies"]:
            if delayed:
                found.same("late bytes first", protocol.reply(address, name, delayed + bytes.fromhex(reply)), None)
            found.same("flushed", protocol.reply(address, name, bytes.fromhex(reply)) is not None, True)
        delayed = b""
