"""What the drivers of vendors' controllers share: stages, the ramp of a stop, and how frames and ids are written."""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from typing import Any, Literal

from drivers.types import Frame, OutgoingFrame, RobotStatus, WheelCommand

_FRAME_LIFE_NS = 50_000_000
_ESTOP_LIFE_NS = 1_000_000_000
_ESTOP_REPEATS = 3
_ESTOP_RANK, _RANK = 0, 1
_LONGEST_STEP_S = 0.1
_PAUSE_NS = 100_000_000
Nodes = int | tuple[int, ...]
"""Ids on CAN of one side's controllers, as robot.toml names them."""
Sign = Literal[-1, 1]


class Stage(enum.Enum):
    """Where a driver is between standing by and driving; BRAKING only where stopping ends with a brake."""

    REST = "rest"
    ARMING = "arming"
    ARMED = "armed"
    STOPPING = "stopping"
    BRAKING = "braking"


class Attention:
    """Since when this host has looked at its controllers without a pause.

    What was not heard in a pause is no silence of theirs: the host was not there, or has not read yet what came then.
    """

    def __init__(self) -> None:
        self._looked_ns = self._since_ns = 0

    def look(self, now_ns: int) -> None:
        """The host looks, once in each tick."""
        if now_ns - self._looked_ns > _PAUSE_NS:
            self._since_ns = now_ns
        self._looked_ns = now_ns

    def silent_ns(self, heard_ns: int) -> int:
        """How long nothing has come since `heard_ns`, of the time without a pause."""
        return self._looked_ns - max(heard_ns, self._since_ns)


def check_command(command: WheelCommand | None) -> None:
    """Raise ValueError for a command that is not finite or valid for no time."""
    if command is not None and not (
        math.isfinite(command.left_rad_s) and math.isfinite(command.right_rad_s) and command.valid_for_s > 0.0
    ):
        raise ValueError(f"not a wheel command: {command}")


def slowed(speeds_rad_s: tuple[float, float], deceleration_rad_s2: float, elapsed_ns: int) -> tuple[float, float]:
    """Speeds of both sides nearer to zero by the deceleration; a pause counts for 0.1 s at most."""
    step = deceleration_rad_s2 * min(max(elapsed_ns, 0) * 1e-9, _LONGEST_STEP_S)
    left, right = (math.copysign(max(abs(speed) - step, 0.0), speed) for speed in speeds_rad_s)
    return left, right


def outgoing(now_ns: int, *frames: Frame, life_ns: int = _FRAME_LIFE_NS) -> tuple[OutgoingFrame, ...]:
    """Frames to be sent within `life_ns`, in this order, after any e-stop."""
    return tuple(OutgoingFrame(frame, now_ns + life_ns, _RANK) for frame in frames)


def estop_frames(now_ns: int, frames: tuple[Frame, ...]) -> tuple[OutgoingFrame, ...]:
    """The frames of an e-stop, three times over, before all others."""
    return tuple(OutgoingFrame(frame, now_ns + _ESTOP_LIFE_NS, _ESTOP_RANK) for frame in _ESTOP_REPEATS * frames)


def status(t_ns: int, state: str) -> RobotStatus:
    """A status of nothing but the state: these controllers know no sessions and count no refused frames."""
    return RobotStatus(
        t_ns=t_ns,
        state=state,
        fault_code=0,
        fault="NONE",
        estop_source="NONE",
        stop_cause="NONE",
        session=0,
        rejected_count=0,
        reject_reason="NONE",
    )


def sides_of(nodes: tuple[Nodes, Nodes]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The ids on the left and on the right."""
    left, right = ((side,) if isinstance(side, int) else side for side in nodes)
    return left, right


def in_sides(nodes: Sequence[int | str]) -> list[Any]:
    """What was heard of motors as left and right, the lower half first: two numbers, or two lists."""
    half = len(nodes) // 2
    left, right = list(nodes[:half]), list(nodes[half:])
    return [left[0], right[0]] if len(left) == len(right) == 1 else [left, right]
