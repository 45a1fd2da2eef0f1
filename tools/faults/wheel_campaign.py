"""`python -m tools.faults.wheel_campaign`: wheels that cease to obey, with every driver's simulated controller.

Every fault at every speed with every driver on a circle and straight on, the sides in turn; then healthy drives on
rough ground. Prints the table of docs/results.md, and exits with 1 if a fault was missed, a cause was wrong, or a
healthy robot was stopped.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import random
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path

from drivers.motor import motor_drivers
from sim.plant_parameters import PlantParameters
from tools.faults.wheel_run import FAULTS, WheelFaultRun, WheelRun

SPEEDS_M_S = (0.03, 0.05, 0.08, 0.2)
TRACKS = ("circle", "straight")
WARM_UP_S = (5.0, 9.0)
WATCHED_S = 4.0
Job = tuple[str, str, float, str, str, int]


def some_plant(chance: random.Random) -> PlantParameters:
    """A robot with motors, geometry and noise of its own."""
    usual = PlantParameters()
    return replace(
        usual,
        wheel_radius_m=usual.wheel_radius_m * chance.uniform(0.95, 1.05),
        axial_distance_m=usual.axial_distance_m * chance.uniform(0.95, 1.05),
        speed_loop_time_constant_s=chance.uniform(0.03, 0.15),
        turning_load_nm=chance.uniform(0.1, 0.5),
    )


def strike(job: Job) -> WheelRun:
    """Run one fault and return its outcome."""
    driver, fault, speed, track, side, seed = job
    chance = random.Random(seed)
    run = WheelFaultRun(driver, speed, track, seed=seed, plant=some_plant(chance))
    stopped = run.drive(chance.uniform(*WARM_UP_S))
    outcome = WheelRun(driver, fault, speed, track, side)
    if stopped:
        outcome.status_text = f"stopped before the fault: {stopped[-1]}"
        return outcome
    return run.strike(outcome, WATCHED_S)


def rough_plant(chance: random.Random) -> PlantParameters:
    """Return a plant on rough ground.

    Wheels that are braked and pushed, a tenth of the way lost to slip, poses that jump and pause.
    """
    usual = some_plant(chance)
    return replace(
        usual,
        wheel_radius_m=0.9 * usual.wheel_radius_m,
        wheel_disturbance_std=chance.uniform(0.05, 0.12),
        wheel_drift_std=chance.uniform(0.0, 0.05),
        slip_std_x_m_s=chance.uniform(0.005, 0.02),
        slip_std_y_m_s=chance.uniform(0.005, 0.02),
        slip_std_yaw_rad_s=chance.uniform(0.02, 0.08),
        volatility=chance.uniform(0.0, 0.5),
        max_motor_torque_nm=chance.uniform(1.5, 5.0),
        pose_gap_interval_s=chance.choice((0.0, 10.0)),
        pose_gap_length_s=chance.uniform(0.2, 0.9),
        pose_outlier_probability=chance.choice((0.0, 0.005)),
        pose_dropout_probability=chance.choice((0.0, 0.1)),
    )


HEALTHY: tuple[dict[str, float | Sequence[float]], ...] = (
    {},
    {"deadband": 0.25},
    {"stiction": 0.9},
    {"motor_lag": 0.25},
    {"command_delay": 0.2},
    {"slope": (0.01, 0.7)},
    {"wheel_gain": (-0.1, 0.08)},
    {"deadband": 0.3, "motor_lag": 0.2, "command_delay": 0.1},
    {"acceleration_limit": 3.1},
    {"battery_sag": (0.1, 60.0)},
)


def drive_healthy(number: int, seconds: float) -> tuple[str, list[str]]:
    """One drive in which nothing is wrong with a wheel; the robot and what stopped it."""
    chance = random.Random(1000 + number)
    drivers = sorted(motor_drivers())
    driver, speed = drivers[number % len(drivers)], SPEEDS_M_S[number % len(SPEEDS_M_S)]
    hide = HEALTHY[number % len(HEALTHY)]
    track = TRACKS[number // 2 % 2]
    run = WheelFaultRun(driver, speed, track, seed=1000 + number, plant=rough_plant(chance), hide=hide)
    return f"{driver} {speed} {track} {hide}", run.drive(seconds)


def jobs(drivers: Sequence[str], seed: int) -> list[Job]:
    """Return the jobs for all faults, speeds and tracks; the sides take turns."""
    every = itertools.product(drivers, FAULTS, SPEEDS_M_S, TRACKS)
    sides = ("left", "right")
    return [
        (driver, fault, speed, track, sides[(number + number // 2 + number // 8) % 2], seed + number)
        for number, (driver, fault, speed, track) in enumerate(every)
    ]


def markdown(runs: Sequence[WheelRun]) -> str:
    """The table of docs/results.md: per driver and fault the slowest stop of all speeds."""
    lines = [
        "| driver | fault | runs | noticed after, median / longest | wheels stand after, longest "
        "| true travel, at the longest | missed | wrong cause |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for (driver, fault), group in itertools.groupby(runs, key=lambda run: (run.driver, run.fault)):
        of = list(group)
        noticed = sorted(run.noticed_s for run in of if not math.isnan(run.noticed_s)) or [math.nan]
        slowest = max(of, key=lambda run: math.inf if math.isnan(run.stopped_s) else run.stopped_s)
        lines.append(
            f"| `{driver}` | {fault} | {len(of)} | {noticed[len(noticed) // 2]:.2f} / {noticed[-1]:.2f} s "
            f"| {slowest.stopped_s:.2f} s | {slowest.travel_rad:.2f} rad | {sum(run.is_missed for run in of)} "
            f"| {sum(run.is_wrong for run in of)} |"
        )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.faults.wheel_campaign", description=__doc__)
    add = parser.add_argument
    add("--drivers", nargs="*", default=sorted(motor_drivers()), help="which")
    add("--seed", type=int, default=0, help="of plants and noise")
    add("--healthy", type=int, default=50, help="how many drives without a fault")
    add("--seconds", type=float, default=40.0, help="of each of them")
    add("--jobs", type=int, default=2, help="processes")
    add("-o", "--out", type=Path, help="write every run as a line of JSON")
    options = parser.parse_args()
    with ProcessPoolExecutor(options.jobs) as pool:
        runs = list(pool.map(strike, jobs(options.drivers, options.seed), chunksize=4))
        numbers = range(options.healthy)
        healthy = list(pool.map(drive_healthy, numbers, [options.seconds] * options.healthy))
    if options.out:
        options.out.write_text("".join(json.dumps(asdict(run)) + "\n" for run in runs))
    print(markdown(runs))
    missed, wrong = [run for run in runs if run.is_missed], [run for run in runs if run.is_wrong]
    stopped = [(which, events) for which, events in healthy if events]
    print(f"\n{len(runs)} faults: {len(missed)} missed, {len(wrong)} wrong causes; ", end="")
    print(f"{len(healthy)} healthy drives of {options.seconds:g} s: {len(stopped)} stopped")
    for name, which in (("missed", missed), ("wrong cause", wrong)):
        for run in which:
            print(f"{name}: {run.driver}, {run.fault}, {run.speed_m_s} m/s, {run.track}, {run.side}: "
                  f"{run.stopped_s:.2f} s, {run.travel_rad:.2f} rad: {run.status_text}")  # fmt: skip
    for which, events in stopped:
        print(f"stopped: {which}: {events}")
    return 1 if missed or wrong or stopped else 0


if __name__ == "__main__":
    sys.exit(main())
