"""The command `disco-hw`: a file for each group of verbs; here they are gathered and errors become an exit code.

Verbs import what they need when they run, so that `estop` and `--help` need nothing else to be healthy.
"""

from __future__ import annotations

import gc
import os
import sys
from typing import Annotated

import typer

from disco_hw.cli import logs, robot, virtual, watch
from disco_hw.cli.experiment import experiment_app
from disco_hw.cli.watch import bridge_app
from disco_hw.errors import InputError, WorkError
from disco_hw.processes import PARENT_VARIABLE, end_with_parent

_YOUNG_OBJECTS = 50_000

app = typer.Typer(
    name="disco-hw",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
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
    watch.view,
    watch.replay,
    virtual.sim,
):
    app.command()(verb)
app.add_typer(experiment_app, name="experiment")
app.add_typer(bridge_app, name="bridge")
app.command("import")(logs.import_log)
app.add_typer(logs.log_app, name="log")


def _version(asked: bool) -> None:
    if asked:
        from importlib import metadata

        print(f"disco-hw {metadata.version('disco-hw')}")
        raise typer.Exit


@app.callback()
def disco_hw(
    _: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Driver stack for a skid-steer robot: fusion, DISCO stochastic MPC, virtual robot, recording."""


def main() -> None:
    """Entry point: bad input prints one line and exits with 2, failed work with 1."""
    parent = os.environ.pop(PARENT_VARIABLE, None)
    if parent is not None:
        end_with_parent(int(parent))
    # Imports make many objects and no garbage: looking for it on the way took a fourteenth of what `estop` computes.
    gc.set_threshold(_YOUNG_OBJECTS)
    try:
        app(prog_name="disco-hw")
    except InputError as error:
        print(f"disco-hw: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except WorkError as error:
        print(f"disco-hw: {error}", file=sys.stderr)
        raise SystemExit(1) from None
