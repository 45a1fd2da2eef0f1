"""The firmware on an emulated microcontroller: compiled for a Cortex-M and run by QEMU.

Its serial line is a socket, whose bytes whoever writes them delivers himself; or a terminal, as a program or a library
may want one, whose bytes are carried by a thread of the kernel that has no priority and is late beside other work.

    python -m tools.check.emulated_board [--processor m4f] [--key FILE] [--slcan] [--plant-line]   until Ctrl-C

Needs arm-none-eabi-gcc with newlib and qemu-system-arm; `make firmware-emulated` installs them on Debian.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from disco_hw.processes import can_lock_memory
from firmware_protocol.build_firmware import PACKAGE, SOURCES

FIRMWARE = PACKAGE / "firmware"
PORTS = PACKAGE / "ports"
COMPILER = "arm-none-eabi-gcc"
EMULATOR = "qemu-system-arm"
FLAGS = ("-mthumb", "-Os", "-ffunction-sections", "-fdata-sections", "--specs=nano.specs")
WARNINGS = ("-Wall", "-Wextra", "-Wdouble-promotion", "-Werror")
SETTINGS = 0x2000_0000
# Below a daemon on this computer, whose loop has 80 and whose other threads have 70: what the emulator makes up for
# must make none of them late.
_REALTIME_PRIORITY = 60
_START_S = 20.0


@dataclass(frozen=True, slots=True)
class Processor:
    """Target to compile for, and QEMU's machine that runs it."""

    flags: tuple[str, ...]
    machine: str


PROCESSORS = {
    # QEMU has no board with an M0+; an M3 runs its instructions as they are.
    "m0plus": Processor(("-mcpu=cortex-m0plus",), "mps2-an385"),
    "m3": Processor(("-mcpu=cortex-m3",), "mps2-an385"),
    "m4f": Processor(("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard"), "mps2-an386"),
}


def missing() -> str:
    """Return in one line what is missing to emulate a board; empty if nothing is."""
    gone = [program for program in (COMPILER, EMULATOR) if shutil.which(program) is None]
    if not gone:
        return ""
    return (
        f"{' and '.join(gone)} not found: apt-get install gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm "
        "(113 MB to download, 923 MB on disk), or run make firmware-emulated as root on Debian"
    )


def compile_for(processor: str, sources: Sequence[Path], target: Path, options: Sequence[str] = ()) -> Path:
    """Link the core and these sources for a Cortex-M, with MPS2's memory; any warning is an error."""
    command = [
        COMPILER, "-std=c11", *PROCESSORS[processor].flags, *FLAGS, *WARNINGS, *options, "-nostartfiles",
        "-Wl,--gc-sections", "-T", str(PORTS / "mps2" / "mps2.ld"), f"-I{FIRMWARE}", f"-I{PORTS}",
        f"-I{PORTS / 'mps2'}", *(str(FIRMWARE / name) for name in SOURCES), *map(str, sources), "-lm",
        "-o", str(target),
    ]  # fmt: skip
    subprocess.run(command, check=True)
    return target


def build_board(processor: str, folder: Path, *, slcan: bool = False, plant_line: bool = False) -> Path:
    """Build the firmware of the MPS2 port; returns its ELF file. `plant_line`: for a virtual robot outside."""
    sources = [PORTS / "controller.c", *sorted((PORTS / "mps2").glob("*.c"))]
    options = ["-DDISCO_LINK_SLCAN"] if slcan else []
    if plant_line:
        sources.append(PORTS / "plant_line.c")
        options.append("-DDISCO_PLANT_LINE")
    target = folder / f"board-{processor}{'-slcan' if slcan else ''}{'-plant' if plant_line else ''}.elf"
    return compile_for(processor, sources, target, options)


