"""`make test` begins with this: compiles on two cores what each test process would else compile for itself."""

from __future__ import annotations

import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

import disco_hw
from disco_hw.control import CommandLimits, Disco, DiscoSettings
from disco_hw.gap.find import missing_effects
from disco_hw.model import Model
from disco_hw.runtime.assembly import make_planner
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.tasks import task_from
from disco_hw.tasks.line.table import Waypoints
from disco_hw.tasks.timed_path import TimedPathCost
from tools.gap_logs import simulated_drive

ROBOT = Path(disco_hw.__file__).parent / "robots" / "wombot.toml"
CORNER = Waypoints(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), np.array([0.0, 5.0, 10.0]))


def plan_every_kind_of_task() -> None:
    setup = load_setup(ROBOT)
    make_planner(setup.config, setup.model)
    limits = CommandLimits.of_robot(setup.config.robot)
    for task in (task_from({"kind": "lemniscate"}).planned("default"), TimedPathCost(CORNER)):
        Disco(setup.model, task, DiscoSettings(), limits).warm_up()


def search_a_log() -> None:
    missing_effects(simulated_drive({}, seed=1, drive="circle"), Model(0.061, 0.415, 0.238))


def main() -> int:
    work: tuple[Callable[[], None], ...] = (plan_every_kind_of_task, search_a_log)
    with ProcessPoolExecutor(len(work)) as pool:
        for done in [pool.submit(one) for one in work]:
            done.result()
    return 0


if __name__ == "__main__":
    sys.exit(main())
