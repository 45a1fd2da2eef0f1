"""What the driver says, and whoever says it: keyboard, gamepad, script."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from disco_hw.runtime.states import State

INPUT_LIMIT_NS = 200_000_000


@dataclass(frozen=True, slots=True)
class ManualInput:
    """Wheel speeds wanted at `t_ns` (rad/s, left and right) and whether the deadman was held then.

    `t_ns` is when the driver was last known to want this, not when it was asked for.
    """

    t_ns: int
    left_rad_s: float
    right_rad_s: float
    deadman: bool


@dataclass(frozen=True, slots=True)
class RobotView:
    """What a source may see of the robot: the daemon's state, whether the last tick drove the wheels by hand, and the
    wheels' measured speeds (rad/s, left and right), None where they are not known.
    """

    state: State
    driving: bool
    wheels: tuple[float, float] | None = None


class ManualSource(Protocol):
    """Asked once a tick; it never waits."""

    @property
    def ended(self) -> str | None:
        """Why there will be no further input, in words; None while there may be."""

    @property
    def completed(self) -> bool:
        """Whether it ended as it should."""

    @property
    def words(self) -> str:
        """What is going on or to be done now, for the person."""

    @property
    def task(self) -> str:
        """What is being carried out and what for; empty where a person decides."""

    def poll(self, now_ns: int, robot: RobotView) -> ManualInput | None:
        """The newest input, however old; None when the device is gone."""

    def close(self) -> None:
        """Give the device back; safe to call twice."""
