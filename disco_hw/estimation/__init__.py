"""Fusion of wheel odometry and measured pose."""

from disco_hw.estimation.correction import PoseReason, PoseUpdate
from disco_hw.estimation.fusion import FusionStats, PoseEstimate, PoseFusion
from disco_hw.estimation.odometry import OdometryParameters, Pose, advance

__all__ = [
    "FusionStats",
    "OdometryParameters",
    "Pose",
    "PoseEstimate",
    "PoseFusion",
    "PoseReason",
    "PoseUpdate",
    "advance",
]
