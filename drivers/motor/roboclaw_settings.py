"""What robot.toml says of RoboClaw boards, and what follows from that: exchange, e-stop, load, safety card."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Annotated

import msgspec
from msgspec import Meta

from drivers.motor import roboclaw_codec as codec
from drivers.motor.vendor_parts import Sign
from drivers.types import CyclicFrame, Frame, SafetyCard, SettingsFault

STANDS_RAD_S = 0.1
_TURNAROUND_S = 0.0009
_MOTOR = re.compile(r"(\d{1,3})/([12])")
EXAMPLE = """motors = ["128/1", "128/2"]
counts_per_rev = 8192.0
direction = [1, -1]
watchdog_s = 0.2
"""
_Motors = str | tuple[str, ...]


class RoboclawSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Its fields in [link]: left before right.

    `motors`: "ADDRESS/MOTOR", address 128 to 135, motor 1 or 2, one or more a side. `counts_per_rev`: of the encoder a
    wheel turn, gear included. `watchdog_s`: the serial timeout, which the driver sets before each arming, in steps of
    0.1 s. `acceleration_rad_s2`: what the boards ramp a wheel with.
    """

    motors: tuple[_Motors, _Motors]
    counts_per_rev: Annotated[float, Meta(gt=0.0, le=1e7)]
    watchdog_s: Annotated[float, Meta(ge=0.1, le=0.5)]
    direction: tuple[Sign, Sign] = (1, 1)
    acceleration_rad_s2: Annotated[float, Meta(gt=0.0, le=1000.0)] = 100.0
    stop_deceleration_rad_s2: Annotated[float, Meta(gt=0.0, le=655.0)] = 10.0

    @property
    def sides(self) -> tuple[tuple[tuple[int, int], ...], tuple[tuple[int, int], ...]]:
        """Address and motor (0 or 1) of each motor, on the left and on the right."""
        left, right = ((side,) if isinstance(side, str) else side for side in self.motors)
        return tuple(map(_place, left)), tuple(map(_place, right))

    @property
    def addresses(self) -> tuple[int, ...]:
        """Of the boards, each once."""
        return tuple(dict.fromkeys(address for side in self.sides for address, _ in side))

    @property
    def counts_per_rad(self) -> float:
        """Encoder counts in a radian of the wheel."""
        return self.counts_per_rev / (2.0 * math.pi)

    @property
    def timeout_ds(self) -> int:
        """The serial timeout in the boards' steps of 0.1 s."""
        return round(10.0 * self.watchdog_s)

    def fault(self) -> SettingsFault | None:
        """What no single field shows."""
        named = [name for side in self.motors for name in ((side,) if isinstance(side, str) else side)]
        wrong = [name for name in named if not _is_place(name)]
        if wrong or not named or () in self.motors:
            found = f'"{wrong[0]}" is no motor' if wrong else "a side has no motor"
            return SettingsFault(
                "motors", found, 'write [left, right] such as ["128/1", "128/2"], addresses 128 to 135'
            )
        places = [place for side in self.sides for place in side]
        if len(set(places)) != len(places):
            return SettingsFault("motors", "a motor stands there twice", "write each once")
        if abs(10.0 * self.watchdog_s - self.timeout_ds) > 1e-6:
            return SettingsFault("watchdog_s", f"{self.watchdog_s:g} is no multiple of 0.1", "write 0.2")
        return None


class RoboclawExchange:
    """Satisfies `drivers.types.Exchange`; a frame's identifier is address and command, its data the packet."""

    timeout_s = 0.02
    quiet_s = 0.012

    def request(self, frame: Frame) -> bytes:
        """The packet as it stands."""
        return frame.data

    def is_answered(self, _frame: Frame) -> bool:
        """Every packet is, by one byte or by what it asks for."""
        return True

    def reply(self, frame: Frame, received: bytes) -> Frame | None:
        """The reply whole, with the CRC that fits this request alone; of a packet that sets something 0xFF."""
        address, command = divmod(frame.can_id, 256)
        name = codec.getter_name(command)
        if name is None:
            return Frame(frame.can_id, codec.ACKNOWLEDGE) if received[:1] == codec.ACKNOWLEDGE else None
        found = codec.reply(address, name, received)
        return None if found is None else Frame(frame.can_id, received[: found[1]])


