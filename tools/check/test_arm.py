"""`make test-arm`: firmware core, estimation and every kernel against its oracle, on aarch64.

On such a computer the tests simply run. Elsewhere a Debian of that architecture is unpacked into build/arm64, from the
mirrors that this machine's own apt is set up with, and its Python runs under QEMU's user emulation as if it were this
machine's. Wheels come by this machine's pip as it is configured. Needs root, and a Debian here. Exits with what pytest
said, 2 with one line where it cannot be done. `make clean` removes all but the two packages that are installed here.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from collections.abc import Sequence
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]
BUILD = PROJECT / "build" / "arm64"
ROOT, WHEELS = BUILD / "root", BUILD / "wheels"
# Where they lie in the root. The sources are a copy: what is compiled beside them is of the other architecture.
SOURCES, PACKAGES, KERNELS = "disco-hw", "packages", "kernels"

BINFMT = Path("/proc/sys/fs/binfmt_misc")
EMULATOR = Path("/usr/lib/binfmt.d/qemu-aarch64.conf")
TOOLS = {"mmdebstrap": "mmdebstrap", "qemu-aarch64-static": "qemu-user-static"}
# Unpacked alone: no script of a package runs, which would take minutes under emulation.
UNPACKED = "python3,python3-dev,gcc,libc6-dev,base-files,coreutils,dash,sed,grep"

# torch has no wheel for ARM without CUDA's packages, viser is the page's; these tests need neither.
LEFT_OUT = ("torch", "viser")
FOR_TESTS = (
    *("pytest", "pytest-timeout", "pytest-xdist", "hypothesis"),
    *("setuptools", "cantools", "crccheck", "jsonschema"),
)
# Handed out as source alone.
COMPILED_THERE = "cobs"
WHEELS_FOR = [f"--platform=manylinux_2_{minor}_aarch64" for minor in (34, 31, 28, 27, 26, 24, 17)]

# The processor of a Raspberry Pi 4: what is compiled for it runs on all later ones.
PROCESSOR = "cortex-a72"
TESTS = (
    "tests/firmware_protocol",
    "tests/estimation",
    "tests/control/kernel",
    "tests/control/test_oracle.py",
    "tests/control/test_pendulum.py",
    "tests/model",
    "tests/effects/test_effects.py",
    "tests/jit",
    "tests/inference/test_simulate.py",
    "tests/inference/test_estimates.py",
    "tests/gap/data/test_free_runs.py",
    "tests/gap/noise/test_noise.py",
)
# Under emulation a kernel compiles for minutes: each test is named when it has ended.
PYTEST = (
    *("-n", "2", "--dist", "loadscope", "-m", "not long and not browser"),
    *("--timeout=3000", "--durations=10", "-rs", "-vv"),
)


class CannotError(Exception):
    """Why it cannot be done here, in one line."""


def run(*command: str, **options: object) -> str:
    """Return the output of a command. Raises CannotError with the last line of it where it fails."""
    both = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, **options}
    done = subprocess.run(command, check=False, **both)  # type: ignore[call-overload]
    if done.returncode:
        output_lines = done.stdout.strip().splitlines() or ["it said nothing"]
        raise CannotError(f"{' '.join(command)[:100]}: {output_lines[-1]}")
    return str(done.stdout)


def mirrors(targets: str) -> list[str]:
    """Lines of apt for the Debian among `ADDRESS|RELEASE|COMPONENT|ORIGIN` lines, each once."""
    rows = [line.split("|") for line in targets.splitlines()]
    return list(dict.fromkeys(f"deb {row[0]} {row[1]} {row[2]}" for row in rows if row[3] == "Debian"))


def requirements(project: str) -> list[str]:
    """Return the packages that these tests need as wheels, by the text of a pyproject.toml."""
    dependencies = tomllib.loads(project)["project"]["dependencies"]
    others = (*LEFT_OUT, COMPILED_THERE)
    return [one for one in dependencies if re.split(r"[<>=\[ ]", one)[0] not in others] + list(FOR_TESTS)


def get_tools() -> None:
    """The emulator and what unpacks a Debian, from Debian."""
    missing = [package for tool, package in TOOLS.items() if shutil.which(tool) is None]
    if os.geteuid() != 0:
        raise CannotError("needs root to enter a Debian of another architecture; run: sudo make test-arm")
    if shutil.which("apt-get") is None:
        raise CannotError("needs Debian's apt-get to unpack its arm64, and this is no Debian; skipped")
    if missing:
        print(f"installing {', '.join(missing)}", flush=True)
        run("apt-get", "-qq", "update")
        run("apt-get", "-qq", "-y", "--no-install-recommends", "install", *missing)


def inside(*command: str, folder: str = SOURCES) -> list[str]:
    """A command that runs in the root. What is mounted there is seen by it alone, and gone with it."""
    variables = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root", "LC_ALL": "C.UTF-8", "TMPDIR": "/tmp"}
    variables |= {"PYTHONPATH": f"/{PACKAGES}", "NUMBA_CACHE_DIR": f"/{KERNELS}", "NUMBA_CPU_NAME": PROCESSOR}
    variables |= {"QEMU_CPU": PROCESSOR, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    mounts = ("-t proc proc $0/proc", "--rbind /dev $0/dev", "-t tmpfs tmpfs $0/dev/shm", "-t tmpfs tmpfs $0/tmp")
    enter = " && ".join(f"mount {one}" for one in mounts) + ' && exec chroot "$0" env -i "$@"'
    alone = ("unshare", "--mount", "--propagation=private", "--pid", "--fork", "--kill-child")
    given = (f"--chdir=/{folder}", *(f"{name}={value}" for name, value in variables.items()))
    return [*alone, "sh", "-c", enter.replace("$0/", '"$0"/'), str(ROOT), *given, *command]


def unpack_debian() -> None:
    """Make the root, if there is none."""
    if ROOT.exists():
        return
    listed = "$(REPO_URI)|$(RELEASE)|$(COMPONENT)|$(ORIGIN)"
    lines = mirrors(run("apt-get", "indextargets", "--format", listed, "Created-By: Packages"))
    if not lines:
        raise CannotError("apt knows no Debian to take arm64 packages from; run: apt-get update")
    release = min((line.split()[2] for line in lines), key=len)
    print(f"unpacking Debian {release} for arm64", flush=True)
    half = BUILD / "root.half"
    shutil.rmtree(half, ignore_errors=True)
    BUILD.mkdir(parents=True, exist_ok=True)
    options = ("--arch=arm64", "--variant=extract", "--skip=check/qemu", f"--include={UNPACKED}")
    alone = ("unshare", "--mount", "--propagation=private")
    run(*alone, "mmdebstrap", *options, release, str(half), *lines)
    half.rename(ROOT)


def let_kernel_run_arm64() -> None:
    """Have the kernel hand programs of the other architecture to the emulator, until the next boot."""
    try_it = inside("true", folder="")
    if subprocess.run(try_it, capture_output=True, check=False).returncode == 0:
        return
    try:
        if not (BINFMT / "register").exists():
            run("mount", "-t", "binfmt_misc", "binfmt_misc", str(BINFMT))
        (BINFMT / "register").write_bytes(EMULATOR.read_bytes())
        run(*try_it)
    except (OSError, CannotError) as error:
        where = "in a container, run on its host, as root"
        message = f"no program of aarch64 runs here ({error}); {where}: apt-get install qemu-user-static"
        raise CannotError(message) from error


def install_wheels() -> None:
    """Have what the project and its tests import in the root, but what cannot be had as wheels."""
    required, constraints = requirements((PROJECT / "pyproject.toml").read_text("utf-8")), PROJECT / "constraints.txt"
    key = hashlib.sha256("\n".join([*required, constraints.read_text("utf-8")]).encode()).hexdigest()
    packages = ROOT / PACKAGES
    done = packages / ".installed"
    if done.exists() and done.read_text("utf-8") == key:
        return
    print("downloading wheels", flush=True)
    shutil.rmtree(packages, ignore_errors=True)
    version = (ROOT / "usr" / "bin" / "python3").readlink().name.removeprefix("python")
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    of_root = (*WHEELS_FOR, f"--python-version={version}", "--implementation=cp", "--only-binary=:all:")
    limits = {**os.environ, "PIP_CONSTRAINT": str(constraints)}
    run(*pip, "download", "--dest", str(WHEELS), *of_root, *required, env=limits)
    run(*pip, "download", "--dest", str(WHEELS), "--no-deps", "--no-binary=:all:", COMPILED_THERE, env=limits)
    local = ("--no-index", "--find-links", str(WHEELS), "--no-compile", "--target", str(packages))
    run(*pip, "install", *local, *of_root, *required, env=limits)
    (source,) = WHEELS.glob(f"{COMPILED_THERE}-*.tar.gz")
    with tarfile.open(source) as archive:
        archive.extractall(ROOT / "src", filter="data")
    run(*inside("python3", "setup.py", "-q", "build", f"--build-lib=/{PACKAGES}", folder=f"src/{source.name[:-7]}"))
    done.write_text(key, "utf-8")


def build_project() -> None:
    """Copy what git would keep of the sources, as they are now, and compile the firmware's core beside them."""
    print("building the firmware's core", flush=True)
    target = ROOT / SOURCES
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir()
    kept = run("git", "ls-files", "--cached", "--others", "--exclude-standard", cwd=PROJECT).splitlines()
    there = "\n".join(name for name in kept if (PROJECT / name).exists())
    run("sh", "-c", 'tar -cf - -T - | tar -xf - -C "$0"', str(target), input=there, cwd=PROJECT)
    run(*inside("python3", "setup.py", "-q", "egg_info", "build_ext", "--inplace"))


def main(arguments: Sequence[str]) -> int:
    """Run the tests that are named, or all that are for this."""
    pytest = ("-m", "pytest", "-p", "no:cacheprovider", *PYTEST, *(arguments or TESTS))
    if platform.machine() == "aarch64":
        return subprocess.run([sys.executable, *pytest], cwd=PROJECT, check=False).returncode
    try:
        get_tools()
        unpack_debian()
        let_kernel_run_arm64()
        install_wheels()
        build_project()
    except CannotError as error:
        print(f"test-arm: {error}", file=sys.stderr)
        return 2
    return subprocess.run(inside("python3", *pytest), check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
