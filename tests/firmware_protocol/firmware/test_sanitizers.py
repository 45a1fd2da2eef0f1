"""The core, compiled as a C program with the undefined-behaviour and address sanitizers, on 200 simulated seconds."""

import subprocess
from pathlib import Path

import pytest

from firmware_protocol.build_firmware import PACKAGE, SOURCES

CYCLES = 200_000
SANITIZE = ["-fsanitize=undefined,address", "-fno-sanitize-recover=all"]


def compile_c(source: Path, target: Path, *options: str) -> subprocess.CompletedProcess:
    firmware = [str(PACKAGE / "firmware" / name) for name in SOURCES] if source.name != "probe.c" else []
    command = ["cc", "-std=c99", "-O1", "-g", *options, f"-I{PACKAGE / 'firmware'}", str(source), *firmware]
    return subprocess.run([*command, "-o", str(target), "-lm"], capture_output=True, text=True, check=False)


def test_no_undefined_behaviour_and_no_stray_access(tmp_path):
    probe = tmp_path / "probe.c"
    probe.write_text("int main(void) { return 0; }\n")
    if compile_c(probe, tmp_path / "probe", *SANITIZE).returncode:
        pytest.skip("this compiler has no sanitizers")
    built = compile_c(Path(__file__).with_name("sanitizer_harness.c"), tmp_path / "harness", *SANITIZE)
    assert built.returncode == 0, built.stderr
    ran = subprocess.run(
        [str(tmp_path / "harness"), str(CYCLES)],
        capture_output=True,
        text=True,
        check=False,
        env={"ASAN_OPTIONS": "detect_leaks=0"},
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    _boot, standby, ready, armed, stopping, fault, estop = map(int, ran.stdout.split())
    assert min(standby, ready, armed, stopping, fault, estop) > 50, ran.stdout
