"""What one step of the planner takes, on the shipped robot: K = 400 sequences, T = 50 steps, L = 7 sigma points."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

import disco_hw
from disco_hw.control import PlannerState
from disco_hw.daemon.assembly import make_planner
from disco_hw.robot_setup import load_setup

STEPS = 3000
PERIOD_NS = 20_000_000


def run() -> dict[str, float]:
    """Time whole calls of `plan` one after another, in microseconds; the first ones are left out."""
    setup = load_setup(Path(disco_hw.__file__).parent / "robots" / "wombot.toml")
    planner = make_planner(setup.config, setup.model)
    taken_ns = np.empty(STEPS)
    for step in range(STEPS):
        now_ns = step * PERIOD_NS
        state = PlannerState(now_ns, 0.75, 0.0, 1.25, 2.3, 4.2)
        began_ns = time.perf_counter_ns()
        planner.plan(now_ns, state)
        taken_ns[step] = time.perf_counter_ns() - began_ns
    settled_us = taken_ns[100:] * 1e-3
    return {
        "control.plan_us.p50": float(np.percentile(settled_us, 50.0)),
        "control.plan_us.p99": float(np.percentile(settled_us, 99.0)),
        "control.plan_us.p99_9": float(np.percentile(settled_us, 99.9)),
        "control.plan_us.max": float(settled_us.max()),
    }
