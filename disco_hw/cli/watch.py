"""Verbs over what was recorded or is running: view, replay, bridge."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from disco_hw.cli.options import (
    AsJson,
    LinkOption,
    ModelOption,
    RobotFile,
    print_result,
)
from disco_hw.config import check_named_files
from disco_hw.errors import InputError
from disco_hw.viewer.page_process import DEFAULT_PORT, LOOPBACK


def view(
    log: Annotated[Path | None, typer.Argument(metavar="[LOG]", help="The log to replay.")] = None,
    live: Annotated[bool, typer.Option("--live", help="Show the running daemon of --robot.")] = False,
    robot: Annotated[Path | None, typer.Option(help="robot.toml; for a log, instead of the one it carries.")] = None,
    model: ModelOption = None,
    link: LinkOption = None,
    snapshot: Annotated[Path | None, typer.Option(help="Write a picture of the log instead.")] = None,
    at: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="When in the log the picture is of; its end if not given.")
    ] = None,
    video: Annotated[Path | None, typer.Option(help="Write a clip of the log instead.")] = None,
    speed: Annotated[float, typer.Option(min=0.1, max=1000.0, help="How much faster the clip runs.")] = 1.0,
    export: Annotated[Path | None, typer.Option(help="Write one HTML file that plays without Python instead.")] = None,
    host: Annotated[
        str, typer.Option(help="Address to listen on; on every one the page asks for the token of the printed address.")
    ] = LOOPBACK,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page.")] = DEFAULT_PORT,
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="With --live: serve Foxglove, port 8765, instead of the page.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Show the page: a log, or the running daemon."""
    if foxglove:
        _foxglove(live, robot, log, (model, link, snapshot, video, export), host, port, as_json)
    if live:
        if robot is None or log is not None:
            raise InputError("view --live: needs --robot ROBOT.toml and no LOG")
        if (snapshot, video, export) != (None, None, None):
            raise InputError("view --live: --snapshot, --video and --export are for a LOG; leave them out")
        check_named_files(robot, model)
        from disco_hw.viewer import commands

        raise typer.Exit(commands.view_live(robot, model, host, port, as_json=as_json, link=link))
    if log is None:
        raise InputError("view: give a LOG, or --live with --robot ROBOT.toml")
    if (model, link) != (None, None):
        raise InputError("view LOG: --model and --link are for --live, as a log has its own model; leave them out")
    check_named_files(robot, logs=[log])
    from disco_hw.viewer import commands

    if snapshot is not None:
        commands.snapshot_log(log, snapshot, at, robot)
    if video is not None:
        commands.video_log(log, video, speed, robot)
    if export is not None:
        commands.export_log(log, export, robot=robot)
    written = [str(path) for path in (snapshot, video, export) if path is not None]
    if not written:
        raise typer.Exit(commands.view_log(log, robot, host, port, as_json))
    if as_json:
        print_result({"written": written}, as_json, "")


def _foxglove(
    live: bool,
    robot: Path | None,
    log: Path | None,
    others: tuple[object, ...],
    host: str,
    port: int,
    as_json: bool,
) -> None:
    if not live or robot is None or log is not None or any(other is not None for other in others):
        raise InputError("view --foxglove: give --live and --robot ROBOT.toml, and of the rest --port alone")
    if host != LOOPBACK:
        raise InputError(f"--host {host}: Foxglove's protocol has no token; leave it out, and tunnel by ssh -L 8765")
    check_named_files(robot)
    try:
        from disco_hw.bridge import foxglove as bridge
    except ModuleNotFoundError as error:
        if error.name != "foxglove":
            raise
        raise InputError("view --foxglove: needs foxglove-sdk; pip install 'disco-hw[foxglove]'") from None
    raise typer.Exit(bridge.serve_foxglove(robot, host, bridge.DEFAULT_PORT if port == DEFAULT_PORT else port, as_json))


def replay(
    log: Annotated[Path, typer.Argument(metavar="LOG")],
    tolerance: Annotated[
        float,
        typer.Option(min=0.0, max=1.0, help="What numbers may differ by, absolutely or relatively; 0: not a bit."),
    ] = 0.0,
    as_json: AsJson = False,
) -> None:
    """Run estimator, planner and governor again on a log's samples and compare every output, by default bit for bit."""
    from disco_hw.processes import limit_thread_pools

    limit_thread_pools()
    check_named_files(logs=[log])
    from disco_hw.runtime.replay import replay as replay_log

    report = replay_log(log, tolerance)
    print_result(report.as_dict(), as_json, report.as_text())
    if not report.ok:
        raise typer.Exit(1)


bridge_app = typer.Typer(no_args_is_help=True, help="Carry poses, commands and state between the daemon and ROS 2.")


@bridge_app.callback()
def _bridge() -> None:
    """Each verb below has a robot of its own."""


@bridge_app.command()
def ros2(robot: RobotFile, model: ModelOption = None, link: LinkOption = None) -> None:
    """Poses and commands in, odometry and state out, beside a daemon that may come and go (docs/ros2.md)."""
    check_named_files(robot, model)
    with _ros2_extra("ros2"):
        from disco_hw.bridge.ros2 import run_ros2_bridge
    raise typer.Exit(run_ros2_bridge(robot, model, link))


@bridge_app.command("ros2-base")
def ros2_base(robot: RobotFile) -> None:
    """Carry commands to a base that is reached over ROS 2 alone, and its odometry back (docs/ros2.md)."""
    check_named_files(robot)
    with _ros2_extra("ros2-base"):
        from disco_hw.bridge.ros2_base import run_base_bridge
    raise typer.Exit(run_base_bridge(robot))


@contextmanager
def _ros2_extra(word: str) -> Iterator[None]:
    """Say what to install where DDS is not."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != "cyclonedds":
            raise
        raise InputError(f"bridge {word}: needs cyclonedds; pip install 'disco-hw[ros2]'") from None
