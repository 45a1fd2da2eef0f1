"""Verbs that need no robot: demo, sim, and the experiments: table, CSV, and a picture as PNG, PDF and SVG."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from disco_hw.cli.options import AsJson, LinkOption, ModelOption, View, print_result, progress_line
from disco_hw.config import SHIPPED_ROBOT, check_named_files
from disco_hw.errors import InputError
from disco_hw.reports import as_json as json_of
from disco_hw.reports import refuse_directory
from disco_hw.viewer import DEFAULT_PORT


def demo(
    link: Annotated[str, typer.Option(help="can (mock bus) or serial (pseudo-terminal).")] = "can",
    device: Annotated[
        str | None, typer.Option(help="Motor controller to simulate in place of the project's own, such as odrive.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Directory for the log, the picture and the figures.")] = Path("out/demo"),
    laps: Annotated[float, typer.Option(min=0.5, max=100.0, help="Laps to drive.")] = 1.5,
    plant_seed: Annotated[int, typer.Option(min=0, help="Seed of the virtual robot's true parameters.")] = 1,
    uncertainty: Annotated[str, typer.Option(help="ut, mc, joint or point.")] = "ut",
    view: View = False,
    adapt: Annotated[
        bool, typer.Option("--adapt", help="Estimate the geometry while driving (docs/adapt.md).")
    ] = False,
    obstacle: Annotated[
        bool, typer.Option("--obstacle", help="Put a pillar on the circle and drive around it (docs/fence.md).")
    ] = False,
    backwards: Annotated[
        bool, typer.Option("--backwards", help="Drive with the robot's back ahead (docs/control.md).")
    ] = False,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page.")] = DEFAULT_PORT,
    as_json: AsJson = False,
) -> None:
    """Drive the paper's circle with a virtual robot in real time, end to end, and print the figures."""
    from disco_hw.experiments.demo import DemoOptions, run_demo

    result = run_demo(
        DemoOptions(
            link=link,
            device=device,
            out=out,
            laps=laps,
            plant_seed=plant_seed,
            uncertainty=uncertainty,
            view=view,
            adapt=adapt,
            obstacle=obstacle,
            backwards=backwards,
            port=port,
            show_progress=not as_json,
        )
    )
    if as_json:
        print(json_of(result.as_dict()))
    if not result.success:
        raise typer.Exit(1)


