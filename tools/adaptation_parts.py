"""`python -m tools.adaptation_parts SEEDS FILE.json`: what each part of adaptation is good for.

Each part is switched off in turn, here and not in the product, and the same drives are made again: steps of a length
by 15 % on two floors, drifts, nothing at all on two floors, wrong, rare, noisy and understated poses, a robot that is
carried; and DISCO on the eight after a step. `only=PART,PART` before SEEDS measures these parts alone, and
`python -m tools.adaptation_parts table FILE.json` prints what a file holds as a table in Markdown.

`python -m tools.adaptation_parts poses SEEDS`: what is learnt from poses of any quality, of robots up to 15 % unlike
their model, and of robots that a narrow belief describes rightly.
`... drives SEEDS`: DISCO on slopes, and with poor poses.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from disco_hw.adaptation import fast, geometry_filter
from drivers.types import Readings
from tools import tracking
from tools.bench.adapt import CHANGE_S, LENGTHS, SCENARIOS, Estimated, Scenario, estimate
from tools.bench_tracking import contenders
from tools.foreign_plant import NOMINAL, ForeignPlant, ForeignRobot, robots
from tools.tracking import drive, tracks

SPEED_M_S, WAY = 0.2, "eight"
TRACKING_CHANGE_S, TRACKING_SETTLED_S, TRACKING_S = 12.0, 2.0, 34.0
FACTORS = (1.15, 0.85)
SLIPPERY = {"grip_std": 0.08, "push_n": 160.0}

_FILTER = geometry_filter
_FILTER_CLASS = geometry_filter.GeometryFilter


def _off(target: object, **values: object) -> list[tuple[object, str, object]]:
    return [(target, name, value) for name, value in values.items()]


PARTS: dict[str, list[tuple[object, str, object]]] = {
    "nothing": [],
    "adaptation": _off(fast.FastAdaptation, feed=lambda self, now_ns, readings: None),
    "alternatives": _off(_FILTER_CLASS, _add_hypotheses=lambda self: setattr(self, "_moved_s", 0.0)),
    "alternatives of one length": _off(_FILTER, KINDS=np.array([(1.0, 1.0, 1.0)])),
    "alternative of all lengths": _off(_FILTER, KINDS=_FILTER.KINDS[1:]),
    "limit of what one pose decides": _off(_FILTER, MOST_BY_A_POSE=1e9),
    "robot that was carried": _off(_FILTER, CARRIED_M=1e9, CARRIED_RAD=1e9),
    "slip of the wheels": _off(_FILTER, SLIP_STD=1e-6),
    "lag of the pose": _off(_FILTER, LAG_S=0.0, LAG_STD_S=1e-9),
    "estimate of the lag": _off(_FILTER, LAG_STD_S=1e-9),
    "sliding into a turn": _off(_FILTER, _SLIDING_S=1e-4, _SLIDING_STD_S=0.0),
    "noise of that sliding": _off(_FILTER, _SLIDING_STD_S=0.0),
    "rougher to the side": _off(_FILTER, _ASIDE_M=_FILTER._ROUGH_M),
    "rough ground": _off(_FILTER, _ROUGH_M=0.0, _ASIDE_M=0.0, _ROUGH_RAD=0.0),
    "random walk of the lengths": _off(_FILTER, DRIFT_PER_SQRT_M=0.0, DRIFT_PER_SQRT_RAD=0.0),
    "least standard deviation": _off(_FILTER, LEAST_STD=1e-9),
    "scale by innovations": _off(_FILTER_CLASS, _variance_scale=1.0),
    "scale by single innovations": _off(
        _FILTER_CLASS, _variance_scale=property(lambda self: max(self._run_innovation_ratio**2, 1.0))
    ),
    "scale by sums of innovations": _off(_FILTER, LARGEST_RUN=0.0),
    "one arc for 45 ms": _off(_FILTER, _STRIDE_S=0.0),
    "poses worse than 30 mm left out": _off(_FILTER, WORST_POSE_STD_M=1e9),
    "check before it takes effect": _off(fast, geometry_fault=lambda geometry, low, high: ""),
    "only significant changes": _off(fast, SIGNIFICANT_STD=0.0),
    "first ten poses": _off(fast, LEAST_POSES=0),
}
"""What is replaced to switch a part off: in which object, by name, with what."""


@contextmanager
def switched_off(part: str) -> Iterator[None]:
    """Adaptation without this part of `PARTS`."""
    patches = [patch.object(target, name, value) for target, name, value in PARTS[part]]
    for one in patches:
        one.start()
    try:
        yield
    finally:
        for one in reversed(patches):
            one.stop()


def _stepped(index: int, factor: float, floor: Mapping[str, float]) -> Scenario:
    """A step of one length on a floor that stays."""

    def changed(robot: ForeignRobot, seconds: float) -> ForeignRobot:
        return replace(robot, **{LENGTHS[index]: NOMINAL[index] * (factor if seconds >= CHANGE_S else 1.0)})

    return Scenario(lambda seed: ForeignRobot(*NOMINAL, **floor), changed, step=(index, factor))  # type: ignore[arg-type]


def _drifting(index: int, rate: float) -> Scenario:
    def changed(robot: ForeignRobot, seconds: float) -> ForeignRobot:
        return replace(robot, **{LENGTHS[index]: NOMINAL[index] * (1.0 + rate * min(seconds / 60.0, 1.0))})

    return Scenario(changed=changed, duration_s=70.0, evaluated_s=40.0)


CHANGED = {
    f"{LENGTHS[index]} {100 * (factor - 1):+.0f} % on a {name} floor": _stepped(index, factor, floor)
    for name, floor in (("firm", {}), ("slippery", SLIPPERY))
    for index in range(3)
    for factor in FACTORS
}
DRIFTING = {f"{LENGTHS[index]} drifts": _drifting(index, -0.05) for index in range(3)}
UNCHANGED = {
    name: Scenario(lambda seed, floor=floor: ForeignRobot(*NOMINAL, **floor), duration_s=60.0, evaluated_s=40.0)  # type: ignore[misc,arg-type]
    for name, floor in (("firm floor", {}), ("slippery floor", SLIPPERY), ("rough floor", {"grip_std": 0.08}))
}
POSES = {
    "5 Hz, 10 mm": SCENARIOS["poses 5 Hz, 10 mm"],
    "2 Hz, 25 mm": SCENARIOS["poses 2 Hz, 25 mm"],
    "one of 40 is 0.1 m off": Scenario(wrong=(40, 0.1), duration_s=60.0, evaluated_s=40.0),
    "one of 40 is 1 m off": Scenario(wrong=(40, 1.0), duration_s=60.0, evaluated_s=40.0),
    "noise of 20 mm, a quarter of it stated": Scenario(
        poses=(1, 0.02, 0.02), stated=0.25, duration_s=60.0, evaluated_s=40.0
    ),
    "noise of 50 mm": Scenario(poses=(1, 0.05, 0.03), duration_s=60.0, evaluated_s=40.0),
}
CARRIED = {"carried": Scenario(carried_s=20.0, duration_s=45.0, evaluated_s=15.0)}
GROUPS = {"changed": CHANGED, "drift": DRIFTING, "unchanged": UNCHANGED, "poses": POSES, "carried": CARRIED}


class ChangingPlant:
    """A foreign robot, one of whose lengths changes by a factor at TRACKING_CHANGE_S."""

    def __init__(self, robot: ForeignRobot, start: tuple[float, float, float], seed: int) -> None:
        self._plant = ForeignPlant(robot, start, seed)
        index, factor = seed % 3, FACTORS[seed // 3 % 2]
        self._changed = replace(robot, **{LENGTHS[index]: NOMINAL[index] * factor})

    @property
    def now_ms(self) -> int:
        """Time of the plant, ms."""
        return self._plant.now_ms

    @property
    def now_ns(self) -> int:
        """Time of the plant, ns."""
        return self._plant.now_ns

    @property
    def pose(self) -> tuple[float, float, float]:
        """True pose: x, y (m), yaw (rad)."""
        return self._plant.pose

    @property
    def forward_m_s(self) -> float:
        """True speed along the body."""
        return self._plant.forward_m_s

    def readings(self) -> Readings:
        """Return the sensors' samples at this time."""
        return self._plant.readings()

    def advance(self, left_rad_s: float, right_rad_s: float, count: int, /) -> None:
        """Hold these wheel speeds for `count` milliseconds."""
        if self._plant.now_ms >= 1e3 * TRACKING_CHANGE_S and self._plant.robot is not self._changed:
            other = ForeignPlant(self._changed, self._plant.pose, 1)
            self._plant.robot, self._plant._numbers = other.robot, other._numbers
        self._plant.advance(left_rad_s, right_rad_s, count)


