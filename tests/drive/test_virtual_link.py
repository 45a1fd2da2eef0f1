"""Tests of which links may be driven unattended."""

import os

import pytest

from disco_hw.config import Link
from disco_hw.drive.drive_command import leads_to_virtual_robot


@pytest.mark.parametrize(
    ("link", "virtual"),
    [
        (Link(interface="unixcan", channel="/tmp/x.can"), True),
        (Link(interface="virtual", channel="0"), True),
        (Link(interface="socketcan", channel="vcan0"), True),
        (Link(interface="socketcan", channel="can0"), False),
        (Link(interface="slcan", channel="/dev/ttyACM0"), False),
        (Link(kind="serial", port="/dev/ttyUSB0"), False),
        (Link(kind="serial", interface="unixcan", port="/dev/ttyS0"), False),
    ],
)
def test_only_what_is_surely_virtual_counts(link, virtual):
    assert leads_to_virtual_robot(link) is virtual


def test_a_pseudo_terminal_is_virtual_by_any_name(tmp_path):
    master, slave = os.openpty()
    (tmp_path / "robot.tty").symlink_to(os.ttyname(slave))
    assert leads_to_virtual_robot(Link(kind="serial", port=str(tmp_path / "robot.tty")))
    os.close(master)
    os.close(slave)
    (tmp_path / "gone.tty").symlink_to(tmp_path / "nothing")
    assert not leads_to_virtual_robot(Link(kind="serial", port=str(tmp_path / "gone.tty")))
