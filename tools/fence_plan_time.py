"""Compares the time of a plan with and without a fence, in one process: `python -m tools.fence_plan_time [--plans N]`.

The planners of the shipped robot plan in turn from the same places on the circle, so that whatever else the computer
does slows all of them down.
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
from disco_hw.runtime.assembly import make_planner
from disco_hw.runtime.robot_setup import load_setup

PERIOD_NS = 100_000_000
FIRST = 50
ROBOT = Path(disco_hw.__file__).parent / "robots" / "wombot.toml"
SIDES_M = (60.0, 4.0, 3.2)


def square(side_m: float) -> Fence:
    """A square room about the origin."""
    half = 0.5 * side_m
    return Fence(keep_in=((-half, -half), (half, -half), (half, half), (-half, half)))


def main() -> int:
    """Plan, and print the median time of each room and its ratio to that without a fence."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plans", type=int, default=300, metavar="N")
    given = parser.parse_args()
    setup = load_setup(ROBOT)
    robot = msgspec.structs.replace(setup.config.robot, footprint_m=FOOTPRINT)
    fences = {"no fence": Fence()} | {f"room of {side:g} m": square(side) for side in SIDES_M}
    planners, took_s = [], np.zeros((FIRST + given.plans, len(fences)))
    for fence in fences.values():
        config = msgspec.structs.replace(setup.config, robot=robot, fence=fence)
        planners.append(make_planner(config, replace(setup, config=config).model))
    for row in range(len(took_s)):
        angle, now_ns = 0.04 * row, row * PERIOD_NS
        state = PlannerState(now_ns, 0.78 * np.cos(angle), 0.78 * np.sin(angle), angle + 0.5 * np.pi, 4.0, 5.5)
        for column, (planner, fence) in enumerate(zip(planners, fences.values(), strict=True)):
            planner.look_around(Boundaries(FOOTPRINT, fence), 0.004)
            begun_s = time.perf_counter()
            planner.plan(now_ns, state)
            took_s[row, column] = time.perf_counter() - begun_s
    medians_ms = 1e3 * np.median(took_s[FIRST:], axis=0)
    for name, median_ms in zip(fences, medians_ms, strict=True):
        print(f"{name:<16}{median_ms:8.3f} ms{median_ms / medians_ms[0]:8.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