def tracked_mm(seed: int, name: str = "disco_adapting") -> float:
    """RMS distance from the line (mm) of DISCO from 2 s after a step of one length by 15 % on."""
    contender = contenders(SPEED_M_S)[name]
    driven = drive(
        contender, ForeignRobot(*NOMINAL), tracks(SPEED_M_S)[WAY], duration_s=TRACKING_S, seed=seed,
        plant_of=ChangingPlant,
    )  # fmt: skip
    return driven.after(TRACKING_CHANGE_S + TRACKING_SETTLED_S).rms_mm


def measure(part: str, seeds: int) -> dict[str, Any]:
    """Every drive without one part: by group and scenario, a list over the seeds."""
    found: dict[str, Any] = {}
    with switched_off(part):
        for group, scenarios in GROUPS.items():
            for name, scenario in scenarios.items():
                found[f"{group}: {name}"] = [_as_lists(estimate(scenario, seed)) for seed in range(seeds)]
        found["tracking"] = [tracked_mm(seed) for seed in range(6 * math.ceil(seeds / 6))]
    return found


def _as_lists(one: Estimated) -> dict[str, Any]:
    return {
        "error": one.error.tolist(),
        "held": one.coverage.tolist(),
        "known_s": min(one.known_s, 30.0),
        "changes": one.changes,
    }


