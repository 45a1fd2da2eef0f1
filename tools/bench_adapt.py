"""What adaptation costs the loop, and what it wins; `python -m tools.bench_adapt steps`: how soon a step is known."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import disco_hw
from disco_hw.adaptation.adapter import Adapter
from disco_hw.adaptation.adapter_link import InForce, PoseReading, ProcessLink, Samples, WheelAngles
from disco_hw.adaptation.geometry_filter import GeometryFilter
from disco_hw.adaptation.guard import Geometry, believed_geometry, possible_range
from disco_hw.adaptation.network import Training, train_network, training_range
from disco_hw.adaptation.recursive import evidence
from disco_hw.daemon.run import warm_up
from disco_hw.experiments import FAST_START, FAST_TASK, running_stack
from disco_hw.experiments.adapt import AdaptOptions, drive_through_change, run_adapt
from disco_hw.inference.excitation import USUAL
from disco_hw.runtime.assembly import make_adaptation, make_pipeline, make_planner, put_in_force
from disco_hw.runtime.robot_setup import Setup, load_setup
from drivers.types import PoseSample, Readings, WheelSample
from tools.adaptation_drives import TRUTH, excited, messages
from tools.foreign_plant import NOMINAL, ForeignPlant, ForeignRobot

LIVE_S = 30.0
ROBOT = Path(disco_hw.__file__).parent / "robots" / "wombot.toml"


def run() -> dict[str, float]:
    """Microseconds of the daemon's calls, milliseconds of the adapter's, figures of the loop, and of the experiment."""
    setup = load_setup(ROBOT)
    return _calls(setup) | _adapter(setup) | _live() | _changed_live() | _won_back(setup)


def steps(seeds: int = 12) -> dict[str, float]:
    """Seconds until the geometry filter and the recursive estimate know 80 % of a step of 15 %, at most LONGEST_STEP_S.

    Foreign robots that turn at 0.29 rad/s, the same readings for both. Of the recursive estimate every proposal counts,
    also one that the daemon's checks would have confirmed first.
    """
    figures: dict[str, float] = {}
    for index, field in enumerate(("radius_m", "axle_m", "x_icr_m")):
        for factor in (1.15, 0.85):
            taken = np.array([step_known_s(index, field, factor, seed) for seed in range(61, 61 + seeds)])
            key = f"adapt.step.{field}_{factor:g}"
            for name, column in zip(("filter", "recursive"), taken.T, strict=True):
                figures |= {f"{key}.{name}_median_s": float(np.median(column)), f"{key}.{name}_worst_s": column.max()}
    return figures


CHANGED_AFTER_S, LONGEST_STEP_S = 10.0, 10.0
# The filter's order is wheel radius, axial distance, x_icr; that of messages begins with x_icr.
_TO_MESSAGE, _FROM_MESSAGE = [2, 0, 1], [1, 2, 0]


def step_known_s(index: int, field: str, factor: float, seed: int) -> tuple[float, float]:
    """Seconds until filter and recursive estimate know 80 % of a step of one length (`index`, `field`) by `factor`."""
    mean = np.array(NOMINAL)
    covariance = np.diag((0.15 / np.sqrt(3.0) * mean) ** 2)
    filtered, recursive = GeometryFilter(mean, covariance, 0.5 * mean, 1.6 * mean), Adapter()
    wide = covariance[np.ix_(_TO_MESSAGE, _TO_MESSAGE)].ravel().tolist()
    recursive.take(InForce(0, tuple(mean[_TO_MESSAGE].tolist()), tuple(wide), adapted=False))
    plant = ForeignPlant(ForeignRobot(*NOMINAL), (0.0, 0.0, 0.3), seed)
    found = [LONGEST_STEP_S, LONGEST_STEP_S]
    begin = round(CHANGED_AFTER_S / 0.02)
    for tick in range(begin + round(LONGEST_STEP_S / 0.02)):
        if tick == begin:
            other = ForeignPlant(replace(plant.robot, **{field: factor * NOMINAL[index]}), plant.pose, 1)
            plant.robot, plant._numbers = other.robot, other._numbers
        readings = plant.readings()
        filtered.add(readings.wheels, readings.poses)
        report = recursive.take(_message(plant.now_ns, readings))
        plant.advance(2.6, 4.6, 20)
        if tick < begin:
            continue
        believed = [filtered.mean]
        if report is not None and report.proposals:
            believed.append(np.array(report.proposals[-1].mean)[_FROM_MESSAGE])
        for place, one in enumerate(believed):
            if (one[index] / NOMINAL[index] - 1.0) / (factor - 1.0) > 0.8:
                found[place] = min(found[place], 0.02 * (tick + 1 - begin))
        if max(found) < LONGEST_STEP_S:
            break
    return found[0], found[1]


def _message(now_ns: int, readings: Readings) -> Samples:
    """The readings as the daemon hands them to the adapter's process."""
    return Samples(
        now_ns,
        tuple(WheelAngles(one.t_ns, one.left_angle_rad, one.right_angle_rad) for one in readings.wheels),
        tuple(PoseReading(one.t_ns, one.x_m, one.y_m, one.yaw_rad) for one in readings.poses),
    )


