"""Benchmark of path following: distance, progress and share of time in reverse, from facing the way and against it.

Plants drawn from the shipped posterior, wheel lag 0.1 s, 5 % wheel noise, plans at 10 Hz. A time counts as in reverse
below -0.02 m/s. What it takes a robot that faces the wrong way to turn round is left out of the distance: 8 s, and 2 s
for one that faces the way.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.control import CommandLimits, Disco, DiscoSettings, PlannerState, SentCommand
from disco_hw.experiments.circle import KinematicPlant, plants
from disco_hw.model import Model, load_model
from disco_hw.tasks.line import load_waypoints
from disco_hw.tasks.path import PathTask
from tools.bench.step_times import summary, times_ms, undisturbed

ROBOTS = SHIPPED_ROBOT.parent
LIMITS = CommandLimits(8.0, 20.0)
RATE_HZ = 10.0
LAG_S, WHEEL_NOISE = 0.1, 0.05
REVERSE_M_S = -0.02
SETTLED_S = {"along": 2.0, "against": 8.0}
TURNED_RAD = {"along": 0.0, "against": math.pi}

Points = tuple[tuple[float, float], ...]
Array = NDArray[np.float64]


def paths() -> dict[str, Points]:
    """The ways to follow, by name; metres."""
    eight = load_waypoints(ROBOTS / "eight.csv").places_m.tolist()
    angle = np.linspace(0.0, 2.0 * np.pi, 181)[:-1]
    ring = [(math.sin(a), 1.0 - math.cos(a)) for a in angle]
    return {
        "eight": tuple((x, y) for x, y in eight),
        "round": (*ring, ring[0]),
        "square": ((0.0, 0.0), (1.5, 0.0), (1.5, 1.5), (0.0, 1.5), (0.0, 0.0)),
        "triangle": ((0.0, 0.0), (2.0, 0.0), (1.0, math.sqrt(3.0)), (0.0, 0.0)),
        "lanes": ((0.0, 0.0), (2.0, 0.0), (2.0, 0.3), (0.0, 0.3), (0.0, 0.6), (2.0, 0.6)),
        "there_and_back": ((0.0, 0.0), (2.0, 0.0), (0.0, 0.0)),
    }


def run(seeds: int = 3, duration_s: float = 40.0, speed_m_s: float = 0.25) -> dict[str, float]:
    """Time of a plan; every path from facing the way and against it: see `followed`."""
    model = load_model(ROBOTS / "wombot_model.toml")
    figures = plan_times(model, speed_m_s)
    for name, points in paths().items():
        task = PathTask(path=f"{name}.csv", speed_m_s=speed_m_s, points=points)
        for facing in TURNED_RAD:
            drives = [drive(model, task, theta, facing, s, duration_s) for s, theta in enumerate(plants(model, seeds))]
            figures |= {f"control.path.{name}.{facing}.{key}": v for key, v in followed(task, drives, facing).items()}
    return figures


def plan_times(model: Model, speed_m_s: float, steps: int = 500) -> dict[str, float]:
    """Milliseconds of a plan along the eight at the paper's size, as the robot moves on."""
    cost = PathTask(path="eight.csv", speed_m_s=speed_m_s, points=paths()["eight"]).planned("default")
    x_m, y_m, *_ = cost.path.table[0].tolist()
    planner = Disco(model, cost, DiscoSettings(), LIMITS)
    with undisturbed():
        return summary(
            "control.path.plan_ms",
            times_ms(lambda n: planner.plan(n * 10**8, PlannerState(n * 10**8, x_m, y_m, 0.8, 3.0, 3.0)), steps),
        )


def followed(task: PathTask, drives: list[Array], facing: str) -> dict[str, float]:
    """Root mean square and largest distance (mm), part of the time in reverse, mean and least way driven (m)."""
    settled = round(SETTLED_S[facing] * RATE_HZ)
    course, path = task.course(), task.planned("default").path
    off_mm = np.array([np.abs(course.off_m(rows[settled:, :2])) * 1e3 for rows in drives])
    reverse = np.array([rows[settled:, 2] < REVERSE_M_S for rows in drives])
    count = len(path.table) - 1
    moved = np.array([np.diff(rows[:, 3]) for rows in drives])
    if path.closed:
        moved -= count * np.round(moved / count)
    driven_m = moved.sum(axis=1) * path.spacing_m
    return {
        "rms_mm": float(np.sqrt(np.mean(off_mm**2))),
        "max_mm": float(off_mm.max()),
        "reverse_part": float(reverse.mean()),
        "driven_m": float(driven_m.mean()),
        "driven_least_m": float(driven_m.min()),
    }


def drive(model: Model, task: PathTask, theta: dict[str, float], facing: str, seed: int, duration_s: float) -> Array:
    """One drive from the first way-point: x, y (m), forward speed (m/s) and place in the table after each period."""
    cost = task.planned("default")
    x_m, y_m, yaw_rad = task.course().start
    plant = KinematicPlant(theta, (x_m, y_m, yaw_rad + TURNED_RAD[facing]), LAG_S, WHEEL_NOISE, seed)
    planner = Disco(model, cost, DiscoSettings(), LIMITS, seed + 1)
    sent: list[SentCommand] = []
    rows = np.empty((round(duration_s * RATE_HZ), 4))
    place: Any = None
    for step in range(len(rows)):
        now_ns = round(step / RATE_HZ * 1e9)
        state = PlannerState(now_ns, plant.x_m, plant.y_m, plant.yaw_rad, *plant.wheels, sent=tuple(sent))
        left, right = planner.plan(now_ns, state).at(now_ns)
        sent = [*sent[-20:], SentCommand(now_ns, left, right)]
        plant.advance(left, right, 1.0 / RATE_HZ)
        place = cost.path.place(plant.x_m, plant.y_m, plant.yaw_rad, place)
        rows[step] = plant.x_m, plant.y_m, plant.forward_m_s, place
    return rows
