"""Fusion of wheel odometry and measured pose."""

from disco_hw.estimation.correction import PoseReason
from disco_hw.estimation.fusion import Estimate, FusionStats, PoseFusion, PoseUpdate
from disco_hw.estimation.odometry import OdometryParameters, Pose, advance

__all__ = [
    "Estimate",
    "FusionStats",
    "OdometryParameters",
    "Pose",
    "PoseFusion",
    "PoseReason",
    "PoseUpdate",
    "advance",
]
