"""Bags of ROS 2 (MCAP and sqlite3) and ROS 1: docs/ros2.md says which topics are read."""

from __future__ import annotations

from pathlib import Path

from disco_hw.config import RobotConfig
from disco_hw.log.drive import DriveLog
from disco_hw.log.importing import LogFormat
from disco_hw.log.rosbag.bag import is_bag


def _read(path: Path, config: RobotConfig) -> DriveLog:
    from disco_hw.log.rosbag.drive import read_rosbag  # noqa: PLC0415

    return read_rosbag(path, config)


FORMAT = LogFormat("rosbag", is_bag, _read, order=20, has_topics=True)
