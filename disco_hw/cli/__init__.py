"""Command `disco-hw`, gathered from a file for each group of verbs, where errors become an exit code.

Verbs import what they need when they run, so that `--help` and `ctl` need nothing else to be healthy. A stop that is
written as in the documents goes past the command-line library, which takes as long to load and to list every verb as
the stop itself.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from disco_hw.errors import InputError, WorkError
from disco_hw.processes import PARENT_VARIABLE, end_with_parent

if TYPE_CHECKING:
    import typer

# Chosen: above what imports make; the reason is at its use.
_YOUNG_OBJECTS = 50_000


def main() -> None:
    """Run the command: bad input prints one line and exits with 2, failed work with 1."""
    parent = os.environ.pop(PARENT_VARIABLE, None)
    if parent is not None:
        end_with_parent(int(parent))
    # Imports make many objects and no garbage: looking for it on the way took a fourteenth of what `estop` computes.
    gc.set_threshold(_YOUNG_OBJECTS)
    try:
        stop = plain_stop(sys.argv[1:])
        if stop is not None:
            from disco_hw.daemon.emergency import stop_and_report

            raise SystemExit(stop_and_report(*stop))
        app()(prog_name="disco-hw")
    except InputError as error:
        print(f"disco-hw: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except WorkError as error:
        print(f"disco-hw: {error}", file=sys.stderr)
        raise SystemExit(1) from None


def plain_stop(arguments: Sequence[str]) -> tuple[Path, str | None, bool] | None:
    """Return the robot file, --link and --json of `estop`.

    None for another verb, and for whatever needs help or an error.
    """
    if not arguments or arguments[0] != "estop":
        return None
    files: list[str] = []
    link, as_json = None, False
    left = iter(arguments[1:])
    for argument in left:
        if argument == "--json":
            as_json = True
        elif argument == "--link":
            link = next(left, None)
            if link is None:
                return None
        elif argument.startswith("--link="):
            link = argument.removeprefix("--link=")
        elif argument.startswith("-"):
            return None
        else:
            files.append(argument)
    return (Path(files[0]), link, as_json) if len(files) == 1 else None


def app() -> typer.Typer:
    """Return the application with every verb, its options and its help."""
    import typer

    from disco_hw.cli import logs, options, robot, virtual

    gathered = typer.Typer(name="disco-hw", no_args_is_help=True, pretty_exceptions_enable=False)
    for verb in (
        virtual.demo,
        robot.run,
        robot.drive,
        robot.ctl,
        robot.check,
        robot.init,
        robot.commission,
        robot.estop,
        logs.infer,
        logs.gap,
        logs.view,
        logs.replay,
        virtual.sim,
    ):
        gathered.command()(verb)
    gathered.add_typer(virtual.experiment_app, name="experiment")
    gathered.add_typer(robot.bridge_app, name="bridge")
    gathered.command("import")(logs.import_log)
    gathered.add_typer(logs.log_app, name="log")
    gathered.callback()(options.disco_hw)
    for group in (gathered, virtual.experiment_app, robot.bridge_app, logs.log_app):
        for command in group.registered_commands:
            command.cls = options.Verb
    return gathered
