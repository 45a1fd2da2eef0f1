"""Verbs on logs: import, infer, gap, log info, recover, export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from disco_hw.cli.options import (
    AsJson,
    Logs,
    ModelOption,
    RobotOption,
    print_result,
    progress_bar,
    progress_line,
)
from disco_hw.config import check_named_files


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
    as_json: AsJson = False,
) -> None:
    """Find where simulation and logs disagree, name the missing effect, write the amended model, show the shrink."""
    from disco_hw.processes import limit_thread_pools

    limit_thread_pools()
    check_named_files(robot, model, logs)
    from disco_hw.daemon.run import compile_beforehand
    from disco_hw.gap.find import gap as find_gap

    result = find_gap(logs, robot, out, model, progress_line)
    print_result(result.as_dict(), as_json, result.as_text())
    compile_beforehand(robot, out / "model.toml", progress_line)


log_app = typer.Typer(help="Look into a log, mend it, hand it on.", no_args_is_help=True)


def import_log(
    log: Annotated[Path, typer.Argument(metavar="FILE", help="A CSV, a candump of our protocol, or a bag of ROS.")],
    robot: RobotOption,
    out: Annotated[Path, typer.Option("-o", "--out", help="Where to write the MCAP log.")],
    topic: Annotated[
        list[str] | None,
        typer.Option("--topic", metavar="ROLE=NAME", help="Read commands, wheels or poses of a bag from this topic."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Convert a foreign log to MCAP for `infer`, `gap` and Foxglove; `view` and `replay` need a log of `run`."""
    check_named_files(robot, logs=[] if log.is_dir() else [log])
    from disco_hw.log.importing import import_log as import_foreign

    result = import_foreign(log, robot, out, topic or ())
    print_result(result.as_dict(), as_json, result.as_text())


@log_app.command()
def info(log: Annotated[Path, typer.Argument(metavar="LOG")], as_json: AsJson = False) -> None:
    """Say what a log holds and whether anything was lost."""
    check_named_files(logs=[log])
    from disco_hw.log.log_command import info as log_info

    print(log_info(log, as_json))


@log_app.command()
def recover(
    log: Annotated[Path, typer.Argument(metavar="LOG")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Where to write the mended log.")],
    as_json: AsJson = False,
) -> None:
    """Copy everything whole from a damaged log into a new one."""
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
