"""Samples that drivers make of what a robot sends, and the command that they send to it.

SI units; left before right; positive wheel speed drives forward; x forward, y left, yaw counter-clockwise.
Time stamps are nanoseconds of the host's monotonic clock unless the name says otherwise.
"""

from __future__ import annotations

import math

import msgspec

FARTHEST_M = 838.0
"""Largest coordinate of a place: the frames of a pose hold 838.86 m along x and y (disco_robot.dbc)."""


class WheelCommand(msgspec.Struct, frozen=True, gc=False):
    """Wheel speeds to hold for at most `valid_for_s` after reception."""

    left_rad_s: float
    right_rad_s: float
    valid_for_s: float


class WheelSample(msgspec.Struct, frozen=True, gc=False):
    """Wheel angles and speeds of one instant; angles are cumulative and do not wrap."""

    t_ns: int
    received_ns: int
    left_angle_rad: float
    right_angle_rad: float
    left_speed_rad_s: float
    right_speed_rad_s: float


class PoseSample(msgspec.Struct, frozen=True, gc=False):
    """A measured pose in the world frame; `t_ns` is when it was true, `received_ns` when it arrived.

    `yaw_rad` and `yaw_std_rad` are both NaN where no heading was measured. The position is that of the point
    `lever_x_m` ahead and `lever_y_m` to the left of the tracked one. `source`: which of robot.toml's, 0 that of [pose],
    then those of [[pose.also]].
    """

    t_ns: int
    received_ns: int
    x_m: float
    y_m: float
    yaw_rad: float
    position_std_m: float
    yaw_std_rad: float
    lever_x_m: float = 0.0
    lever_y_m: float = 0.0
    source: int = 0

    @property
    def has_heading(self) -> bool:
        """Whether there is a heading beside the position."""
        return not (math.isnan(self.yaw_rad) and math.isnan(self.yaw_std_rad))


class MotorSample(msgspec.Struct, frozen=True, gc=False):
    """Motor currents and temperatures."""

    t_ns: int
    left_current_a: float
    right_current_a: float
    left_temperature_c: float
    right_temperature_c: float


class PowerSample(msgspec.Struct, frozen=True, gc=False):
    """Battery voltage, current and temperature."""

    t_ns: int
    voltage_v: float
    current_a: float
    temperature_c: float


class RobotStatus(msgspec.Struct, frozen=True, gc=False):
    """Status that the robot's controller reports; names are those of the DBC's value tables."""

    t_ns: int
    state: str
    fault_code: int
    fault: str
    estop_source: str
    stop_cause: str
    session: int
    rejected_count: int
    reject_reason: str


class RobotLinkHealth(msgspec.Struct, frozen=True, gc=False):
    """The robot's own count of trouble on the link."""

    t_ns: int
    tx_error_count: int
    rx_error_count: int
    bus_off_count: int
    crc_error_count: int
    sequence_error_count: int
    watchdog_count: int


class Readings(msgspec.Struct, frozen=True, gc=False):
    """Readings from one batch of received frames, oldest first.

    `other_host`: what another host does on the link, such as "it sends HOST_STATE"; None while none was noticed.
    """

    wheels: tuple[WheelSample, ...] = ()
    poses: tuple[PoseSample, ...] = ()
    motors: tuple[MotorSample, ...] = ()
    power: tuple[PowerSample, ...] = ()
    status: tuple[RobotStatus, ...] = ()
    link_health: tuple[RobotLinkHealth, ...] = ()
    events: tuple[str, ...] = ()
    other_host: str | None = None