def _calls(setup: Setup) -> dict[str, float]:
    """The calls that the loop makes, the adapter's process at the other end."""
    link = ProcessLink()
    planner = make_planner(setup.config, setup.model)
    pipeline = make_pipeline(setup.config, setup.model, planner)
    warm_up(pipeline)
    adaptation = make_adaptation(setup, pipeline, link)
    readings = Readings(
        wheels=(WheelSample(1, 1, 0.0, 0.0, 0.0, 0.0),), poses=(PoseSample(1, 1, 0.0, 0.0, 0.0, 0.01, 0.01),)
    )
    try:
        figures = _timed("adapt.step", 2000, lambda k: adaptation.step(k * 20_000_000))
        figures |= _timed("adapt.feed", 2000, lambda k: adaptation.feed(k * 20_000_000, readings))
    finally:
        link.close()
    believed = believed_geometry(setup.model)
    beliefs = [Geometry(believed.mean * (1.0 + 1e-4 * k), believed.covariance) for k in range(300)]
    figures |= _timed("adapt.put_in_force", 300, lambda k: put_in_force(pipeline, setup.model, beliefs[k]))
    return figures


def _timed(name: str, count: int, call: Callable[[int], object]) -> dict[str, float]:
    taken = np.empty(count)
    for k in range(count):
        begun = time.perf_counter()
        call(k)
        taken[k] = 1e6 * (time.perf_counter() - begun)
    p50, p99, p999 = np.percentile(taken, (50.0, 99.0, 99.9))
    return {f"{name}_p50_us": float(p50), f"{name}_p99_us": float(p99), f"{name}_p999_us": float(p999)}


def _adapter(setup: Setup) -> dict[str, float]:
    """A report of the recursive estimate over a full window, training, and a conditioning; coverage of the network."""
    adapter = Adapter()
    adapter.take(InForce(0, TRUTH, tuple((np.diag([0.02, 0.006, 0.04]) ** 2).ravel().tolist()), adapted=False))
    reports = []
    for message in messages(60.0):
        begun = time.perf_counter()
        if adapter.take(message) is not None:
            reports.append(1e3 * (time.perf_counter() - begun))
    mean = np.array(TRUTH)
    low, high = training_range(mean, *possible_range(setup.config.prior))
    begun = time.perf_counter()
    network = train_network(Training(low, high, setup.config.robot.max_wheel_speed_rad_s), USUAL, setup.model)
    figures = {
        "adapt.report_p50_ms": float(np.median(reports[30:])),
        "adapt.train_s": time.perf_counter() - begun,
    }
    rng = np.random.default_rng(1)
    inside, taken = [], []
    for seed in range(100):
        truth = tuple((mean * rng.uniform(0.85, 1.1, 3)).tolist())
        window = evidence(excited(8.0, seed=seed, truth=truth), USUAL)
        begun = time.perf_counter()
        found = network.condition(window)
        taken.append(1e3 * (time.perf_counter() - begun))
        inside.append(np.abs(found.mean - truth) < 1.645 * np.sqrt(np.diag(found.covariance)))
    return figures | {"adapt.condition_p50_ms": float(np.median(taken)), "adapt.coverage_of_90": float(np.mean(inside))}


def _live() -> dict[str, float]:
    """The loop in real time with and without adaptation, while the network is trained and after."""
    figures: dict[str, float] = {}
    for name, arguments in (("without", ()), ("with", ("--adapt",))):
        with TemporaryDirectory() as directory:
            task = FAST_TASK.replace("0.45", "0.3")
            with running_stack(Path(directory), task=task, start=FAST_START, run_arguments=arguments) as stack:
                stack.start()
                time.sleep(LIVE_S)
                loop = stack.operator.status()["loop"]
                stack.operator.request("quit")
        for figure in ("p50", "p99", "p999", "max"):
            figures[f"adapt.loop_{name}.lateness_{figure}_us"] = loop["lateness_us"][figure]
            figures[f"adapt.loop_{name}.duration_{figure}_us"] = loop["duration_us"][figure]
        figures[f"adapt.loop_{name}.overruns"] = float(loop["overruns"])
        figures[f"adapt.loop_{name}.skipped"] = float(loop["skipped"])
    return figures


def _changed_live() -> dict[str, float]:
    """Wheels or axle that grow by 15 % under the real daemon: tracking costs before and after, adapting and not."""
    figures: dict[str, float] = {}
    for changes in ("wheel radius", "axial distance"):
        for name, adapt in (("without", False), ("with", True)):
            with TemporaryDirectory() as directory:
                driven = drive_through_change(Path(directory), changes, adapt=adapt)
            key = f"adapt.{changes.replace(' ', '_')}_live_{name}"
            figures |= {f"{key}.{field}": float(value) for field, value in asdict(driven).items()}
    return figures


def _won_back(setup: Setup) -> dict[str, float]:
    """The experiment with one seed."""
    figures: dict[str, float] = {}
    for row in run_adapt(setup, replace(AdaptOptions(), seeds=1)).rows():
        name = str(row.pop("changes")).replace(" ", "_")
        figures |= {f"adapt.{name}.{key}": float(value) for key, value in row.items()}
    return figures


if __name__ == "__main__":
    asked = sys.argv[1:]
    for key, value in (steps(*map(int, asked[1:])) if asked[:1] == ["steps"] else run()).items():
        print(f"{key:45} {value:12.4g}")