def sim(
    robot: Annotated[
        Path | None, typer.Argument(metavar="ROBOT.toml", help="The robot's configuration (docs/robot.md).")
    ] = None,
    hide: Annotated[list[str] | None, typer.Option(metavar="EFFECT=VALUE", help="Give the plant this effect.")] = None,
    model: ModelOption = None,
    link: LinkOption = None,
    plant_seed: Annotated[
        int | None, typer.Option(min=0, help="Draw the true parameters from the model's posterior with this seed.")
    ] = None,
    start: Annotated[
        tuple[float, float, float] | None, typer.Option(metavar="X Y YAW", help="Start pose (m, m, rad).")
    ] = None,
    truth: Annotated[Path | None, typer.Option(help="Write the true motion to this CSV file.")] = None,
    inject: Annotated[Path | None, typer.Option(help="Listen for faults to inject on this Unix socket.")] = None,
    bus_log: Annotated[Path | None, typer.Option(help="Write every frame to this file, as candump does.")] = None,
    faults: Annotated[Path | None, typer.Option(help="Inject the faults of this TOML schedule.")] = None,
    board: Annotated[
        str | None,
        typer.Option(
            metavar="PORT", help="Be the wheels of a board on a desk, on its second serial line (docs/port.md)."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the sensors' and the ground's noise.")] = 1,
    list_effects: Annotated[bool, typer.Option("--list-effects", help="List the effects and exit.")] = False,
    list_faults: Annotated[bool, typer.Option("--list-faults", help="List the kinds of faults and exit.")] = False,
) -> None:
    """Run the virtual robot alone, behind a CAN bus or a serial line."""
    if list_faults:
        from sim.fault_schedule import kinds_table

        print(kinds_table())
        return
    if list_effects:
        from sim.effects import effects_table

        print(effects_table())
        return
    if robot is None:
        raise InputError("sim: no ROBOT.toml given; name one, such as disco_hw/robots/wombot.toml")
    check_named_files(robot, model)
    from disco_hw.experiments.virtual import run_sim

    raise typer.Exit(
        run_sim(
            robot,
            model=model,
            link=link,
            hide=tuple(hide or ()),
            plant_seed=plant_seed,
            start=start,
            truth=truth,
            inject=inject,
            bus_log=bus_log,
            faults=faults,
            seed=seed,
            board=board,
        )
    )


SeedOffset = Annotated[
    int,
    typer.Option(
        min=0, help="First seed: 50 seeds from 50 on differ from 50 from 0 on; together they are 100 from 0 on."
    ),
]

experiment_app = typer.Typer(help="The paper's experiments, as table, CSV and picture.", no_args_is_help=True)


@experiment_app.command()
def pendulum(
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each curve.")] = 50,
    seed_offset: SeedOffset = 0,
    out: Annotated[Path, typer.Option("-o", "--out", help="Directory for CSV and picture.")] = Path("out/pendulum"),
    as_json: AsJson = False,
) -> None:
    """Swing a pendulum up: true parameters; unscented transform and draws, each with prior and posterior."""
    from disco_hw.experiments.pendulum import PendulumOptions, run_pendulum

    refuse_directory(out)
    result = run_pendulum(PendulumOptions(seeds=seeds, seed_offset=seed_offset), progress_line)
    out.mkdir(parents=True, exist_ok=True)
    result.write_csv(out / "pendulum.csv")
    result.write_pictures(out / "pendulum.png")
    print_result({"curves": result.rows(), "options": asdict(result.options)}, as_json, result.table())


@experiment_app.command()
def circle(
    robot: Annotated[
        Path | None, typer.Option(help="robot.toml whose model to use; by default the shipped robot's.")
    ] = None,
    mode: Annotated[str, typer.Option(help="default or paper.")] = "default",
    seeds: Annotated[int, typer.Option(min=1, help="Plants drawn from the posterior.")] = 8,
    seed_offset: SeedOffset = 0,
    duration_s: Annotated[float, typer.Option(min=1.0, help="Length of a drive.")] = 40.0,
    rate_hz: Annotated[float, typer.Option(min=1.0, max=200.0, help="Plans per second.")] = 10.0,
    largest_rot_s: Annotated[float, typer.Option(min=0.1, help="Largest wheel speed, rotations per second.")] = 1.0,
    largest_rot_s2: Annotated[
        float, typer.Option(min=0.1, help="Largest change of a command in a second, rotations per second.")
    ] = math.inf,
    lag_s: Annotated[float, typer.Option(min=0.0, help="Lag of the plant's wheels.")] = 0.1,
    wheel_noise: Annotated[float, typer.Option(min=0.0, help="Noise of a wheel's speed, as a share of it.")] = 0.05,
    belief_scale: Annotated[
        float,
        typer.Option(min=0.1, max=10.0, help="Factor on the posterior's standard deviations, also for the plants."),
    ] = 1.0,
    out: Annotated[Path, typer.Option("-o", "--out", help="Directory for CSV and picture.")] = Path("out/circle"),
    as_json: AsJson = False,
) -> None:
    """Drive the circle knowing the prior, the posterior, its mean alone, a point estimate, or the truth."""
    from disco_hw.experiments.circle import CircleOptions, run_circle
    from disco_hw.runtime.robot_setup import load_setup

    if mode not in {"default", "sampled", "paper"}:
        raise InputError(f"--mode {mode}: no such mode; write default, sampled or paper")
    refuse_directory(out)
    setup = load_setup(robot or SHIPPED_ROBOT)
    options = CircleOptions(
        seeds, duration_s, rate_hz, largest_rot_s, largest_rot_s2, lag_s, wheel_noise, seed_offset, belief_scale
    )
    result = run_circle(setup.model, mode, options, progress_line)
    out.mkdir(parents=True, exist_ok=True)
    result.write_csv(out / "circle.csv")
    result.write_pictures(out / "circle.png")
    print_result({"curves": result.rows(), "mode": mode, "options": asdict(options)}, as_json, result.table())


@experiment_app.command()
def adapt(
    robot: Annotated[
        Path | None, typer.Option(help="robot.toml whose model to use; by default the shipped robot's.")
    ] = None,
    change: Annotated[float, typer.Option(min=-0.3, max=0.3, help="Relative change of the parameter.")] = 0.15,
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each configuration.")] = 3,
    seed_offset: SeedOffset = 0,
    out: Annotated[Path, typer.Option("-o", "--out", help="Directory for CSV and picture.")] = Path("out/adapt"),
    as_json: AsJson = False,
) -> None:
    """Change wheel radius or axial distance on the way, and compare the drive with and without adaptation."""
    from disco_hw.experiments.adapt import AdaptOptions, run_adapt
    from disco_hw.runtime.robot_setup import load_setup

    refuse_directory(out)
    setup = load_setup(robot or SHIPPED_ROBOT)
    result = run_adapt(setup, AdaptOptions(change=change, seeds=seeds, seed_offset=seed_offset), progress_line)
    out.mkdir(parents=True, exist_ok=True)
    result.write_csv(out / "adapt.csv")
    result.write_pictures(out / "adapt.png")
    print_result({"changes": result.rows()}, as_json, result.table())


@experiment_app.command()
def gap(
    hide: Annotated[
        list[str] | None,
        typer.Option(metavar="EFFECT=VALUE", help="Hide this effect in the virtual robot; may be repeated."),
    ] = None,
    robot: Annotated[Path | None, typer.Option(help="robot.toml to drive; by default the shipped robot's.")] = None,
    laps: Annotated[float, typer.Option(min=0.5, max=20.0, help="Laps of each circle.")] = 1.5,
    script: Annotated[str, typer.Option(help="Script whose log is searched (docs/drive.md).")] = "excite",
    plant_seed: Annotated[
        int | None, typer.Option(min=0, help="Draw the true geometry from the model's posterior with this seed.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the sensors' and the ground's noise.")] = 1,
    out: Annotated[Path, typer.Option("-o", "--out", help="Directory for log, report, table and picture.")] = Path(
        "out/gap"
    ),
    as_json: AsJson = False,
) -> None:
    """Hide an effect in the virtual robot, find it in a log, and drive the circle without and with it in the model."""
    from disco_hw.experiments.gap import GapExperimentOptions, run_gap_experiment

    hidden = tuple(hide or ("deadband=0.8",))
    options = GapExperimentOptions(robot or SHIPPED_ROBOT, hidden, out, laps, script, plant_seed, seed)
    result = run_gap_experiment(options, progress_line)
    print_result(
        result.as_dict(), as_json, f"{result.as_text()}\n\nwritten: {out}/experiment.png, report.html, drive.mcap"
    )


@experiment_app.command()
def fence(
    rooms: Annotated[int, typer.Option(min=1, help="Random rooms with a task.")] = 200,
    manual: Annotated[int, typer.Option(min=1, help="Wild drives by hand.")] = 200,
    alone: Annotated[int, typer.Option(min=1, help="Tight rooms for each planner without the guard.")] = 40,
    off: Annotated[float, typer.Option(min=0.0, max=0.3, help="Largest relative error of a true parameter.")] = 0.15,
    seconds: Annotated[float, typer.Option(min=2.0, help="Length of a drive.")] = 12.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of rooms, robots and commands.")] = 1,
    out: Annotated[
        Path,
        typer.Option("-o", "--out", help="Directory for drives and picture; drives already there are not repeated."),
    ] = Path("out/fence"),
    as_json: AsJson = False,
) -> None:
    """Drive unknown robots in random rooms, and count how often one leaves its fence."""
    from disco_hw.experiments.fence import FenceOptions, run_fence

    refuse_directory(out)
    result = run_fence(FenceOptions(rooms, manual, alone, off, seconds, seed), out, progress_line)
    result.write_pictures(out / "fence.png")
    print_result(result.as_dict(), as_json, f"{result.table()}\n\nwritten: {out}/fence.png")
