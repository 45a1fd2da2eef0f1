"""Arguments and printing that several verbs share, and what the command takes without a verb."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from click import Context
from typer.core import TyperCommand

from disco_hw.config import LINK_FORMS
from disco_hw.errors import InputError
from disco_hw.reports import as_json as json_of

RobotFile = Annotated[Path, typer.Argument(metavar="ROBOT.toml", help="The robot's configuration (docs/robot.md).")]
RobotOption = Annotated[Path, typer.Option("--robot", help="The robot's configuration (docs/robot.md).")]
ModelOption = Annotated[Path | None, typer.Option("--model", help="Use this model.toml instead of robot.toml's.")]
LinkOption = Annotated[
    str | None, typer.Option("--link", metavar="LINK", help=f"Use this link instead of robot.toml's: {LINK_FORMS}.")
]
LogFileOption = Annotated[Path | None, typer.Option("--log", help="Record to this file.")]
Logs = Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs of driving: MCAP or CSV.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object for machines.")]
View = Annotated[bool, typer.Option("--view", help="Also serve the page, for this host only.")]


class Verb(TyperCommand):
    """A verb, of which no option takes a number that is not finite, as no limit catches nan; a default may be inf."""

    def parse_args(self, ctx: Context, args: list[str]) -> list[str]:
        """Read the arguments as the library does; raises InputError for nan, and for inf where it is no default."""
        left = super().parse_args(ctx, args)
        for option in self.params:
            value = ctx.params.get(option.name or "")
            for number in value if isinstance(value, tuple) else (value,):
                if isinstance(number, float) and not math.isfinite(number) and number != option.default:
                    raise InputError(f"{option.opts[0]} {number}: not a finite number; write one")
        return left


def progress_line(text: str) -> None:
    """Write one line of progress to standard error, which leaves standard output to the result."""
    print(text, file=sys.stderr, flush=True)


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Show how far a work is on standard error, stage and share in [0, 1]: a bar in a terminal, else a line a stage."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        work = bar.add_task("", total=1.0)
        shown = ""

        def report(stage: str, share: float) -> None:
            nonlocal shown
            bar.update(work, description=stage, completed=share)
            if stage != shown and not console.is_terminal:
                progress_line(stage)
            shown = stage

        yield report


def print_result(result: dict[str, Any], as_json: bool, text: str) -> None:
    """Print the result once: as one JSON object, or as text."""
    print(json_of(result) if as_json else text)


def _version(requested: bool) -> None:
    if requested:
        from importlib import metadata

        print(f"disco-hw {metadata.version('disco-hw')}")
        raise typer.Exit


def disco_hw(
    _: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Driver stack for a skid-steer robot: fusion, DISCO stochastic MPC, virtual robot, recording."""
