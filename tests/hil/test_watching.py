"""python-can's viewer watches the virtual robot's bus while it runs, as docs/virtual-robot.md says."""

from __future__ import annotations

import os
import pty
import re
import select
import subprocess
import sys
import time

import pytest

from tests.hil.stack import virtual_robot
from tools.stack import write_robot_file

pytestmark = pytest.mark.hil


@pytest.mark.thorough
def test_python_cans_viewer_shows_the_frames_in_a_terminal(tmp_path):
    robot_file = write_robot_file(tmp_path)
    with virtual_robot(robot_file):
        master, slave = pty.openpty()
        viewer = [sys.executable, "-m", "can.viewer", "-i", "unixcan", "-c", str(tmp_path / "bus")]
        environment = {**os.environ, "TERM": "xterm", "LINES": "40", "COLUMNS": "120"}
        with subprocess.Popen(viewer, stdin=slave, stdout=slave, stderr=slave, env=environment) as process:
            shown = b""
            deadline = time.monotonic() + 60.0
            while time.monotonic() < deadline and not {b"0x110", b"0x111"} <= set(re.findall(rb"0x\d{3}", shown)):
                if select.select((master,), (), (), 0.1)[0]:
                    shown += os.read(master, 65536)
            process.terminate()
    assert {b"0x110", b"0x111"} <= set(re.findall(rb"0x\d{3}", shown))