def setting(address: int, name: str, **values: int) -> Frame:
    """The packet that sets something."""
    return Frame(address << 8 | codec.SETTERS[name].command, codec.set_bytes(address, name, **values))


def question(address: int, name: str) -> Frame:
    """The packet that asks for something."""
    return Frame(address << 8 | codec.GETTERS[name].command, codec.ask_bytes(address, name))


def stop_frames(settings: RoboclawSettings) -> tuple[Frame, ...]:
    """Zero duty for every board, and the question whether its motors stand; nothing latches it."""
    return (
        *(setting(address, "duty_m1m2", duty_m1=0, duty_m2=0) for address in settings.addresses),
        *(question(address, "speeds") for address in settings.addresses),
    )


def stop_confirmation(settings: RoboclawSettings) -> Callable[[Frame], bool]:
    """Return what says, reply by reply, whether every board took the stop and its motors stand since."""
    taken = dict.fromkeys(settings.addresses, False)
    standing = dict.fromkeys(settings.addresses, False)

    def heard(frame: Frame) -> bool:
        address, command = divmod(frame.can_id, 256)
        if address in taken and command == codec.SETTERS["duty_m1m2"].command:
            taken[address] = True
        elif address in taken and command == codec.GETTERS["speeds"].command:
            found = codec.reply(address, "speeds", frame.data)
            standing[address] = found is not None and stands(settings, found[0]["speed_m1"], found[0]["speed_m2"])
        return all(taken.values()) and all(standing.values())

    return heard


def stands(settings: RoboclawSettings, *speeds_counts_s: codec.Value) -> bool:
    """Whether these motors' speeds are those of wheels at rest."""
    return all(abs(float(speed)) < STANDS_RAD_S * settings.counts_per_rad for speed in speeds_counts_s)


def cyclic_frames(settings: RoboclawSettings, command_rate_hz: float, _authenticated: bool) -> tuple[CyclicFrame, ...]:
    """A command, speeds and counts of each board in each tick, and one question more; request and reply in turn."""
    each = {"speed command": 16 + 1, "speeds": 2 + 10, "encoders": 2 + 10}
    frames = [
        CyclicFrame(f"{name} of {address}", "LINE", length, command_rate_hz, length, _TURNAROUND_S)
        for address in settings.addresses
        for name, length in each.items()
    ]
    return (*frames, CyclicFrame("status", "LINE", 8, command_rate_hz, 8, _TURNAROUND_S))


def safety_card(settings: RoboclawSettings) -> SafetyCard:
    """Who stops the robot when."""
    return SafetyCard(
        host_silent=f"each board {settings.watchdog_s:g} s after the last packet of any kind, by its serial timeout, "
        "which is set and read back before each arming",
        stops_by="stopping both motors, braking or coasting as the board is set",
        reaction_s=settings.watchdog_s,
        brakes=False,
        estop="through the daemon first, as two must not speak at once; zero duty for every board, which nothing "
        "latches but this driver and nothing confirms but standing motors: wire a button to S3, S4 or S5",
        unverified=(
            "whether a motor that is stopped brakes or coasts; which packets feed the timeout is the manual's word",
            "not tried on hardware: the driver was tried against a simulator made from the manual and the vendor's "
            "host libraries",
        ),
        setup=(
            "Motion Studio: packet serial at link.baud, each board its own address, encoders and velocity PID tuned "
            "(QPPS is taken as the fastest speed)",
        ),
    )


def _is_place(name: str) -> bool:
    found = _MOTOR.fullmatch(name)
    return found is not None and codec.FIRST_ADDRESS <= int(found[1]) <= codec.LAST_ADDRESS


def _place(name: str) -> tuple[int, int]:
    address, _, motor = name.partition("/")
    return int(address), int(motor) - 1
