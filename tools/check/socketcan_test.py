"""Tests the CAN transport against Linux's SocketCAN: on this kernel if it has vcan, else on Debian's in an emulator.

The emulator is QEMU without KVM, so that it runs everywhere; it sees this machine's files read-only, and this very
Python runs in it. What it needs comes from Debian by apt-get and stays in build/socketcan. Needs root, and there a
Debian or Ubuntu on x86-64. Exits with what pytest said, 2 with one line where it cannot be done.
"""

import contextlib
import os
import platform
import re
import shutil
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

from tools.check.test_arm import CannotError, run

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "build" / "socketcan"
INTERFACE = "vcan0"


EMULATOR, KERNEL = "qemu-system-x86_64", "linux-image-amd64"
# Programs, and the packages that have them.
TOOLS = {
    EMULATOR: "qemu-system-x86",
    "busybox": "busybox-static",
    "cpio": "cpio",
    "depmod": "kmod",
    "ip": "iproute2",
}
FOR_ROOT_FILES = ("virtio_pci", "9p", "9pnet_virtio")
FOR_TESTS = ("can", "can-raw", "can-dev", "vcan", "slcan")
BOOT_AND_TEST_S = 1200
PYTEST = (
    *("-m", "pytest", "-p", "no:cacheprovider", "--color=no", "--tb=short"),
    *("tests/socketcan", "--timeout=200", "-rs"),
)


def kernel_has_vcan() -> bool:
    """Make a virtual CAN interface, if this kernel can."""
    if Path("/sys/class/net", INTERFACE).exists():
        return True
    with contextlib.suppress(CannotError, OSError):
        run("modprobe", "-q", "vcan")
    try:
        run("ip", "link", "add", "dev", INTERFACE, "type", "vcan")
        run("ip", "link", "set", INTERFACE, "up")
    except (CannotError, OSError):
        return False
    return True


def fetch() -> tuple[Path, str]:
    """Get the tools and Debian's kernel; return where it is unpacked, and its release."""
    if platform.machine() != "x86_64" or shutil.which("apt-get") is None:
        raise CannotError("this kernel has no vcan, and the emulator is prepared for Debian on x86-64; skipped")
    missing = [package for tool, package in TOOLS.items() if shutil.which(tool) is None]
    if missing:
        run("apt-get", "update", "-qq")
        run("apt-get", "install", "-y", "-qq", "--no-install-recommends", *missing)
    dependencies = run("apt-cache", "depends", KERNEL)
    found = re.search(r"Depends: linux-image-(\S+)", dependencies)
    if found is None:
        raise CannotError(f"apt-cache knows no {KERNEL}; run apt-get update")
    release = found.group(1)
    unpacked = BUILD / release
    if not (unpacked / "boot" / f"vmlinuz-{release}").exists():
        BUILD.mkdir(parents=True, exist_ok=True)
        run("apt-get", "download", f"linux-image-{release}", cwd=BUILD)
        package = next(BUILD.glob(f"linux-image-{release}_*.deb"))
        run("dpkg", "-x", str(package), str(unpacked))
        package.unlink()
        run("depmod", "-b", str(unpacked), release)
    return unpacked, release


def module_files(unpacked: Path, release: str, names: tuple[str, ...]) -> list[str]:
    """The files of modules and of what they need, in the order in which they must be loaded."""
    files: list[str] = []
    for name in names:
        output = run("modprobe", "-d", str(unpacked), "-S", release, "--show-depends", name)
        files += [line.split()[1] for line in output.splitlines() if line.startswith("insmod")]
    return list(dict.fromkeys(files))


