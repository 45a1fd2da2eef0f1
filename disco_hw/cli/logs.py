"""Verbs for logs and for what is running: import, infer, gap, log info, recover, export, replay, view."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from disco_hw.cli.options import (
    AsJson,
    LinkOption,
    Logs,
    ModelOption,
    RobotOption,
    print_result,
    progress_bar,
    progress_line,
)
from disco_hw.config import check_named_files
from disco_hw.errors import InputError
from disco_hw.viewer import DEFAULT_PORT, LOOPBACK


def infer(
    logs: Logs,
    robot: RobotOption,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Write the model with its posterior here.")] = None,
    paper: Annotated[bool, typer.Option("--paper", help="The paper's statistics and 1000 simulations.")] = False,
    random_features: Annotated[
        bool, typer.Option("--random-features", help="With --paper: its mixture on random Fourier features (MDRFF).")
    ] = False,
    cross_correlation: Annotated[
        bool, typer.Option("--cross-correlation", help="With --paper: its statistics of steps against actions.")
    ] = False,
    simulations: Annotated[int | None, typer.Option(min=200, help="Simulations in all.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of simulations and networks.")] = 1,
    report: Annotated[Path | None, typer.Option(help="Write diagnostics with pictures to this HTML file.")] = None,
    dask: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Simulate and fit on the Dask cluster of this scheduler.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Infer the robot's parameters from logs of driving (BayesSim) and write a model with its posterior."""
    from disco_hw.processes import limit_thread_pools

    # Before the numeric libraries are loaded: on small matrices their pools of threads cost more than the work.
    limit_thread_pools()
    check_named_files(robot, logs=logs)
    from disco_hw.daemon.run import compile_beforehand
    from disco_hw.inference.infer import InferOptions
    from disco_hw.inference.infer_command import infer_command

    options = InferOptions(paper, simulations, seed, random_features, cross_correlation)
    with progress_bar() as report_progress:
        result = infer_command(logs, robot, out, report, options, dask, report_progress)
    print_result(result.as_dict(), as_json, result.as_text())
    if out is not None:
        compile_beforehand(robot, out, progress_line)


