"""The main loop, the core and a POSIX port as a process: a board whose serial lines are pseudo-terminals."""

import contextlib
import os
import subprocess
import tty
from dataclasses import dataclass
from pathlib import Path

from firmware_protocol.build_firmware import PACKAGE, SOURCES

FIRMWARE, PORTS = PACKAGE / "firmware", PACKAGE / "ports"
PORT = Path(__file__).with_name("posix_port.c")


TEMPLATE = (str(PORTS / "template" / "port.c"), "-Wl,-z,muldefs")
"""Options that leave to the template to measure and to drive; the rest stays that of the first port."""


def build_board(folder, *options):
    """Compile it with these options for the compiler; returns the program."""
    program = folder / "board"
    sources = [PORTS / "controller.c", PORT, *(FIRMWARE / name for name in SOURCES)]
    if "-DDISCO_PLANT_LINE" in options:
        sources.append(PORTS / "plant_line.c")
    flags = ["-std=gnu11", "-O1", "-Wall", "-Wextra", "-Werror", f"-I{FIRMWARE}", f"-I{PORTS}"]
    subprocess.run(["cc", *flags, *map(str, sources), *options, "-lm", "-o", str(program)], check=True)
    return program


def prefer(process):
    """Give a process that has just started priority: what a busy computer holds up looks to its peers like a hang."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(process.pid, os.SCHED_FIFO, os.sched_param(30))


@dataclass(frozen=True)
class Board:
    """A running board: the terminals of its link and of its plant's line."""

    link: str
    plant: str
    process: subprocess.Popen


@contextlib.contextmanager
def running_board(program):
    """Start it; it ends with the block."""
    ends = [os.openpty() for _ in range(2)]
    for master, slave in ends:
        tty.setraw(slave)
        os.set_blocking(master, False)
    (link, _), (plant, _) = ends
    environment = {"LINK": str(link), "PLANT": str(plant)}
    process = subprocess.Popen([str(program)], pass_fds=(link, plant), env=environment)
    prefer(process)
    try:
        yield Board(os.ttyname(ends[0][1]), os.ttyname(ends[1][1]), process)
    finally:
        process.kill()
        process.wait()
        for descriptor in (descriptor for pair in ends for descriptor in pair):
            os.close(descriptor)
