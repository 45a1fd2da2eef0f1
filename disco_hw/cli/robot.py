"""Verbs for whoever stands beside the robot: run, drive, init, commission, ctl, check, estop, bridge."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from disco_hw.cli.options import (
    AsJson,
    LinkOption,
    LogFileOption,
    ModelOption,
    RobotFile,
    View,
    print_result,
    progress_line,
)
from disco_hw.config import check_named_files
from disco_hw.errors import InputError
from disco_hw.viewer import DEFAULT_PORT, LOOPBACK, page_in_background

PagePort = Annotated[int, typer.Option("--port", min=1, max=65535, help="Port of the page.")]


@contextmanager
def _page(
    view: bool, robot: Path, model: Path | None, port: int, link: str | None
) -> Iterator[Callable[[], tuple[str, ...]]]:
    """Serve the page meanwhile if `view`; yields a function that says what happened to it since the last call."""
    if not view:
        yield lambda: ()
        return
    with page_in_background(robot, model, LOOPBACK, port, link) as page:
        yield page.new_messages


def _prepare_loop() -> None:
    """Prepare this process for the control loop, before the numeric libraries are loaded."""
    from disco_hw.processes import limit_thread_pools, spare_memory

    # A pool of threads in them costs the loop its deadlines.
    limit_thread_pools()
    spare_memory()


def run(
    robot: RobotFile,
    model: ModelOption = None,
    link: LinkOption = None,
    log_file: LogFileOption = None,
    view: View = False,
    port: PagePort = DEFAULT_PORT,
    adapt: Annotated[
        bool, typer.Option("--adapt", help="Estimate the geometry while driving (docs/adapt.md).")
    ] = False,
    accept_missing_effects: Annotated[
        bool, typer.Option("--accept-missing-effects", help="Use a model that is marked as lacking an effect.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Run the on-robot daemon: connect, estimate, record; arm and start only when told to (`disco-hw ctl`)."""
    _prepare_loop()
    check_named_files(robot, model)
    from disco_hw.daemon.run import DaemonOptions, run_daemon
    from disco_hw.drive.hand_pilot import task_pilot

    with _page(view, robot, model, port, link) as page_messages:
        options = DaemonOptions(robot, model, link, log_file, as_json, accept_missing_effects, adapt)
        code = run_daemon(options, task_pilot, page_messages=page_messages)
    raise typer.Exit(code)


def drive(
    robot: RobotFile,
    gamepad: Annotated[bool, typer.Option("--gamepad", help="Drive with a gamepad instead of the keyboard.")] = False,
    page: Annotated[bool, typer.Option("--page", help="Drive from the page, which --view then serves.")] = False,
    ros2: Annotated[
        bool, typer.Option("--ros2", help="Drive by /cmd_vel, through `disco-hw bridge ros2` (docs/ros2.md).")
    ] = False,
    script: Annotated[
        str | None,
        typer.Option(
            help="Drive by a script while the deadman is held: circle, steps, excite, or one that a report names."
        ),
    ] = None,
    unattended: Annotated[
        bool, typer.Option("--unattended", help="Let the script hold the deadman: for virtual robots.")
    ] = False,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End the script after this many seconds.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random steps.")] = 1,
    model: ModelOption = None,
    link: LinkOption = None,
    log_file: LogFileOption = None,
    view: View = False,
    port: PagePort = DEFAULT_PORT,
    as_json: AsJson = False,
) -> None:
    """Drive by keyboard, gamepad or script, and record it for `infer` and `gap` (docs/drive.md)."""
    _prepare_loop()
    check_named_files(robot, model)
    from disco_hw.drive.drive_command import DriveOptions, run_drive

    with _page(view or page, robot, model, port, link) as page_messages:
        result = run_drive(
            DriveOptions(
                robot=robot,
                model=model,
                link=link,
                log_file=log_file,
                gamepad=gamepad,
                page=page,
                ros2=ros2,
                script=script,
                unattended=unattended,
                seconds=seconds,
                seed=seed,
                as_json=as_json,
            ),
            page_messages,
        )
    print_result(result.as_dict(), as_json, result.as_text())
    if not result.completed:
        raise typer.Exit(1)


