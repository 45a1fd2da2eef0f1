"""`make socketcan-test` emulates an x86-64 alone: this very Python runs in the guest."""

import shutil

import pytest

from tools.check import socketcan_test as of_socketcan


def test_no_other_machine_is_emulated(monkeypatch):
    monkeypatch.setattr(of_socketcan.platform, "machine", lambda: "riscv64")
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    with pytest.raises(of_socketcan.CannotError, match="skipped"):
        of_socketcan.fetch()