@dataclass(frozen=True, slots=True)
class Truth:
    """One line of the bench: what truly happens on the board, at `ms` of its clock in its start number `start`."""

    start: int
    ms: int
    setpoints: tuple[float, float]
    speeds: tuple[float, float]
    pose: tuple[float, float, float]
    state: int
    accepted: int

    @property
    def fastest(self) -> float:
        """Speed of the faster wheel, rad/s."""
        return max(map(abs, self.speeds))


class Bench:
    """The test bench's line: what truly happens, 100 times a second, and what a person could do to the board.

    `rows` is what it printed so far. A thread reads it: a line that nobody reads holds up the board.
    """

    def __init__(self, path: Path) -> None:
        self.rows: list[Truth] = []
        deadline = time.monotonic() + _START_S
        while not path.exists():
            if time.monotonic() > deadline:
                raise TimeoutError("the emulator makes no bench")
            time.sleep(0.01)
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.connect(str(path))
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def do(self, what: str) -> None:
        """Send a bench command: r restart, b brown-out, h hang, p press or release the emergency stop."""
        self._socket.sendall(what.encode())

    def latest(self, within_s: float = 5.0) -> Truth:
        """Wait for the next line."""
        seen, deadline = len(self.rows), time.monotonic() + within_s
        while len(self.rows) <= seen:
            if time.monotonic() > deadline:
                raise TimeoutError("the bench prints nothing")
            time.sleep(0.005)
        return self.rows[-1]

    def close(self) -> None:
        """Disconnect from the bench's line."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._reader.join()
        self._socket.close()

    def _read(self) -> None:
        rest = b""
        while data := self._socket.recv(1 << 16):
            *lines, rest = (rest + data).split(b"\n")
            self.rows += [row for line in lines if (row := _truth(line)) is not None]


def _truth(line: bytes) -> Truth | None:
    fields = line.split()
    if len(fields) != 11:
        return None
    start, ms, *scaled, state, accepted = map(int, fields)
    left_set, right_set, left, right = (value * 1e-3 for value in scaled[:4])
    x, y, yaw = (value * 1e-4 for value in scaled[4:])
    return Truth(start, ms, (left_set, right_set), (left, right), (x, y, yaw), state, accepted)


@dataclass(frozen=True, slots=True)
class Board:
    """Board that is running: its serial line as `link.port` names it, its bench, and the emulator's process."""

    port: str
    bench: Bench
    process: subprocess.Popen[str]


def _settings(entropy: int, first_us: int, key: bytes) -> list[str]:
    words = [entropy & 0xFFFF_FFFF, entropy >> 32, first_us, 1 if key else 0]
    words += [int.from_bytes(key[i : i + 4], "little") for i in range(0, len(key), 4)]
    return [
        option
        for place, word in enumerate(words)
        for option in ("-device", f"loader,addr={SETTINGS + 4 * place:#x},data={word:#x},data-len=4")
    ]


def _command(image: Path, processor: str, settings: list[str], *lines: str) -> list[str]:
    serial = [option for line in lines for option in ("-serial", line)]
    machine = ["-machine", PROCESSORS[processor].machine, "-kernel", str(image), "-display", "none", "-monitor", "none"]
    # What the computer takes from the emulator's memory it has to read from the disk again, and the board stands still.
    locked = ["-overcommit", "mem-lock=on", "-accel", "tcg,tb-size=16"] if can_lock_memory() else []
    return [EMULATOR, *machine, *locked, *serial, *settings]


@contextlib.contextmanager
def _running(command: Sequence[str]) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


