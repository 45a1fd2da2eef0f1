"""The bridge to ROS 2: odometry to a subscriber, a pose to a wheel command, and the loop's lateness with and without.

Simulator, daemon with the real planner, bridge and node are processes of their own on this machine. A pose's time is
from when the node says it to when the first wheel command that knew it is on the wire; the loop runs at 50 Hz. What
the machine does beside makes lateness differ: its load is given with each, and the daemon's CPU time.
"""

from __future__ import annotations

import os
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
from tools.bench.latency import WHEEL_COMMAND, frames_on_wire
from tools.bench.step_times import process_cpu_s, summary
from tools.stack import FAST_START, FAST_TASK, write_robot_file

DOMAIN = 90
SETTLED_S = 2.0


def run(seconds: float = 30.0) -> dict[str, float]:
    """Return the figures in milliseconds."""
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name, circling(Path(name)) as (daemon, start_ns):
        figures |= _loop_for(seconds, daemon, "with")
        end_ns = time.monotonic_ns()
        status = send_request(Path(name) / "control.sock", {"do": "status"})
        assert status["running"], status["detail"]
        send_request(Path(name) / "control.sock", {"do": "quit"})
        time.sleep(2.0)
        figures |= summary("bridge.odometry_from_tick_ms", _odometry_ms(Path(name), start_ns, end_ns))
        figures |= summary("bridge.pose_to_command_ms", _pose_to_command_ms(Path(name), start_ns, end_ns))
        figures |= summary("bridge.loop_lateness_with_ms", _lateness_ms(Path(name), start_ns, end_ns))
    with tempfile.TemporaryDirectory() as name, circling(Path(name), bridged=False) as (daemon, start_ns):
        figures |= _loop_for(seconds, daemon, "without")
        figures |= summary("bridge.loop_lateness_without_ms", _lateness_ms(Path(name), start_ns, time.monotonic_ns()))
    return figures


@contextmanager
def circling(directory: Path, bridged: bool = True) -> Iterator[tuple[int, int]]:
    """The stack on its circle, by a node's poses or without bridge; yields daemon's process and since when (ns)."""
    robot_file = write_robot_file(directory, task=FAST_TASK)
    if bridged:
        lines = f'[pose]\nsource = "ros2"\nport = {5100 + DOMAIN}\n[ros2]\ndomain = {DOMAIN}\n'
        robot_file.write_text(robot_file.read_text(encoding="utf-8") + lines, encoding="utf-8")
    start = list(map(str, FAST_START))
    simulator = ["sim", str(robot_file), "--bus-log", str(directory / "bus.log"), "--start", *start]
    with ExitStack() as stack:
        children = [
            stack.enter_context(disco_hw_process("virtual robot", simulator, directory / "sim.txt")),
            stack.enter_context(
                disco_hw_process(
                    "daemon", ["run", str(robot_file), "--log", str(directory / "run.mcap")], directory / "daemon.txt"
                )
            ),
        ]
        if bridged:
            bridge = ["bridge", "ros2", str(robot_file)]
            children.append(stack.enter_context(disco_hw_process("bridge", bridge, directory / "bridge.txt")))
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
        yield children[1].process.pid, time.monotonic_ns()


def _loop_for(seconds: float, daemon: int, bridge: str) -> dict[str, float]:
    """Let it run, and return the daemon's CPU time for a second of it (ms), and the machine's load and CPUs."""
    before_s = process_cpu_s(daemon)
    time.sleep(seconds)
    return {
        f"bridge.daemon_cpu_ms_per_s_{bridge}": 1e3 * (process_cpu_s(daemon) - before_s) / seconds,
        f"bridge.load_{bridge}": os.getloadavg()[0],
        "bridge.cpus": float(len(os.sched_getaffinity(0))),
    }


def _node_odometry(directory: Path) -> np.ndarray:
    """Return (N, 3): stamp (wall clock), reception and reply (monotonic, ns) of each odometry."""
    rows = [line.split() for line in (directory / "node.txt").read_text(encoding="utf-8").splitlines()]
    return np.array([list(map(int, row[:3])) for row in rows if len(row) == 5])


def _odometry_ms(directory: Path, start_ns: int, end_ns: int) -> np.ndarray:
    """From the tick that took a wheel sample to the node that heard the odometry of it."""
    offset_ns = time.time_ns() - time.monotonic_ns()
    with open_log(directory / "run.mcap") as log:
        ticks = np.array([(entry.record.t_ns, entry.now_ns) for entry in log.records({"/wheels"})])
    found = []
    for stamp_ns, received_ns, _ in _node_odometry(directory):
        if start_ns <= received_ns <= end_ns:
            nearest = int(np.abs(ticks[:, 0] + offset_ns - stamp_ns).argmin())
            found.append((received_ns - ticks[nearest, 1]) * 1e-6)
    return np.array(found)


def _pose_to_command_ms(directory: Path, start_ns: int, end_ns: int) -> np.ndarray:
    """From a node's saying a pose to the next wheel command on the wire after the tick that took it."""
    offset_ns = time.time_ns() - time.monotonic_ns()
    node_rows = _node_odometry(directory)
    on_wire = frames_on_wire(directory)
    commands = np.array([round(t_s * 1e9) for t_s, can_id, _ in on_wire if can_id == WHEEL_COMMAND])
    found = []
    with open_log(directory / "run.mcap") as log:
        for entry in log.records({"/pose"}):
            if start_ns <= entry.now_ns <= end_ns:
                nearest = int(np.abs(node_rows[:, 0] - offset_ns - entry.record.t_ns).argmin())
                sent_ns = commands[np.searchsorted(commands, entry.now_ns)]
                found.append((sent_ns - node_rows[nearest, 2]) * 1e-6)
    return np.array(found)


def _lateness_ms(directory: Path, start_ns: int, end_ns: int) -> np.ndarray:
    with open_log(directory / "run.mcap") as log:
        ticks = [entry.record for entry in log.records({"/loop"}) if start_ns <= entry.now_ns <= end_ns]
    return np.array([tick.lateness_ns * 1e-6 for tick in ticks])
