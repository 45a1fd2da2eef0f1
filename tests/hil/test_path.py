"""A path as the task of the whole stack in real time: checked, driven, stopped at its end, replayed from the log."""

from __future__ import annotations

import pytest

from disco_hw.experiments import READY_TIMEOUT_S
from tests.hil.stack import disco, disco_json_here
from tests.runtime.path_robot import ROBOTS
from tools.stack import running_stack, write_robot_file

PATH = "x_m,y_m\n0,0\n0.5,0\n0.8,0.2\n"
TASK = 'path = "path.csv"\nspeed_m_s = 0.25\n'


@pytest.mark.hil
@pytest.mark.long
def test_a_path_is_driven_to_its_end_and_the_log_needs_no_other_file(tmp_path):
    (tmp_path / "path.csv").write_text(PATH)
    with running_stack(tmp_path, task=TASK, start=(0.0, 0.0, 0.0)) as stack:
        stack.operator.wait_for("READY", READY_TIMEOUT_S)
        assert stack.operator.status()["task"]["asked"]["speed_m_s"] == 0.25
        stack.start()
        end = stack.operator.wait_until("at its end", lambda s: s["task"]["laps"] > 0.9 and not s["running"], 30.0)
        assert end["state"] == "ARMED"
        code, output = disco("ctl", str(stack.robot_file), "status")
        assert code == 0, output
        assert "of 0.86 m" in output
        stack.operator.request("quit")
        stack.daemon.process.wait(10.0)
        rows = stack.truth()
    assert max(row.fastest for row in rows) > 2.0
    assert rows[-1].fastest < 0.05
    (tmp_path / "path.csv").unlink()
    code, output = disco("replay", str(tmp_path / "run.mcap"))
    assert code == 0, output
    assert "equal bit for bit" in output
    for verb in ("--snapshot", "--export"):
        out = tmp_path / ("end.png" if verb == "--snapshot" else "run.html")
        code, output = disco("view", str(tmp_path / "run.mcap"), verb, str(out))
        assert code == 0, output
        assert out.stat().st_size > 10_000


def test_check_judges_the_path_and_its_speed(tmp_path):
    (tmp_path / "path.csv").write_text((ROBOTS / "eight.csv").read_text())
    robot_file = write_robot_file(tmp_path, task=TASK)
    _, report, _ = disco_json_here("check", str(robot_file))
    found = {check["name"]: check for check in report["checks"]}["task"]
    assert found["level"] == "ok"
    assert found["text"].startswith("path path.csv of 9.")