def figures(found: Mapping[str, Any]) -> dict[str, float]:
    """Means over the drives of one part: errors (root mean square of three lengths, %), seconds, false changes, mm."""
    rows: dict[str, float] = {}
    for group in GROUPS:
        runs = [one for name, many in found.items() if name.startswith(f"{group}: ") for one in many]
        rows[f"{group}_error_percent"] = float(np.mean([_size(one) for one in runs]))
        rows[f"{group}_held_percent"] = 100.0 * float(np.mean([one["held"] for one in runs]))
        rows[f"{group}_changes"] = float(sum(one["changes"] for one in runs))
        if group == "changed":
            known = [one["known_s"] for one in runs]
            rows["known_median_s"], rows["known_p90_s"] = map(float, np.percentile(known, (50.0, 90.0)))
    rows["tracking_mm"] = float(np.mean(found["tracking"]))
    return rows


def _size(one: Mapping[str, Any]) -> float:
    return 100.0 * float(np.sqrt(np.mean(np.square(one["error"]))))


POSE_QUALITIES: dict[str, tuple[tuple[int, float, float], float, float]] = {
    "25 Hz, 3 mm": ((1, 0.0, 0.0), 1.0, 0.02),
    "5 Hz, 20 mm, 0.02 rad": ((5, 0.02, 0.02), 1.0, 0.02),
    "2 Hz, 10 mm, 0.01 rad": ((12, 0.01, 0.01), 1.0, 0.02),
    "1 Hz, 10 mm, 0.01 rad": ((25, 0.01, 0.01), 1.0, 0.02),
    "25 Hz, 20 mm, a quarter of it stated": ((1, 0.02, 0.02), 0.25, 0.02),
    "25 Hz, 50 mm, 0.05 rad, a tenth of it stated": ((1, 0.05, 0.05), 0.1, 0.02),
    "5 Hz, 50 mm, 0.05 rad, a tenth of it stated": ((5, 0.05, 0.05), 0.1, 0.02),
    "0.5 s late": ((1, 0.0, 0.0), 1.0, 0.5),
    "1 s late": ((1, 0.0, 0.0), 1.0, 1.0),
}
"""Every how many-th pose comes and the noise added to it, the stated part of that, and how late poses are (s)."""


