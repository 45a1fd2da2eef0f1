"""Random faults of the bridge to ROS 2 and of its node, on the running stack: each must stop the robot, a flood none.

    python -m tools.ros2_trials --trials 500

A trial drives the circle by the poses of a node, strikes at a random time, and measures how long the wheels go on. They
may for `estimation.pose_timeout_s` and the time in which a robot at speed stops; a trial takes ten to twenty seconds.
"""

from __future__ import annotations

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from contextlib import ExitStack
from pathlib import Path

from disco_hw.config import load_robot_config
from disco_hw.experiments.live_stack import FAST_START, FAST_TASK, Operator, disco_hw_process, stands, write_robot_file
from tools.bench_latency import READY_TIMEOUT_S

DOMAIN = 91
STOPPING_S = 1.0
FLOOD_S = 2.0
WHOM = ("kill node", "freeze node", "kill bridge", "freeze bridge", "nan", "frame", "late", "garbage", "flood")


class Parts:
    """Bridge and node beside the stack; either is made anew after its fault."""

    def __init__(self, directory: Path, robot_file: Path) -> None:
        self._directory, self._robot_file = directory, robot_file
        self.bridge: subprocess.Popen[bytes] | None = None
        self.node: subprocess.Popen[bytes] | None = None

    def begin(self, fault: str, at: tuple[float, float, float]) -> None:
        """Make both anew for a fault; the odometry of a new bridge begins where the robot is."""
        self.close()
        kind = "echo" if " " in fault else fault
        self.bridge = self._make("disco_hw", "bridge", "ros2", str(self._robot_file))
        self.node = self._make("tools.ros2_node", str(DOMAIN), kind, *map(str, at))

    def strike(self, fault: str) -> None:
        """Do what `fault` says."""
        assert self.bridge is not None
        assert self.node is not None
        what, _, whom = fault.partition(" ")
        how = {"kill": signal.SIGKILL, "freeze": signal.SIGSTOP}.get(what, signal.SIGUSR1)
        (self.bridge if whom == "bridge" else self.node).send_signal(how)

    def close(self) -> None:
        """End both."""
        for process in (self.bridge, self.node):
            if process is not None:
                process.kill()
                process.wait()

    def _make(self, *words: str) -> subprocess.Popen[bytes]:
        with (self._directory / "parts.txt").open("ab") as output:
            return subprocess.Popen([sys.executable, "-m", *words], stdout=output, stderr=output)


def run(trials: int, seed: int) -> int:
    """Run the trials, print a table; returns 1 if one of them went wrong."""
    draw = random.Random(seed)
    took: dict[str, list[float]] = defaultdict(list)
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        directory = Path(name)
        robot_file = write_robot_file(directory, task=FAST_TASK)
        lines = f'[pose]\nsource = "ros2"\nport = {5100 + DOMAIN}\n[ros2]\ndomain = {DOMAIN}\n'
        robot_file.write_text(robot_file.read_text(encoding="utf-8") + lines, encoding="utf-8")
        limit_s = load_robot_config(robot_file).estimation.pose_timeout_s + STOPPING_S
        simulator = ["sim", str(robot_file), "--start", *map(str, FAST_START)]
        robot = stack.enter_context(disco_hw_process("virtual robot", simulator, directory / "sim.txt"))
        run_it = ["run", str(robot_file), "--log", str(directory / "run.mcap")]
        daemon = stack.enter_context(disco_hw_process("daemon", run_it, directory / "daemon.txt"))
        operator = Operator(directory / "control.sock", (robot, daemon))
        parts = Parts(directory, robot_file)
        stack.callback(parts.close)
        for trial in range(trials):
            fault = draw.choice(WHOM)
            seconds, words = one(operator, parts, fault, draw.uniform(0.2, 1.5))
            took[fault].append(seconds)
            if words or (fault != "flood" and seconds > limit_s):
                wrong.append(f"trial {trial}, seed {seed}: {fault}: {words or f'{seconds:.2f} s'}")
                print(wrong[-1], flush=True)
    for fault, seconds_of in sorted(took.items()):
        print(f"{fault:14} {len(seconds_of):4} trials, stopped after {max(seconds_of):.2f} s at most")
    print(f"{trials} trials, {len(wrong)} wrong; a stop may take {limit_s:.1f} s, {STOPPING_S:.1f} s of it ramp")
    return bool(wrong)


def one(operator: Operator, parts: Parts, fault: str, wait_s: float) -> tuple[float, str]:
    """One trial: how long the wheels turned after the fault (s), and what went wrong, empty for nothing."""
    operator.wait_for_standstill(READY_TIMEOUT_S)
    parts.begin(fault, FAST_START if operator.status()["state"] == "READY" else tuple(operator.status()["pose"]))
    operator.wait_until("without a pose", lambda status: not status["pose_ok"], 10.0)
    status = operator.wait_until("seeing", lambda s: s["pose_ok"] and s["state"] in ("READY", "ARMED"), READY_TIMEOUT_S)
    if status["running"]:
        return 0.0, "it began to drive by itself"
    if status["state"] == "READY":
        operator.tell("arm")
        operator.wait_for("ARMED", 5.0)
    operator.tell("start")
    operator.wait_until("moving", lambda now: not stands(now), 10.0)
    time.sleep(wait_s)
    status = operator.status()
    if not status["running"]:
        return 0.0, f"stopped before the fault: {status['detail']}"
    struck_s = time.monotonic()
    parts.strike(fault)
    if fault == "flood":
        time.sleep(FLOOD_S)
        running = operator.status()["running"]
        operator.tell("stop")
        return 0.0, "" if running else "a flood stopped it"
    operator.wait_until("standing", lambda now: stands(now) and not now["running"], 10.0)
    return time.monotonic() - struck_s, ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    # So that whoever breaks it off leaves no robot running.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    return run(asked.trials, asked.seed)


if __name__ == "__main__":
    raise SystemExit(main())
