"""Random faults of the bridge to ROS 2 and of its node, on the running stack: each must stop the robot, a flood none.

    python -m tools.study.ros2_trials --trials 500 --record trials.jsonl

A trial drives the circle by the poses of a node, strikes at a random time, and measures how long the wheels go on. They
may for `estimation.pose_timeout_s` and the time in which a robot at speed stops; a trial takes ten to twenty seconds.
Each is drawn from seed and number alone and is a line of the record, so that a run that was broken off goes on where it
was; one that goes wrong is followed by a fresh stack. Whoever only strikes the node keeps the bridge.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from disco_hw.config import load_robot_config
from disco_hw.errors import WorkError
from disco_hw.experiments import (
    FAST_START,
    FAST_TASK,
    READY_TIMEOUT_S,
    Operator,
    disco_hw_process,
    stands,
    write_robot_file,
)

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
        self._origin = FAST_START

    def begin(self, fault: str, at: tuple[float, float, float]) -> None:
        """Make them anew for a fault, the bridge where it was struck; its odometry begins where the robot is."""
        _end(self.node)
        if self.bridge is None or self.bridge.poll() is not None:
            self.bridge, self._origin = self._make("disco_hw", "bridge", "ros2", str(self._robot_file)), at
        kind = "echo" if " " in fault else fault
        self.node = self._make("tools.ros2_node", str(DOMAIN), kind, *map(str, self._origin))

    def strike(self, fault: str) -> None:
        """Do what `fault` says."""
        assert self.bridge is not None
        assert self.node is not None
        what, _, whom = fault.partition(" ")
        how = {"kill": signal.SIGKILL, "freeze": signal.SIGSTOP}.get(what, signal.SIGUSR1)
        (self.bridge if whom == "bridge" else self.node).send_signal(how)

    def after(self, fault: str) -> None:
        """End what a fault has left frozen."""
        if fault.endswith("bridge"):
            _end(self.bridge)

    def close(self) -> None:
        """Stop the bridge and the node."""
        _end(self.node)
        _end(self.bridge)

    def _make(self, *words: str) -> subprocess.Popen[bytes]:
        with (self._directory / "parts.txt").open("ab") as output:
            return subprocess.Popen([sys.executable, "-m", *words], stdout=output, stderr=output)


def _end(process: subprocess.Popen[bytes] | None) -> None:
    if process is not None:
        process.kill()
        process.wait()


@contextmanager
def stack() -> Iterator[tuple[Operator, Parts, float]]:
    """Run robot and daemon; yield the operator, the parts to fault, and how long a stop may take (s)."""
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        robot_file = write_robot_file(directory, task=FAST_TASK)
        lines = f'[pose]\nsource = "ros2"\nport = {5100 + DOMAIN}\n[ros2]\ndomain = {DOMAIN}\n'
        robot_file.write_text(robot_file.read_text(encoding="utf-8") + lines, encoding="utf-8")
        limit_s = load_robot_config(robot_file).estimation.pose_timeout_s + STOPPING_S
        simulator = ["sim", str(robot_file), "--start", *map(str, FAST_START)]
        run_it = ["run", str(robot_file), "--log", str(directory / "run.mcap")]
        with (
            disco_hw_process("virtual robot", simulator, directory / "sim.txt") as robot,
            disco_hw_process("daemon", run_it, directory / "daemon.txt") as daemon,
        ):
            parts = Parts(directory, robot_file)
            try:
                yield Operator(directory / "control.sock", (robot, daemon)), parts, limit_s
            finally:
                parts.close()


def run(trials: int, seed: int, record: Path, minutes: float) -> int:
    """Run the trials that the record lacks, for so long, and print a table of it; returns 1 if one went wrong."""
    end_s = time.monotonic() + 60.0 * minutes
    done = {line["trial"]: line for line in _lines(record) if line["seed"] == seed and line["trial"] < trials}
    left = [trial for trial in range(trials) if trial not in done]
    while left and time.monotonic() < end_s:
        with stack() as (operator, parts, limit_s):
            while left and time.monotonic() < end_s:
                done[left[0]] = line = judged(operator, parts, left[0], seed, limit_s)
                with record.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(line) + "\n")
                left.pop(0)
                if line["wrong"]:
                    print(f"trial {line['trial']}, seed {seed}: {line['fault']}: {line['wrong']}", flush=True)
                    break
    return table(done.values(), len(left))


def judged(operator: Operator, parts: Parts, trial: int, seed: int, limit_s: float) -> dict[str, Any]:
    """One trial as a line of the record."""
    draw = random.Random(f"{seed}/{trial}")
    fault = draw.choice(WHOM)
    try:
        seconds, wrong = one(operator, parts, fault, draw.uniform(0.2, 1.5))
    except WorkError as error:
        seconds, wrong = 0.0, str(error)
    parts.after(fault)
    if not wrong and seconds > limit_s:
        wrong = f"stopped after {seconds:.2f} s, {limit_s:.1f} s are allowed"
    load = round(os.getloadavg()[0], 1)
    return {"trial": trial, "seed": seed, "fault": fault, "seconds": round(seconds, 3), "wrong": wrong, "load": load}


def table(lines: Iterable[dict[str, Any]], left: int) -> int:
    """Print what the record says; returns 1 if a trial went wrong."""
    took: dict[str, list[float]] = defaultdict(list)
    wrong = [line for line in lines if line["wrong"]]
    for line in lines:
        took[line["fault"]].append(line["seconds"])
    for fault, seconds in sorted(took.items()):
        print(f"{fault:14} {len(seconds):4} trials, stopped after {max(seconds):.2f} s at most")
    print(f"{sum(map(len, took.values()))} trials, {len(wrong)} wrong, {left} to go")
    return bool(wrong)


def _lines(record: Path) -> list[dict[str, Any]]:
    if not record.exists():
        return []
    return [json.loads(line) for line in record.read_text(encoding="utf-8").splitlines() if line.endswith("}")]


def one(operator: Operator, parts: Parts, fault: str, wait_s: float) -> tuple[float, str]:
    """Run one trial; return how long the wheels turned after the fault (s), and what went wrong, empty for nothing."""
    operator.wait_for_standstill(READY_TIMEOUT_S)
    parts.begin(fault, FAST_START if operator.status()["state"] == "READY" else tuple(operator.status()["pose"]))
    operator.wait_until("without a pose", lambda status: not status["pose_ok"], 10.0)
    status = operator.wait_until("seeing", lambda s: s["pose_ok"] and s["state"] in ("READY", "ARMED"), READY_TIMEOUT_S)
    if status["running"]:
        return 0.0, "it began to drive by itself"
    if status["state"] == "READY":
        operator.arm()
    operator.request("start")
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
        operator.request("stop")
        return 0.0, "" if running else "a flood stopped it"
    operator.wait_until("standing", lambda now: stands(now) and not now["running"], 10.0)
    return time.monotonic() - struck_s, ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--record", type=Path, default=Path("ros2_trials.jsonl"))
    parser.add_argument("--minutes", type=float, default=1e6, help="no trial begins later than that")
    asked = parser.parse_args()
    # So that whoever breaks it off leaves no robot running.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    return run(asked.trials, asked.seed, asked.record, asked.minutes)


if __name__ == "__main__":
    raise SystemExit(main())
