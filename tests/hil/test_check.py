"""`disco-hw check` with a virtual robot in real time and with none."""

from __future__ import annotations

import re

import pytest

from tests.hil.stack import disco, disco_json_here, virtual_robot
from tools.stack import write_robot_file

pytestmark = pytest.mark.hil


def assert_check_passes(robot_file) -> None:
    """Check the robot that runs at the file's address, and what is reported of it."""
    code, report, _ = disco_json_here("check", str(robot_file))
    levels = {check["name"]: check["level"] for check in report["checks"]}
    failed = {name for name, level in levels.items() if level == "fail"}
    # How soon a busy machine answers is not for a test to judge.
    assert failed <= {"round trip"}, report
    assert code == bool(failed)
    assert levels["link"] == "ok"
    assert levels["firmware"] == "ok"
    assert levels["firmware limits"] == "ok"
    assert levels["link load"] == "ok"
    assert "median" in next(check["text"] for check in report["checks"] if check["name"] == "round trip")
    assert levels["wheels"] == "ok"
    telemetry = next(check["text"] for check in report["checks"] if check["name"] == "telemetry")
    wheels, poses = map(int, re.findall(r"\d+", telemetry)[:2])
    assert 90 <= wheels <= 101
    assert 20 <= poses <= 26


# tests/hil/test_drive.py checks a robot on CAN before it drives it.
@pytest.mark.long
def test_check_passes_with_a_robot_on_a_serial_line(tmp_path):
    robot_file = write_robot_file(tmp_path, link="serial")
    with virtual_robot(robot_file):
        assert_check_passes(robot_file)


@pytest.mark.thorough
def test_check_fails_without_a_robot_and_says_what_to_do(tmp_path):
    code, output = disco("check", str(write_robot_file(tmp_path)))
    assert code == 1
    assert "fail  link" in output
    assert 'adaptation: fast, as control.adaptation = "auto"' in output
