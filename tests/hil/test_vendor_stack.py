"""The whole stack with each vendor's simulated controller: killed, frozen, unplugged, stopped from beside."""

from __future__ import annotations

import os
import signal
import time

import pytest

from disco_hw.experiments import DEVICES
from tests.hil.stack import STATIONARY_RAD_S, disco_json
from tools.stack import running_stack

pytestmark = pytest.mark.hil

ROLLS_S = 6.0
"""Until a robot that coasts stands: the simulated floor takes so long from 6 rad/s."""


def each_device(marks, faults):
    """Every device with every fault, `long` unless `marks` has other ones: what they share, one of them shows."""
    return [
        pytest.param(device, fault, marks=marks.get((device, fault), pytest.mark.long))
        for device in DEVICES
        for fault in faults
    ]


@pytest.mark.parametrize(
    ("device", "fault"), each_device({("odrive", "SIGKILL"): pytest.mark.thorough}, ("SIGKILL", "SIGSTOP", "unplug"))
)
def test_the_robot_stops_and_nothing_arms_again(tmp_path, device, fault):
    with running_stack(tmp_path, device=device) as stack:
        stack.drive()
        cut_s = time.monotonic()
        if fault == "unplug":
            assert stack.inject("unplug 1.0") == "ok"
        else:
            os.kill(stack.daemon.process.pid, getattr(signal, fault))
        time.sleep(2.0)
        if fault == "SIGSTOP":
            os.kill(stack.daemon.process.pid, signal.SIGCONT)
        time.sleep(ROLLS_S - 2.0)
        if fault != "SIGKILL":
            assert stack.operator.status()["state"] != "ARMED"
        rows = stack.truth()
    moving = [row for row in rows if row.t_s <= cut_s]
    assert moving[-1].fastest > 5.0, "the robot was not at speed when the fault struck"
    # What each controller holds at most after the last command, and a little.
    driven = [row for row in rows if row.t_s > cut_s + 0.8 and row.requested > 1e-6]
    assert not driven, f"asked for {driven[0].requested} rad/s {driven[0].t_s - cut_s:.2f} s later"
    stopped = [row for row in rows if row.t_s > cut_s + ROLLS_S - 0.5]
    assert stopped
    assert max(row.fastest for row in stopped) < STATIONARY_RAD_S


@pytest.mark.parametrize(
    ("device", "daemon"), each_device({("vesc", "frozen"): pytest.mark.thorough}, ("healthy", "frozen"))
)
def test_an_estop_from_beside_stops_it_and_is_confirmed(tmp_path, device, daemon):
    with running_stack(tmp_path, device=device) as stack:
        stack.drive()
        if daemon == "frozen":
            os.kill(stack.daemon.process.pid, signal.SIGSTOP)
        code, outcome = disco_json("estop", str(stack.robot_file))
        replied_s = time.monotonic()
        if daemon == "frozen":
            os.kill(stack.daemon.process.pid, signal.SIGCONT)
        assert code == 0, outcome
        assert outcome["sent"]
        time.sleep(ROLLS_S)
        status = stack.operator.status()
        assert status["state"] != "ARMED"
        rows = stack.truth()
    stopped = [row for row in rows if row.t_s > replied_s + ROLLS_S - 0.5]
    assert max(row.fastest for row in stopped) < STATIONARY_RAD_S
