"""robot.toml, and what a command line says of the robot: the files it names, and --link."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from disco_hw.config.robot import (
    LONGEST_HORIZON,
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
)
from disco_hw.config.robot_file import (
    link_of,
    load_daemon_address,
    load_robot_config,
    refuse_outside_task,
    task_fault,
)
from disco_hw.errors import InputError
from disco_hw.files import LOG, MODEL_TOML, WAY_POINTS, open_file, read_toml

__all__ = [
    "LINK_FORMS",
    "LONGEST_HORIZON",
    "SHIPPED_ROBOT",
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
    "check_named_files",
    "link_fields",
    "link_of",
    "load_daemon_address",
    "load_robot_config",
    "model_file_of",
    "names_address",
    "refuse_outside_task",
    "task_fault",
]

SHIPPED_ROBOT = Path(__file__).parents[1] / "robots" / "wombot.toml"
"""The robot.toml that comes with the package; its model and a path lie beside it."""


def model_file_of(robot: Path, config: RobotConfig, model: Path | None) -> Path | None:
    """Return the model file in use: `model` where it is given, else the one that robot.toml names, if any."""
    if model is None and config.model.file is not None:
        return robot.parent / config.model.file
    return model


def check_named_files(robot: Path | None = None, model: Path | None = None, logs: Iterable[Path] = ()) -> None:
    """Raise InputError for the first file that is missing or no such file, or a robot.toml that is wrong.

    Of `robot` the model that it names counts too, unless `model` overrides it, and the way-points of its task. What a
    model, way-points or a log say is not looked at.
    """
    if robot is not None:
        config = load_robot_config(robot)
        if config.task.file is not None:
            os.close(open_file(robot.parent / config.task.file, WAY_POINTS))
        model = model_file_of(robot, config, model)
    if model is not None:
        read_toml(model, MODEL_TOML)
    for log in logs:
        os.close(open_file(log, LOG))


LINK_FORMS = "can, serial, can:INTERFACE:CHANNEL or serial:PORT"


def link_fields(option: str | None) -> dict[str, Any]:
    """Return the fields of robot.toml's [link] that the option sets; raises InputError for one that says nothing."""
    match None if option is None else option.split(":"):
        case None:
            return {}
        case ["can" | "serial" as kind]:
            return {"kind": kind}
        case ["can", interface, *channel] if interface and any(channel):
            return {"kind": "can", "interface": interface, "channel": ":".join(channel), "options": {}}
        case ["serial", *port] if any(port):
            return {"kind": "serial", "port": ":".join(port)}
    raise InputError(f"--link {option}: not a link; write {LINK_FORMS}")


def names_address(fields: dict[str, Any]) -> bool:
    """Whether the fields say where the robot is, not only over what it is reached."""
    return len(fields) > 1
