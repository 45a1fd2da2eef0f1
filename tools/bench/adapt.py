"""Cost of adaptation in the loop; `python -m tools.bench.adapt scenarios`: how well it estimates."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw.adaptation.fast import FastAdaptation
from disco_hw.adaptation.guard import Geometry, believed_geometry
from disco_hw.config import SHIPPED_ROBOT
from disco_hw.daemon.run import warm_up
from disco_hw.runtime.assembly import apply_geometry, create_fast_adaptation, create_pipeline, create_planner
from disco_hw.runtime.robot_setup import load_setup
from drivers.types import PoseSample, Readings, WheelSample
from tools.bench.step_times import percentiles, times_ms
from tools.foreign_plant import NOMINAL, ForeignPlant, ForeignRobot, robots

Array = NDArray[np.float64]

LENGTHS = ("radius_m", "axle_m", "x_icr_m")
# The order of the adaptation's arrays is x_icr, wheel radius, axial distance.
_TO_ADAPTATION, _FROM_ADAPTATION = [2, 0, 1], [1, 2, 0]


def run() -> dict[str, float]:
    """Times of the calls that the loop makes, in microseconds."""
    setup = load_setup(SHIPPED_ROBOT)
    planner = create_planner(setup.config, setup.model)
    pipeline = create_pipeline(setup.config, setup.model, planner)
    warm_up(pipeline)
    adaptation = create_fast_adaptation(setup, pipeline)

    def readings(k: int) -> Readings:
        t_ns, angle_rad = k * 20_000_000, 0.08 * k
        pose = PoseSample(t_ns, t_ns, 0.004 * k, 0.0, 0.0, 0.005, 0.01)
        return Readings(
            wheels=(WheelSample(t_ns, t_ns, angle_rad, angle_rad, 4.0, 4.0),), poses=(pose,) if k % 2 else ()
        )

    believed = believed_geometry(setup.model)
    beliefs = [Geometry(believed.mean * (1.0 + 1e-4 * k), believed.covariance) for k in range(320)]
    calls: dict[str, tuple[int, Callable[[int], object]]] = {
        "feed": (2000, lambda k: adaptation.feed(k * 20_000_000, readings(k))),
        "step": (2000, lambda k: adaptation.step(k * 20_000_000)),
        "apply_geometry": (300, lambda k: apply_geometry(pipeline, setup.model, beliefs[k])),
    }
    figures: dict[str, float] = {}
    for name, (count, call) in calls.items():
        figures |= percentiles(f"adapt.{name}_us", 1e3 * times_ms(call, count))
    return figures


@dataclass(frozen=True, slots=True)
class Scenario:
    """A drive of a foreign robot: what it is, how it changes at `change_s`, and how good its poses are.

    `changed` gives the robot after `seconds` of driving. `narrow`: the belief at first is 1 % wide, else 15 %.
    `poses`: every how many-th pose arrives, and the noise added to it (m, rad), which the poses state. Evaluated over
    the last `evaluated_s`. `step` of the length number `index` by a factor: how soon 80 % is known.
    """

    robot: Callable[[int], ForeignRobot] = lambda seed: ForeignRobot(*NOMINAL)
    changed: Callable[[ForeignRobot, float], ForeignRobot] = lambda robot, seconds: robot
    narrow: bool = False
    poses: tuple[int, float, float] = (1, 0.0, 0.0)
    duration_s: float = 45.0
    evaluated_s: float = 15.0
    step: tuple[int, float] | None = None


CHANGE_S = 15.0


def _step(index: int, factor: float, **more: object) -> Scenario:
    name = LENGTHS[index]
    changed: dict[str, float] = {name: NOMINAL[index] * factor}

    def after(robot: ForeignRobot, seconds: float) -> ForeignRobot:
        return replace(robot, **(changed if seconds >= CHANGE_S else {}), **(more if seconds >= CHANGE_S else {}))  # type: ignore[arg-type]

    return Scenario(changed=after, step=(index, factor))


def _unlike(seed: int) -> ForeignRobot:
    return robots(8000 + seed, 1)[0]


SCENARIOS: dict[str, Scenario] = {
    **{
        f"{name} {100 * (factor - 1):+.0f} %": _step(index, factor)
        for index, name in enumerate(LENGTHS)
        for factor in (1.15, 0.85)
    },
    "slippery surface": _step(1, 1.1, grip_std=0.08, push_n=160.0),
    "robot unlike its model": Scenario(robot=_unlike),
    "the same, belief of 1 %": Scenario(robot=lambda seed: robots(8000 + seed, 1, 0.10)[0], narrow=True),
    "radius drifts 5 % in 60 s": Scenario(
        changed=lambda robot, seconds: replace(robot, radius_m=NOMINAL[0] * (1.0 - 0.05 * min(seconds / 60.0, 1.0))),
        duration_s=70.0,
        evaluated_s=40.0,
    ),
    "no change, rough ground": Scenario(
        robot=lambda seed: ForeignRobot(*NOMINAL, grip_std=0.08), duration_s=60.0, evaluated_s=40.0
    ),
    "no change, belief of 1 %": Scenario(narrow=True, duration_s=60.0, evaluated_s=50.0),
    "poses 5 Hz, 10 mm": Scenario(robot=_unlike, poses=(5, 0.01, 0.015), duration_s=60.0),
    "poses 2 Hz, 25 mm": Scenario(robot=_unlike, poses=(12, 0.025, 0.03), duration_s=90.0, evaluated_s=30.0),
}


@dataclass(frozen=True, slots=True)
class Estimated:
    """Result of one drive.

    Root mean square error (3,) by size, share of time (3,) in which the 90 % interval held the truth. `known_s` after a
    step until 80 % of it was known (infinite: never); `changes` that the filter believed in.
    """

    error: Array
    coverage: Array
    known_s: float
    changes: int


def scenarios(seeds: int = 8) -> dict[str, float]:
    """Errors and coverage of the filter's estimates on foreign robots, and how soon a change is known."""
    figures: dict[str, float] = {}
    for name, scenario in SCENARIOS.items():
        found = [estimate(scenario, seed) for seed in range(seeds)]
        key = f"adapt.{name}"
        errors, coverage = (np.array([getattr(one, field) for one in found]) for field in ("error", "coverage"))
        for index, length in enumerate(LENGTHS):
            figures[f"{key}.{length}_error_percent"] = float(100.0 * np.median(errors[:, index]))
            figures[f"{key}.{length}_held_percent"] = float(100.0 * np.mean(coverage[:, index]))
        if scenario.step is not None:
            figures[f"{key}.known_median_s"] = float(np.median([one.known_s for one in found]))
            figures[f"{key}.known_worst_s"] = max(one.known_s for one in found)
        figures[f"{key}.changes"] = float(sum(one.changes for one in found))
    return figures


