"""Every verb of the command `disco-hw`, gathered from the files of its groups.

Verbs import what they need when they run, so that `--help` and `ctl` need nothing else to be healthy.
"""

from __future__ import annotations

from typing import Annotated

import typer

from disco_hw.cli import logs, robot, virtual

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
    logs.view,
    logs.replay,
    virtual.sim,
):
    app.command()(verb)
app.add_typer(virtual.experiment_app, name="experiment")
app.add_typer(robot.bridge_app, name="bridge")
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
