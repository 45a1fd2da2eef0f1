"""Whether what the host means to do is within what the robot's firmware allows."""

from __future__ import annotations

from drivers.types import Capabilities

_SPEED_RESOLUTION_RAD_S = 0.002
_ACCELERATION_RESOLUTION_RAD_S2 = 0.01


def check_limits(
    capabilities: Capabilities,
    max_wheel_speed_rad_s: float,
    max_wheel_acceleration_rad_s2: float,
    ticks_per_rev: float,
) -> list[str]:
    """Compare robot.toml's limits with the firmware's; return a line for each that does not fit, none if all do.

    A limit is to be refused at the start, not clipped in silence: a host that plans with more than the robot does
    plans wrongly. Equal within the resolution on the wire (0.002 rad/s, 0.01 rad/s^2) is within.
    """
    errors = []
    if not max_wheel_speed_rad_s <= capabilities.max_wheel_speed_rad_s + _SPEED_RESOLUTION_RAD_S:
        errors.append(
            f"robot.max_wheel_speed_rad_s: {max_wheel_speed_rad_s:g} is above the firmware's limit; "
            f"write at most {capabilities.max_wheel_speed_rad_s:g}, or flash a firmware with a higher limit"
        )
    if (
        not max_wheel_acceleration_rad_s2
        <= capabilities.max_wheel_acceleration_rad_s2 + _ACCELERATION_RESOLUTION_RAD_S2
    ):
        errors.append(
            f"robot.max_wheel_acceleration_rad_s2: {max_wheel_acceleration_rad_s2:g} is above the firmware's limit; "
            f"write at most {capabilities.max_wheel_acceleration_rad_s2:g}, or flash a firmware with a higher limit"
        )
    if ticks_per_rev != capabilities.ticks_per_rev:
        errors.append(
            f"robot.ticks_per_rev: {ticks_per_rev:g} differs from the firmware's {capabilities.ticks_per_rev}; "
            f"write {capabilities.ticks_per_rev}, or flash the firmware for this encoder"
        )
    return errors
