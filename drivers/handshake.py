"""Who the robot is, and whether this host may talk to it."""

from __future__ import annotations

from drivers.types import Capabilities
from firmware_protocol.codec import Codec, Decoded

MESSAGES = frozenset({"HELLO", "BUILD", "LIMITS"})
_AUTHENTICATION = Codec().choice_value("HELLO", "capabilities", "AUTHENTICATION")


class Handshake:
    """Gathers HELLO, BUILD and both pages of LIMITS, and judges them.

    Another major version is refused. The same major version with another DBC hash may be read, but never armed.
    `refusal` says why the robot must not be armed and what to do about it, None if nothing speaks against it so far;
    `capabilities` is what the robot said of itself, None until it is complete or if its limits make no sense.
    """

    def __init__(self, major: int, minor: int, dbc_hash: int, *, has_key: bool = False) -> None:
        """`has_key`: whether this host proves its commands; a robot of the other mind is refused."""
        self._has_key = has_key
        self._major = major
        self._minor = minor
        self._dbc_hash = dbc_hash
        self._hello: dict[str, float] | None = None
        self._build: dict[str, float] | None = None
        self._pages: dict[int, dict[str, float]] = {}
        self.refusal: str | None = None
        self.capabilities: Capabilities | None = None

    def take(self, decoded: Decoded) -> None:
        """Take in a frame of one of `MESSAGES`."""
        match decoded.name:
            case "HELLO":
                self._hello = decoded.values
            case "BUILD":
                self._build = decoded.values
            case _:
                self._pages[int(decoded.values["page"])] = decoded.values
        self.refusal = self._judge()
        self.capabilities = self._gather()

    @property
    def missing(self) -> tuple[str, ...]:
        """What has not come yet, by message name."""
        names = {"HELLO": self._hello, "BUILD": self._build, "LIMITS": len(self._pages) == 2 or None}
        return tuple(name for name, value in names.items() if value is None)

    def _judge(self) -> str | None:
        if self._hello is not None and int(self._hello["protocol_major"]) != self._major:
            theirs = f"{int(self._hello['protocol_major'])}.{int(self._hello['protocol_minor'])}"
            return (
                f"the robot speaks protocol {theirs}, this host {self._major}.{self._minor}; "
                f"flash the firmware that matches this host, or install the host that matches the firmware"
            )
        if self._build is not None and int(self._build["dbc_hash"]) != self._dbc_hash:
            return (
                f"the robot's DBC hash is {int(self._build['dbc_hash']):08x}, this host's {self._dbc_hash:08x}: "
                f"telemetry only; flash the firmware built from this host's disco_robot.dbc, "
                f"or install the host that matches the firmware"
            )
        if self._hello is not None and bool(int(self._hello["capabilities"]) & _AUTHENTICATION) != self._has_key:
            if self._has_key:
                return (
                    "the robot takes commands from anybody, and this host has a key: "
                    "give the robot's firmware the key, or take link.key_file out of robot.toml"
                )
            return "the robot obeys only who holds its key: write link.key_file in robot.toml, the file with that key"
        if len(self._pages) == 2 and not self._limits_make_sense():
            return "the robot reports limits that make no sense (a zero among them); correct its configuration"
        return None

    def _gather(self) -> Capabilities | None:
        hello, build = self._hello, self._build
        if hello is None or build is None or self.missing or not self._limits_make_sense():
            return None
        speed, times = self._pages[0], self._pages[1]
        return Capabilities(
            protocol_major=int(hello["protocol_major"]),
            protocol_minor=int(hello["protocol_minor"]),
            firmware_version=".".join(str(int(hello[f"firmware_{part}"])) for part in ("major", "minor", "patch")),
            dbc_hash=int(build["dbc_hash"]),
            board_id=int(build["board_id"]),
            max_wheel_speed_rad_s=speed["max_wheel_speed"],
            max_wheel_acceleration_rad_s2=speed["max_wheel_acceleration"],
            ticks_per_rev=int(speed["ticks_per_rev"]),
            command_timeout_s=times["command_timeout"],
            drive_off_timeout_s=times["drive_off_timeout"],
            stop_deceleration_rad_s2=times["stop_deceleration"],
        )

    def _limits_make_sense(self) -> bool:
        values = {name: value for page in self._pages.values() for name, value in page.items() if name != "page"}
        return all(value > 0 for value in values.values())
