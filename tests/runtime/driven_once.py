"""Arms, drives, learns and changes its task in simulated time, and prints which functions were compiled by when."""

from __future__ import annotations

import gc
import json
import sys
from dataclasses import replace

import msgspec
from numba.core.dispatcher import Dispatcher

from disco_hw.adaptation.guard import believed_geometry
from disco_hw.config import SHIPPED_ROBOT
from disco_hw.daemon.run import warm_up
from disco_hw.runtime import State
from disco_hw.runtime.assembly import apply_geometry, create_pipeline, create_planner
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.runtime.supervisor import UserRequest
from tests.runtime.simulated import simulated_stack


def compiled_forms() -> dict[str, int]:
    """How many forms each compiled function of ours has; the plant is the robot, which may stall."""
    functions = [each for each in gc.get_objects() if isinstance(each, Dispatcher)]
    found = {f"{each.py_func.__module__}.{each.py_func.__qualname__}": len(each.overloads) for each in functions}
    return {name: count for name, count in found.items() if name.startswith("disco_hw.")}


def main(uncertainty: str) -> None:
    setup = load_setup(SHIPPED_ROBOT)
    control = msgspec.structs.replace(setup.config.control, uncertainty=uncertainty)
    setup = replace(setup, config=msgspec.structs.replace(setup.config, control=control))
    warm_up(create_pipeline(setup.config, setup.model, create_planner(setup.config, setup.model)))
    stack = simulated_stack(create_planner(setup.config, setup.model))
    before = compiled_forms()
    stack.run(1.0)
    stack.run(1.0, UserRequest.ARM)
    stack.run(1.0, UserRequest.START)
    for _ in range(3):
        stack.run(0.5)
        found = stack.core.pipeline.rollouts(16)
        assert found is not None
        assert len(found.weights) == 16
    if uncertainty == "ut":
        believed = believed_geometry(setup.model)
        apply_geometry(stack.core.pipeline, setup.model, replace(believed, covariance=0.5 * believed.covariance))
        stack.run(0.5)
    stack.run(1.0, UserRequest.STOP)
    stack.core.set_task(msgspec.structs.replace(stack.core.task, radius_m=1.0))
    last = stack.run(1.0, UserRequest.START)[-1]
    assert last.output.state is State.ARMED
    assert last.pipeline.plan is not None
    print(json.dumps({"before": before, "after": compiled_forms()}))


main(sys.argv[1])
