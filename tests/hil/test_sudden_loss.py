"""Whatever takes the commands away at full speed, the robot stops by itself, and nothing starts it again."""

from __future__ import annotations

import os
import signal
import time

import pytest

from disco_hw.experiments.live_stack import running_stack
from disco_hw.log.reader import open_log
from tests.hil.stack import assert_stopped_in_time

pytestmark = pytest.mark.hil


def strike(stack, fault: str) -> None:
    match fault:
        case "SIGKILL" | "SIGSTOP":
            os.kill(stack.daemon.process.pid, getattr(signal, fault))
        case "unplug":
            assert stack.inject("unplug 1.0") == "ok"
        case "bus_off":
            assert stack.inject("bus_off host") == "ok"
        case "babble_commands":
            assert stack.inject(f"babble {0x100:#x} 400") == "ok"
        case "babble_flood":
            assert stack.inject("babble 0x000 100000") == "ok"


def mend(stack, fault: str) -> None:
    if fault == "SIGSTOP":
        os.kill(stack.daemon.process.pid, signal.SIGCONT)
    if fault.startswith("babble"):
        assert stack.inject("babble 0x000 0") == "ok"


@pytest.mark.parametrize(
    ("link", "fault"),
    [
        ("can", "SIGKILL"),
        ("can", "SIGSTOP"),
        ("can", "unplug"),
        ("can", "bus_off"),
        pytest.param("can", "babble_commands", marks=pytest.mark.long),
        ("can", "babble_flood"),
        pytest.param("serial", "SIGKILL", marks=pytest.mark.long),
        ("serial", "unplug"),
    ],
)
def test_the_robot_stops_and_stays(tmp_path, link, fault):
    with running_stack(tmp_path, link=link) as stack:
        stack.drive()
        cut_s = time.monotonic()
        strike(stack, fault)
        time.sleep(1.3)
        mend(stack, fault)
        time.sleep(1.2)
        if fault != "SIGKILL":
            assert stack.operator.status()["state"] != "ARMED"
        assert_stopped_in_time(stack.truth(), cut_s)
    with open_log(tmp_path / "run.mcap") as log:
        # At 50 Hz the drive takes dozens of ticks; whatever became of the daemon, they can be read back.
        driven = log.columns("/command")["source"] == "plan"
        assert driven.sum() > 10
        assert {"robot.toml", "model.toml", "disco_robot.dbc"} <= set(log.summary().attachments)