@contextlib.contextmanager
def running_board(
    image: Path,
    processor: str,
    *,
    entropy: int | None = None,
    first_us: int = 0,
    key: bytes = b"",
    terminal: bool = False,
) -> Iterator[Board]:
    """Start QEMU with this image; it ends with the block.

    `first_us`: where the board's counter begins. `terminal`: its serial line is a terminal, and no socket.
    """
    board_entropy = secrets.randbits(63) if entropy is None else entropy
    with tempfile.TemporaryDirectory(prefix="disco-hw-board-") as folder:
        link, bench = Path(folder) / "link", Path(folder) / "bench"
        lines = [f"unix:{path},server=on,wait=off" for path in (link, bench)]
        if terminal:
            lines[0] = "pty"
        settings = _settings(board_entropy, first_us, key)
        with _running(_command(image, processor, settings, *lines)) as process:
            port = _ports_of(process, 1)[0] if terminal else f"unix://{link}"
            with contextlib.closing(Bench(bench)) as test_bench:
                # When it prints something, all its threads are there.
                test_bench.latest(_START_S)
                _prefer(process.pid)
                yield Board(port, test_bench, process)


@contextlib.contextmanager
def running_bare_board(image: Path, processor: str) -> Iterator[tuple[str, str]]:
    """Start QEMU with an image that has a plant's line; yields the terminals of the link and of that line."""
    with _running(_command(image, processor, _settings(secrets.randbits(63), 0, b""), "pty", "pty")) as process:
        link, plant = _ports_of(process, 2)
        _prefer(process.pid)
        yield link, plant


def run_fast(image: Path, processor: str, folder: Path, seconds: float, first_us: int = 0) -> tuple[bytes, list[Truth]]:
    """Let a board run as fast as the computer can for so many seconds of its own clock, which counts instructions.

    Returns what it sent over its serial line, and what its bench printed.
    """
    line, bench = folder / "line", folder / "bench"
    command = _command(image, processor, _settings(1, first_us, b""), f"file:{line}", f"file:{bench}")
    with _running([*command, "-icount", "shift=5,sleep=off"]) as process:
        # A line for each 10 ms.
        least, size = round(100 * seconds), 0
        while process.poll() is None and not (size > 20 * least and bench.read_bytes().count(b"\n") > least):
            time.sleep(1.0)
            # A busy computer has not made it yet.
            size = bench.stat().st_size if bench.exists() else 0
    rows = [row for text in bench.read_bytes().split(b"\n")[:-1] if (row := _truth(text)) is not None]
    return line.read_bytes(), rows


def _prefer(process: int) -> None:
    """Give all threads of the emulator priority: its clock is the computer's, and what is held up is late."""
    for thread in os.listdir(f"/proc/{process}/task"):
        with contextlib.suppress(OSError):
            os.sched_setscheduler(int(thread), os.SCHED_FIFO, os.sched_param(_REALTIME_PRIORITY))


def _ports_of(process: subprocess.Popen[str], count: int) -> list[str]:
    assert process.stdout is not None
    output, ports = "", []
    for line in process.stdout:
        output += line
        ports += re.findall(r"redirected to (/dev/\S+)", line)
        if len(ports) == count:
            return ports
    raise RuntimeError(f"the emulator did not start: {output.strip()}")


def main() -> int:
    """Run a board until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--processor", choices=[name for name in PROCESSORS if name != "m0plus"], default="m4f")
    parser.add_argument("--slcan", action="store_true", help="speak SLCAN in the place of the serial framing")
    parser.add_argument("--plant-line", action="store_true", help="leave the wheels to disco-hw sim --board")
    parser.add_argument("--key", type=Path, metavar="FILE", help="the robot's key")
    given = parser.parse_args()
    if what := missing():
        print(what, file=sys.stderr)
        return 2
    key = bytes.fromhex(given.key.read_text("utf-8")) if given.key else b""
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(KeyboardInterrupt):
        image = build_board(given.processor, Path(folder), slcan=given.slcan, plant_line=given.plant_line)
        if given.plant_line:
            with running_bare_board(image, given.processor) as (link, plant):
                print(f"ready {link} ({given.processor}), plant's line {plant}", flush=True)
                signal.pause()
        with running_board(image, given.processor, key=key, terminal=True) as board:
            print(f"ready {board.port} ({given.processor})", flush=True)
            board.process.wait()
    return 0


if __name__ == "__main__":
    sys.exit(main())
