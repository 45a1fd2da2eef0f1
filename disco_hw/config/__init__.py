"""robot.toml and the one reader of every file that a user names."""

from disco_hw.config.robot import (
    Control,
    DaemonSettings,
    Drive,
    Estimation,
    Link,
    LogSettings,
    ModelFile,
    PoseInput,
    Prior,
    Robot,
    RobotConfig,
    Ros2,
    link_of,
    load_daemon_address,
    load_robot_config,
)

__all__ = [
    "Control",
    "DaemonSettings",
    "Drive",
    "Estimation",
    "Link",
    "LogSettings",
    "ModelFile",
    "PoseInput",
    "Prior",
    "Robot",
    "RobotConfig",
    "Ros2",
    "link_of",
    "load_daemon_address",
    "load_robot_config",
]
