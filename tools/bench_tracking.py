"""Comparison of classical followers and DISCO on a line, on foreign robots whose parameters are wrong.

Wheel radius, axle and x_icr of every robot are off by up to 15 %, and nobody is told; the motors' lag and dead band are
known to all. From rest on the line; figures are of 5 to 30 s, at 50 plans a second. The gains of the classical ones
were found on robots 0 to 4 (`docs/results.md`); these are robots 1000 on, or others with `--first`.
Names that begin with `mujoco_` drive the robot of `tools/mujoco_plant.py`, those with `turned_` the same robots with
their back as their front (`turned_robot`), as the MPC drives them. Ways that begin with `timed_` are
way-points by time, of which the distance from the line is shown. With `--slope 0.03` the ground carries the moving
robots of `tools/foreign_plant.py` by so much (m/s).

`python -m tools.bench_tracking disco_adapting circle,square 20` drives some of it; `... starts 20` begins anywhere.
`... --first 5000 --count 20` drives robots that nothing was chosen on; `--speeds 0.1,0.2,0.3` at these speeds (m/s),
and `--json` prints the figures as JSON. `nmpc` is a textbook nonlinear MPC (`tools/nmpc.py`, of [bench]). `forward` is
the part of the time in which a robot moves forward: nothing in the cost of that MPC asks for it. `nmpc_forward` is the
same MPC, which may not drive backwards.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from disco_hw.control import Disco, DiscoSettings, PlannerState, SentCommand
from disco_hw.control.baselines import Kanayama, LinearQuadratic, PurePursuit
from disco_hw.runtime.pipeline import Planner
from tools.foreign_plant import NOMINAL, ForeignPlant, ForeignRobot, robots, turned_robot
from tools.mujoco_plant import mujoco_plant, mujoco_robots
from tools.nmpc import NonlinearMpc
from tools.tracking import LIMITS, Contender, Drive, Track, classical, disco, drive, model, timed, tracks

FIRST = 1000
SPEED_M_S, RATE_HZ = 0.2, 50.0
MUJOCO, TURNED, TIMED = "mujoco_", "turned_", "timed_"


def contenders(speed_m_s: float = SPEED_M_S) -> dict[str, Contender]:
    """Return the rows of the table, by name, for tracks of this speed."""
    settings = DiscoSettings.for_speed(speed_m_s, RATE_HZ)
    nmpc = Contender(partial(_nmpc, speed_m_s, False), learns=True)
    integral = classical(PurePursuit(look_ahead_m=0.081, integral=3.04, preview_s=0.142), speed_m_s)
    nmpc_forward = Contender(partial(_nmpc, speed_m_s, True), learns=True)
    adapting = disco(settings, learns=True)
    sampled = disco(DiscoSettings.for_speed(speed_m_s, RATE_HZ, refine=False), learns=True)
    return {
        "pure_pursuit": classical(PurePursuit(), speed_m_s),
        "pure_pursuit_integral": integral,
        "kanayama": classical(Kanayama(), speed_m_s),
        "lqr": classical(LinearQuadratic(), speed_m_s),
        "nmpc": nmpc,
        "nmpc_forward": nmpc_forward,
        "disco_point": disco(replace(settings, uncertainty="point")),
        "disco_ut": disco(settings),
        "disco_adapting": adapting,
        "disco_backwards": disco(replace(settings, backwards=True), learns=True),
        "disco_sampled": sampled,
        "disco_truth": disco(settings, knows=True),
        "kanayama_truth": classical(Kanayama(), speed_m_s, knows=True),
    }


def _nmpc(speed_m_s: float, forward: bool, robot: ForeignRobot, track: Track) -> Planner:
    """Make the nonlinear MPC that begins with the geometry which is believed."""
    return NonlinearMpc(robot, track, speed_m_s, robot.believed, forward)


def rows(
    count: int,
    names: tuple[str, ...],
    ways: tuple[str, ...],
    first: int = FIRST,
    speed_m_s: float = SPEED_M_S,
    slope_m_s: float = 0.0,
) -> Iterator[tuple[str, list[Drive]]]:
    """The drives of these contenders on robots `first` to `first + count` - 1, and what they are called, by way."""
    for name in names:
        made: Callable[[int, int], list[ForeignRobot]] = robots
        plant_of: Callable[..., ForeignPlant] = ForeignPlant
        contender = name
        if contender.startswith(MUJOCO):
            made, plant_of, contender = mujoco_robots, mujoco_plant, contender.removeprefix(MUJOCO)
        driven = [replace(robot, slope_m_s=slope_m_s) for robot in made(first, count)]
        if contender.startswith(TURNED):
            driven, contender = [turned_robot(robot) for robot in driven], contender.removeprefix(TURNED)
        for way in ways:
            track = tracks(speed_m_s)[way.removeprefix(TIMED)]
            track = timed(track, speed_m_s) if way.startswith(TIMED) else track
            yield (
                f"tracking.{name}.{way}",
                [
                    drive(
                        contenders(speed_m_s)[contender],
                        robot,
                        track,
                        rate_hz=RATE_HZ,
                        seed=seed,
                        plant_of=plant_of,
                    ).after()
                    for seed, robot in enumerate(driven)
                ],
            )


def figures_of(drives: list[Drive]) -> dict[str, float]:
    """Median and worst RMS and median signed distance (mm), travel (rot/s^2), speed (m/s), part of the time forward."""
    return {
        "rms_median_mm": float(np.median([one.rms_mm for one in drives])),
        "rms_worst_mm": max(one.rms_mm for one in drives),
        "signed_median_mm": float(np.median([one.signed_mm for one in drives])),
        "travel_rot_s2": float(np.median([one.travel_rot_s2 for one in drives])),
        "speed_m_s": float(np.median([one.speed_m_s for one in drives])),
        "forward": float(np.median([np.mean(one.forward_m_s > 0.0) for one in drives])),
    }


def run(count: int = 20) -> dict[str, float]:
    """The figures of every controller on every way."""
    return {
        f"{key}.{field}": value
        for key, drives in rows(count, tuple(contenders()), tuple(tracks(SPEED_M_S)))
        for field, value in figures_of(drives).items()
    } | starts(count)


ON_THE_LINE_M, STAYS_S, SPARE_S, AROUND_M = 0.05, 3.0, 10.0, 1.0
STARTS_RATE_HZ = 25.0
STARTED_WAYS = ("circle", "eight", "square")


def starts(count: int = 200, ways: tuple[str, ...] = STARTED_WAYS) -> dict[str, float]:
    """Random poses within AROUND_M of a line, the true pose given to the planner, with and without a dead band.

    Seconds from the straight way to the line, at the task's speed, to the begin of STAYS_S within ON_THE_LINE_M of it,
    driven forwards; and how many were later than SPARE_S, or went along the line backwards.
    """
    figures: dict[str, float] = {}
    for way in ways:
        for dead_rad_s in (0.0, 0.8):
            robot = ForeignRobot(*NOMINAL, dead_rad_s=dead_rad_s)
            track = tracks(SPEED_M_S)[way]
            planner = Disco(
                model(robot, True), track.task, DiscoSettings.for_speed(SPEED_M_S, STARTS_RATE_HZ), LIMITS, 1
            )
            found = [_arrival_s(planner, robot, track, seed) for seed in range(count)]
            delay_s = np.array([delay_s for delay_s, _ in found])
            figures |= {
                f"starts.{way}.dead_{dead_rad_s:g}.late_median_s": float(np.median(delay_s)),
                f"starts.{way}.dead_{dead_rad_s:g}.late_worst_s": float(delay_s.max()),
                f"starts.{way}.dead_{dead_rad_s:g}.lost": float((delay_s > SPARE_S).sum()),
                f"starts.{way}.dead_{dead_rad_s:g}.backwards": float(sum(backwards for _, backwards in found)),
            }
    return figures


def _arrival_s(planner: Disco, robot: ForeignRobot, track: Track, seed: int) -> tuple[float, bool]:
    """Seconds beyond the straight way to the line, at most twice SPARE_S; whether it went along the line backwards."""
    rng = np.random.default_rng([seed, 99])
    low, high = track.points_m.min(axis=0) - AROUND_M, track.points_m.max(axis=0) + AROUND_M
    x_m, y_m = rng.uniform(low, high).tolist()
    plant = ForeignPlant(robot, (x_m, y_m, float(rng.uniform(-math.pi, math.pi))), seed)
    way_s = abs(float(track.course.off_m(np.array([[x_m, y_m]]))[0])) / SPEED_M_S
    planner.reset()
    period_ms = round(1e3 / STARTS_RATE_HZ)
    sent: list[SentCommand] = []
    off_m: list[float] = []
    forward_m_s: list[float] = []
    stays = round(STAYS_S * STARTS_RATE_HZ)
    while plant.now_ms < 1e3 * (way_s + 2.0 * SPARE_S + STAYS_S):
        left, right = plant.wheels_rad_s
        state = PlannerState(plant.now_ns, *plant.pose, left, right, sent=tuple(sent[-50:]))
        command = planner.plan(plant.now_ns, state).at(plant.now_ns)
        sent.append(SentCommand(plant.now_ns, *command))
        plant.advance(*command, period_ms)
        off_m.append(abs(float(track.course.off_m(np.array([plant.pose[:2]]))[0])))
        forward_m_s.append(plant.forward_m_s)
        if len(off_m) >= stays and max(off_m[-stays:]) < ON_THE_LINE_M:
            speed_m_s = float(np.mean(forward_m_s[-stays:]))
            if abs(speed_m_s) > 0.5 * SPEED_M_S:
                return plant.now_ms * 1e-3 - STAYS_S - way_s, speed_m_s < 0.0
    return 2.0 * SPARE_S, False


def main(arguments: list[str]) -> None:
    """Print figures as they are found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("names", nargs="?", default=",".join(contenders()), help="contenders, or `starts COUNT [WAYS]`")
    parser.add_argument("ways", nargs="?", default=",".join(tracks(SPEED_M_S)))
    parser.add_argument("robots", nargs="?", default="", help="robots of each row, 6 unless said")
    parser.add_argument("--count", type=int, help="the same")
    parser.add_argument("--first", type=int, default=FIRST, help="the first robot's number")
    parser.add_argument("--speeds", default=str(SPEED_M_S), help="speeds of the tracks (m/s), comma-separated")
    parser.add_argument("--slope", type=float, default=0.0, help="how fast the ground carries the robots (m/s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object of all figures at the end")
    options = parser.parse_args(arguments)
    if options.names == "starts":
        for way in options.robots.split(",") if options.robots else STARTED_WAYS:
            for key, value in starts(int(options.ways), (way,)).items():
                print(f"{key:60} {value:10.3g}", flush=True)
        return
    names, ways = options.names.split(","), options.ways.split(",")
    if options.slope and any(name.startswith(MUJOCO) for name in names):
        parser.error("--slope: the robot in MuJoCo stands on level ground")
    count = options.count or int(options.robots or 6)
    figures: dict[str, float] = {}
    for speed in options.speeds.split(","):
        for key, drives in rows(count, tuple(names), tuple(ways), options.first, float(speed), options.slope):
            found = figures_of(drives)
            named = f"{key}.{float(speed):g}"
            figures |= {f"{named}.{field}": value for field, value in found.items()}
            if not options.json:
                print(f"{named:45}", *(f"{field} {value:.3g} " for field, value in found.items()), flush=True)
    if options.json:
        print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main(sys.argv[1:])
