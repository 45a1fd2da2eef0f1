"""How fast a line can be driven: the wheels' limit straight ahead, whatever its bends."""

from __future__ import annotations

import math
from collections.abc import Mapping

from disco_hw.tasks.task import SLOWEST_M_S, Chassis, Editable


def straight_fastest_m_s(robot: Chassis) -> float:
    """Speed straight ahead at which the wheels of the nominal robot are at their limit."""
    return robot.max_wheel_speed_rad_s * robot.wheel_radius_m


def straight_too_fast(speed_m_s: float, robot: Chassis) -> str | None:
    """Why the wheels cannot do a speed straight ahead, and the remedy; None if they can."""
    fastest = straight_fastest_m_s(robot)
    if speed_m_s <= fastest:
        return None
    return (
        f"{speed_m_s:g} m/s asks the wheels for more than {robot.max_wheel_speed_rad_s:g} rad/s; "
        f"at most {math.floor(fastest * 1000.0) / 1000.0:g} m/s"
    )


def speed_range(robot: Chassis) -> Mapping[str, Editable]:
    """The speed as the field that a person may change."""
    return {"speed_m_s": Editable(SLOWEST_M_S, straight_fastest_m_s(robot), "Speed (m/s)")}
