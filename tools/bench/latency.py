"""Latency end to end: from a frame with an encoder sample on the wire to the wheel command that knew it on the wire.

Simulator and daemon are the processes that a user runs, with the real planner; times are those of the wire as the
simulator keeps it. The daemon commands at 50 Hz and samples come at 100 Hz, so a sample waits up to 10 ms for a tick.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from disco_hw.experiments import Operator, disco_hw_process
from disco_hw.log.reader import open_log
from tools.bench.step_times import summary
from tools.stack import write_robot_file

WHEEL_COMMAND, WHEEL_TICKS = 0x100, 0x111
SETTLED_S = 2.0


def run(seconds: float = 20.0) -> dict[str, float]:
    """Return the latencies in milliseconds, over CAN and over serial."""
    figures: dict[str, float] = {}
    for link in ("can", "serial"):
        with tempfile.TemporaryDirectory() as name:
            _drive(Path(name), link, seconds)
            total_ms, waited_ms = _latencies_ms(Path(name))
        figures |= summary(f"latency.{link}_ms", total_ms) | summary(f"latency.{link}.waiting_ms", waited_ms)
        figures[f"latency.{link}.commands"] = float(len(total_ms))
    return figures


def _drive(directory: Path, link: str, seconds: float) -> None:
    robot_file = write_robot_file(directory, link)
    simulator = ["sim", str(robot_file), "--bus-log", str(directory / "bus.log")]
    daemon = ["run", str(robot_file), "--log", str(directory / "run.mcap")]
    with (
        disco_hw_process("virtual robot", simulator, directory / "sim.txt") as robot,
        disco_hw_process("daemon", daemon, directory / "daemon.txt") as host,
    ):
        operator = Operator(directory / "control.sock", (robot, host))
        operator.arm()
        operator.request("start")
        time.sleep(SETTLED_S + seconds)


def _latencies_ms(directory: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the latency of each command, wire to wire, and of that the time until the tick began, in ms."""
    passed: dict[tuple[int, bytes], list[float]] = {}
    for line in (directory / "bus.log").read_text(encoding="utf-8").splitlines():
        stamp, _, frame = line.split()
        can_id, _, data = frame.partition("#")
        if int(can_id, 16) in (WHEEL_COMMAND, WHEEL_TICKS):
            passed.setdefault((int(can_id, 16), bytes.fromhex(data)), []).append(float(stamp[1:-1]))
    total_ms, waited_ms = [], []
    newest: float | None = None
    with open_log(directory / "run.mcap") as log:
        for entry in log.records({"/can/rx", "/can/tx"}):
            record = entry.record
            if record.can_id == WHEEL_TICKS:
                newest = _nearest(passed.get((WHEEL_TICKS, record.data)), record.t_ns * 1e-9)
            elif record.can_id == WHEEL_COMMAND and newest is not None:
                sent = _nearest(passed.get((WHEEL_COMMAND, record.data)), record.t_ns * 1e-9)
                if sent is not None:
                    total_ms.append(1e3 * (sent - newest))
                    waited_ms.append(1e3 * (record.t_ns * 1e-9 - newest))
    return np.array(total_ms), np.array(waited_ms)


def _nearest(times_s: list[float] | None, t_s: float) -> float | None:
    """The time on the wire of the frame that the host has seen at `t_s`: equal frames come again after 0.16 s."""
    if times_s is None:
        return None
    best = min(times_s, key=lambda time_s: abs(time_s - t_s))
    return best if abs(best - t_s) < 0.08 else None
