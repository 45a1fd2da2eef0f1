"""The bridge to ROS 2: from the daemon's tick to a subscriber that has the odometry of it.

Simulator, daemon with the real planner, bridge and node are processes of their own on this machine.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from disco_hw.daemon import send_request
from disco_hw.experiments import READY_TIMEOUT_S, Operator, disco_hw_process
from disco_hw.log.reader import open_log
from tools.bench.step_times import summary
from tools.stack import FAST_START, FAST_TASK, write_robot_file

DOMAIN = 90
SETTLED_S = 2.0


def run(seconds: float = 30.0) -> dict[str, float]:
    """Return the figures in milliseconds."""
    with tempfile.TemporaryDirectory() as name, circling(Path(name)) as start_ns:
        time.sleep(seconds)
        end_ns = time.monotonic_ns()
        status = send_request(Path(name) / "control.sock", {"do": "status"})
        assert status["running"], status["detail"]
        send_request(Path(name) / "control.sock", {"do": "quit"})
        time.sleep(2.0)
        return summary("bridge.odometry_from_tick_ms", _odometry_ms(Path(name), start_ns, end_ns))


@contextmanager
def circling(directory: Path) -> Iterator[int]:
    """The stack on its circle, by a node's poses; yields since when (ns)."""
    robot_file = write_robot_file(directory, task=FAST_TASK)
    lines = f'[pose]\nsource = "ros2"\nport = {5100 + DOMAIN}\n[ros2]\ndomain = {DOMAIN}\n'
    robot_file.write_text(robot_file.read_text(encoding="utf-8") + lines, encoding="utf-8")
    start = list(map(str, FAST_START))
    commands = {
        "sim": ["sim", str(robot_file), "--start", *start],
        "daemon": ["run", str(robot_file), "--log", str(directory / "run.mcap")],
        "bridge": ["bridge", "ros2", str(robot_file)],
    }
    with ExitStack() as stack:
        children = [
            stack.enter_context(disco_hw_process(name, command, directory / f"{name}.txt"))
            for name, command in commands.items()
        ]
        node = [sys.executable, "-m", "tools.ros2_node", str(DOMAIN), "echo", *start]
        with (directory / "node.txt").open("wb") as output:
            child = subprocess.Popen(node, stdout=output)
            stack.callback(child.wait)
            stack.callback(child.kill)
        operator = Operator(directory / "control.sock", children)
        operator.wait_until("ready, with poses", lambda s: s["state"] == "READY" and s["pose_ok"], READY_TIMEOUT_S)
        operator.arm()
        operator.request("start")
        time.sleep(SETTLED_S)
        yield time.monotonic_ns()


def _odometry_ms(directory: Path, start_ns: int, end_ns: int) -> np.ndarray:
    """From the tick that took a wheel sample to the node that heard the odometry of it."""
    offset_ns = time.time_ns() - time.monotonic_ns()
    with open_log(directory / "run.mcap") as log:
        ticks = np.array([(entry.record.t_ns, entry.now_ns) for entry in log.records({"/wheels"})])
    found = []
    rows = [line.split() for line in (directory / "node.txt").read_text(encoding="utf-8").splitlines()]
    # Stamp (wall clock) and reception (monotonic, ns) of each odometry; the last line may be half a line.
    for stamp_ns, received_ns in (map(int, row[:2]) for row in rows if len(row) == 5):
        if start_ns <= received_ns <= end_ns:
            nearest = int(np.abs(ticks[:, 0] + offset_ns - stamp_ns).argmin())
            found.append((received_ns - ticks[nearest, 1]) * 1e-6)
    return np.array(found)
