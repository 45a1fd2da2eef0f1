"""Verbs that learn from logs: infer, gap."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from disco_hw.verbs.options import (
    AsJson,
    Logs,
    ModelOption,
    RobotOption,
    print_result,
    progress_line,
)


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

    result = infer_command(logs, robot, out, paper, simulations, seed, report, progress_line)
    print_result(result.as_dict(), as_json, result.as_text())


def gap(
    logs: Logs,
    robot: RobotOption,
    out: Annotated[Path, typer.Option("-o", "--out", help="Directory for report, pictures and amended model.")],
    model: ModelOption = None,
    as_json: AsJson = False,
) -> None:
    """Find where simulation and logs disagree, name the missing effect, write the amended model, show the shrink."""
    from disco_hw.gap.commands import gap as find_gap

    result = find_gap(logs, robot, out, model, progress_line)
    print_result(result.as_dict(), as_json, result.as_text())
