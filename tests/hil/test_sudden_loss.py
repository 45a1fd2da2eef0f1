"""Whatever takes the commands away at full speed, the robot stops by itself, and nothing starts it again.

So does an e-stop, after whose reset the robot can be driven again.
"""

from __future__ import annotations

import os
import signal
import time

import pytest

from disco_hw.log.log_command import info
from disco_hw.log.reader import open_log
from tests.hil.stack import assert_stopped_in_time
from tests.hil.test_estop import assert_latched, latch_and_reset
from tools.stack import running_stack

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
    ("link", "faults"),
    [
        ("can", ["estop", "unplug", "bus_off", "babble_flood", "SIGKILL"]),
        # After it a pose that has jumped may rightly stop the next drive.
        ("can", ["SIGSTOP"]),
        pytest.param("can", ["babble_commands"], marks=pytest.mark.long),
        pytest.param("serial", ["SIGKILL"], marks=pytest.mark.long),
        pytest.param("serial", ["unplug"], marks=pytest.mark.thorough),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value),
)
def test_the_robot_stops_and_stays(tmp_path, link, faults):
    """One fault after the other, each on a drive of its own."""
    spans_s, replied_s = [], None
    with running_stack(tmp_path, link=link) as stack:
        for fault in faults:
            begin_s = time.monotonic()
            stack.drive()
            if fault == "estop":
                replied_s = latch_and_reset(stack, "healthy")
                reset_s = time.monotonic()
                continue
            cut_s = time.monotonic()
            strike(stack, fault)
            time.sleep(1.3)
            mend(stack, fault)
            # Half a second is enough to connect and to shake hands in.
            time.sleep(0.6)
            if fault != "SIGKILL":
                assert stack.operator.status()["state"] != "ARMED", fault
            spans_s.append((begin_s, cut_s, time.monotonic()))
        rows = stack.truth()
    if replied_s is not None:
        assert_latched([row for row in rows if row.t_s < reset_s], replied_s)
    for begin_s, cut_s, end_s in spans_s:
        assert_stopped_in_time([row for row in rows if begin_s < row.t_s < end_s], cut_s)
    if faults[-1] == "SIGKILL":
        text = info(tmp_path / "run.mcap", as_json=False)
        assert "ended properly" not in text
        assert "the daemon or its recorder had ended" in text
    with open_log(tmp_path / "run.mcap") as log:
        # At 50 Hz the drive takes dozens of ticks; whatever became of the daemon, they can be read back.
        driven = log.columns("/command")["source"] == "plan"
        assert driven.sum() > 10
        assert {"robot.toml", "model.toml", "disco_robot.dbc"} <= set(log.summary().attachments)