def gap(
    logs: Logs,
    robot: RobotOption,
    out: Annotated[Path, typer.Option("-o", "--out", help="Directory for report, pictures and amended model.")],
    model: ModelOption = None,
    fleet: Annotated[
        bool, typer.Option("--fleet", help="Search each log separately, and print one table of all.")
    ] = False,
    dask: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Like --fleet, on the Dask cluster of this scheduler.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Find where model and logs disagree, name the missing effect, and write the amended model."""
    from disco_hw.processes import limit_thread_pools

    limit_thread_pools()
    check_named_files(robot, model, logs)
    from disco_hw.gap import gap as find_gap
    from disco_hw.gap import gap_fleet

    if dask is not None:
        from disco_hw.inference.simulate import dask_workers

        with dask_workers(dask) as workers:
            table = gap_fleet(logs, robot, out, model, progress_line, workers.map)
    elif fleet:
        table = gap_fleet(logs, robot, out, model, progress_line)
    if fleet or dask is not None:
        print_result(table.as_dict(), as_json, table.as_text())
        return
    from disco_hw.daemon.run import compile_beforehand

    result = find_gap(logs, robot, out, model, progress_line)
    print_result(result.as_dict(), as_json, result.as_text())
    compile_beforehand(robot, out / "model.toml", progress_line)


log_app = typer.Typer(help="Inspect a log, repair it, export it.", no_args_is_help=True)


def import_log(
    log: Annotated[Path, typer.Argument(metavar="FILE", help="A CSV, a candump of our protocol, or a bag of ROS.")],
    robot: RobotOption,
    out: Annotated[Path, typer.Option("-o", "--out", help="Where to write the MCAP log.")],
    topic: Annotated[
        list[str] | None,
        typer.Option("--topic", metavar="ROLE=NAME", help="Read commands, wheels or poses of a bag from this topic."),
    ] = None,
    channel: Annotated[
        str, typer.Option("--channel", metavar="NAME", help="Read this channel of a candump that has several.")
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Convert a foreign log to MCAP for `infer`, `gap` and Foxglove; `view` and `replay` need a log of `run`."""
    check_named_files(robot, logs=[] if log.is_dir() else [log])
    from disco_hw.log.importing import import_log as import_foreign

    result = import_foreign(log, robot, out, topic or (), channel)
    print_result(result.as_dict(), as_json, result.as_text())


@log_app.command("fence")
def fence_of(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A log of a drive once round along the edge.")],
    as_json: AsJson = False,
) -> None:
    """Write the fence along which a robot was driven or pushed, for its robot.toml (docs/fence.md)."""
    check_named_files(logs=[log])
    from disco_hw.first_use.fence_drive import fence_of_log, fence_toml

    keep_in = fence_of_log(log)
    print_result({"keep_in": [list(corner) for corner in keep_in]}, as_json, fence_toml(keep_in))


@log_app.command()
def info(log: Annotated[Path, typer.Argument(metavar="LOG")], as_json: AsJson = False) -> None:
    """Say what a log holds and whether anything was lost."""
    check_named_files(logs=[log])
    from disco_hw.log.log_command import info as log_info

    print(log_info(log, as_json))


@log_app.command()
def recover(
    log: Annotated[Path, typer.Argument(metavar="LOG")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Where to write the repaired log.")],
    as_json: AsJson = False,
) -> None:
    """Copy what is readable of a damaged log into a new one."""
    check_named_files(logs=[log])
    from disco_hw.log.log_command import recover as log_recover

    print(log_recover(log, out, as_json))


@log_app.command()
def export(
    log: Annotated[Path, typer.Argument(metavar="LOG")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Where to write the CSV file, or the bag's folder.")],
    rosbag2: Annotated[bool, typer.Option("--rosbag2", help="Write a bag of ROS 2 instead (docs/ros2.md).")] = False,
    as_json: AsJson = False,
) -> None:
    """Write commands, encoders and poses as CSV, or as a bag of ROS 2."""
    check_named_files(logs=[log])
    from disco_hw.log.log_command import export as log_export
    from disco_hw.log.log_command import export_rosbag

    print((export_rosbag if rosbag2 else log_export)(log, out, as_json))


def view(
    log: Annotated[Path | None, typer.Argument(metavar="[LOG]", help="The log to replay.")] = None,
    live: Annotated[bool, typer.Option("--live", help="Show the running daemon of --robot.")] = False,
    robot: Annotated[Path | None, typer.Option(help="robot.toml; for a log, instead of the one it carries.")] = None,
    model: ModelOption = None,
    link: LinkOption = None,
    snapshot: Annotated[Path | None, typer.Option(help="Write a picture of the log instead.")] = None,
    at: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Time in the log that the picture shows; by default its end."),
    ] = None,
    video: Annotated[Path | None, typer.Option(help="Write a clip of the log instead.")] = None,
    speed: Annotated[
        float, typer.Option(min=0.1, max=1000.0, help="Playback speed of the clip, relative to real time.")
    ] = 1.0,
    export: Annotated[Path | None, typer.Option(help="Write one HTML file that plays without Python instead.")] = None,
    host: Annotated[
        str, typer.Option(help="Address to listen on; on each, the page requires the token of the printed address.")
    ] = LOOPBACK,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page.")] = DEFAULT_PORT,
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="With --live: serve Foxglove on port 8765 instead of the page.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Show a log or the running daemon on the page."""
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
    live: bool, robot: Path | None, log: Path | None, others: tuple[object, ...], host: str, port: int, as_json: bool
) -> None:
    if not live or robot is None or log is not None or any(other is not None for other in others):
        raise InputError("view --foxglove: give --live and --robot ROBOT.toml, and of the other options only --port")
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
        typer.Option(
            min=0.0, max=1.0, help="Largest absolute or relative difference of two numbers; 0: equal bit for bit."
        ),
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
