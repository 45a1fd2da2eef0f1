"""Settings and port of bases that take speed and turn rate of their body, common to all of them."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Annotated

import msgspec
from msgspec import Meta

from drivers.motor import vendor_parts as parts
from drivers.motor.vendor_driver import BRAKING_NS, IMPLAUSIBLE, FrameReport, Port, Table
from drivers.types import Frame, Limit, Limits, WheelSample


class BodySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings in [link] of a base that takes speeds of its body: the nominal geometry, and what the base can do.

    Write the geometry of [robot] there, and leave it when the model learns another.
    """

    wheel_radius_m: Annotated[float, Meta(gt=0.0, le=2.0)]
    track_m: Annotated[float, Meta(gt=0.0, le=5.0)]
    max_speed_m_s: Annotated[float, Meta(gt=0.0, le=10.0)]
    max_turn_rad_s: Annotated[float, Meta(gt=0.0, le=20.0)] | None = None
    stop_deceleration_rad_s2: Annotated[float, Meta(gt=0.0, le=655.0)] = 10.0

    @property
    def fastest_rad_s(self) -> float:
        """The wheel speed of the base's largest speed."""
        return self.max_speed_m_s / self.wheel_radius_m

    @property
    def largest_difference_rad_s(self) -> float:
        """The difference of the wheel speeds of the base's largest turn rate."""
        turn_rad_s = math.inf if self.max_turn_rad_s is None else self.max_turn_rad_s
        return turn_rad_s * self.track_m / self.wheel_radius_m


class BodyPort(Port):
    """Port of a base that takes speed and turn rate of its body, and makes wheel speeds of them by its own track."""

    settings: BodySettings

    def __init__(self, settings: BodySettings, watchdog_s: float, timeout: Limit) -> None:
        """Create the port; `watchdog_s` is that of `Table`, `timeout` the base's own and who states it."""
        self.settings, self._timeout = settings, timeout
        slowdown = settings.stop_deceleration_rad_s2
        self.table = Table(stop_deceleration_rad_s2=slowdown, watchdog_s=watchdog_s, zeros_to_arm=5)
        self._turned = (parts.Odometer(), parts.Odometer())
        self.reset_state(0)

    @property
    def limits(self) -> Limits:
        """Limits that robot.toml declares of the base, and its time-out."""
        fastest = Limit(self.settings.fastest_rad_s, "robot.toml")
        return parts.limits(fastest, self._timeout, self.table.stop_deceleration_rad_s2)

    def reset_state(self, now_ns: int) -> None:
        """Compare the next counts with none before."""
        for side in self._turned:
            side.reset_state()

    def speeds(self, now_ns: int, left_rad_s: float, right_rad_s: float) -> Sequence[Frame]:
        """Return the frame that commands the body's motion, by the nominal geometry and on its curve."""
        it = self.settings
        left_m_s, right_m_s = it.wheel_radius_m * left_rad_s, it.wheel_radius_m * right_rad_s
        # A base holds speed and turn rate to its limits one by one, which would change the curve.
        scale = min(
            1.0,
            it.max_speed_m_s / max(abs(left_m_s), abs(right_m_s), 1e-9),
            it.largest_difference_rad_s / max(abs(right_rad_s - left_rad_s), 1e-9),
        )
        return (self._motion(scale * (left_m_s + right_m_s) / 2.0, scale * (right_m_s - left_m_s) / it.track_m),)

    def brake(self, now_ns: int, lasts_ns: int) -> tuple[Sequence[Frame], bool]:
        """Zero speed until the base stands, then the frames of standby."""
        if self._is_stationary or lasts_ns > BRAKING_NS:
            self._repeat_ns = now_ns
            return self._standby_frames(), True
        return (self._motion(0.0, 0.0),), False

    def _handle_counts(
        self, counts: tuple[int, int], t_ns: int, looked_ns: int, fastest: float, slack: float
    ) -> FrameReport:
        """Take in the counts of both sides, as `Odometer.add_wrapping` does; a jump ends a drive."""
        plausible = [
            side.add_wrapping(count, t_ns, looked_ns, fastest, slack)
            for side, count in zip(self._turned, counts, strict=True)
        ]
        if all(plausible):
            return FrameReport(wheels=self._sample(t_ns))
        lost = "the base has restarted: the angles of its wheels jumped"
        return FrameReport(counts=IMPLAUSIBLE, wheels=self._sample(t_ns), lost=lost)

    @abstractmethod
    def _sample(self, t_ns: int) -> WheelSample | None:
        """Return the wheels by the newest counts; None before their speeds are known."""

    @property
    @abstractmethod
    def _is_stationary(self) -> bool:
        """Whether the base says that it does not move."""

    @abstractmethod
    def _motion(self, linear_m_s: float, angular_rad_s: float) -> Frame:
        """Return the command of these speeds of the body."""

    @abstractmethod
    def _standby_frames(self) -> tuple[Frame, ...]:
        """Return the frames after which a base that stands takes no speeds."""
