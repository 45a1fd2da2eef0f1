"""Lateness of the control loop on this machine, with and without real-time scheduling, beside a busy receive thread."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import threading
import time

from disco_hw import processes
from disco_hw.daemon.loop import Loop, MonotonicClock
from disco_hw.runtime.pipeline import Governor, WheelLimits
from disco_hw.runtime.supervisor import Inputs, Supervisor, SupervisorSettings
from drivers.types import DriverState, LinkState

RATE_HZ = 50.0
PRIORITY = 80


def run(seconds: float = 10.0) -> dict[str, float]:
    """Return p50, p99, p99.9 and maximum of the loop's lateness and the cost of its own parts, in microseconds."""
    figures: dict[str, float] = {}
    for mode in ("plain", "realtime"):
        # Scheduler and collector belong to the process, so each case has one of its own.
        command = [sys.executable, "-m", "tools.bench.loop", mode, str(seconds)]
        result = subprocess.run(command, check=True, capture_output=True, text=True)
        figures |= {f"loop.{mode}.{key}": value for key, value in json.loads(result.stdout).items()}
    return figures


def measure(mode: str, seconds: float) -> dict[str, float]:
    allowed = True
    if mode == "realtime":
        allowed = all(step.done for step in processes.enter_real_time(PRIORITY))
    finished = threading.Event()
    receiver = threading.Thread(target=_receive, args=(finished,))
    receiver.start()
    if mode == "realtime":
        allowed = processes.raise_loop_thread(PRIORITY).done and allowed
    loop = Loop(MonotonicClock(), RATE_HZ)
    body = _Body(loop)
    end_ns = time.monotonic_ns() + round(seconds * 1e9)
    loop.run(body.tick, lambda: time.monotonic_ns() >= end_ns)
    finished.set()
    receiver.join()
    figures = {"allowed": float(allowed), "ticks": float(loop.stats.ticks)}
    for name, value in loop.stats.lateness.summary_s().items():
        figures[f"lateness_{name.removesuffix('_s')}_us"] = value * 1e6
    figures["overruns"] = float(loop.stats.overruns)
    figures["skipped_periods"] = float(loop.stats.skipped_periods)
    for name in loop.stages.last_ns:
        figures[f"{name}_p50_us"] = statistics.median(stages_ns[name] for stages_ns in body.timed[1:]) * 1e-3
    return figures


class _Body:
    """A tick of the daemon's own parts, and the garbage that any tick makes."""

    def __init__(self, loop: Loop) -> None:
        self._stages = loop.stages
        self.timed: list[dict[str, int]] = []
        self._supervisor = Supervisor(SupervisorSettings(0.05, 0.15, pose_required=True))
        self._governor = Governor(WheelLimits(8.0, 20.0, 20.0), 1.0 / RATE_HZ)
        self._inputs = Inputs(LinkState.UP, 1, DriverState.READY, "ready", 0.01, 0.0, pose_ok=True)

    def tick(self, now_ns: int) -> None:
        self.timed.append(self._stages.last_ns)
        self._supervisor.step(now_ns, self._inputs)
        self._stages.mark("supervisor")
        self._governor.step(3.0, 3.5, 1.0 / RATE_HZ)
        self._stages.mark("governor")
        json.loads(json.dumps([{"t_ns": now_ns, "values": [0.5] * 20} for _ in range(10)]))
        self._stages.mark("garbage")


def _receive(finished: threading.Event) -> None:
    """Stand in for a link at 1000 frames a second."""
    while not finished.is_set():
        time.sleep(0.001)
        sum(range(200))


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1], float(sys.argv[2]))))
