import subprocess

import pytest

from firmware_protocol.build_firmware import PACKAGE, SOURCES
from tests.firmware_protocol.bench import Bench
from tools.check.firmware_check import HARNESS_SANITIZERS


@pytest.fixture
def bench():
    """A controller that has just started."""
    return Bench()


@pytest.fixture(scope="session")
def compiled_core(tmp_path_factory):
    """The compiler's flags, and the core's objects made with them: with the sanitizers if this compiler has them."""
    folder = tmp_path_factory.mktemp("core")
    probe = folder / "probe.c"
    probe.write_text("int main(void) { return 0; }\n")
    tried = subprocess.run(
        ["cc", *HARNESS_SANITIZERS, str(probe), "-o", str(folder / "probe")], capture_output=True, check=False
    )
    sanitizers = () if tried.returncode else HARNESS_SANITIZERS
    firmware = PACKAGE / "firmware"
    flags = ("-std=c99", "-O0", "-g1", "-Wall", "-Wextra", "-Werror", f"-I{firmware}", *sanitizers)
    subprocess.run(["cc", *flags, "-c", *(str(firmware / name) for name in SOURCES)], cwd=folder, check=True)
    return flags, sorted(map(str, folder.glob("*.o")))
