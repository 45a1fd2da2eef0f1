"""The live page of a running robot: its e-stop stops the wheels, and nothing that befalls it touches the loop."""

import os
import signal
import socket
import time
from pathlib import Path

import pytest

from disco_hw.operator import disco_hw_process
from tests.hil.stack import STILL_RAD_S, running_stack
from tests.viewer.browser import chromium, keep, opened
from tests.viewer.test_page import wait_for

pytestmark = pytest.mark.hil


def address(output: Path, timeout_s: float = 30.0) -> str:
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        for line in output.read_text().splitlines():
            if line.startswith("page: "):
                return line.split()[1]
        time.sleep(0.05)
    raise AssertionError(f"no page: {output.read_text()}")


def test_the_page_changes_nothing_while_it_is_stopped_and_its_estop_stops_the_wheels(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        view = ["view", "--live", "--port", str(taken.getsockname()[1]), "--robot"]
    with chromium() as browser, running_stack(tmp_path) as stack:
        page_file = tmp_path / "page.txt"
        with disco_hw_process("page", [*view, str(stack.robot_file)], page_file) as page:
            with opened(browser, address(page_file)) as tab:
                stack.drive()
                tab.get_by_text("ARMED · running").wait_for()
                wait_for(tab, lambda: "rad/s (plan)" in tab.inner_text("body"))
                keep(tab, "live")
                stop_the_page_for_a_while(stack, page.process.pid)
                tab.get_by_role("button", name="E-STOP").click()
                stack.operator.wait_for("FAULT", 10.0)
                stopped_s = time.monotonic()
                tab.get_by_text("E-STOP is latched.").wait_for()
                keep(tab, "estop")
                tab.get_by_role("button", name="Reset").click()
                stack.operator.wait_for("READY", 10.0)
            os.kill(page.process.pid, signal.SIGTERM)
            assert page.process.wait(10) == 0
        rows = stack.truth()
    assert any(row.fastest > 5.0 for row in rows)
    later = [row.fastest for row in rows if row.t_s > stopped_s + 0.5]
    assert later
    assert max(later) < STILL_RAD_S


def stop_the_page_for_a_while(stack, pid):
    """The robot goes on driving and the log goes on being written while the page's process does nothing."""
    os.kill(pid, signal.SIGSTOP)
    before = stack.operator.status()
    time.sleep(2.0)
    after = stack.operator.status()
    os.kill(pid, signal.SIGCONT)
    assert after["state"] == "ARMED"
    assert after["task"]["laps"] > before["task"]["laps"] + 0.02
    assert after["driver"]["commands_sent"] > before["driver"]["commands_sent"] + 50
    assert after["recorder"]["dropped_ticks"] == 0
