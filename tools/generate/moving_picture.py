"""Animated SVGs from real drives, where no code may run.

    python -m tools.generate.moving_picture LOG -o FILE.svg
    python -m tools.generate.moving_picture --hide deadband=0.8 -o FILE.svg

The first draws the task's circle, the way that was estimated, drawn as it was driven, and the robot on it. The second
is the experiment `gap` with this effect hidden: the robot on its circle with the model as given and the one amended,
and the gap of either below.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np

from disco_hw.experiments.gap import GapExperimentOptions, GapExperimentResult, run_gap_experiment
from disco_hw.log.reader import open_log
from disco_hw.runtime.robot_setup import setup_of_log
from disco_hw.tasks.circle import CircleTask, circle_task

WIDTH = 420
POINTS = 240
SPEED_UP = 4.0
_SHIPPED = Path("disco_hw/robots/wombot.toml")
_DRIVEN, _ROBOT = "#d1495b", "#2a6f97"
_REACH = 1.35
"""What a picture shows each way from the centre of the circle, in radii."""
_STAGES = {"nominal": "model as given", "refitted": "geometry learnt", "amended": "with what was found"}


def on_its_circle(task: CircleTask, way: np.ndarray, seconds: float, width: float) -> str:
    """The circle, the way, which is drawn as it is driven, and the robot on it: a square group from the origin.

    `way`: (N, 3), x and y (m) and yaw (rad) of equal spans of time. `seconds`: until it begins anew.
    """
    reach_m = _REACH * task.radius_m
    scale = width / (2.0 * reach_m)

    def at(x_m: float, y_m: float) -> tuple[float, float]:
        return (x_m - task.center_x_m + reach_m) * scale, (task.center_y_m + reach_m - y_m) * scale

    rows = way[:: max(1, len(way) // POINTS)]
    places = [at(float(x_m), float(y_m)) for x_m, y_m, _ in rows]
    turns = np.unwrap(rows[:, 2])
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    length = sum(math.dist(a, b) for a, b in pairwise(places))
    moves = ";".join(f"{x:.1f},{y:.1f}" for x, y in places)
    spins = ";".join(f"{-math.degrees(turn):.0f}" for turn in turns)
    middle = at(task.center_x_m, task.center_y_m)
    forever = f'dur="{seconds:.1f}s" repeatCount="indefinite"'
    radius = task.radius_m * scale
    return f"""<circle cx="{middle[0]:.1f}" cy="{middle[1]:.1f}" r="{radius:.1f}" fill="none" stroke="#bbb"/>
<polyline points="{line}" fill="none" stroke="{_DRIVEN}" stroke-width="2" stroke-dasharray="{length:.0f}">
<animate attributeName="stroke-dashoffset" from="{length:.0f}" to="0" {forever}/></polyline>
<g><animateTransform attributeName="transform" type="translate" values="{moves}" {forever}/>
<g><animateTransform attributeName="transform" type="rotate" values="{spins}" {forever}/>
<rect x="-14" y="-10" width="28" height="20" rx="3" fill="{_ROBOT}"/>
<path d="M14 0 L4 -6 L4 6 Z" fill="#fff"/></g></g>"""


def animated(log_file: Path) -> str:
    """The SVG's text, self-contained, some tens of kilobytes."""
    with open_log(log_file) as log:
        task = circle_task(setup_of_log(log, "give the log of a drive").config.task, "the picture")
        estimate, command = log.columns("/estimate"), log.columns("/command")
    driven = np.isin(command["t_ns"], command["t_ns"][command["in_force"].astype(bool)])
    began, ended = command["t_ns"][driven][0], command["t_ns"][driven][-1]
    during = (estimate["t_ns"] >= began) & (estimate["t_ns"] <= ended)
    way = np.column_stack([estimate[name][during] for name in ("x_m", "y_m", "yaw_rad")])
    seconds = float(ended - began) * 1e-9 / SPEED_UP
    return f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {WIDTH}" width="{WIDTH}" height="{WIDTH}">
