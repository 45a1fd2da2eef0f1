"""Parts that the drivers of vendors' controllers share: odometers, layouts of messages, frames as sent, ids."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

from drivers.types import (
    DriverState,
    Frame,
    Limit,
    Limits,
    OutgoingFrame,
    RobotStatus,
    SettingsFault,
    WheelCommand,
    WheelSample,
)

# Chosen: a frame that waited for longer is of an older tick than the next ones.
_FRAME_LIFE_NS = 50_000_000
# Chosen: a late e-stop is better than none, so it outlives other frames; three of it, as one may be lost.
ESTOP_LIFE_NS = 1_000_000_000
ESTOP_REPEATS = 3
# Lower ranks are sent first (`drivers.types.OutgoingFrame`).
_ESTOP_RANK, _RANK = 0, 1
Nodes = int | tuple[int, ...]
"""Ids on CAN of one side's controllers, as robot.toml names them."""
Sign = Literal[-1, 1]


@dataclass(slots=True)
class Odometer:
    """Distance that one motor has turned since the driver began, in the controller's counts.

    `total` goes on over a restart of the controller; `speed` in counts/s carries it on from `t_ns`, when the last count
    was received; it is not older than `looked_ns`, when the host had looked before.
    """

    total: float = 0.0
    speed: float = 0.0
    t_ns: int = 0
    looked_ns: int = 0
    last: float | None = None
    is_new: bool = False

    def add(self, count: float, t_ns: int, looked_ns: int, fastest: float, slack: float) -> bool:
        """Whether the motor can have turned so far since the count before; if not, it goes on from this one.

        `fastest` in counts/s, and `slack` counts more. A pause of the host brings the stamps of two counts together,
        but not before the host had looked last (`looked_ns`, now).
        """
        longest_s = (t_ns - min(self.t_ns, self.looked_ns)) * 1e-9
        moved = 0.0 if self.last is None else count - self.last
        plausible = abs(moved) <= fastest * longest_s + slack
        self.total += moved if plausible else 0.0
        self.last, self.t_ns, self.looked_ns, self.is_new = count, t_ns, looked_ns, True
        return plausible

    def add_wrapping(
        self, count: int, t_ns: int, looked_ns: int, fastest: float, slack: float, *, bits: int = 32
    ) -> bool:
        """Add a count that wraps, as `add` does one that does not."""
        last, half = count if self.last is None else int(self.last), 2 ** (bits - 1)
        moved = (count - last + half) % (2 * half) - half
        self.last = None if self.last is None else count - moved
        return self.add(count, t_ns, looked_ns, fastest, slack)

    def reset_state(self) -> None:
        """Compare the next count with none before, because the controller may have restarted."""
        self.last, self.is_new = None, False


def wheel_sample(
    t_ns: int, sides: Sequence[Sequence[Odometer]], direction: tuple[int, int], rad_per_count: float
) -> WheelSample:
    """Return the wheels of both sides, each the mean of its motors.

    What was counted earlier is carried on to `t_ns`.
    """
    angles, speeds = [], []
    for side, sign in zip(sides, direction, strict=True):
        turned = [each.total + each.speed * (t_ns - each.t_ns) * 1e-9 for each in side]
        angles.append(sign * rad_per_count * sum(turned) / len(side))
        speeds.append(sign * rad_per_count * sum(each.speed for each in side) / len(side))
        for each in side:
            each.is_new = False
    return WheelSample(t_ns, t_ns, angles[0], angles[1], speeds[0], speeds[1])


@dataclass(frozen=True, slots=True)
class Layout:
    """Layout of a message: its name and number, its bytes by `struct` without the byte order, and its fields.

    `steps`: of each field, how many steps on the wire make a unit; a value with one step a unit stays a whole number.
    """

    name: str
    command: int
    order: str
    body: str
    fields: tuple[str, ...] = ()
    steps: tuple[float, ...] = ()

    @property
    def length(self) -> int:
        """Length of the fields in bytes."""
        return struct.calcsize(self.order + self.body)

    def pack(self, *values: float) -> bytes:
        """Return the bytes of the fields, from values in steps."""
        return struct.pack(self.order + self.body, *values)

    def unpack(self, data: bytes, offset: int = 0) -> dict[str, Any]:
        """Return the fields by name, of bytes that have them from `offset` on."""
        raw = struct.unpack_from(self.order + self.body, data, offset)
        named = zip(self.fields, self.steps, raw, strict=True)
        return {name: value if steps == 1.0 else value / steps for name, steps, value in named}


