"""The core, compiled as a C program with the undefined-behaviour and address sanitizers, on random frames."""

import subprocess

import pytest

from tests.tables import thinned
from tools.check.firmware_check import HARNESS, HARNESS_SANITIZERS, run_harness

CYCLES = 30_000
pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def harness(compiled_core, tmp_path_factory):
    flags, objects = compiled_core
    if not set(HARNESS_SANITIZERS) <= set(flags):
        pytest.skip("this compiler has no sanitizers")
    program = tmp_path_factory.mktemp("harness") / "harness"
    subprocess.run(["cc", *flags, str(HARNESS), *objects, "-o", str(program), "-lm"], check=True)
    return program


@thinned("authenticated", [True, False], quick=1)
def test_no_undefined_behaviour_and_no_stray_access(harness, authenticated):
    """30 simulated seconds each; in a flood 20 random frames a millisecond. `make firmware-check` sends 10 million."""
    ran = run_harness(harness, CYCLES, 20, authenticated)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    _boot, standby, ready, armed, stopping, fault, estop, frames = map(int, ran.stdout.split())
    assert min(standby, ready, armed, stopping, fault, estop) > 50, ran.stdout
    assert frames > CYCLES * 2
