"""Verbs on log files: import, log info, recover, export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from disco_hw.config.command_line import check_named_files
from disco_hw.verbs.options import (
    AsJson,
    RobotOption,
    print_result,
)

log_app = typer.Typer(help="Look into a log, mend it, hand it on.", no_args_is_help=True)


def import_log(
    log: Annotated[Path, typer.Argument(metavar="FILE", help="A CSV file, or a candump of our protocol.")],
    robot: RobotOption,
    out: Annotated[Path, typer.Option("-o", "--out", help="Where to write the MCAP log.")],
    as_json: AsJson = False,
) -> None:
    """Write a foreign log as a log of ours, for `infer`, `gap` and Foxglove; `view` and `replay` need one of `run`."""
    check_named_files(robot, logs=[log])
    from disco_hw.log.importing.write import import_log as import_foreign

    result = import_foreign(log, robot, out)
    print_result(result.as_dict(), as_json, result.as_text())


@log_app.command()
def info(log: Annotated[Path, typer.Argument(metavar="LOG")], as_json: AsJson = False) -> None:
    """Say what a log holds and whether anything was lost."""
    check_named_files(logs=[log])
    from disco_hw.log.commands import info as log_info

    print(log_info(log, as_json))


@log_app.command()
def recover(
    log: Annotated[Path, typer.Argument(metavar="LOG")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Where to write the mended log.")],
    as_json: AsJson = False,
) -> None:
    """Copy everything whole from a damaged log into a new one."""
    check_named_files(logs=[log])
    from disco_hw.log.commands import recover as log_recover

    print(log_recover(log, out, as_json))


@log_app.command()
def export(
    log: Annotated[Path, typer.Argument(metavar="LOG")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Where to write the CSV file.")],
    as_json: AsJson = False,
) -> None:
    """Write commands, encoders and poses as CSV."""
    check_named_files(logs=[log])
    from disco_hw.log.commands import export as log_export

    print(log_export(log, out, as_json))
