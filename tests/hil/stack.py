"""Checks of the whole stack after a fault, and the command as a user runs it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any
from unittest import mock

from disco_hw.cli import main
from disco_hw.experiments import READY_TIMEOUT_S, Child, disco_hw_process
from tests.drivers.waiting import wait_until
from tools.stack import TruthRow

STATIONARY_RAD_S = 0.05
COMMAND_TIMEOUT_S = 0.1
DECELERATION_RAD_S2 = 20.0
# The motors follow their setpoint with a lag of 0.06 s: from 8 rad/s that takes 0.21 s after the ramp has ended.
MOTOR_SETTLING_S = 0.3


def disco(*arguments: str, timeout_s: float = 60.0) -> tuple[int, str]:
    """Run the command `disco-hw` to its end; returns the exit code and all that it printed."""
    result = _run(arguments, timeout_s)
    return result.returncode, result.stdout + result.stderr


def disco_json(*arguments: str, timeout_s: float = 60.0) -> tuple[int, dict[str, Any]]:
    """Run the command `disco-hw` with `--json`; returns the exit code and the parsed standard output.

    Standard error is not parsed: it has lines for people, such as "compiling ...".
    """
    result = _run((*arguments, "--json"), timeout_s)
    assert result.stdout, result.stderr
    return result.returncode, json.loads(result.stdout)


def disco_here(*arguments: str) -> tuple[int, str]:
    """Run the command `disco-hw` in this process, which has imported it; returns the exit code and all it printed."""
    printed = StringIO()
    return _run_here(arguments, printed, printed), printed.getvalue()


def disco_json_here(*arguments: str) -> tuple[int, dict[str, Any], str]:
    """As `disco_here`, with `--json`; returns the exit code, the parsed standard output, and the standard error."""
    output, errors = StringIO(), StringIO()
    code = _run_here((*arguments, "--json"), output, errors)
    assert output.getvalue(), errors.getvalue()
    return code, json.loads(output.getvalue()), errors.getvalue()


@contextmanager
def virtual_robot(robot_file: Path, *arguments: str) -> Iterator[Child]:
    """Run `disco-hw sim`, which prints to a file beside the robot's, within the block; yield once it is ready."""
    output = robot_file.with_name("sim.txt")
    with disco_hw_process("virtual robot", ["sim", str(robot_file), *arguments], output) as robot:
        wait_until(lambda: "ready" in robot.output_lines(), READY_TIMEOUT_S)
        yield robot


def _run_here(arguments: tuple[str, ...], output: StringIO, errors: StringIO) -> int:
    with mock.patch.object(sys, "argv", ["disco-hw", *arguments]), redirect_stdout(output), redirect_stderr(errors):
        try:
            main()
        except SystemExit as end:
            return int(end.code or 0)
    return 0


def _run(arguments: tuple[str, ...], timeout_s: float) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "disco_hw", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)


def assert_stopped_in_time(rows: list[TruthRow], cut_s: float) -> None:
    """The wheels stand within 0.1 s plus the deceleration after the last accepted command, and for the rest of the run.

    `cut_s` is when the fault struck; the robot must have been moving then.
    """
    moving = [row for row in rows if row.t_s <= cut_s]
    assert moving, "the fault came before the truth"
    assert moving[-1].fastest > 5.0, "the robot was not at speed when the fault struck"
    final = rows[-1].accepted
    last_accepted = next(row for row in rows if row.accepted == final)
    # The firmware still slews towards the last command while it waits for the next one.
    requested_rad_s = [
        row.requested for row in rows if last_accepted.t_s <= row.t_s <= last_accepted.t_s + COMMAND_TIMEOUT_S
    ]
    ramp_s = max(requested_rad_s) / DECELERATION_RAD_S2
    zero_requested_s = last_accepted.t_s + COMMAND_TIMEOUT_S + ramp_s + 0.02
    stationary_s = zero_requested_s + MOTOR_SETTLING_S
    later_requests = [row for row in rows if row.t_s > zero_requested_s and row.requested > 1e-6]
    assert not later_requests, (
        f"asked for {later_requests[0].requested} rad/s {later_requests[0].t_s - last_accepted.t_s:.3f} s later"
    )
    turning = [row for row in rows if row.t_s > stationary_s and row.fastest >= STATIONARY_RAD_S]
    assert not turning, f"{turning[0].fastest} rad/s {turning[0].t_s - last_accepted.t_s:.3f} s later"
    assert rows[-1].t_s > stationary_s + 0.5, "the truth ends too early to judge"
