"""Measures on emulated processors what the firmware core costs, and prints the table of docs/port.md.

    python -m tools.generate.firmware_figures

Code and constants: the linked core at -Os, without the C library's helpers. RAM: one core. Stack: the deepest, without
interrupts. A step is a cycle of 1 ms with the sending of what it queued; a reception is one frame.
`tests/firmware_protocol/ports/test_figures.py` has their limits.
"""

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from firmware_protocol.build_firmware import SOURCES
from tools.check.emulated_board import COMPILER, EMULATOR, FIRMWARE, FLAGS, PORTS, PROCESSORS, compile_for, missing

PROGRAM = Path(__file__).with_suffix(".c")
# What a board calls of the core; the linker drops what none of these needs.
ROOTS = (
    "disco_firmware_init", "disco_firmware_step", "disco_firmware_receive", "disco_firmware_pop", "disco_firmware_pose",
    "disco_pose", "disco_config_default",
)  # fmt: skip
LINK_ROOTS = (
    "disco_serial_init", "disco_serial_feed", "disco_serial_encode", "disco_record_pack", "disco_record_unpack",
)  # fmt: skip
# The compiler's helpers for doubles and for divisions of 64 bits: hundreds of instructions each.
SLOW = re.compile(r"__aeabi_(?:u?ldivmod|d\w+|\w*2d)\b")
ROWS = {
    "code": "code of the core, bytes",
    "constants": "constants of the core, bytes",
    "code_link": "code and constants with serial framing and parameter record, bytes",
    "ram": "RAM of the core, bytes",
    "stack": "deepest stack, bytes",
    "step_mean": "instructions in a step, mean",
    "step_worst": "instructions in a step, worst",
    "reception_mean": "instructions in a reception, mean",
    "reception_worst": "instructions in a reception, worst",
    "key_step_mean": "with a key: in a step, mean",
    "key_step_worst": "with a key: in a step, worst",
    "key_reception_mean": "with a key: in a reception, mean",
    "key_reception_worst": "with a key: in a reception, worst",
}


def sizes(processor: str, folder: Path, roots: tuple[str, ...]) -> tuple[int, int]:
    """Return bytes of code and of constants that these functions need of the core."""
    linked = folder / f"core-{processor}.o"
    root_options = [f"-Wl,-u,{root}" for root in roots]
    subprocess.run(
        [COMPILER, "-std=c11", *PROCESSORS[processor].flags, *FLAGS[:-1], "-nostdlib", "-r", "-Wl,--gc-sections",
         f"-Wl,-e,{roots[0]}", *root_options, *(str(FIRMWARE / name) for name in SOURCES), "-o", str(linked)],
        check=True,
    )  # fmt: skip
    tools = COMPILER.removesuffix("gcc")
    relocations = subprocess.run(
        [f"{tools}objdump", "-r", str(linked)], capture_output=True, text=True, check=True
    ).stdout
    assert not SLOW.findall(relocations), f"the core has doubles or divides 64 bits: {SLOW.findall(relocations)}"
    listed = subprocess.run([f"{tools}size", "-A", str(linked)], capture_output=True, text=True, check=True).stdout
    found = [(name, int(count)) for name, count in re.findall(r"^\.(\w+)\S*\s+(\d+)", listed, re.MULTILINE)]
    assert not sum(count for name, count in found if name in ("bss", "data")), "the core has no variables of its own"
    return tuple(sum(count for name, count in found if name == kind) for kind in ("text", "rodata"))  # type: ignore[return-value]


def counted(processor: str, folder: Path, *, key: bool) -> dict[str, int]:
    """Run the program of measurements; return what it prints."""
    image = compile_for(
        processor,
        [PROGRAM, PORTS / "mps2" / "startup.c"],
        folder / f"figures-{processor}.elf",
        ["-DWITH_KEY"] if key else [],
    )
    command = [
        EMULATOR, "-machine", PROCESSORS[processor].machine, "-kernel", str(image), "-display", "none", "-monitor",
        "none", "-serial", "null", "-icount", "shift=10,sleep=off", "-semihosting-config", "enable=on,target=native",
    ]  # fmt: skip
    # Semihosting writes to standard error.
    ran = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    return {name: int(value) for name, value in re.findall(r"^(\w+) (\d+)$", ran.stdout + ran.stderr, re.MULTILINE)}


def measure(processor: str) -> dict[str, int]:
    """Return all figures of one processor, by the names of `ROWS`."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        code, constants = sizes(processor, folder, ROOTS)
        plain, proved = counted(processor, folder, key=False), counted(processor, folder, key=True)
        for run in (plain, proved):
            # The drive went as it should: armed, obeyed, stopped by the watchdog.
            assert run["accepted"] > 300, run
            assert run["watchdog_events"] == 1, run
        figures = {"code": code, "constants": constants, "code_link": sum(sizes(processor, folder, ROOTS + LINK_ROOTS))}
    figures |= {name: plain[name] for name in ROWS if name in plain}
    figures["stack"] = max(plain["stack"], proved["stack"])
    return figures | {name: proved[name.removeprefix("key_")] for name in ROWS if name.startswith("key_")}


def table(figures: Mapping[str, Mapping[str, int]]) -> str:
    """Return the figures as a table in Markdown."""
    lines = [f"| | {' | '.join(figures)} |", f"|---|{'---:|' * len(figures)}"]
    lines += [f"| {label} | {' | '.join(str(of[name]) for of in figures.values())} |" for name, label in ROWS.items()]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Measure and print."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    if what := missing():
        print(what, file=sys.stderr)
        return 2
    print(table({processor: measure(processor) for processor in PROCESSORS}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
