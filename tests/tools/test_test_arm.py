"""What `make test-arm` asks for, and what it says where it cannot be had."""

import os
import shutil
from pathlib import Path

import pytest

from tools.check import test_arm as arm

PROJECT = Path(arm.__file__).parents[2]


def test_mirrors_are_those_of_the_machines_own_debian():
    apt_sources = (
        "http://one.example/debian/|bookworm|main|Debian\n"
        "http://one.example/debian/|bookworm|main|Debian\n"
        "http://two.example/|nodistro|main|Others\n"
        "http://one.example/security/|bookworm-security|main|Debian\n"
    )
    assert arm.mirrors(apt_sources) == [
        "deb http://one.example/debian/ bookworm main",
        "deb http://one.example/security/ bookworm-security main",
    ]


def test_what_has_no_wheel_is_not_asked_for():
    requirements = arm.requirements('[project]\ndependencies = ["numba>=0.61", "torch>=2.6", "cobs>=1.2", "click<9"]')
    assert requirements[:2] == ["numba>=0.61", "click<9"]
    assert not {"torch>=2.6", "cobs>=1.2"} & set(requirements)
    assert "pytest" in requirements


def test_the_named_tests_are_there():
    assert all((PROJECT / name).exists() for name in arm.TESTS)


@pytest.mark.parametrize(
    ("user", "tool", "expected_error"), [(1000, "/bin/tool", "run: sudo make test-arm"), (0, None, "this is no Debian")]
)
def test_where_it_cannot_be_done_it_says_so_in_one_line(monkeypatch, capsys, user, tool, expected_error):
    monkeypatch.setattr(arm.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(os, "geteuid", lambda: user)
    monkeypatch.setattr(shutil, "which", lambda name: tool)
    assert arm.main([]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert expected_error in line
