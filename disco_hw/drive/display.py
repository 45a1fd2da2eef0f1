"""What is shown while driving, by a process of its own: a slow terminal must not hold up the loop.

`python -m disco_hw.drive.display SOCKET` asks the daemon for its status; a table in a terminal, else a line a second.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from disco_hw.daemon import send_request
from disco_hw.errors import WorkError

_TABLE_PERIOD_S = 0.4
_LINE_PERIOD_S = 1.0
_START_TIMEOUT_S = 60.0


def line(status: Mapping[str, Any]) -> str:
    """The state of the drive in one line."""
    drive = status["drive"]
    return f"{status['state']}: {drive['words']} | {drive['coverage_words']}"


def table(status: Mapping[str, Any]) -> Group:
    """The state of the drive as a picture for the terminal."""
    drive = status["drive"]
    items = Table("", "excited", "of", "for", box=None, pad_edge=False)
    for item in drive["coverage"]["items"]:
        mark = Text("done", "green") if item["covered"] else Text("missing", "yellow" if item["found"] else "red")
        unit = " s" if item["unit"] == "s" else ""
        amounts = f"{item['found']:.0f}{unit}", f"{item['wanted']:.0f}{unit}"
        items.add_row(mark, Text(f"{item['name']}  {amounts[0]}"), amounts[1], Text(item["purpose"]))
    wheels, command = status["wheels"], status["command"]
    measured = "none" if wheels is None else f"{wheels[0]:+.1f} {wheels[1]:+.1f}"
    return Group(
        Text(f"{status['state']}: {status['detail']}", "bold green" if drive["driving"] else "bold"),
        Text(f"command {command[0]:+.1f} {command[1]:+.1f}  wheels {measured} rad/s"),
        Text(drive["words"]),
        Text(drive["task"]),
        items,
        Text(drive["coverage_words"]),
        *(Text(message, "dim") for message in drive["messages"]),
    )


def show(socket: Path, console: Console) -> None:
    """Show the drive until its daemon has gone."""
    _wait_for(socket)
    if not console.is_terminal:
        while (status := _status(socket)) is not None:
            console.out(line(status), highlight=False)
            time.sleep(_LINE_PERIOD_S)
        return
    with Live(console=console, auto_refresh=False) as live:
        while (status := _status(socket)) is not None:
            live.update(table(status), refresh=True)
            time.sleep(_TABLE_PERIOD_S)


def _wait_for(socket: Path) -> None:
    deadline_s = time.monotonic() + _START_TIMEOUT_S
    while time.monotonic() < deadline_s and _status(socket) is None:
        time.sleep(_TABLE_PERIOD_S)


def _status(socket: Path) -> Mapping[str, Any] | None:
    """The daemon's status; None without a daemon that is driven by hand."""
    try:
        status = send_request(socket, {"do": "status"})
    except WorkError:
        return None
    return status if status.get("ok") and "drive" in status else None


if __name__ == "__main__":
    show(Path(sys.argv[1]), Console())