def poses(seeds: int) -> str:
    """Markdown: for each quality of the poses the error without and with adaptation, and false changes."""
    lines = ["| poses | unlike its model | with adaptation | rightly known | false changes |", "|---|---|---|---|---|"]
    for name, (quality, stated, late_s) in POSE_QUALITIES.items():
        found: dict[str, list[Estimated]] = {}
        for kind, spread in (("unlike", 0.15), ("right", 0.0)):
            scenario = Scenario(
                lambda seed, spread=spread, late_s=late_s: robots(8000 + seed, 1, spread, pose_delay_s=late_s)[0],  # type: ignore[misc]
                narrow=kind == "right",
                poses=quality,
                stated=stated,
                duration_s=60.0,
                evaluated_s=30.0,
            )
            found[kind] = [estimate(scenario, seed) for seed in range(seeds)]
            if kind == "unlike":
                with switched_off("adaptation"):
                    found["without"] = [estimate(scenario, seed) for seed in range(seeds)]
        errors = {kind: [_size(_as_lists(one)) for one in many] for kind, many in found.items()}
        cells = [f"{np.mean(errors[kind]):.1f} % ({max(errors[kind]):.1f})" for kind in ("without", "unlike", "right")]
        changes = sum(one.changes for kind in ("unlike", "right") for one in found[kind])
        lines.append(f"| {name} | {' | '.join(cells)} | {changes} |")
    return "\n".join(lines)


def drives(seeds: int) -> str:
    """Mean RMS distance (mm) of DISCO on the eight on unlike robots.

    On a slope, with `disturbance = true`, where the filter may and may not expect that the ground carries the robot;
    and with poses of 20 mm, 0.02 rad, and of 25 mm, 0.05 rad, with and without adaptation.
    """
    lines, learner = [], tracking._learner
    for slope_m_s in (0.0, 0.02):
        for drifts in (True, False):
            with patch.object(tracking, "_learner", lambda robot, line, _, drifts=drifts: learner(robot, line, drifts)):
                rms_mm = _driven_mm("disco_offset_free", seeds, slope_m_s=slope_m_s)
            lines.append(f"slope {slope_m_s} m/s, {'expected' if drifts else 'not expected'}: {rms_mm:.2f} mm")
    for noise in ({"pose_std_m": 0.02, "yaw_std_rad": 0.02}, {"pose_std_m": 0.025, "yaw_std_rad": 0.05}):
        for name in ("disco_adapting", "disco_ut"):
            lines.append(f"{noise}, {name}: {_driven_mm(name, seeds, **noise):.2f} mm")
    return "\n".join(lines)


def _driven_mm(name: str, seeds: int, **changes: float) -> float:
    contender, way = contenders(SPEED_M_S)[name], tracks(SPEED_M_S)[WAY]
    found = enumerate(robots(8000, seeds, **changes))
    return float(np.mean([drive(contender, robot, way, seed=seed).after().rms_mm for seed, robot in found]))


COLUMNS: dict[str, Callable[[dict[str, float]], str]] = {
    "step: error, %": lambda row: f"{row['changed_error_percent']:.2f}",
    "80 % known after, median / p90, s": lambda row: f"{row['known_median_s']:.1f} / {row['known_p90_s']:.1f}",
    "drift: error, %": lambda row: f"{row['drift_error_percent']:.2f}",
    "false changes": lambda row: f"{row['unchanged_changes']:.0f}",
    "bad poses: error, %; false changes": lambda row: f"{row['poses_error_percent']:.2f}; {row['poses_changes']:.0f}",
    "carried: error, %": lambda row: f"{row['carried_error_percent']:.2f}",
    "held, %": lambda row: f"{(row['changed_held_percent'] + row['unchanged_held_percent']) / 2.0:.0f}",
    "DISCO, mm": lambda row: f"{row['tracking_mm']:.2f}",
}


def table(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Markdown: a row for each part."""
    lines = [f"| without | {' | '.join(COLUMNS)} |", f"|---{'|---' * len(COLUMNS)}|"]
    for part, drives in found.items():
        row = figures(drives)
        lines.append(f"| {part} | {' | '.join(text(row) for text in COLUMNS.values())} |")
    return "\n".join(lines)


def main(arguments: list[str]) -> None:
    """Measure into a file, part by part, or print the table of one."""
    if arguments[0] in {"poses", "drives"}:
        print({"poses": poses, "drives": drives}[arguments[0]](int(arguments[1])))
        return
    names = list(PARTS)
    if arguments[0].startswith("only="):
        names = arguments.pop(0).removeprefix("only=").split(",")
    file = Path(arguments[1])
    found = json.loads(file.read_text("utf-8")) if file.exists() else {}
    if arguments[0] != "table":
        for part in names:
            found[part] = measure(part, int(arguments[0]))
            file.write_text(json.dumps(found), "utf-8")
            print(part, figures(found[part]), flush=True)
    print(table(found))


if __name__ == "__main__":
    main(sys.argv[1:])
