"""A parameter of the transition function: its name, unit and physical range."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of theta.

    `low` and `high` bound what is physically possible; `start` is a plausible value to begin a fit from and `starts`
    are further ones for parameters whose likelihood has several hills; `neutral` is the value without any effect;
    `realistic` is the smallest size that real robots show, None where that says nothing.
    """

    name: str
    unit: str
    low: float
    high: float
    start: float
    neutral: float = 0.0
    starts: tuple[float, ...] = ()
    realistic: float | None = None


WHEEL_RADIUS = Parameter("wheel_radius_m", "m", 0.005, 2.0, 0.06, neutral=0.06)
AXIAL_DISTANCE = Parameter("axial_distance_m", "m", 0.02, 5.0, 0.4, neutral=0.4)
X_ICR = Parameter("x_icr_m", "m", -2.0, 2.0, 0.0)

BASE_PARAMETERS = (WHEEL_RADIUS, AXIAL_DISTANCE, X_ICR)
