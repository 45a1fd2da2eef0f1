"""Shows that the firmware's tests notice every change of the hand-written C: each mutant must fail one of them.

    python -m tools.firmware_mutants [--only FILE.c ...] [--jobs 2] [--report FILE]

A mutant that compiles to the same machine code as the original is none. One that passes the tests is run under the
sanitizers too. Those that cannot be distinguished from the original
by any frame or setpoint are in firmware_equivalents.toml, each with its reason. Exits 1 if any other survives.
"""

import argparse
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from firmware_protocol.build_firmware import PACKAGE, SOURCES, create_ffi
from tools.check.firmware_check import build_harness, run_harness
from tools.check.mutation import FAST_TESTS, Mutant, mutants

ROOT = Path(__file__).resolve().parent.parent
FIRMWARE = PACKAGE / "firmware"
TESTS = ROOT / "tests" / "firmware_protocol"
EQUIVALENTS = Path(__file__).with_name("firmware_equivalents.toml")
HAND_WRITTEN = tuple(name for name in SOURCES if name != "disco_robot.c")
FLAGS = ("-std=c99", "-O1", "-fPIC", "-w")
TIMEOUT_S = 240
# Three times what all tests take: a mutant that loops for ever takes no longer.
CPU_S = 150
SANITIZED_CYCLES = 20_000
SANITIZED_FRAMES = 20
MEMORY = 6 << 30
# The tests that are most likely to notice, by file; then all others.
FIRST = {
    "e2e": ("test_e2e", "firmware/test_reception"),
    "cmac": ("test_authentication",),
    "authentication": ("test_authentication", "firmware/test_authentication"),
    "reception": ("firmware/test_reception", "firmware/test_authentication"),
    "rejection": ("firmware/test_reception", "firmware/test_command"),
    "quantise": ("firmware/test_telemetry",),
    "pose": ("firmware/test_telemetry",),
    "firmware": ("test_firmware_core", "firmware/test_telemetry"),
    "supervisor": ("firmware/test_host", "firmware/test_states", "firmware/test_command"),
    "drive": ("firmware/test_drive",),
    "host": ("firmware/test_host",),
    "timebase": ("firmware/test_timebase",),
    "serial_framing": ("test_serial_framing",),
    "slcan": ("test_slcan",),
    "robot_config": ("test_firmware_core", "firmware/test_robot_config"),
}


@dataclass(frozen=True, slots=True)
class Result:
    """The result of one mutant: "killed", "same code", "does not compile" or "SURVIVED"."""

    file: str
    mutant: Mutant
    outcome: str


def compile_object(text: str, target: Path) -> bool:
    """Compile C from its text, so that no file name gets into the object; return whether it compiles."""
    command = ["gcc", *FLAGS, "-x", "c", "-", f"-I{FIRMWARE}", "-c", "-o", str(target)]
    return subprocess.run(command, input=text, text=True, capture_output=True, check=False).returncode == 0


class Builder:
    """Compiles the unchanged parts once; each mutant costs one file and a link."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.objects = {}
        wrapper = folder / "_firmware.c"
        create_ffi().emit_c_code(str(wrapper))
        include = subprocess.run(
            [sys.executable, "-c", "import sysconfig; print(sysconfig.get_path('include'))"],
            capture_output=True, text=True, check=True,
        ).stdout.strip()  # fmt: skip
        command = ["gcc", *FLAGS, "-DPy_LIMITED_API=0x03080000", f"-I{include}", f"-I{FIRMWARE}", "-c", str(wrapper)]
        subprocess.run([*command, "-o", str(folder / "_firmware.o")], check=True)
        for name in SOURCES:
            self.objects[name] = folder / f"{name}.o"
            if not compile_object((FIRMWARE / name).read_text("utf-8"), self.objects[name]):
                raise SystemExit(f"{name} does not compile")

    def build(self, name: str, mutant: Mutant, target: Path) -> str | None:
        """Make the extension with this mutant in a folder of its own; return why there is none, or None."""
        target.mkdir()
        mutated = target / "mutated.o"
        if not compile_object(mutant.apply((FIRMWARE / name).read_text("utf-8")), mutated):
            return "does not compile"
        if mutated.read_bytes() == self.objects[name].read_bytes():
            return "same code"
        self.link(target, [mutated, *(path for other, path in self.objects.items() if other != name)])
        return None

    def link(self, target: Path, objects: Iterable[Path]) -> None:
        """Make the extension in a folder from these parts."""
        extension = target / "_firmware.abi3.so"
        parts = [str(self.folder / "_firmware.o"), *map(str, objects)]
        subprocess.run(["gcc", "-shared", *parts, "-lm", "-o", str(extension)], check=True)


def test_files(name: str) -> list[str]:
    """The fast tests, the likeliest to notice a change of this file first."""
    stem = Path(name).stem
    first = [TESTS / f"{part}.py" for part in FIRST.get(stem, (f"firmware/test_{stem}",))]
    slow = {TESTS / "firmware" / "test_sanitizers.py", *TESTS.glob("emulated/*.py"), *TESTS.glob("ports/*.py")}
    others = [path for path in sorted(TESTS.rglob("test_*.py")) if path not in slow and path not in first]
    return [str(path) for path in (*first, *others)]


def child(folder: Path, files: Sequence[str]) -> int:
    """Run the tests against the extension in `folder`, in this forked process; return their exit status."""
    import pytest  # noqa: PLC0415

    import firmware_protocol  # noqa: PLC0415

    firmware_protocol.__path__.insert(0, str(folder))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    # Of its own time, so that a busy computer kills no mutant; and one that waits for ever is ended, too.
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
    signal.alarm(10 * TIMEOUT_S)
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    os.chdir(ROOT)
    for one in files:
        # File by file, so that the others need not even be collected.
        status = pytest.main(["-x", "-m", FAST_TESTS, "-p", "no:cacheprovider", "-n", "0", "-p", "no:timeout",
                              "--hypothesis-profile=mutants", f"--basetemp={folder}/t", one])  # fmt: skip
        if status not in (0, pytest.ExitCode.NO_TESTS_COLLECTED):
            return int(status)
    return 0


def fork_child(folder: Path, files: Sequence[str]) -> int:
    """Run the tests against the extension in `folder` in a process of their own; return its number."""
    process = os.fork()
    if process == 0:
        status = 99
        try:
            status = child(folder, files)
        finally:
            os._exit(status)
    return process


def sanitizers_notice(name: str, mutant: Mutant, folder: Path) -> bool:
    """Whether the sanitizers' harness fails with this mutant: what reads beyond its bounds may do no visible harm."""
    mutated = folder / name
    mutated.write_text(mutant.apply((FIRMWARE / name).read_text("utf-8")), "utf-8")
    harness = build_harness(folder, {name: mutated})
    try:
        return any(
            run_harness(harness, SANITIZED_CYCLES, SANITIZED_FRAMES, authenticated, TIMEOUT_S).returncode != 0
            for authenticated in (False, True)
        )
    except subprocess.TimeoutExpired:
        return True