def estimate(scenario: Scenario, seed: int) -> Estimated:
    """Drive one scenario in simulated time, and judge the belief in force."""
    mean = np.array(NOMINAL)[_TO_ADAPTATION]
    spread = 0.01 if scenario.narrow else 0.15 / math.sqrt(3.0)
    model = Geometry(mean, np.diag((spread * mean) ** 2))
    in_force = [model]
    adaptation = FastAdaptation(model, 0.5 * mean, 1.6 * mean, lambda one: in_force.append(one or model))
    first = scenario.robot(seed)
    plant, noise = ForeignPlant(first, (0.0, 0.0, 0.3), seed), np.random.default_rng(seed + 1000)
    errors, covered, known_s = [], [], math.inf
    for tick in range(round(scenario.duration_s / 0.02)):
        seconds = 0.02 * tick
        if tick % 25 == 0:
            plant.become(scenario.changed(first, seconds))
        adaptation.feed(plant.now_ns, _as_good(plant.readings(), scenario, noise))
        adaptation.step(plant.now_ns)
        plant.advance(*_commands(seconds), 20)
        truth = np.array([getattr(plant.robot, length) for length in LENGTHS])
        believed, deviation = (array[_FROM_ADAPTATION] for array in (in_force[-1].mean, in_force[-1].std))
        if seconds > scenario.duration_s - scenario.evaluated_s:
            errors.append(believed / truth - 1.0)
            covered.append(np.abs(believed - truth) < 1.645 * deviation)
        if scenario.step is not None and seconds >= CHANGE_S and math.isinf(known_s):
            index, factor = scenario.step
            if (believed[index] / NOMINAL[index] - 1.0) / (factor - 1.0) > 0.8:
                known_s = seconds - CHANGE_S
    error = np.sqrt(np.mean(np.square(errors), axis=0))
    return Estimated(error, np.mean(covered, axis=0), known_s, adaptation.counts()["changes"])


def _commands(seconds: float) -> tuple[float, float]:
    """Wheel speeds (rad/s) at a time: curves, a straight, a turn the other way, a turn on the spot; 12 s in all."""
    phase = seconds % 12.0
    if phase < 4.0:
        return 3.0 + 0.8 * math.sin(1.7 * seconds), 4.2 - 0.6 * math.sin(1.3 * seconds)
    if phase < 7.0:
        return 4.0, 4.0
    return (4.6, 2.4) if phase < 10.0 else (-1.5, 1.5)


def _as_good(readings: Readings, scenario: Scenario, noise: np.random.Generator) -> Readings:
    """The readings with poses made rarer and noisier."""
    every, position_m, yaw_rad = scenario.poses
    found = []
    for pose in readings.poses:
        if pose.t_ns // 40_000_000 % every == 0:
            x, y, yaw = noise.standard_normal(3) * (position_m, position_m, yaw_rad)
            found.append(
                msgspec.structs.replace(
                    pose, x_m=pose.x_m + x, y_m=pose.y_m + y, yaw_rad=pose.yaw_rad + yaw,
                    position_std_m=math.hypot(pose.position_std_m, position_m),
                    yaw_std_rad=math.hypot(pose.yaw_std_rad, yaw_rad),
                )
            )  # fmt: skip
    return Readings(wheels=readings.wheels, poses=tuple(found))


if __name__ == "__main__":
    for key, value in scenarios(*map(int, sys.argv[2:])).items():
        print(f"{key:45} {value:12.4g}")
