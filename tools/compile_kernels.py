"""Compile on two cores what each worker of `make test` would else compile for itself.

What the tests of one file alone need is not here: these compile it themselves.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.control import CommandLimits, Disco, DiscoSettings
from disco_hw.gap import missing_effects
from disco_hw.inference.estimates import estimates
from disco_hw.inference.excitation import excitation
from disco_hw.inference.noise import USUAL
from disco_hw.inference.simulate import Simulator
from disco_hw.model import Model
from disco_hw.model.step import FreeRun
from disco_hw.runtime.assembly import create_planner
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.tasks import task_from
from disco_hw.tasks.line import Waypoints
from disco_hw.tasks.timed_path import TimedPathCost
from tools.every_effect import model_with_every_effect
from tools.gap.logs import simulated_drive

PROCESSORS = 2
CORNER = Waypoints(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), np.array([0.0, 5.0, 10.0]))


def plan_the_shipped_tasks() -> None:
    setup = load_setup(SHIPPED_ROBOT)
    create_planner(setup.config, setup.model)
    limits = CommandLimits.of_robot(setup.config.robot)
    for task in (task_from({"kind": "lemniscate"}).planned("default"), TimedPathCost(CORNER)):
        Disco(setup.model, task, DiscoSettings(), limits).warm_up()


def search_a_log() -> None:
    log, nominal = simulated_drive({}, seed=1, drive="circle"), Model(0.061, 0.415, 0.238)
    missing_effects(log, nominal)
    drive = excitation(log)
    Simulator(nominal, drive, USUAL).poses(np.array([[0.238, 0.061, 0.415]]), np.zeros(1, np.uint32))
    estimates(drive, USUAL).theta(drive.pose[None])
    model = model_with_every_effect({}, (0.06, 0.4, 0.1))
    FreeRun(model, model.point()[None], 0.1).states(np.zeros(5), np.zeros((4, 2)), 3)


def main() -> int:
    work: tuple[Callable[[], None], ...] = (plan_the_shipped_tasks, search_a_log)
    with ProcessPoolExecutor(PROCESSORS) as pool:
        for done in [pool.submit(one) for one in work]:
            done.result()
    return 0


if __name__ == "__main__":
    sys.exit(main())
