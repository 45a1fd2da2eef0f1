"""What `disco-hw view` does: the live page, and each use of a log.

What a page does not need is imported where it is used: the plotting library alone takes half a second.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from disco_hw.config import link_fields, load_robot_config
from disco_hw.daemon import socket_path
from disco_hw.daemon.process import StopSignals
from disco_hw.errors import InputError
from disco_hw.processes import SWITCH_INTERVAL_S
from disco_hw.viewer import DEFAULT_PORT, LOOPBACK
from disco_hw.viewer.operator_controls import Desk
from disco_hw.viewer.pages import LivePage, ReplayPage, run_live, run_replay
from disco_hw.viewer.recording import Recording, stage_of_robot
from disco_hw.viewer.server import serving
from disco_hw.viewer.timeline import marks_of


def view_live(
    robot: Path,
    model: Path | None = None,
    host: str = LOOPBACK,
    port: int = DEFAULT_PORT,
    ended: Callable[[], bool] = lambda: False,
    as_json: bool = False,
    link: str | None = None,
) -> int:
    """Serve the live page of this robot's daemon until SIGTERM, SIGINT or `ended()`; returns the exit code.

    The daemon may come and go. `link` overrides robot.toml's kind for the e-stop that the page sends by itself. Raises
    InputError for a bad file or link, or a host or port that cannot be listened to.
    """
    link_fields(link)
    # A busy event loop gives way to the threads of the e-stop as fast as the daemon's does.
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    stage = stage_of_robot(robot, model)
    socket = socket_path(load_robot_config(robot))
    desk = Desk(socket, robot, link)
    with (
        StopSignals() as signals,
        closing(desk),
        serving(f"disco-hw: {stage.name}", host, port, desk) as page,
    ):
        live = LivePage(page.server, stage, socket, desk)
        _print_served({"page": page.url}, as_json)
        run_live(live, lambda: signals.received is not None or ended())
    return 0


def view_log(
    log: Path, robot: Path | None = None, host: str = LOOPBACK, port: int = DEFAULT_PORT, as_json: bool = False
) -> int:
    """Serve the replay of a log until SIGTERM or SIGINT; returns the exit code.

    `robot` replaces the robot.toml kept in the log. Raises InputError for a bad file, host or port.
    """
    with (
        StopSignals() as signals,
        Recording(log, robot) as recording,
        serving(f"disco-hw: {log.name}", host, port) as page,
    ):
        replay = ReplayPage(page.server, recording)
        _print_served({"page": page.url, **in_figures(recording)}, as_json)
        run_replay(replay, lambda: signals.received is not None)
    return 0


def in_figures(recording: Recording) -> dict[str, Any]:
    """Return a log's length, number of control cycles and marks (time and text) as a JSON-serialisable dict."""
    marks = marks_of(recording.timeline)
    return {
        "duration_s": recording.duration_s,
        "ticks": len(recording.ticks),
        "marks": [
            {"t_s": (mark.t_ns - recording.first_ns) * 1e-9, "kind": mark.kind, "text": mark.text} for mark in marks
        ],
    }


def snapshot_log(log: Path, out: Path, at_s: float | None = None, robot: Path | None = None) -> None:
    """Write a picture of the log's instant `at_s` seconds from its start, or of its end; needs no display.

    Raises InputError for a bad file or an ending that is no kind of picture.
    """
    from disco_hw.viewer.picture import draw_picture  # noqa: PLC0415

    with Recording(log, robot) as recording:
        _check_folder(out)
        draw_picture(recording, recording.duration_s if at_s is None else at_s, out)


def video_log(log: Path, out: Path, speed: float = 1.0, robot: Path | None = None) -> None:
    """Write the log as a clip, `speed` times as fast as it was; needs no display. Raises InputError as `draw_clip`."""
    from disco_hw.viewer.picture import draw_clip  # noqa: PLC0415

    with Recording(log, robot) as recording, _progress(f"writing {out.name}") as progress:
        _check_folder(out)
        draw_clip(recording, out, speed, progress)


def export_log(log: Path, out: Path, robot: Path | None = None) -> None:
    """Write the log as one HTML file that plays without Python. Raises InputError for a bad file."""
    from disco_hw.viewer.picture import export_html  # noqa: PLC0415

    with Recording(log, robot) as recording, _progress(f"writing {out.name}") as progress:
        _check_folder(out)
        export_html(recording, out, progress)


def _print_served(served: Mapping[str, Any], as_json: bool) -> None:
    """Say where the page is, at once: whoever started it waits for the line."""
    print(json.dumps(served) if as_json else f"page: {served['page']}", flush=True)


def _check_folder(out: Path) -> None:
    if not out.parent.is_dir():
        raise InputError(f"{out.parent}: no such directory; make it first")


@contextmanager
def _progress(title: str) -> Iterator[Callable[[float], None]]:
    """Show a bar on standard error for the part done."""
    with Progress(console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task(title, total=1.0)
        yield lambda part: bars.update(task, completed=part)


def main(arguments: list[str]) -> int:
    """Serve the page until told to stop or until the process with the first argument's number is not the parent."""
    parent, host, port, robot, model, link = arguments
    try:
        with redirect_stdout(sys.stderr):
            return view_live(
                Path(robot),
                Path(model) if model else None,
                host,
                int(port),
                lambda: os.getppid() != int(parent),
                link=link or None,
            )
    except InputError as error:
        print(f"page: {error}", file=sys.stderr, flush=True)
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
