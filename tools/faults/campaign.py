"""`make fault-campaign`: hours of random faults in simulated time against the whole stack, seed by seed.

Each seed's result is a file; a campaign that was interrupted goes on where it was. What the monitors find is printed
with the seed that shows it again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import traceback
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

KINDS_LEFT_OUT = ("disk_full",)
"""What simulated time has no part for: tests/log and tests/hil do it to real processes."""
QUIET_AT_END_S = 5.0


def run_seed(seed: int, duration_s: float, cycle_us: int, planner: str) -> dict[str, Any]:
    """Run one seed; return its figures as plain data."""
    from disco_hw.config import SHIPPED_ROBOT  # noqa: PLC0415
    from disco_hw.runtime.assembly import create_planner  # noqa: PLC0415 - in the worker, after its niceness is set
    from disco_hw.runtime.robot_setup import load_setup  # noqa: PLC0415
    from sim.fault_schedule import KINDS  # noqa: PLC0415
    from tools.faults.random_faults import random_schedule  # noqa: PLC0415
    from tools.faults.run import FaultRun  # noqa: PLC0415

    kinds = tuple(name for name in KINDS if name not in KINDS_LEFT_OUT)
    schedule = random_schedule(seed, duration_s - QUIET_AT_END_S, kinds=kinds)
    disco = None
    if planner == "disco":
        setup = load_setup(SHIPPED_ROBOT)
        disco = create_planner(setup.config, setup.model)
    run = FaultRun(schedule, seed=seed, cycle_us=cycle_us, planner=disco)
    run.run(0.1)
    began_cpu_s = time.process_time()
    raised = ""
    try:
        run.run(duration_s - 0.1)
    except Exception:
        # Whatever came out of the stack is a finding, kept with its seed, and fails the campaign.
        raised = traceback.format_exc(limit=-4)
    cpu_s = time.process_time() - began_cpu_s
    outcome = run.outcome
    return {
        "seed": seed,
        "asked_s": duration_s,
        "cycle_us": cycle_us,
        "planner": planner,
        "simulated_s": run.now_us * 1e-6,
        "moving_s": outcome.moving_s,
        "cpu_s": cpu_s,
        "commands_seen": outcome.commands_seen,
        "commands_accepted": outcome.commands_accepted,
        "violations": outcome.violations,
        "raised": raised,
        "faults": [
            {
                "kind": fault.fault.kind.name,
                "what": str(fault.fault),
                "at_s": fault.fault.begin_ns * 1e-9,
                "struck": fault.struck,
                "armed": fault.armed_before,
                "stopped_s": fault.stopped_s,
                "counters": list(fault.counters),
                "told": list(fault.events[:3]),
            }
            for fault in outcome.faults
        ],
    }


def summary(results: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """By kind of fault: how many struck an armed robot, how many it tolerated, and how visible they were."""
    rows: dict[str, dict[str, Any]] = defaultdict(
        lambda: {"struck": 0, "tolerated": 0, "stopped": 0, "slowest_s": 0.0, "counted": 0, "told": 0, "stop_untold": 0}
    )
    for result in results:
        for fault in result["faults"]:
            if not (fault["struck"] and fault["armed"]):
                continue
            row = rows[fault["kind"]]
            row["struck"] += 1
            stopped = fault["stopped_s"] is not None
            row["stopped" if stopped else "tolerated"] += 1
            row["slowest_s"] = max(row["slowest_s"], fault["stopped_s"] or 0.0)
            row["counted"] += bool(fault["counters"])
            row["told"] += bool(fault["counters"] or fault["told"])
            row["stop_untold"] += stopped and not fault["told"]
    return dict(sorted(rows.items()))


def markdown(rows: dict[str, dict[str, Any]]) -> str:
    """The table of docs/faults.md."""
    lines = [
        "| fault | struck | tolerated | stopped | slowest stop | in a counter | in the log |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind, row in rows.items():
        slowest = f"{row['slowest_s']:.2f} s" if row["stopped"] else ""
        lines.append(
            f"| `{kind}` | {row['struck']} | {row['tolerated']} | {row['stopped']} | {slowest} "
            f"| {row['counted']} | {row['told']} |"
        )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.faults.campaign", description=__doc__)
    add = parser.add_argument
    add("--seeds", type=int, default=100, help="how many")
    add("--first", type=int, default=0, help="the first of them")
    add("--hours", type=float, default=1.0, help="simulated, for each seed")
    add("--jobs", type=int, default=os.cpu_count(), help="processes")
    add("--cycle-ms", type=float, default=5.0, help="period of the robot's controller; 1 on a board")
    add("--planner", choices=("circling", "disco"), default="circling", help="disco is some ten times slower")
    add("--out", type=Path, default=Path("out/faults"))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    cycle_us, duration_s = round(given.cycle_ms * 1000), given.hours * 3600.0
    seeds = range(given.first, given.first + given.seeds)
    files = {seed: given.out / f"seed-{seed:03}-{given.hours:g}h-{cycle_us}us-{given.planner}.json" for seed in seeds}
    with ProcessPoolExecutor(given.jobs, initializer=os.nice, initargs=(10,)) as pool:
        running = {
            pool.submit(run_seed, seed, duration_s, cycle_us, given.planner): seed
            for seed in seeds
            if not files[seed].exists()
        }
        for future in as_completed(running):
            result = future.result()
            fresh = files[result["seed"]].with_suffix(".part")
            fresh.write_text(json.dumps(result), encoding="utf-8")
            fresh.replace(files[result["seed"]])
            violations = len(result["violations"]) + bool(result["raised"])
            factor = result["simulated_s"] / result["cpu_s"]
            print(
                f"seed {result['seed']}: {result['simulated_s']:.0f} s at {factor:.0f} times real time on a core, "
                f"{len(result['faults'])} faults, {violations} violations",
                flush=True,
            )
    results = [json.loads(file.read_text(encoding="utf-8")) for file in files.values() if file.exists()]
    return _report(results)


def _report(results: list[dict[str, Any]]) -> int:
    rows = summary(results)
    print(markdown(rows))
    hours = sum(result["simulated_s"] for result in results) / 3600.0
    cpu_s = sum(result["cpu_s"] for result in results)
    seen, accepted = (sum(result[f"commands_{name}"] for result in results) for name in ("seen", "accepted"))
    print(
        f"{len(results)} seeds, {hours:.2f} h simulated in {cpu_s / 3600.0:.2f} CPU h "
        f"({hours * 3600.0 / cpu_s:.0f} times real time on a core); "
        f"{seen} wheel commands reached the robot, {accepted} were accepted"
    )
    bad = [
        f"seed {result['seed']}: {text}"
        for result in results
        for text in (*result["violations"], *([result["raised"]] if result["raised"] else []))
    ]
    silent = {kind: row["stop_untold"] for kind, row in rows.items() if row["stop_untold"]}
    bad += [f"{kind}: {count} stops without a word in the log" for kind, count in silent.items()]
    print("\n".join(bad) or "no violation")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
