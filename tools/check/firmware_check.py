"""Checks of the hand-written firmware C: warnings, undefined behaviour, coverage, ten million random frames.

Builds the extension in a copy of the tree, once with the undefined-behaviour sanitizer and once with gcov (each adds
branches of its own, which the other must not see), and runs the firmware's tests on both. Exits 1 if anything is
missing. Needs gcc and gcov.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from firmware_protocol.build_firmware import SOURCES

ROOT = Path(__file__).resolve().parents[2]
HAND_WRITTEN = tuple(name for name in SOURCES if name != "disco_robot.c")
WARNINGS = (
    "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wsign-conversion", "-Wdouble-promotion", "-Wshadow",
    "-Wstrict-prototypes",
)  # fmt: skip
SANITIZE = "-O1 -fsanitize=undefined -fno-sanitize-recover=all"
COVER = "-O0 --coverage"
HARNESS_SANITIZERS = ("-fsanitize=undefined,address", "-fno-sanitize-recover=all")
HARNESS = ROOT / "tests" / "firmware_protocol" / "firmware" / "sanitizer_harness.c"
# A tenth of the cycles are a flood, so that the core is met in every state.
FLOOD_CYCLES = 1_000_000
FLOOD_FRAMES = 50


@dataclass(frozen=True, slots=True)
class Coverage:
    """Coverage of one file by the tests."""

    name: str
    lines: int
    missed_lines: tuple[int, ...]
    branches: int
    missed_branches: tuple[int, ...]


def warnings_of(name: str) -> str:
    source = ROOT / "firmware_protocol" / "firmware" / name
    command = ["gcc", "-std=c99", "-O2", *WARNINGS, "-c", str(source), "-o", os.devnull]
    return subprocess.run(command, capture_output=True, text=True, check=False).stderr


def run_instrumented(tree: Path, flags: str) -> bool:
    for part in (
        "firmware_protocol",
        "tests/firmware_protocol",
        "tests/drivers",
        "tests/conftest.py",
        "tests/tables.py",
        "drivers",
        "docs",
        "tools",
        "pyproject.toml",
        "setup.py",
    ):
        source, target = ROOT / part, tree / part
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("*.so", "*.o", "__pycache__", "_firmware.c"))
        else:
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target)
    environment = os.environ | {"CFLAGS": flags, "LDFLAGS": flags, "PYTHONPATH": str(tree)}
    build = [sys.executable, "firmware_protocol/build_firmware.py"]
    subprocess.run(build, cwd=tree, env=environment, check=True, capture_output=True)
    # Those of ports and of the emulated board build their own firmware, and want more of the project than is here.
    others = [f"--ignore=tests/firmware_protocol/{part}" for part in ("emulated", "ports")]
    tests = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-m", "not long", *others]
    return subprocess.run([*tests, "tests/firmware_protocol"], cwd=tree, env=environment, check=False).returncode == 0


def coverage_of(tree: Path, name: str) -> Coverage:
    notes = next(tree.rglob(f"{Path(name).stem}.gcno"))
    command = ["gcov", "--json-format", "--stdout", "--branch-probabilities", str(notes)]
    output = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=True).stdout
    file = next(file for file in json.loads(output)["files"] if file["file"].endswith(f"firmware/{name}"))
    lines = {line["line_number"]: line for line in file["lines"]}
    branches = [
        (number, branch) for number, line in lines.items() for branch in line["branches"] if not branch["throw"]
    ]
    return Coverage(
        name=name,
        lines=len(lines),
        missed_lines=tuple(number for number, line in lines.items() if not line["count"]),
        branches=len(branches),
        missed_branches=tuple(number for number, branch in branches if not branch["count"]),
    )


def build_harness(folder: Path, replaced: dict[str, Path] | None = None) -> Path:
    """Compile the sanitizers' harness into `folder`; `replaced` gives other files in the place of sources, by name."""
    harness = folder / "harness"
    firmware = ROOT / "firmware_protocol" / "firmware"
    sources = [str((replaced or {}).get(name, firmware / name)) for name in SOURCES]
    command = ["cc", "-std=c99", "-O1", "-g", *HARNESS_SANITIZERS]
    subprocess.run([*command, f"-I{firmware}", str(HARNESS), *sources, "-o", str(harness), "-lm"], check=True)
    return harness


def run_harness(
    harness: Path, cycles: int, frames: int, authenticated: bool, timeout_s: float | None = None
) -> subprocess.CompletedProcess[str]:
    """Run the harness; its status is 0 if all was sound.

    So many cycles of a host and mad measurements, then random frames.
    """
    return subprocess.run(
        [str(harness), str(cycles), str(frames), "1" if authenticated else "0"],
        capture_output=True, text=True, check=False, timeout=timeout_s,
        env=os.environ | {"ASAN_OPTIONS": "detect_leaks=0"},
    )  # fmt: skip


def flood(folder: Path) -> bool:
    """Send ten million random frames through the core, half of them in authenticated mode, under the sanitizers."""
    harness = build_harness(folder)
    sound = True
    for authenticated in (False, True):
        ran = run_harness(harness, FLOOD_CYCLES, FLOOD_FRAMES, authenticated)
        print(f"random frames, authenticated {authenticated}: BOOT to ESTOP, frames: {ran.stdout.strip()}{ran.stderr}")
        sound &= ran.returncode == 0
    return sound


def main() -> int:
    """Check everything but the mutants, which are `tools.firmware_mutants`' part."""
    failed = False
    for name in HAND_WRITTEN:
        if found := warnings_of(name):
            print(found)
            failed = True
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        failed |= not run_instrumented(tree / "sanitized", SANITIZE)
        failed |= not run_instrumented(tree / "covered", COVER)
        results = [coverage_of(tree / "covered", name) for name in HAND_WRITTEN]
        failed |= not flood(tree)
    print(f"{'file':<16}{'lines':>7}{'missed':>8}{'branches':>10}{'missed':>8}")
    for result in results:
        print(
            f"{result.name:<16}{result.lines:>7}{len(result.missed_lines):>8}"
            f"{result.branches:>10}{len(result.missed_branches):>8}"
            + (f"   lines {result.missed_lines}" if result.missed_lines else "")
            + (f"   branches in {sorted(set(result.missed_branches))}" if result.missed_branches else "")
        )
    lines, missed = sum(r.lines for r in results), sum(len(r.missed_lines) for r in results)
    branches, dead = sum(r.branches for r in results), sum(len(r.missed_branches) for r in results)
    print(f"lines {1 - missed / lines:.1%}, branches {1 - dead / branches:.1%}")
    failed |= missed > 0 or dead > 0
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
