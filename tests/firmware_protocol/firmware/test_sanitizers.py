"""The core, compiled as a C program with the undefined-behaviour and address sanitizers, on random frames."""

import subprocess
from pathlib import Path

import pytest

from firmware_protocol.build_firmware import PACKAGE, SOURCES

CYCLES = 100_000
pytestmark = pytest.mark.timeout(300)
SANITIZE = ["-fsanitize=undefined,address", "-fno-sanitize-recover=all"]


def compile_c(source: Path, target: Path, *options: str) -> subprocess.CompletedProcess:
    firmware = [str(PACKAGE / "firmware" / name) for name in SOURCES] if source.name != "probe.c" else []
    command = ["cc", "-std=c99", "-O1", "-g", *options, f"-I{PACKAGE / 'firmware'}", str(source), *firmware]
    return subprocess.run([*command, "-o", str(target), "-lm"], capture_output=True, text=True, check=False)


def build_harness(folder: Path) -> Path | None:
    """Return the harness with the sanitizers in it, None if this compiler has none."""
    probe = folder / "probe.c"
    probe.write_text("int main(void) { return 0; }\n")
    if compile_c(probe, folder / "probe", *SANITIZE).returncode:
        return None
    built = compile_c(Path(__file__).with_name("sanitizer_harness.c"), folder / "harness", *SANITIZE)
    assert built.returncode == 0, built.stderr
    return folder / "harness"


@pytest.fixture(scope="module")
def harness(tmp_path_factory):
    built = build_harness(tmp_path_factory.mktemp("harness"))
    if built is None:
        pytest.skip("this compiler has no sanitizers")
    return built


@pytest.mark.parametrize("authenticated", ["0", "1"])
def test_no_undefined_behaviour_and_no_stray_access(harness, authenticated):
    """100 simulated seconds each; in a flood 20 random frames a millisecond. `make firmware-check` sends 10 million."""
    ran = subprocess.run(
        [str(harness), str(CYCLES), "20", authenticated],
        capture_output=True,
        text=True,
        check=False,
        env={"ASAN_OPTIONS": "detect_leaks=0"},
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    _boot, standby, ready, armed, stopping, fault, estop, frames = map(int, ran.stdout.split())
    assert min(standby, ready, armed, stopping, fault, estop) > 50, ran.stdout
    assert frames > CYCLES * 2