def init(
    out: Annotated[Path, typer.Option("-o", "--out", help="Where to write the robot.toml.")] = Path("robot.toml"),
    link: LinkOption = None,
    driver: Annotated[
        str | None, typer.Option(help="The motor controller's driver, if it is not found by listening.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="The robot's name.")] = None,
    wheel_radius_m: Annotated[float | None, typer.Option(min=0.0, help="Radius of a wheel, m.")] = None,
    axial_distance_m: Annotated[
        float | None, typer.Option(min=0.0, help="Distance from left to right wheels, m.")
    ] = None,
    ticks_per_rev: Annotated[float | None, typer.Option(min=1.0, help="Encoder ticks per turn of a wheel.")] = None,
    max_wheel_speed_rad_s: Annotated[
        float | None, typer.Option(min=0.0, help="Largest speed of a wheel, rad/s.")
    ] = None,
    pose_source: Annotated[str | None, typer.Option(help="Where measured poses come from.")] = None,
    listen_s: Annotated[float, typer.Option(min=0.0, help="How long to listen on the link.")] = 3.0,
    ask: Annotated[
        bool | None,
        typer.Option(
            "--ask/--no-ask",
            help="Ask on a serial line for a controller that only answers (RoboClaw: its version); else you are asked.",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Overwrite an existing file.")] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="Ask nothing: take the usual value for what is not given.")
    ] = False,
) -> None:
    """Write a robot.toml from the frames on the robot's link and your answers; nothing moves."""
    import sys

    from disco_hw.first_use import InitOptions, run_init

    measures = {
        "wheel_radius_m": wheel_radius_m,
        "axial_distance_m": axial_distance_m,
        "ticks_per_rev": ticks_per_rev,
        "max_wheel_speed_rad_s": max_wheel_speed_rad_s,
    }
    given = tuple((field, value) for field, value in measures.items() if value is not None)
    options = InitOptions(out, link, driver, name, given, listen_s, pose_source, overwrite, ask)
    is_interactive = not yes and sys.stdin.isatty()
    written = run_init(options, input if is_interactive else None, progress_line)
    from disco_hw.first_use.fence_drive import OFFER, record_fence

    print(f"written: {written}\nnext: disco-hw check {shlex.quote(str(written))}", flush=True)
    # Its wiring is not known to be right yet.
    if not is_interactive or not record_fence(
        written, input, "push it, disarmed; drive it after `commission` only", link
    ):
        print(OFFER.format(robot=shlex.quote(str(written))))


def commission(
    robot: RobotFile,
    stage: Annotated[
        list[str] | None, typer.Option(help="Only this stage, or these: sides, turns, floor.", show_default=False)
    ] = None,
    write: Annotated[
        bool | None,
        typer.Option("--write/--no-write", help="Correct robot.toml, or never; without this option you are asked."),
    ] = None,
    link: LinkOption = None,
    log_directory: Annotated[Path | None, typer.Option(help="Directory for the logs.")] = None,
    as_json: AsJson = False,
) -> None:
    """Guide the first drive: wheels up, then on the floor; finds wrong wiring, ticks and poses (docs/commission.md)."""
    _prepare_loop()
    check_named_files(robot)
    from disco_hw.first_use.commission import CommissionOptions, run_commission

    options = CommissionOptions(robot, link, write=write, log_directory=log_directory)
    if stage:
        options = replace(options, stages=tuple(stage))
    from disco_hw.first_use.fence_drive import OFFER, record_fence

    result = run_commission(options)
    print_result(result.as_dict(), as_json, result.as_text())
    if result.ok and not as_json and not record_fence(robot, input, "push it, or drive it by hand", link):
        print(OFFER.format(robot=shlex.quote(str(robot))))
    if not result.ok:
        raise typer.Exit(1)


def ctl(
    robot: RobotFile,
    do: Annotated[
        str,
        typer.Argument(
            help="arm, start, stop, disarm, reset, estop, status, task, obstacle, fence, revert, adapt or quit."
        ),
    ],
    changes: Annotated[
        list[str] | None,
        typer.Argument(
            help="Of task, while disarmed: radius_m=0.8. Of obstacle: add name=pillar x_m=0.7 y_m=0 radius_m=0.15, or "
            "remove name=pillar. Of fence: override, or hold."
        ),
    ] = None,
    unrecorded: Annotated[
        bool, typer.Option("--unrecorded", help="Arm even though the log is not being recorded.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Send the running daemon a command, or ask for its status."""
    from disco_hw.daemon import ask, describe

    reply = ask(robot, do, changes or (), unrecorded)
    print_result(reply, as_json, describe(reply, robot))
    if not reply.get("ok", False):
        raise typer.Exit(1)


def check(robot: RobotFile, link: LinkOption = None, as_json: AsJson = False) -> None:
    """Check link, firmware match, latency, bus load, real-time settings and limits before a drive.

    Nothing moves.
    """
    check_named_files(robot)
    from disco_hw.daemon.check import run_check
    from disco_hw.daemon.run import compile_beforehand

    report = run_check(robot, link)
    print_result(report.as_dict(), as_json, report.as_text())
    compile_beforehand(robot, None, progress_line)
    if not report.ok:
        raise typer.Exit(1)


def estop(robot: RobotFile, link: LinkOption = None, as_json: AsJson = False) -> None:
    """Stop the robot now, whatever state the daemon is in."""
    from disco_hw.daemon.emergency import stop_and_report

    raise typer.Exit(stop_and_report(robot, link, as_json))


bridge_app = typer.Typer(no_args_is_help=True, help="Carry poses, commands and state between the daemon and ROS 2.")


@bridge_app.callback()
def _bridge() -> None:
    """Group the bridge's commands, each of which takes a robot.toml."""


@bridge_app.command()
def ros2(robot: RobotFile, model: ModelOption = None, link: LinkOption = None) -> None:
    """Take poses and commands from ROS 2, and publish odometry and state (docs/ros2.md)."""
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
def _ros2_extra(bridge: str) -> Iterator[None]:
    """Say what to install where DDS is not."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != "cyclonedds":
            raise
        raise InputError(f"bridge {bridge}: needs cyclonedds; pip install 'disco-hw[ros2]'") from None
