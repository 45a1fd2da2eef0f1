"""The geometry: the parameters that every model has."""

from __future__ import annotations

from disco_hw.effects.effect import Parameter

WHEEL_RADIUS = Parameter("wheel_radius_m", "m", 0.005, 2.0, 0.06, neutral=0.06)
AXIAL_DISTANCE = Parameter("axial_distance_m", "m", 0.02, 5.0, 0.4, neutral=0.4)
X_ICR = Parameter("x_icr_m", "m", -2.0, 2.0, 0.0)

BASE_PARAMETERS = (WHEEL_RADIUS, AXIAL_DISTANCE, X_ICR)
