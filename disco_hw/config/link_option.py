"""What the option `--link` says of the link to the robot, in place of robot.toml."""

from __future__ import annotations

from typing import Any

from disco_hw.errors import InputError

FORMS = "can, serial, can:INTERFACE:CHANNEL or serial:PORT"


def link_fields(option: str | None) -> dict[str, Any]:
    """The fields of robot.toml's [link] that the option sets; raises InputError for one that says nothing."""
    match None if option is None else option.split(":"):
        case None:
            return {}
        case ["can" | "serial" as kind]:
            return {"kind": kind}
        case ["can", interface, *channel] if interface and any(channel):
            return {"kind": "can", "interface": interface, "channel": ":".join(channel), "options": {}}
        case ["serial", *port] if any(port):
            return {"kind": "serial", "port": ":".join(port)}
    raise InputError(f"--link {option}: not a link; write {FORMS}")


def names_address(fields: dict[str, Any]) -> bool:
    """Whether the fields say where the robot is, not only over what it is reached."""
    return len(fields) > 1
