"""Verbs that need no robot: demo, sim."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from disco_hw.cli.options import (
    AsJson,
    LinkOption,
    ModelOption,
    View,
)
from disco_hw.config import check_named_files
from disco_hw.errors import InputError
from disco_hw.reports import as_json as json_of
from disco_hw.viewer.page_process import DEFAULT_PORT


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
    adapt: Annotated[bool, typer.Option("--adapt", help="Learn the geometry on the way (docs/adapt.md).")] = False,
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
    from disco_hw.experiments.virtual import SimOptions, run_sim

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
                faults=faults,
                seed=seed,
                board=board,
            )
        )
    )
