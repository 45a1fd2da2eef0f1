"""Compares the time of a plan with and without a fence, in one process: `python -m tools.fence_plan_time [--plans N]`.

The planners of the shipped robot look around and plan in turn from the same places on the circle, so that whatever else
the computer does slows all of them down. The tenth percentile is what a plan takes while nothing else runs.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

import disco_hw
from disco_hw.control import PlannerState
from disco_hw.experiments.fence_drives import FOOTPRINT
from disco_hw.fence import Fence
from disco_hw.fence.clearance import Boundaries
from disco_hw.runtime.assembly import create_planner
from disco_hw.runtime.robot_setup import load_setup

PERIOD_NS = 100_000_000
FIRST = 50
ROBOT = Path(disco_hw.__file__).parent / "robots" / "wombot.toml"
SIDES_M = (60.0, 6.0, 4.0, 3.2)
PERCENTILES = (10, 50)


def square(side_m: float) -> Fence:
    """A square room about the origin."""
    half = 0.5 * side_m
    return Fence(keep_in=((-half, -half), (half, -half), (half, half), (-half, half)))


def main() -> int:
    """Plan, and print the times of each room and their ratios to those without a fence."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plans", type=int, default=300, metavar="N")
    given = parser.parse_args()
    setup = load_setup(ROBOT)
    robot = msgspec.structs.replace(setup.config.robot, footprint_m=FOOTPRINT)
    fences = {"no fence": Fence()} | {f"room of {side:g} m": square(side) for side in SIDES_M}
    planners, took_s = [], np.zeros((FIRST + given.plans, len(fences)))
    for fence in fences.values():
        config = msgspec.structs.replace(setup.config, robot=robot, fence=fence)
        planners.append(create_planner(config, replace(setup, config=config).model))
    bounds = [Boundaries(FOOTPRINT, fence) for fence in fences.values()]
    for row in range(len(took_s)):
        angle, now_ns = 0.04 * row, row * PERIOD_NS
        state = PlannerState(now_ns, 0.78 * np.cos(angle), 0.78 * np.sin(angle), angle + 0.5 * np.pi, 4.0, 5.5)
        for column, (planner, one) in enumerate(zip(planners, bounds, strict=True)):
            begun_s = time.perf_counter()
            planner.look_around(one, 0.004)
            planner.plan(now_ns, state)
            took_s[row, column] = time.perf_counter() - begun_s
    took_ms = 1e3 * np.percentile(took_s[FIRST:], PERCENTILES, axis=0)
    print(f"{'':<16}" + "".join(f"{f'p{part}, ms':>10}{'ratio':>8}" for part in PERCENTILES))
    for name, times_ms in zip(fences, took_ms.T, strict=True):
        pairs = zip(times_ms, took_ms[:, 0], strict=True)
        print(f"{name:<16}" + "".join(f"{time_ms:10.3f}{time_ms / free_ms:8.2f}" for time_ms, free_ms in pairs))
    return 0


if __name__ == "__main__":
    sys.exit(main())
