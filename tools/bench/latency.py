"""Latency end to end: from a frame with an encoder sample on the wire to the wheel command that knew it on the wire.

Simulator and daemon are the processes that a user runs, with the real planner; times are those of the wire as the
simulator keeps it. The daemon commands at 50 Hz and samples come at 100 Hz, so a sample waits up to 10 ms for a tick.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from disco_hw.log.reader import open_log
from tools.bench.step_times import summary
from tools.stack import CIRCLE_START, running_stack

WHEEL_COMMAND, WHEEL_TICKS = 0x100, 0x111
SETTLED_S = 2.0


def run(seconds: float = 20.0) -> dict[str, float]:
    """Return the latencies in milliseconds, over CAN and over serial."""
    figures: dict[str, float] = {}
    for link in ("can", "serial"):
        with tempfile.TemporaryDirectory() as name:
            kept = ("--bus-log", f"{name}/bus.log")
            with running_stack(Path(name), link, task="", start=CIRCLE_START, sim_arguments=kept) as stack:
                stack.start()
                time.sleep(SETTLED_S + seconds)
            total_ms, waited_ms = _latencies_ms(Path(name))
        figures |= summary(f"latency.{link}_ms", total_ms) | summary(f"latency.{link}.waiting_ms", waited_ms)
        figures[f"latency.{link}.commands"] = float(len(total_ms))
    return figures


def frames_on_wire(directory: Path) -> Iterator[tuple[float, int, bytes]]:
    """Yield time (s), id and data of each frame that the simulator kept of the wire."""
    for line in (directory / "bus.log").read_text(encoding="utf-8").splitlines():
        stamp, _, frame = line.split()
        can_id, _, data = frame.partition("#")
        yield float(stamp[1:-1]), int(can_id, 16), bytes.fromhex(data)


def _latencies_ms(directory: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the latency of each command, wire to wire, and of that the time until the tick began, in ms."""
    passed: dict[tuple[int, bytes], list[float]] = {}
    for t_s, can_id, data in frames_on_wire(directory):
        if can_id in (WHEEL_COMMAND, WHEEL_TICKS):
            passed.setdefault((can_id, data), []).append(t_s)
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
