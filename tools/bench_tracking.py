"""Comparison of classical followers and DISCO on a line, on foreign robots whose parameters are wrong.

Wheel radius, axle and x_icr of every robot are off by up to 15 %, and nobody is told; the motors' lag and dead band are
known to all. From rest on the line; figures are of 5 to 30 s, at 50 plans a second. The gains of the classical ones
were found on robots 0 to 4 (`docs/results.md`); these are robots 1000 on, or others with `--first`.
Names that begin with `mujoco_` drive the robot of `tools/mujoco_plant.py`, those with `turned_` the same robots with
their back as their front (`turned_robot`), as the MPC drives them. Ways that begin with `timed_` are
way-points by time, of which the distance from the line is shown. With `--slope 0.03` the ground carries the moving
robots of `tools/foreign_plant.py` by so much (m/s).

`python -m tools.bench_tracking disco_adapting circle,square 20` drives some of it.
`... --first 5000 --count 20` drives robots that nothing was chosen on; `--speeds 0.1,0.2,0.3` at these speeds (m/s),
and `--json` prints the figures as JSON. `nmpc` is a textbook nonlinear MPC (`tools/nmpc.py`, of [bench]). `forward` is
the part of the time in which a robot moves forward: nothing in the cost of that MPC asks for it. `nmpc_forward` is the
same MPC, which may not drive backwards.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from disco_hw.control import DiscoSettings
from disco_hw.control.baselines import Kanayama, LinearQuadratic, PurePursuit
from disco_hw.runtime.pipeline import Planner
from tools.foreign_plant import ForeignPlant, ForeignRobot, robots, turned_robot
from tools.mujoco_plant import mujoco_plant, mujoco_robots
from tools.nmpc import NonlinearMpc
from tools.tracking import Contender, Drive, Track, classical, disco, drive, timed, tracks

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
    }


def main(arguments: list[str]) -> None:
    """Print figures as they are found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("names", nargs="?", default=",".join(contenders()), help="contenders")
    parser.add_argument("ways", nargs="?", default=",".join(tracks(SPEED_M_S)))
    parser.add_argument("robots", nargs="?", default="", help="robots of each row, 6 unless said")
    parser.add_argument("--count", type=int, help="the same")
    parser.add_argument("--first", type=int, default=FIRST, help="the first robot's number")
    parser.add_argument("--speeds", default=str(SPEED_M_S), help="speeds of the tracks (m/s), comma-separated")
    parser.add_argument("--slope", type=float, default=0.0, help="how fast the ground carries the robots (m/s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object of all figures at the end")
    options = parser.parse_args(arguments)
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