<title>The virtual robot on the circle of {task.radius_m} m at {task.speed_m_s} m/s, {SPEED_UP:g} times as fast</title>
<rect width="100%" height="100%" fill="#fff"/>
{on_its_circle(task, way, seconds, WIDTH)}
</svg>
"""


def closed(result: GapExperimentResult) -> str:
    """Return the SVG's text of the robot on its circle before and after.

    True ways side by side; below, the gaps.
    """
    half, foot = 360, 150
    panels, task = [], result.task
    names = {"given": "with the model as given", "amended": f"with {_found(result)}"}
    for place, (run, name) in enumerate(names.items()):
        track, lap = result.tracks[run], result.laps[run]
        way = np.column_stack([track.x_m, track.y_m, track.yaw_rad])
        seconds = float(track.t_s[-1] - track.t_s[0]) / SPEED_UP
        panels.append(
            f'<g transform="translate({half * place} 0)"><text x="{half // 2}" y="20">{name}</text>'
            f'<text x="{half // 2}" y="{half // 2 + 5}">{1e3 * lap.rms_distance_m:.0f} mm off, '
            f"speed {lap.rms_speed_error_m_s:.3f} m/s off</text>{on_its_circle(task, way, seconds, half)}</g>"
        )
    gaps = {stage: result.report.at_horizon(stage).position_m for stage in _STAGES}
    room = (2 * half - 330) / max(gaps.values())
    bars = []
    for place, (stage, gap_m) in enumerate(gaps.items()):
        top, long = half + 36 + 32 * place, gap_m * room
        bars.append(
            f'<text x="200" y="{top + 16}" text-anchor="end">{_STAGES[stage]}</text>'
            f'<rect x="210" y="{top}" width="{long:.1f}" height="22" fill="{_ROBOT}">'
            f'<animate attributeName="width" values="0;{long:.1f};{long:.1f}" keyTimes="0;0.15;1" dur="8s" '
            f'repeatCount="indefinite"/></rect><text x="{216 + long:.0f}" y="{top + 16}" text-anchor="start">'
            f"{1e3 * gap_m:.0f} mm</text>"
        )
    ahead = f"{result.report.horizon_s:g} s ahead"
    hidden = ", ".join(f"{name} {values[0]:g}" for name, values in result.hidden.items())
    width, height = 2 * half, half + foot
    return f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}"
 font-family="sans-serif" font-size="14" text-anchor="middle">
<title>The virtual robot with a hidden {hidden}, on its circle before and after; {SPEED_UP:g} times as fast</title>
<rect width="100%" height="100%" fill="#fff"/>
{"".join(panels)}
<text x="{half}" y="{half + 18}">the gap: how far the robot is from where its model expects it, {ahead}</text>
{"".join(bars)}
</svg>
"""


def _found(result: GapExperimentResult) -> str:
    return ", ".join(
        f"{effect.name.replace('_', ' ')} {' '.join(f'{one.value:.2f}' for one in effect.parameters.values())}"
        for effect in result.report.effects
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path, nargs="?")
    parser.add_argument("--hide", metavar="EFFECT=VALUE")
    parser.add_argument("-o", "--out", type=Path, required=True)
    arguments = parser.parse_args()
    if (arguments.log is None) == (arguments.hide is None):
        parser.error("give a LOG, or --hide EFFECT=VALUE")
    if arguments.hide is None:
        text = animated(arguments.log)
    else:
        with tempfile.TemporaryDirectory() as directory:
            options = GapExperimentOptions(_SHIPPED, (arguments.hide,), Path(directory), laps=1.0)
            text = closed(run_gap_experiment(options, print))
    arguments.out.write_text(text, encoding="utf-8")
    print(arguments.out)


if __name__ == "__main__":
    main()
