"""Verbs that carry the daemon's state to other worlds: bridge."""

from __future__ import annotations

import typer

from disco_hw.cli.options import LinkOption, ModelOption, RobotFile
from disco_hw.config.command_line import check_named_files
from disco_hw.errors import InputError

bridge_app = typer.Typer(no_args_is_help=True, help="Carry poses, commands and state between the daemon and ROS 2.")


@bridge_app.callback()
def _bridge() -> None:
    """Make `ros2` a word of its own."""


@bridge_app.command()
def ros2(robot: RobotFile, model: ModelOption = None, link: LinkOption = None) -> None:
    """Poses and commands in, odometry and state out, beside a daemon that may come and go (docs/ros2.md)."""
    check_named_files(robot, model)
    try:
        from disco_hw.bridge.ros2 import run_ros2_bridge
    except ModuleNotFoundError as error:
        if error.name != "cyclonedds":
            raise
        raise InputError("bridge ros2: needs cyclonedds; pip install 'disco-hw[ros2]'") from None
    raise typer.Exit(run_ros2_bridge(robot, model, link))