def layout(order: str, name: str, command: int, body: str, fields: str) -> Layout:
    """Return the layout of a message; `fields` names its fields, each with `:STEPS` where a unit is not one step."""
    pairs = [item.partition(":") for item in fields.split()]
    steps = tuple(float(steps) if steps else 1.0 for _, _, steps in pairs)
    return Layout(name, command, order, body, tuple(name for name, _, _ in pairs), steps)


def layouts(order: str, *rows: tuple[str, int, str, str]) -> Mapping[str, Layout]:
    """Return layouts by name, from rows of name, number, body and fields as `layout` takes them."""
    return MappingProxyType({row[0]: layout(order, *row) for row in rows})


def by_number(named: Mapping[str, Layout]) -> Mapping[int, Layout]:
    """Return the same layouts by their numbers."""
    return MappingProxyType({each.command: each for each in named.values()})


@dataclass(frozen=True, slots=True)
class Decoded:
    """A message by its name, with its fields, and which controller or motor sent it (-1 where it does not say)."""

    name: str
    values: Mapping[str, Any]
    node: int = -1


def limits(fastest: Limit, timeout: Limit, stop_deceleration_rad_s2: float) -> Limits:
    """Return the limits of controllers that this host slows down, with what robot.toml declares."""
    slows = Limit(stop_deceleration_rad_s2, "robot.toml")
    return Limits(max_wheel_speed_rad_s=fastest, command_timeout_s=timeout, stop_deceleration_rad_s2=slows)


def check_command(command: WheelCommand | None, shortest_s: float) -> None:
    """Raise ValueError for a command that is not finite, or valid for no time or for less than `shortest_s`."""
    if command is None:
        return
    is_finite = math.isfinite(command.left_rad_s) and math.isfinite(command.right_rad_s)
    if not (is_finite and command.valid_for_s > 0.0 and command.valid_for_s >= shortest_s):
        raise ValueError(f"not a wheel command: {command}")


def outgoing(now_ns: int, *frames: Frame, life_ns: int = _FRAME_LIFE_NS) -> tuple[OutgoingFrame, ...]:
    """Frames to be sent within `life_ns`, in this order, after any e-stop."""
    return tuple(OutgoingFrame(frame, now_ns + life_ns, _RANK) for frame in frames)


def estop_frames(now_ns: int, frames: tuple[Frame, ...]) -> tuple[OutgoingFrame, ...]:
    """Return the frames of an e-stop, three times over, before all others."""
    return tuple(OutgoingFrame(frame, now_ns + ESTOP_LIFE_NS, _ESTOP_RANK) for frame in ESTOP_REPEATS * frames)


def status(t_ns: int, state: DriverState, stop_confirmed: bool) -> RobotStatus:
    """Return a status of nothing but the state: these controllers know no sessions and count no refused frames.

    An e-stop that is not confirmed yet is a stop under way.
    """
    names = {DriverState.ARMED: "ARMED", DriverState.FAULT: "FAULT", DriverState.STOPPING: "STOPPING"}
    names[DriverState.ESTOP] = "ESTOP" if stop_confirmed else "STOPPING"
    return RobotStatus(
        t_ns=t_ns,
        state=names.get(state, "STANDBY"),
        fault_code=0,
        fault="NONE",
        estop_source="NONE",
        stop_cause="NONE",
        session=0,
        rejected_count=0,
        reject_reason="NONE",
    )


def sides_of(nodes: tuple[Nodes, Nodes]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the ids on the left and on the right."""
    left, right = ((side,) if isinstance(side, int) else side for side in nodes)
    return left, right


def all_of(nodes: tuple[Nodes, Nodes]) -> tuple[int, ...]:
    """Return every id, left before right."""
    left, right = sides_of(nodes)
    return (*left, *right)


def nodes_fault(nodes: tuple[Nodes, Nodes], largest: int, reserved: int | None = None) -> SettingsFault | None:
    """Return what is wrong with the ids in link.nodes, or None; `reserved` is an id that no controller may have."""
    ids = all_of(nodes)
    if not all(sides_of(nodes)):
        return SettingsFault("nodes", "a side has no controller", "write [left, right], such as [3, 5]")
    if any(not 0 <= one <= largest or one == reserved for one in ids):
        of_host = "" if reserved is None else f", or is {reserved}, the id of this host"
        return SettingsFault("nodes", f"an id is outside 0 to {largest}{of_host}", "write the ids of the controllers")
    if len(set(ids)) != len(ids):
        return SettingsFault("nodes", "an id is listed twice", "give each controller an id of its own")
    return None


def in_sides(nodes: Sequence[int | str]) -> list[Any]:
    """Split the motors that were received into left and right, the lower half first: two numbers, or two lists."""
    half = len(nodes) // 2
    left, right = list(nodes[:half]), list(nodes[half:])
    return [left[0], right[0]] if len(left) == len(right) == 1 else [left, right]
