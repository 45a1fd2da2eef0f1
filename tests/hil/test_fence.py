"""A fence in the whole stack in real time: what the daemon refuses, and obstacles by `ctl` and by UDP."""

from __future__ import annotations

import json
import socket

import pytest

from disco_hw.errors import WorkError
from disco_hw.experiments import READY_TIMEOUT_S
from tests.drivers.waiting import free_port
from tests.hil.stack import disco
from tools.stack import running_stack

TASK = 'kind = "circle"\nradius_m = 0.75\nspeed_m_s = 0.2\n'
ROOM = [[-1.8, -1.8], [1.8, -1.8], [1.8, 1.8], [-1.8, 1.8]]
AGE_LIMIT_S = 3.0


@pytest.mark.hil
@pytest.mark.long
def test_a_daemon_keeps_its_task_inside_and_stops_for_an_obstacle_that_is_reported_no_longer(tmp_path):
    port = free_port(socket.SOCK_DGRAM)
    task = f"{TASK}\n[fence]\nkeep_in = {ROOM}\nobstacles_port = {port}\n"
    with running_stack(tmp_path, task=task, start=(0.75, 0.0, 1.5707963)) as stack:
        operator, robot = stack.operator, str(stack.robot_file)
        operator.wait_for("READY", READY_TIMEOUT_S)
        with pytest.raises(WorkError, match=r"fence: the task starts at .* outside; keep the task inside"):
            operator.request("task", radius_m=1.7)
        operator.request("fence", margin_m=0.06)
        assert operator.status()["area"]["fence"]["margin_m"] == 0.06
        stack.start()
        with pytest.raises(WorkError, match="the fence can be changed only while the robot is disarmed"):
            operator.request("fence", margin_m=0.05)
        code, output = disco("ctl", robot, "obstacle", "add", "name=box", "x_m=-1.5", "y_m=1.5", "radius_m=0.1")
        assert (code, output.strip()) == (
            0,
            "obstacle box: valid for 600 s; without a newer report the robot then stops",
        )
        person = {"name": "person", "x_m": -1.5, "y_m": -1.5, "radius_m": 0.2, "age_limit_s": AGE_LIMIT_S}
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(json.dumps(person).encode(), ("127.0.0.1", port))
        both = operator.wait_until("aware of both", lambda s: len(s["area"]["obstacles"]) == 2, AGE_LIMIT_S)
        assert both["running"]
        assert both["area"]["verdict"] in {"free", "scaled"}
        stopped = operator.wait_until("stopped for the person", lambda s: not s["running"], 2.0 * AGE_LIMIT_S)
        assert stopped["area"]["verdict"] == "obstacle lost"
        operator.wait_for_standstill(2.0)
        code, output = disco("ctl", robot, "status")
        assert code == 0, output
        assert "fence: obstacle lost, obstacle person is no longer reported; report it again or remove it" in output
        code, output = disco("ctl", robot, "obstacle", "remove", "name=person")
        assert (code, output.strip()) == (0, "obstacle person: removed")
        operator.wait_until("free again", lambda s: s["area"]["verdict"] == "free", 2.0)
        operator.request("quit")
        stack.daemon.process.wait(10.0)
    log = str(tmp_path / "run.mcap")
    code, output = disco("replay", log)
    assert code == 0, output
    assert "equal bit for bit" in output
