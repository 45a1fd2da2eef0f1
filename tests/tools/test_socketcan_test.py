"""`make socketcan-test` emulates the kind of machine that it runs on: this very Python runs in the guest."""

import shutil
from pathlib import Path

import pytest

from tools.check import socketcan_test as of_socketcan


@pytest.mark.parametrize(
    ("machine", "program", "console"),
    [("x86_64", "qemu-system-x86_64", "console=ttyS0"), ("aarch64", "qemu-system-aarch64", "console=ttyAMA0")],
)
def test_the_emulator_is_of_this_machines_kind(monkeypatch, machine, program, console):
    monkeypatch.setattr(of_socketcan.platform, "machine", lambda: machine)
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    command = of_socketcan.boot_command(of_socketcan.emulator_here(), Path("/unpacked"), "6.1", Path("/image"))
    assert command[0] == program
    assert command[command.index("-append") + 1].startswith(console)
    assert ("virt" in command) == (machine == "aarch64")


def test_no_other_machine_is_emulated(monkeypatch):
    monkeypatch.setattr(of_socketcan.platform, "machine", lambda: "riscv64")
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    with pytest.raises(of_socketcan.CannotError, match="skipped"):
        of_socketcan.emulator_here()
