"""`python -m tools.moving_picture LOG -o FILE.svg`: the drive of a log as an animated SVG, where no code may run.

The task's circle, the way that was estimated, drawn as it was driven, and the robot on it.
"""

from __future__ import annotations

import argparse
import math
from itertools import pairwise
from pathlib import Path

import numpy as np

from disco_hw.log.reader import open_log
from disco_hw.runtime.robot_setup import setup_of_log
from disco_hw.tasks.circle import circle_task

WIDTH = 420
POINTS = 240
SPEED_UP = 4.0


def animated(log_file: Path) -> str:
    """The SVG's text, self-contained, some tens of kilobytes."""
    with open_log(log_file) as log:
        task = circle_task(setup_of_log(log, "give the log of a drive").config.task, "the picture")
        estimate, command = log.columns("/estimate"), log.columns("/command")
    driven = np.isin(command["t_ns"], command["t_ns"][command["in_force"].astype(bool)])
    began, ended = command["t_ns"][driven][0], command["t_ns"][driven][-1]
    during = (estimate["t_ns"] >= began) & (estimate["t_ns"] <= ended)
    rows = np.flatnonzero(during)[:: max(1, int(np.count_nonzero(during) / POINTS))]
    reach_m = 1.35 * task.radius_m
    scale = WIDTH / (2.0 * reach_m)

    def at(x_m: float, y_m: float) -> tuple[float, float]:
        return (x_m - task.center_x_m + reach_m) * scale, (task.center_y_m + reach_m - y_m) * scale

    places = [at(float(estimate["x_m"][k]), float(estimate["y_m"][k])) for k in rows]
    turns = np.unwrap([float(estimate["yaw_rad"][k]) for k in rows])
    seconds = float(ended - began) * 1e-9 / SPEED_UP
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    length = sum(math.dist(a, b) for a, b in pairwise(places))
    moves = ";".join(f"{x:.1f},{y:.1f}" for x, y in places)
    spins = ";".join(f"{-math.degrees(turn):.0f}" for turn in turns)
    middle = at(task.center_x_m, task.center_y_m)
    forever = f'dur="{seconds:.1f}s" repeatCount="indefinite"'
    return f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {WIDTH}" width="{WIDTH}" height="{WIDTH}">
<title>The virtual robot on the circle of {task.radius_m} m at {task.speed_m_s} m/s, {SPEED_UP:g} times as fast</title>
<rect width="100%" height="100%" fill="#fff"/>
<circle cx="{middle[0]:.1f}" cy="{middle[1]:.1f}" r="{task.radius_m * scale:.1f}" fill="none" stroke="#bbb"/>
<polyline points="{line}" fill="none" stroke="#d1495b" stroke-width="2" stroke-dasharray="{length:.0f}">
<animate attributeName="stroke-dashoffset" from="{length:.0f}" to="0" {forever}/></polyline>
<g><animateTransform attributeName="transform" type="translate" values="{moves}" {forever}/>
<g><animateTransform attributeName="transform" type="rotate" values="{spins}" {forever}/>
<rect x="-14" y="-10" width="28" height="20" rx="3" fill="#2a6f97"/><path d="M14 0 L4 -6 L4 6 Z" fill="#fff"/></g></g>
</svg>
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    arguments = parser.parse_args()
    arguments.out.write_text(animated(arguments.log), encoding="utf-8")
    print(arguments.out)


if __name__ == "__main__":
    main()
