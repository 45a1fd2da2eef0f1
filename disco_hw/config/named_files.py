"""Whether the files that a command names can be read, before what reads them in full is imported."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from disco_hw.config.input_file import LOG, MODEL_TOML, WAY_POINTS, open_file, read_toml
from disco_hw.config.robot import load_robot_config


def check_named_files(robot: Path | None = None, model: Path | None = None, logs: Iterable[Path] = ()) -> None:
    """Raise InputError for the first file that is missing or no such file, or a robot.toml that is wrong.

    Of `robot` the model that it names counts too, unless `model` overrides it, and the way-points of its task. What a
    model, way-points or a log say is not looked at.
    """
    if robot is not None:
        config = load_robot_config(robot)
        path = getattr(config.task, "path", None)
        if path is not None:
            os.close(open_file(robot.parent / path, WAY_POINTS))
        if model is None and config.model.file is not None:
            model = robot.parent / config.model.file
    if model is not None:
        read_toml(model, MODEL_TOML)
    for log in logs:
        os.close(open_file(log, LOG))