def load_the_rest() -> None:
    """Import what every child needs, so that a fork has it; all but the extension itself."""
    import cantools.autosar.end_to_end  # noqa: F401, PLC0415
    import crccheck.crc  # noqa: F401, PLC0415
    import hypothesis.stateful  # noqa: PLC0415
    import pytest  # noqa: F401, PLC0415

    import firmware_protocol.protection  # noqa: F401, PLC0415

    hypothesis.settings.register_profile("mutants", derandomize=True, deadline=None, database=None, max_examples=60)


def sweep(names: Sequence[str], jobs: int, chosen: slice, report: Path | None = None) -> list[Result]:
    """Try the mutants of these files; progress on stderr. Raises RuntimeError if the unchanged core fails its tests."""
    known = tomllib.loads(EQUIVALENTS.read_text("utf-8")) if EQUIVALENTS.exists() else {}
    load_the_rest()
    results: list[Result] = []
    running: dict[int, tuple[str, Mutant, Path]] = {}
    started = time.monotonic()

    def finish() -> None:
        process, status = os.wait()
        name, mutant, folder = running.pop(process)
        # A crash, a hang and a failing test all are a change that was noticed; 0 alone is none.
        survived = status == 0 and not sanitizers_notice(name, mutant, folder)
        shutil.rmtree(folder, ignore_errors=True)
        add(Result(name, mutant, "SURVIVED" if survived else "killed"))

    def add(result: Result) -> None:
        results.append(result)
        if result.outcome == "SURVIVED":
            reason = known.get(result.file, {}).get(result.mutant.key)
            if reason is not None:
                results[-1] = Result(result.file, result.mutant, "equivalent")
            else:
                line = f"SURVIVED {result.file}:{result.mutant.line}: {result.mutant.key}"
                print(line, file=sys.stderr, flush=True)
                if report is not None:
                    with report.open("a", encoding="utf-8") as file:
                        file.write(line + "\n")
        if len(results) % 50 == 0:
            print(f"{len(results)} mutants, {time.monotonic() - started:.0f} s", file=sys.stderr, flush=True)

    with tempfile.TemporaryDirectory() as folder:
        builder = Builder(Path(folder))
        unchanged = Path(folder) / "unchanged"
        unchanged.mkdir()
        builder.link(unchanged, builder.objects.values())
        _, status = os.waitpid(fork_child(unchanged, test_files(names[0])), 0)
        if status != 0:
            raise RuntimeError("the unchanged core fails its tests: every mutant would pass for noticed")
        for name in names:
            for number, mutant in enumerate(list(mutants((FIRMWARE / name).read_text("utf-8")))[chosen]):
                target = Path(folder) / f"{Path(name).stem}{number}"
                without = builder.build(name, mutant, target)
                if without is not None:
                    shutil.rmtree(target, ignore_errors=True)
                    add(Result(name, mutant, without))
                    continue
                while len(running) >= jobs:
                    finish()
                running[fork_child(target, test_files(name))] = (name, mutant, target)
        while running:
            finish()
    return results


def main() -> int:
    """Sweep, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="FILE.c", choices=HAND_WRITTEN, default=HAND_WRITTEN)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only each Nth mutant of each file")
    parser.add_argument("--report", type=Path, help="file to which survivors are added as they are found")
    given = parser.parse_args()
    results = sweep(given.only, given.jobs, slice(None, None, given.every), given.report)
    outcomes = ("killed", "equivalent", "same code", "does not compile", "SURVIVED")
    print(f"{'file':<20}" + "".join(f"{outcome:>18}" for outcome in outcomes))
    for name in given.only:
        counts = Counter(result.outcome for result in results if result.file == name)
        print(f"{name:<20}" + "".join(f"{counts[outcome]:>18}" for outcome in outcomes))
    return int(any(result.outcome == "SURVIVED" for result in results))


if __name__ == "__main__":
    sys.exit(main())