def executable(path: Path, text: str) -> Path:
    """Write an executable script."""
    path.write_text(text, encoding="utf-8")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def initial_ram_disk(unpacked: Path, release: str) -> Path:
    """A busybox that mounts this machine's files over 9p and goes on with the guest's script."""
    tree = BUILD / "initrd"
    shutil.rmtree(tree, ignore_errors=True)
    for folder in ("bin", "mods", "proc", "sys", "dev", "newroot"):
        (tree / folder).mkdir(parents=True)
    shutil.copy(str(shutil.which("busybox")), tree / "bin" / "busybox")
    (tree / "bin" / "sh").symlink_to("busybox")
    files = module_files(unpacked, release, FOR_ROOT_FILES)
    for file in files:
        shutil.copy(file, tree / "mods")
    loads = "\n".join(f"$B insmod /mods/{Path(file).name}" for file in files)
    executable(
        tree / "init",
        f"""#!/bin/sh
B=/bin/busybox
$B mount -t proc p /proc; $B mount -t sysfs s /sys; $B mount -t devtmpfs d /dev
{loads}
$B mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000,cache=loose,ro root /newroot || $B poweroff -f
$B mount --move /dev /newroot/dev; $B mount --move /proc /newroot/proc; $B mount --move /sys /newroot/sys
exec $B switch_root /newroot {BUILD}/guest.sh
""",
    )
    loads = "\n".join(f"busybox insmod {file}" for file in module_files(unpacked, release, FOR_TESTS))
    executable(
        BUILD / "guest.sh",
        f"""#!/bin/sh
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME=/run TMPDIR=/run
export PYTHONDONTWRITEBYTECODE=1 PYTHONPATH={ROOT}
mount -t tmpfs tmpfs /run; mkdir -p /dev/pts /dev/shm; mount -t devpts devpts /dev/pts; mount -t tmpfs tmpfs /dev/shm
{loads}
ip link set lo up; ip link add dev {INTERFACE} type vcan; ip link set {INTERFACE} up
cd {ROOT}
echo "GUEST up after $(cut -d' ' -f1 /proc/uptime) s, kernel $(uname -r)"
{sys.executable} {" ".join(PYTEST)}
echo "GUEST rc=$?"
busybox poweroff -f
""",
    )
    image = BUILD / "initrd.gz"
    run("sh", "-c", f"find . | cpio -o -H newc --quiet | gzip -1 > {image}", cwd=tree)
    return image


def boot_command(unpacked: Path, release: str, image: Path) -> list[str]:
    """Return the command that boots the kernel in the emulator, with this machine's files to read."""
    return [
        EMULATOR, "-accel", "tcg,thread=multi", "-cpu", "max", "-m", "1024", "-smp", "2",
        "-nographic", "-no-reboot", "-nic", "none", "-kernel", str(unpacked / "boot" / f"vmlinuz-{release}"),
        "-initrd", str(image), "-append", "console=ttyS0 quiet panic=-1",
        "-virtfs", "local,path=/,mount_tag=root,security_model=none,readonly=on,multidevs=remap",
    ]  # fmt: skip


def emulate() -> int:
    """Boot, run the tests, come back with their exit status."""
    unpacked, release = fetch()
    command = boot_command(unpacked, release, initial_ram_disk(unpacked, release))
    # A file named kvm may exist and not work: the emulator alone runs everywhere.
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as guest:
        assert guest.stdout is not None
        end = threading.Timer(BOOT_AND_TEST_S, guest.kill)
        end.start()
        status = None
        for raw in guest.stdout:
            line = raw.decode("utf-8", "replace").rstrip()
            found = re.search(r"GUEST rc=(\d+)", line)
            status = int(found.group(1)) if found else status
            print(line, flush=True)
        end.cancel()
    if status is None:
        raise CannotError(f"the emulated machine ended, or {BOOT_AND_TEST_S} s passed, before the tests were done")
    return status


def main() -> int:
    """Test natively or in the emulator."""
    started = time.monotonic()
    try:
        if os.geteuid() != 0:
            raise CannotError(
                "needs root to make a CAN interface or to fetch an emulator; run: sudo make socketcan-test"
            )
        if kernel_has_vcan():
            status = subprocess.run([sys.executable, *PYTEST], cwd=ROOT, check=False).returncode
        else:
            status = emulate()
    except CannotError as error:
        print(f"socketcan-test: {error}", file=sys.stderr)
        return 2
    print(f"{time.monotonic() - started:.0f} s")
    return status


if __name__ == "__main__":
    sys.exit(main())
