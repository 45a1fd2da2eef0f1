"""Verbs that repeat an experiment: table, CSV and PNG."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from disco_hw.errors import InputError
from disco_hw.verbs.options import (
    AsJson,
    print_result,
    progress_line,
)

experiment_app = typer.Typer(help="The paper's experiments, as table, CSV and PNG.", no_args_is_help=True)


@experiment_app.command()
def pendulum(
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each curve.")] = 50,
    out: Annotated[Path, typer.Option("-o", "--out", help="Directory for CSV and PNG.")] = Path("out/pendulum"),
    as_json: AsJson = False,
) -> None:
    """Swing a pendulum up: true parameters; unscented transform and draws, each with prior and posterior."""
    from disco_hw.control.experiments.pendulum import PendulumOptions, run_pendulum

    result = run_pendulum(PendulumOptions(seeds=seeds), progress_line)
    out.mkdir(parents=True, exist_ok=True)
    result.write_csv(out / "pendulum.csv")
    result.write_png(out / "pendulum.png")
    print_result({"curves": result.rows()}, as_json, result.table())


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
    result = run_circle(setup.model, mode, CircleOptions(seeds=seeds), progress_line)
    out.mkdir(parents=True, exist_ok=True)
    result.write_csv(out / "circle.csv")
    result.write_png(out / "circle.png")
    print_result({"curves": result.rows()}, as_json, result.table())


@experiment_app.command()
def adapt(
    robot: Annotated[
        Path | None, typer.Option(help="robot.toml whose model to use; the shipped robot's if none.")
    ] = None,
    change: Annotated[
        float, typer.Option(min=-0.3, max=0.3, help="By how much of its size the parameter changes.")
    ] = 0.15,
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each.")] = 3,
    out: Annotated[Path, typer.Option("-o", "--out", help="Directory for CSV and PNG.")] = Path("out/adapt"),
    as_json: AsJson = False,
) -> None:
    """Let wheel radius or axial distance change on the way, and see what adaptation wins back."""
    import disco_hw
    from disco_hw.adapt.experiment import AdaptOptions, run_adapt
    from disco_hw.robot_setup import load_setup

    setup = load_setup(robot or Path(disco_hw.__file__).parent / "robots" / "wombot.toml")
    result = run_adapt(setup, AdaptOptions(change=change, seeds=seeds), progress_line)
    out.mkdir(parents=True, exist_ok=True)
    result.write_csv(out / "adapt.csv")
    result.write_png(out / "adapt.png")
    print_result({"changes": result.rows()}, as_json, result.table())
