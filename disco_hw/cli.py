"""The command `disco-hw`: each verb parses its arguments and calls one function.

Verbs import what they need when they run, so that `estop` and `--help` need nothing else to be healthy.
"""

from __future__ import annotations

import json
import sys
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Annotated, Any

import typer

from disco_hw.errors import InputError, WorkError
from disco_hw.viewer.address import DEFAULT_PORT, LOOPBACK

app = typer.Typer(
    name="disco-hw",
    help="Driver stack for a skid-steer robot: fusion, DISCO stochastic MPC, virtual robot, recording.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

RobotFile = Annotated[Path, typer.Argument(metavar="ROBOT.toml", help="The robot's configuration (docs/robot.md).")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object for machines.")]
ModelOption = Annotated[Path | None, typer.Option("--model", help="Use this model.toml instead of robot.toml's.")]

Logs = Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs of driving: MCAP or CSV.")]
RobotOption = Annotated[Path, typer.Option("--robot", help="The robot's configuration (docs/robot.md).")]
View = Annotated[bool, typer.Option("--view", help="Serve the page beside it, for this host only.")]


def _page(view: bool, robot: Path, model: Path | None) -> AbstractContextManager[object]:
    from disco_hw.viewer.beside import page_beside

    return page_beside(robot, model, LOOPBACK, DEFAULT_PORT) if view else nullcontext()


def _progress_line(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _print(result: dict[str, Any], as_json: bool, text: str) -> None:
    print(json.dumps(result) if as_json else text)


@app.command()
def demo(
    link: Annotated[str, typer.Option(help="can (mock bus) or serial (pseudo-terminal).")] = "can",
    out: Annotated[Path, typer.Option(help="Directory for the log, the picture and the figures.")] = Path("out/demo"),
    laps: Annotated[float, typer.Option(min=0.5, max=100.0, help="Laps to drive.")] = 1.5,
    plant_seed: Annotated[int, typer.Option(min=0, help="Seed of the virtual robot's true parameters.")] = 1,
    uncertainty: Annotated[str, typer.Option(help="ut, mc or point.")] = "ut",
    view: View = False,
    as_json: AsJson = False,
) -> None:
    """Drive the paper's circle with a virtual robot in real time, end to end, and print the figures."""
    from disco_hw.demo import DemoOptions, run_demo

    result = run_demo(
        DemoOptions(
            link=link,
            out=out,
            laps=laps,
            plant_seed=plant_seed,
            uncertainty=uncertainty,
            view=view,
            show_progress=not as_json,
        )
    )
    if as_json:
        print(json.dumps(result.as_dict()))
    if not result.success:
        raise typer.Exit(1)


@app.command()
def run(
    robot: RobotFile,
    model: ModelOption = None,
    link: Annotated[str | None, typer.Option(help="Use this link instead of robot.toml's: can or serial.")] = None,
    log_file: Annotated[Path | None, typer.Option("--log", help="Record to this file.")] = None,
    view: View = False,
    as_json: AsJson = False,
) -> None:
    """Run the on-robot daemon: connect, estimate, record; arm and start only when told to (`disco-hw ctl`)."""
    from disco_hw.daemon.realtime import limit_thread_pools

    # Before the numeric libraries are loaded: a pool of threads in them costs the loop its deadlines.
    limit_thread_pools()
    from disco_hw.daemon.daemon import DaemonOptions, run_daemon

    with _page(view, robot, model):
        code = run_daemon(DaemonOptions(robot=robot, model=model, link=link, log_file=log_file, as_json=as_json))
    raise typer.Exit(code)


@app.command()
def sim(
    robot: RobotFile,
    hide: Annotated[list[str] | None, typer.Option(metavar="EFFECT=VALUE", help="Give the plant this effect.")] = None,
    model: ModelOption = None,
    link: Annotated[str | None, typer.Option(help="Use this link instead of robot.toml's: can or serial.")] = None,
    plant_seed: Annotated[
        int | None, typer.Option(min=0, help="Draw the true parameters from the model's posterior with this seed.")
    ] = None,
    start: Annotated[
        tuple[float, float, float] | None, typer.Option(metavar="X Y YAW", help="Start pose (m, m, rad).")
    ] = None,
    truth: Annotated[Path | None, typer.Option(help="Write the true motion to this CSV file.")] = None,
    inject: Annotated[Path | None, typer.Option(help="Listen for faults to inject on this Unix socket.")] = None,
    bus_log: Annotated[Path | None, typer.Option(help="Write every frame to this file, as candump does.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the sensors' and the ground's noise.")] = 1,
    list_effects: Annotated[bool, typer.Option("--list-effects", help="List the effects and exit.")] = False,
) -> None:
    """Run the virtual robot alone, behind a CAN bus or a serial line."""
    from disco_hw.virtual import SimOptions, run_sim
    from sim.effects import effects_table

    if list_effects:
        print(effects_table())
        return
    raise typer.Exit(
        run_sim(
            SimOptions(
                robot=robot,
                model=model,
                link=link,
                hide=tuple(hide or ()),
                plant_seed=plant_seed,
                start=start,
                truth=truth,
                inject=inject,
                bus_log=bus_log,
                seed=seed,
            )
        )
    )


@app.command()
def drive(
    robot: RobotFile,
    gamepad: Annotated[bool, typer.Option("--gamepad", help="Drive with a gamepad instead of the keyboard.")] = False,
    script: Annotated[
        str | None, typer.Option(help="Drive by itself while the deadman is held: circle, steps or excite.")
    ] = None,
    unattended: Annotated[
        bool, typer.Option("--unattended", help="Let the script hold the deadman: for virtual robots.")
    ] = False,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="Break the script off after so long.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random steps.")] = 1,
    model: ModelOption = None,
    link: Annotated[str | None, typer.Option(help="Use this link instead of robot.toml's: can or serial.")] = None,
    log_file: Annotated[Path | None, typer.Option("--log", help="Record to this file.")] = None,
    view: View = False,
    as_json: AsJson = False,
) -> None:
    """Drive by keyboard, gamepad or script, and record it for `infer` and `gap` (docs/drive.md)."""
    from disco_hw.daemon.realtime import limit_thread_pools

    limit_thread_pools()
    from disco_hw.drive.commands import DriveOptions, run_drive

    with _page(view, robot, model):
        result = run_drive(
            DriveOptions(
                robot=robot,
                model=model,
                link=link,
                log_file=log_file,
                gamepad=gamepad,
                script=script,
                unattended=unattended,
                seconds=seconds,
                seed=seed,
                as_json=as_json,
            )
        )
    _print(result.as_dict(), as_json, result.as_text())
    if not result.completed:
        raise typer.Exit(1)


@app.command()
def ctl(
    robot: RobotFile,
    do: Annotated[str, typer.Argument(help="arm, start, stop, disarm, reset, estop, status or quit.")],
    as_json: AsJson = False,
) -> None:
    """Tell the running daemon what to do, or ask how it is."""
    from disco_hw.daemon.client import ask, in_words

    reply = ask(robot, do)
    _print(reply, as_json, in_words(reply))
    if not reply.get("ok", False):
        raise typer.Exit(1)


@app.command()
def check(
    robot: RobotFile,
    link: Annotated[str | None, typer.Option(help="Use this link instead of robot.toml's: can or serial.")] = None,
    as_json: AsJson = False,
) -> None:
    """Preflight: link, firmware match, latency, bus load, real-time settings, limits. Nothing moves."""
    from disco_hw.check import run_check

    report = run_check(robot, link)
    _print(report.as_dict(), as_json, report.as_text())
    if not report.ok:
        raise typer.Exit(1)


@app.command()
def replay(log: Annotated[Path, typer.Argument(metavar="LOG")], as_json: AsJson = False) -> None:
    """Run estimator, planner and governor again on a log's samples and compare every output bit for bit."""
    from disco_hw.daemon.realtime import limit_thread_pools

    limit_thread_pools()
    from disco_hw.replay import replay as replay_log

    report = replay_log(log)
    _print(report.as_dict(), as_json, report.as_text())
    if not report.ok:
        raise typer.Exit(1)


@app.command()
def estop(
    robot: RobotFile,
    link: Annotated[str | None, typer.Option(help="Use this link instead of robot.toml's: can or serial.")] = None,
    as_json: AsJson = False,
) -> None:
    """Stop the robot now, whatever state anything else is in."""
    from disco_hw.emergency import stop_robot

    outcome = stop_robot(robot, link)
    _print(outcome.as_dict(), as_json, outcome.as_text())
    if not outcome.sent:
        raise typer.Exit(1)


@app.command()
def infer(
    logs: Logs,
    robot: RobotOption,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Write the model with its posterior here.")] = None,
    paper: Annotated[bool, typer.Option("--paper", help="The paper's statistics and 1000 simulations.")] = False,
    simulations: Annotated[int | None, typer.Option(min=200, help="Simulations in all.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of simulations and networks.")] = 1,
    report: Annotated[Path | None, typer.Option(help="Write diagnostics with pictures to this HTML file.")] = None,
    as_json: AsJson = False,
) -> None:
    """Infer the robot's parameters from logs of driving (BayesSim) and write a model with its posterior."""
    from disco_hw.inference.commands import infer_command

    result = infer_command(logs, robot, out, paper, simulations, seed, report, _progress_line)
    _print(result.as_dict(), as_json, result.as_text())


@app.command()
def gap(
    logs: Logs,
    robot: RobotOption,
    out: Annotated[Path, typer.Option("-o", "--out", help="Directory for report, pictures and amended model.")],
    model: ModelOption = None,
    as_json: AsJson = False,
) -> None:
    """Find where simulation and logs disagree, name the missing effect, write the amended model, show the shrink."""
    from disco_hw.gap.commands import gap as find_gap

    result = find_gap(logs, robot, out, model, _progress_line)
    _print(result.as_dict(), as_json, result.as_text())


@app.command()
def view(
    log: Annotated[Path | None, typer.Argument(metavar="[LOG]", help="The log to replay.")] = None,
    live: Annotated[bool, typer.Option("--live", help="Show the running daemon of --robot.")] = False,
    robot: Annotated[Path | None, typer.Option(help="robot.toml; for a log, instead of the one it carries.")] = None,
    model: ModelOption = None,
    snapshot: Annotated[Path | None, typer.Option(help="Write a picture of the log instead.")] = None,
    at: Annotated[float | None, typer.Option(metavar="SECONDS", help="Where in the log; its end if not given.")] = None,
    video: Annotated[Path | None, typer.Option(help="Write a clip of the log instead.")] = None,
    speed: Annotated[float, typer.Option(min=0.1, max=1000.0, help="How much faster the clip runs.")] = 1.0,
    export: Annotated[Path | None, typer.Option(help="Write one HTML file that plays without Python instead.")] = None,
    host: Annotated[
        str, typer.Option(help="Address to listen on; any but this host's own needs the token that is printed.")
    ] = LOOPBACK,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page.")] = DEFAULT_PORT,
) -> None:
    """Show the page: a log, or the running daemon."""
    from disco_hw.viewer import commands

    if live:
        if robot is None or log is not None:
            raise InputError("view --live: needs --robot ROBOT.toml and no LOG")
        raise typer.Exit(commands.view_live(robot, model, host, port))
    if log is None:
        raise InputError("view: give a LOG, or --live with --robot ROBOT.toml")
    if snapshot is not None:
        commands.snapshot_log(log, snapshot, at, robot)
    if video is not None:
        commands.video_log(log, video, speed, robot)
    if export is not None:
        commands.export_log(log, export, robot=robot)
    if snapshot is None and video is None and export is None:
        raise typer.Exit(commands.view_log(log, robot, host, port))


experiment_app = typer.Typer(help="The paper's experiments, as table, CSV and PNG.", no_args_is_help=True)
app.add_typer(experiment_app, name="experiment")


@experiment_app.command()
def pendulum(
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each curve.")] = 50,
    out: Annotated[Path, typer.Option("-o", "--out", help="Directory for CSV and PNG.")] = Path("out/pendulum"),
    as_json: AsJson = False,
) -> None:
    """Swing a pendulum up: true parameters; unscented transform and draws, each with prior and posterior."""
    from disco_hw.control.experiments.pendulum import PendulumOptions, run_pendulum

    result = run_pendulum(PendulumOptions(seeds=seeds), _progress_line)
    out.mkdir(parents=True, exist_ok=True)
    result.write_csv(out / "pendulum.csv")
    result.write_png(out / "pendulum.png")
    _print({"curves": result.rows()}, as_json, result.table())


@experiment_app.command()
def circle(
    robot: Annotated[
        Path | None, typer.Option(help="robot.toml whose model to use; the shipped robot's if none.")
    ] = None,
    mode: Annotated[str, typer.Option(help="default or paper.")] = "default",
    seeds: Annotated[int, typer.Option(min=1, help="Plants drawn from the posterior.")] = 8,
    out: Annotated[Path, typer.Option("-o", "--out", help="Directory for CSV and PNG.")] = Path("out/circle"),
    as_json: AsJson = False,
) -> None:
    """Drive the circle knowing the prior, the posterior, a point estimate, or the truth."""
    import disco_hw
    from disco_hw.control.experiments.circle import CircleOptions, run_circle
    from disco_hw.robot_setup import load_setup

    if mode not in {"default", "paper"}:
        raise InputError(f"--mode {mode}: no such mode; write default or paper")
    setup = load_setup(robot or Path(disco_hw.__file__).parent / "robots" / "wombot.toml")
    result = run_circle(setup.model, mode, CircleOptions(seeds=seeds), _progress_line)
    out.mkdir(parents=True, exist_ok=True)
    result.write_csv(out / "circle.csv")
    result.write_png(out / "circle.png")
    _print({"curves": result.rows()}, as_json, result.table())


log_app = typer.Typer(help="Look into a log, mend it, hand it on.", no_args_is_help=True)
app.add_typer(log_app, name="log")


@log_app.command()
def info(log: Annotated[Path, typer.Argument(metavar="LOG")], as_json: AsJson = False) -> None:
    """Say what a log holds and whether anything was lost."""
    from disco_hw.log.commands import info as log_info

    print(log_info(log, as_json))


@log_app.command()
def recover(
    log: Annotated[Path, typer.Argument(metavar="LOG")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Where to write the mended log.")],
    as_json: AsJson = False,
) -> None:
    """Copy everything whole from a damaged log into a new one."""
    from disco_hw.log.commands import recover as log_recover

    print(log_recover(log, out, as_json))


@log_app.command()
def export(
    log: Annotated[Path, typer.Argument(metavar="LOG")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Where to write the CSV file.")],
    as_json: AsJson = False,
) -> None:
    """Write commands, encoders and poses as CSV."""
    from disco_hw.log.commands import export as log_export

    print(log_export(log, out, as_json))


def main() -> None:
    """Entry point: bad input prints one line and exits with 2, failed work with 1."""
    try:
        app()
    except InputError as error:
        print(f"disco-hw: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except WorkError as error:
        print(f"disco-hw: {error}", file=sys.stderr)
        raise SystemExit(1) from None
